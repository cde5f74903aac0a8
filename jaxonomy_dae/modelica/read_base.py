"""Reads Base Modelica, the flat text that Modelica compilers write (Modelica Change Proposal MCP-0031).

A recursive descent over a list of tokens, one method for each rule of the grammar; operators by precedence climbing.
"""

import re
from typing import Any, NoReturn

from ..errors import ModelError
from .tree import (
    Array,
    Assignment,
    Binary,
    Branches,
    Call,
    Choice,
    Class,
    Comprehension,
    Declaration,
    Effect,
    End,
    Equality,
    Expression,
    Jump,
    Loop,
    Matrix,
    Number,
    Part,
    Range,
    Reference,
    Several,
    Statement,
    Text,
    Truth,
    Unary,
    Whole,
)

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
    "parameter constant discrete input output final flow stream inner outer each protected public".split()
)
CLASSES = ("model", "record", "function", "type", "package", "class", "block", "connector")
_BEFORE_CLASS = ("pure", "impure", "operator", "partial", "encapsulated", "final", "expandable")
SECTION_ENDS = ("end", "equation", "algorithm", "initial", "external", "protected", "public", "annotation")


def read_base(text: str) -> Class:
    """The outermost class of a Base Modelica text: a package that holds functions, types and the model.

    **Raises:**

    - `ModelError` for what is not Base Modelica, with line and column.
    """
    return Reader(text).file()


def read_modifiers(text: str) -> dict[str, Any]:
    """What stands in parentheses behind a name, such as `(StopTime = 2.0)`."""
    return Reader(text).modifiers()


