"""Reads Modelica: flat texts in Base Modelica (Modelica Change Proposal MCP-0031), and the sources of libraries.

A recursive descent over a list of tokens, one method for each rule of the grammar; operators by precedence climbing.
Annotations are passed over, but for that of a model, which says how to run it.
"""

import re
from collections.abc import Iterator
from typing import NoReturn

from ..base.errors import ModelError
from . import tree

_TOKEN = re.compile(
    r"""(?:\s+|//[^\n]*|/\*.*?\*/)*
    (?: (?P<string>"(?:[^"\\]|\\.)*") | (?P<quoted>'(?:[^'\\]|\\.)*') | (?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)
      | (?P<word>[A-Za-z_]\w*) | (?P<sign>:=|<=|>=|==|<>|\.[+*/^-]|[-+*/^<>=(){}\[\],;:.]) | (?P<stop>\Z) )""",
    re.X | re.S,
)
_LEVEL = {  # binary operators, and how strongly they bind
    "or": 1, "and": 2, "<": 4, "<=": 4, ">": 4, ">=": 4, "==": 4, "<>": 4,
    "+": 5, "-": 5, ".+": 5, ".-": 5, "*": 6, "/": 6, ".*": 6, "./": 6, "^": 7, ".^": 7,
}  # fmt: skip
_NOT, _SUM, _POWER = 3, 5, 7
FUNCTION = "function"  # marks an argument that is a function of which some arguments are given
INSIDE = "[\\'"  # a quoted name with names in its subscripts
_QUOTED = r"'(?:[^'\\]|\\.)*'"
_PART = re.compile(rf"([^\[\]]+)(?:\[((?:{_QUOTED}|\[(?:{_QUOTED}|[^\[\]'])*\]|[^\[\]'])*)\])?\.?")
PREFIXES = frozenset(
    "parameter constant discrete input output final flow stream inner outer each protected public redeclare "
    "replaceable".split()
)
CLASSES = ("model", "record", "function", "type", "package", "class", "block", "connector")
BEFORE_CLASS = frozenset(
    "redeclare replaceable final partial encapsulated inner outer pure impure operator expandable".split()
)
BEFORE_MODIFIER = frozenset({"final", "each", "redeclare", "replaceable"})
SECTION_ENDS = ("end", "equation", "algorithm", "initial", "external", "protected", "public", "annotation")


def read_base(text: str) -> tree.Class:
    """The outermost class of a Base Modelica text: a package that holds functions, types and the model.

    **Raises:**

    - `ModelError` for what is not Base Modelica, with line and column.
    """
    return Reader(text).file()


def read_modifiers(text: str) -> tree.Modifiers:
    """What stands in parentheses behind a name, such as `(StopTime = 2.0)`."""
    return Reader(text).modifiers()


def written(name: str) -> tree.Reference:
    """A quoted name with subscripts inside, such as 'x[\\'i\\'].y', as the reference x[i].y."""
    parts: list[str] = []
    subscripts: list[tuple[tree.Expression, ...]] = []
    for part, inside in _PART.findall(re.sub(r"\\(.)", r"\1", name)):
        parts.append(part)
        subscripts.append(Reader(f"[{inside}]")._subscripts() if inside else ())
    return tree.Reference(tuple(parts), tuple(subscripts))


# The names of the arguments of operators that are read by their places.
_ARGUMENTS = {
    "smooth": ("p", "expr"), "homotopy": ("actual", "simplified"), "delay": ("expr", "delayTime", "delayMax"),
    "semiLinear": ("x", "positiveSlope", "negativeSlope"), "max": ("x", "y"), "min": ("x", "y"),
    "sample": ("start", "interval"),
}  # fmt: skip


def _call(
    function: str, arguments: tuple[tree.Expression, ...], named: tuple[tuple[str, tree.Expression], ...]
) -> tree.Call:
    """A call; named arguments of operators in their places."""
    given = dict(named)
    order = _ARGUMENTS.get(function, ())[len(arguments) :]
    if not given or not given.keys() <= set(order) or list(order[: len(given)]) != [n for n in order if n in given]:
        return tree.Call(function, arguments, named)
    return tree.Call(function, (*arguments, *(given[n] for n in order if n in given)), ())