def written(name: str) -> Reference:
    """A quoted name with subscripts inside, such as 'x[\\'i\\'].y', as the reference x[i].y."""
    parts: list[str] = []
    subscripts: list[tuple[Expression, ...]] = []
    for part, inside in _PART.findall(re.sub(r"\\(.)", r"\1", name)):
        parts.append(part)
        subscripts.append(Reader(f"[{inside}]")._subscripts() if inside else ())
    return Reference(tuple(parts), tuple(subscripts))


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

    # --- expressions -------------------------------------------------------------------------------------------------

    def expression(self) -> Expression:
        if self.take("if"):
            branches = [self._branch()]
            while self.take("elseif"):
                branches.append(self._branch())
            self.need("else")
            return Choice(tuple(branches), self.expression())
        first = self.operation(1)
        if not self.take(":"):
            return first
        second = self.operation(1)
        if self.take(":"):
            return Range(first, second, self.operation(1))
        return Range(first, Number(1), second)

    def _branch(self) -> tuple[Expression, Expression]:
        condition = self.expression()
        self.need("then")
        return condition, self.expression()

    def operation(self, level: int) -> Expression:
        """An operation whose operators bind at least as strongly as `level`."""
        if level <= _NOT and self.take("not"):
            left: Expression = Unary("not", self.operation(_NOT + 1))
        elif level <= _SUM + 1 and (sign := self.take("-", "+", ".-", ".+")):
            left = self.operation(_SUM + 1)  # a sign binds as weakly as a sum: -a * b is -(a * b)
            if "-" in sign:
                left = Number(-left.value) if isinstance(left, Number) else Unary("-", left)
        else:
            left = self.primary()
        while True:
            sign = self.keys[self.i]
            strength = _LEVEL.get(sign, 0)
            if strength < level:
                return left
            self.i += 1
            left = Binary(sign, left, self.primary() if strength == _POWER else self.operation(strength + 1))

    def primary(self) -> Expression:
        kind, word = self.kinds[self.i], self.words[self.i]
        if kind == "number":
            self.i += 1
            return Number(int(word) if word.isdigit() else float(word))
        if kind == "string":
            self.i += 1
            return Text(word[1:-1])
        if kind == "sign":
            if self.take("("):
                return self._in_parentheses()
            if self.take("{"):
                return Array(self._arguments("}")[0])
            if self.take("["):
                rows = [[self.expression()]]
                while sign := self.take(",", ";"):
                    if sign == ",":
                        rows[-1].append(self.expression())
                    else:
                        rows.append([self.expression()])
                self.need("]")
                return Matrix(tuple(map(tuple, rows)))
            if self.take("-"):  # as in 2^-1
                return Unary("-", self.primary())
            self._fail("expected an expression")
        if kind == "word":
            if word in ("true", "false"):
                self.i += 1
                return Truth(word == "true")
            if word == "end":
                self.i += 1
                return End()
        return self._reference()

    def _in_parentheses(self) -> Expression:
        entries: list[Expression | None] = []
        while not self.take(")"):
            entries.append(None if self.at(",") else self.expression())
            if not self.at(")"):
                self.need(",")
                if self.at(")"):
                    entries.append(None)
        if len(entries) == 1 and entries[0] is not None:
            return self._parts_of(entries[0])
        return Several(tuple(entries))

    def _reference(self) -> Expression:
        parts: list[str] = []
        subscripts: list[tuple[Expression, ...]] = []
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
            return self._parts_of(Call(".".join(parts), arguments, named))
        return Reference(tuple(parts), tuple(subscripts))

    def _parts_of(self, whole: Expression) -> Expression:
        while self.at("[", "."):
            whole = Part(whole, self.name(), ()) if self.take(".") else Part(whole, None, self._subscripts())
        return whole

    def _subscripts(self) -> tuple[Expression, ...]:
        if not self.take("["):
            return ()
        out: list[Expression] = []
        while not self.take("]"):
            if self.at(":") and self.keys[self.i + 1] in (",", "]"):
                self.i += 1
                out.append(Whole())
            else:
                out.append(self.expression())
            if not self.at("]"):
                self.need(",")
        return tuple(out)

    def _arguments(self, end: str) -> tuple[tuple[Expression, ...], tuple[tuple[str, Expression], ...]]:
        arguments: list[Expression] = []
        named: list[tuple[str, Expression]] = []
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

    def _argument(self) -> Expression:
        if self.take("function"):
            return Call(FUNCTION, (self.expression(),), ())
        value = self.expression()
        return Comprehension(value, self._iterators()) if self.take("for") else value

    def _iterators(self) -> tuple[tuple[str, Expression | None], ...]:
        out = []
        while True:
            out.append((self.name(), self.expression() if self.take("in") else None))
            if not self.take(","):
                return tuple(out)

    # --- equations and statements ------------------------------------------------------------------------------------

    def statements(self, *ends: str) -> tuple[Statement, ...]:
        out: list[Statement] = []
        while not self.at(*ends):
            if self.take("annotation"):
                self.modifiers()
                self.need(";")
            else:
                out.append(self.statement())
        return tuple(out)

    def statement(self) -> Statement:
        line = self.line()
        kind = self.take("if", "when", "for", "while", "return", "break")
        if kind in ("if", "when"):
            out: Statement = Branches(kind, self._branches(), line)
        elif kind == "for":
            iterators = self._iterators()
            self.need("loop")
            out = Loop(iterators, None, self.statements("end"), line)
        elif kind == "while":
            condition = self.expression()
            self.need("loop")
            out = Loop((), condition, self.statements("end"), line)
        elif kind:
            out = Jump(kind, line)
        else:
            out = self._simple(line)
        if isinstance(out, Branches | Loop):
            self.need("end")
            self.need(kind)
        self.comment()
        if self.take("annotation"):
            self.modifiers()
        self.need(";")
        return out

    def _simple(self, line: int) -> Statement:
        left = self.expression()
        sign = self.take("=", ":=")
        if sign:
            return (Equality if sign == "=" else Assignment)(left, self.expression(), line)
        if not isinstance(left, Call):
            self._fail("expected '=', ':=' or a call")
        return Effect(left, line)

    def _branches(self) -> tuple[tuple[Expression, tuple[Statement, ...]], ...]:
        out = []
        while True:
            condition = self.expression()
            self.need("then")
            out.append((condition, self.statements("end", "else", "elseif", "elsewhen")))
            if not self.take("elseif", "elsewhen"):
                break
        if self.take("else"):
            out.append((Truth(True), self.statements("end")))
        return tuple(out)

    # --- declarations and classes ------------------------------------------------------------------------------------

    def modifiers(self) -> dict[str, Any]:
        out: dict[str, Any] = {}
        self.need("(")
        while not self.take(")"):
            while self.take("final", "each"):
                pass
            name = self.name()
            while self.take("."):
                name += "." + self.name()
            inner = self.modifiers() if self.at("(") else None
            value = self.expression() if self.take("=", ":=") else None
            out[name] = value if inner is None else inner if value is None else {**inner, "=": value}
            self.comment()
            if not self.at(")"):
                self.need(",")
        return out

    def declaration(self) -> Declaration:
        line = self.line()
        prefixes = set()
        while self.kinds[self.i] == "word" and self.words[self.i] in PREFIXES:
            prefixes.add(self.words[self.i])
            self.i += 1
        kind = self.name()
        while self.take("."):
            kind += "." + self.name()
        dimensions = self._subscripts()
        name = self.name()
        dimensions += self._subscripts()
        modifiers = self.modifiers() if self.at("(") else {}
        value = self.expression() if self.take("=", ":=") else None
        comment = self.comment()
        if self.take("annotation"):
            self.modifiers()
        self.need(";")
        return Declaration(frozenset(prefixes), kind, name, dimensions, modifiers, value, comment, line)

    def file(self) -> Class:
        out = self.definition()
        self.take(";")
        if self.kinds[self.i] != "stop":
            self._fail("expected the end of the text")
        return out

    def definition(self) -> Class:
        while self.take(*_BEFORE_CLASS):
            pass
        kind = self.take(*CLASSES)
        if not kind:
            self._fail("expected a class, such as package, model or function")
        name = self.name()
        if self.take("="):
            return self._short(kind, name)
        return self._long(kind, name)

    def _short(self, kind: str, name: str) -> Class:
        literals: list[str] = []
        base = None
        if self.take("enumeration"):
            self.need("(")
            while not self.take(")"):
                literals.append(self.name())
                self.comment()
                self.take(",")
            comment = self.comment()
            self.need(";")
        else:
            line = self.line()
            prefixes = frozenset(iter(lambda: self.take(*PREFIXES), ""))
            of = self.name()
            while self.take("."):
                of += "." + self.name()
            dimensions = self._subscripts()
            modifiers = self.modifiers() if self.at("(") else {}
            comment = self.comment()
            if self.take("annotation"):
                self.modifiers()
            self.need(";")
            base = Declaration(prefixes, of, name, dimensions, modifiers, None, comment, line)
        return Class(kind, name, (), (), (), (), (), (), {}, tuple(literals), base, None, comment)

    def _long(self, kind: str, name: str) -> Class:
        comment = self.comment()
        declarations: list[Declaration] = []
        classes: list[Class] = []
        sections: dict[str, list] = {
            "equation": [], "initial equation": [], "algorithm": [], "initial algorithm": []
        }  # fmt: skip
        annotation: dict[str, Any] = {}
        external, base = None, None
        while not self.take("end"):
            if self.take("protected", "public"):
                continue
            start = "initial " if self.at("initial") and self.keys[self.i + 1] in ("equation", "algorithm") else ""
            if start:
                self.i += 1
            if section := self.take("equation", "algorithm"):
                sections[start + section].append(self.statements(*SECTION_ENDS))
            elif self.take("annotation"):
                annotation = self.modifiers()
                self.need(";")
            elif self.take("external"):
                external = self._external()
            elif self.take("extends"):
                line, of = self.line(), self.name()
                base = Declaration(frozenset(), of, name, (), {}, None, "", line)
                self.need(";")
            elif self._begins_class():
                classes.append(self.definition())
            else:
                declarations.append(self.declaration())
        self.name()
        self.need(";")
        joined = {k: tuple(s for section in sections[k] for s in section) for k in ("equation", "initial equation")}
        return Class(
            kind, name, tuple(declarations), joined["equation"], joined["initial equation"],
            tuple(sections["algorithm"]), tuple(sections["initial algorithm"]), tuple(classes), annotation, (), base,
            external, comment,
        )  # fmt: skip

    def _begins_class(self) -> bool:
        i = self.i
        while self.keys[i] in _BEFORE_CLASS:
            i += 1
        return self.keys[i] in CLASSES and self.kinds[i + 1] in ("word", "quoted")

    def _external(self) -> str:
        """The name of the called function; its arguments are left out."""
        if self.kinds[self.i] == "string":
            self.i += 1
        called = ""
        while not self.take(";"):
            if self.keys[self.i + 1] == "(" and self.kinds[self.i] == "word" and not called:
                called = self.words[self.i]
            if self.take("annotation"):
                self.modifiers()
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