class Reader:
    def __init__(self, text: str):
        self.text = text
        self.kinds: list[str] = []
        self.words: list[str] = []
        self.places: list[int] = []
        at, match = 0, _TOKEN.match
        while True:
            found = match(text, at)
            if found is None:
                self._fail_at(len(re.compile(r"(?:\s+|//[^\n]*)*").match(text, at).group()) + at, "unknown character")  # type: ignore[union-attr]
            kind = found.lastgroup or "stop"
            self.kinds.append(kind)
            self.words.append(found.group(kind))
            self.places.append(found.start(kind))
            if kind == "stop":
                break
            at = found.end()
        self.i = 0
        # A quoted name or a string may look like a keyword; keywords are asked for in this list.
        self.keys = [w if k in ("word", "sign") else "" for k, w in zip(self.kinds, self.words, strict=True)]
        self.lines = _Lines(text)

    # --- tokens ------------------------------------------------------------------------------------------------------

    def _fail_at(self, place: int, what: str) -> NoReturn:
        line = self.text.count("\n", 0, place) + 1
        column = place - self.text.rfind("\n", 0, place)
        shown = self.text[place : place + 40].split("\n")[0]
        raise ModelError(f"Base Modelica, line {line}, column {column}: {what}, at {shown!r}")

    def _fail(self, what: str) -> NoReturn:
        self._fail_at(self.places[self.i], what)

    def at(self, *words: str) -> bool:
        return self.keys[self.i] in words

    def take(self, *words: str) -> str:
        """Goes past one of these words, and returns it; the empty text if something else follows."""
        key = self.keys[self.i]
        if key in words:
            self.i += 1
            return key
        return ""

    def past(self, words: frozenset[str]) -> frozenset[str]:
        """Goes past all of these words that follow, and returns them."""
        first = self.i
        while self.keys[self.i] in words:
            self.i += 1
        return frozenset(self.keys[first : self.i])

    def need(self, word: str) -> None:
        if self.keys[self.i] != word:
            self._fail(f"expected '{word}'")
        self.i += 1

    def name(self) -> str:
        kind, word = self.kinds[self.i], self.words[self.i]
        if kind == "quoted":
            word = word[1:-1]
        elif kind != "word":
            self._fail("expected a name")
        self.i += 1
        return word

    def path(self) -> str:
        """Names joined by dots; a dot before them stands for the outermost package."""
        self.take(".")
        out = self.name()
        while self.take("."):
            out += "." + self.name()
        return out

    def line(self) -> int:
        return self.lines.of(self.places[self.i])

    def comment(self) -> str:
        out = ""
        while self.kinds[self.i] == "string":
            out = self.words[self.i][1:-1]
            self.i += 1
            if not self.take("+"):
                break
        return out

    def pass_parentheses(self) -> None:
        """Goes past what stands in parentheses, if anything does."""
        depth = 0
        while depth or self.at("("):
            if self.kinds[self.i] == "stop":
                self._fail("expected ')'")
            depth += {"(": 1, ")": -1}.get(self.keys[self.i], 0)
            self.i += 1

    def pass_annotation(self) -> None:
        if self.take("annotation"):
            self.pass_parentheses()

    def pass_constraint(self) -> None:
        if self.take("constrainedby"):
            self.path()
            self.pass_parentheses()

    # --- expressions -------------------------------------------------------------------------------------------------

    def expression(self) -> tree.Expression:
        if self.take("if"):
            branches = [self._branch()]
            while self.take("elseif"):
                branches.append(self._branch())
            self.need("else")
            return tree.Choice(tuple(branches), self.expression())
        first = self.operation(1)
        if not self.take(":"):
            return first
        second = self.operation(1)
        if self.take(":"):
            return tree.Range(first, second, self.operation(1))
        return tree.Range(first, tree.Number(1), second)

    def _branch(self) -> tuple[tree.Expression, tree.Expression]:
        condition = self.expression()
        self.need("then")
        return condition, self.expression()

    def operation(self, level: int) -> tree.Expression:
        """An operation whose operators bind at least as strongly as `level`."""
        if level <= _NOT and self.take("not"):
            left: tree.Expression = tree.Unary("not", self.operation(_NOT + 1))
        elif level <= _SUM + 1 and (sign := self.take("-", "+", ".-", ".+")):
            left = self.operation(_SUM + 1)  # a sign binds as weakly as a sum: -a * b is -(a * b)
            if "-" in sign:
                left = tree.Number(-left.value) if isinstance(left, tree.Number) else tree.Unary("-", left)
        else:
            left = self.primary()
        while True:
            sign = self.keys[self.i]
            strength = _LEVEL.get(sign, 0)
            if strength < level:
                return left
            self.i += 1
            left = tree.Binary(sign, left, self.primary() if strength == _POWER else self.operation(strength + 1))

    def primary(self) -> tree.Expression:
        self.take(".")  # of a name from the outermost package, such as `.Modelica.Constants.pi`
        kind, word = self.kinds[self.i], self.words[self.i]
        if kind == "number":
            self.i += 1
            return tree.Number(int(word) if word.isdigit() else float(word))
        if kind == "string":
            self.i += 1
            return tree.Text(word[1:-1])
        if kind == "sign":
            if self.take("("):
                return self._in_parentheses()
            if self.take("{"):
                return tree.Array(self._arguments("}")[0])
            if self.take("["):
                rows = [[self.expression()]]
                while sign := self.take(",", ";"):
                    if sign == ",":
                        rows[-1].append(self.expression())
                    else:
                        rows.append([self.expression()])
                self.need("]")
                return tree.Matrix(tuple(map(tuple, rows)))
            if self.take("-"):  # as in 2^-1
                return tree.Unary("-", self.primary())
            self._fail("expected an expression")
        if kind == "word":
            if word in ("true", "false"):
                self.i += 1
                return tree.Truth(word == "true")
            if word == "end":
                self.i += 1
                return tree.End()
        return self._reference()

    def _in_parentheses(self) -> tree.Expression:
        entries: list[tree.Expression | None] = []
        while not self.take(")"):
            entries.append(None if self.at(",") else self.expression())
            if not self.at(")"):
                self.need(",")
                if self.at(")"):
                    entries.append(None)
        if len(entries) == 1 and entries[0] is not None:
            return self._parts_of(entries[0])
        return tree.Several(tuple(entries))

    def _reference(self) -> tree.Expression:
        parts: list[str] = []
        subscripts: list[tuple[tree.Expression, ...]] = []
        while not parts or self.take("."):
            name = self.name()
            if INSIDE in name:
                within = written(name)
                parts.extend(within.parts)
                subscripts.extend(within.subscripts)
                if self.at("["):
                    subscripts[-1] += self._subscripts()
            else:
                parts.append(name)
                subscripts.append(self._subscripts())
        if self.take("("):
            arguments, named = self._arguments(")")
            return self._parts_of(_call(".".join(parts), arguments, named))
        return tree.Reference(tuple(parts), tuple(subscripts))

    def _parts_of(self, whole: tree.Expression) -> tree.Expression:
        while self.at("[", "."):
            whole = tree.Part(whole, self.name(), ()) if self.take(".") else tree.Part(whole, None, self._subscripts())
        return whole

    def _subscripts(self) -> tuple[tree.Expression, ...]:
        if not self.take("["):
            return ()
        out: list[tree.Expression] = []
        while not self.take("]"):
            if self.at(":") and self.keys[self.i + 1] in (",", "]"):
                self.i += 1
                out.append(tree.Whole())
            else:
                out.append(self.expression())
            if not self.at("]"):
                self.need(",")
        return tuple(out)

    def _arguments(self, end: str) -> tuple[tuple[tree.Expression, ...], tuple[tuple[str, tree.Expression], ...]]:
        arguments: list[tree.Expression] = []
        named: list[tuple[str, tree.Expression]] = []
        while not self.take(end):
            if self.kinds[self.i] in ("word", "quoted") and self.keys[self.i + 1] == "=":
                name = self.name()
                self.i += 1
                named.append((name, self._argument()))
            else:
                arguments.append(self._argument())
            if not self.at(end):
                self.need(",")
        return tuple(arguments), tuple(named)

    def _argument(self) -> tree.Expression:
        if self.take("function"):
            return tree.Call(FUNCTION, (self.expression(),), ())
        value = self.expression()
        return tree.Comprehension(value, self._iterators()) if self.take("for") else value

    def _iterators(self) -> tuple[tuple[str, tree.Expression | None], ...]:
        out = []
        while True:
            out.append((self.name(), self.expression() if self.take("in") else None))
            if not self.take(","):
                return tuple(out)

    # --- equations and statements ------------------------------------------------------------------------------------

    def statements(self, *ends: str) -> tuple[tree.Statement, ...]:
        out: list[tree.Statement] = []
        while not self.at(*ends):
            if self.at("annotation"):
                self.pass_annotation()
                self.need(";")
            else:
                out.append(self.statement())
        return tuple(out)

    def statement(self) -> tree.Statement:
        line = self.line()
        kind = self.take("if", "when", "for", "while", "return", "break")
        if kind in ("if", "when"):
            out: tree.Statement = tree.Branches(kind, self._branches(), line)
        elif kind == "for":
            iterators = self._iterators()
            self.need("loop")
            out = tree.Loop(iterators, None, self.statements("end"), line)
        elif kind == "while":
            condition = self.expression()
            self.need("loop")
            out = tree.Loop((), condition, self.statements("end"), line)
        elif kind:
            out = tree.Jump(kind, line)
        else:
            out = self._simple(line)
        if isinstance(out, tree.Branches | tree.Loop):
            self.need("end")
            self.need(kind)
        self.comment()
        self.pass_annotation()
        self.need(";")
        return out

    def _simple(self, line: int) -> tree.Statement:
        left = self.expression()
        sign = self.take("=", ":=")
        if sign:
            return (tree.Equality if sign == "=" else tree.Assignment)(left, self.expression(), line)
        if not isinstance(left, tree.Call):
            self._fail("expected '=', ':=' or a call")
        return tree.Effect(left, line)

    def _branches(self) -> tuple[tuple[tree.Expression, tuple[tree.Statement, ...]], ...]:
        out = []
        while True:
            condition = self.expression()
            self.need("then")
            out.append((condition, self.statements("end", "else", "elseif", "elsewhen")))
            if not self.take("elseif", "elsewhen"):
                break
        if self.take("else"):
            out.append((tree.Truth(True), self.statements("end")))
        return tuple(out)

    # --- declarations and classes ------------------------------------------------------------------------------------

    def modifiers(self) -> tree.Modifiers:
        """What stands in parentheses behind a name, if anything does; a redeclared class is noted as the declaration of
        what it stands for."""
        out: tree.Modifiers = {}
        ended = not self.take("(")
        while not (ended or self.take(")")):
            self.past(BEFORE_MODIFIER)
            if self.keys[self.i] in CLASSES and self.kinds[self.i + 1] == "word":
                self.i += 1
                name = self.name()
                self.need("=")
                out[name] = self._short(name)
                self.pass_constraint()
            else:
                name = self.path()
                if self.kinds[self.i] in ("word", "quoted"):  # a redeclared component with its type
                    name = self.name()
                inner = self.modifiers() if self.at("(") else None
                value = self._value()
                out[name] = value if inner is None else inner if value is None else {**inner, "=": value}
            self.comment()
            self.pass_annotation()
            if not self.at(")"):
                self.need(",")
        return out

    def _value(self) -> tree.Expression | None:
        return self.expression() if self.take("=", ":=") else None

    def declarations(self) -> Iterator[tree.Declaration]:
        """The declarations of one clause, such as `Real a, b = 1;`."""
        line, prefixes = self.line(), self.past(PREFIXES)
        kind, shared, first = self.path(), self._subscripts(), True
        while first or self.take(","):
            first = False
            name = self.name()
            dimensions = self._subscripts() + shared
            modifiers, value = self.modifiers(), self._value()
            whether: frozenset[str] = frozenset()
            if self.take("if"):
                self.expression()
                whether = frozenset({"conditional"})
            self.pass_constraint()
            comment = self.comment()
            self.pass_annotation()
            yield tree.Declaration(prefixes | whether, kind, name, dimensions, modifiers, value, comment, line)
        self.need(";")

    def file(self) -> tree.Class:
        if self.take("within"):
            while not self.take(";"):
                self.i += 1
        out = self.definition()
        self.take(";")
        if self.kinds[self.i] != "stop":
            self._fail("expected the end of the text")
        return out

    def definition(self) -> tree.Class:
        before = self.past(BEFORE_CLASS)
        kind = self.take(*CLASSES) or ("package" if "operator" in before else "")  # `operator 'constructor'`
        if not kind:
            self._fail("expected a class, such as package, model or function")
        continues = bool(self.take("extends"))
        name = self.name()
        if self.take("="):
            return self._stands_for(kind, name)
        self.pass_parentheses()  # of `redeclare function extends f(…)`
        return self._long(kind, name, continues)

    def _stands_for(self, kind: str, name: str) -> tree.Class:
        literals: list[str] = []
        alias = None
        if self.take("enumeration"):
            self.need("(")
            while not self.take(")"):
                if not self.take(":"):
                    literals.append(self.name())
                self.comment()
                self.pass_annotation()
                self.take(",")
        else:
            alias = self._short(name)
        comment = self.comment()
        self.pass_constraint()
        self.comment()
        self.pass_annotation()
        self.need(";")
        return tree.Class(kind, name, literals=tuple(literals), alias=alias, comment=comment)

    def _short(self, name: str) -> tree.Declaration:
        """What a short definition stands for."""
        line, prefixes, of = self.line(), self.past(PREFIXES), self.path()
        dimensions = self._subscripts()
        if of == "der":
            self.pass_parentheses()
        return tree.Declaration(prefixes, of, name, dimensions, self.modifiers(), None, "", line)

    def _long(self, kind: str, name: str, continues: bool) -> tree.Class:
        comment = self.comment()
        declarations: list[tree.Declaration] = []
        classes: dict[str, tree.Class] = {}
        bases: list[tuple[str, tree.Modifiers]] = []
        imports: list[tuple[str, str]] = []
        sections: dict[str, list] = {
            "equation": [], "initial equation": [], "algorithm": [], "initial algorithm": []
        }  # fmt: skip
        annotation: tree.Modifiers = {}
        external = None
        while not self.take("end"):
            if self.take("protected", "public"):
                continue
            start = "initial " if self.at("initial") and self.keys[self.i + 1] in ("equation", "algorithm") else ""
            if start:
                self.i += 1
            if section := self.take("equation", "algorithm"):
                sections[start + section].append(self.statements(*SECTION_ENDS))
            elif self.at("annotation"):
                if kind == "model":
                    self.i += 1
                    annotation = self.modifiers()
                self.pass_annotation()
                self.need(";")
            elif self.take("external"):
                external = self._external()
            elif self.take("import"):
                imports += self._imports()
            elif self.take("extends"):
                bases.append((self.path(), self.modifiers()))
                self.pass_annotation()
                self.need(";")
            elif self._begins_class():
                begin = self.i
                inner = self.definition()
                if inner.name in classes:
                    self._fail_at(self.places[begin], f"'{name}' defines the class '{inner.name}' twice")
                classes[inner.name] = inner
            else:
                declarations += self.declarations()
        self.name()
        self.need(";")
        equations, initial = (
            tuple(s for section in sections[k] for s in section) for k in ("equation", "initial equation")
        )
        return tree.Class(
            kind, name, tuple(declarations), equations, initial, tuple(sections["algorithm"]),
            tuple(sections["initial algorithm"]), classes, tuple(bases), tuple(imports), annotation, external=external,
            comment=comment, continues=continues,
        )  # fmt: skip

    def _begins_class(self) -> bool:
        i = self.i
        while self.keys[i] in BEFORE_CLASS:
            i += 1
        if self.keys[i] in CLASSES:
            return self.kinds[i + 1] in ("word", "quoted")
        return self.kinds[i] == "quoted" and i > self.i and self.keys[i - 1] == "operator"

    def _imports(self) -> list[tuple[str, str]]:
        """The pairs (local name, full name) of one clause."""
        name = self.name()
        if self.take("="):
            out = [(name, self.path())]
        else:
            out = self._imports_by_name(name)
        self.comment()
        self.need(";")
        return out

    def _imports_by_name(self, name: str) -> list[tuple[str, str]]:
        while self.take("."):
            if self.take("{"):
                names = []
                while not self.take("}"):
                    names.append(self.name())
                    self.take(",")
                return [(each, f"{name}.{each}") for each in names]
            name += "." + self.name()
        return [("*" if self.take(".*") else name.rpartition(".")[2], name)]

    def _external(self) -> str:
        """The name of the called function; its arguments are left out."""
        if self.kinds[self.i] == "string":
            self.i += 1
        called = ""
        while not self.take(";"):
            if self.keys[self.i + 1] == "(" and self.kinds[self.i] == "word" and not called:
                called = self.words[self.i]
            if self.at("annotation"):
                self.pass_annotation()
            else:
                self.i += 1
        return called


class _Lines:
    """Numbers of lines, for places that are asked for in rising order."""

    def __init__(self, text: str):
        self.text, self.place, self.number = text, 0, 1

    def of(self, place: int) -> int:
        self.number += self.text.count("\n", self.place, place)
        self.place = place
        return self.number
