"""Reads Modelica: flat texts in Base Modelica (Modelica Change Proposal MCP-0031), and the sources of libraries.

A recursive descent over a list of tokens, one method for each rule of the grammar; expressions by `read_expressions`.
Annotations are passed over, but for that of a model, which says how to run it.
"""

from collections.abc import Iterator

from . import tree
from .read_expressions import ExpressionReader, unescaped

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


class Reader(ExpressionReader):
    """A text, read by the rules of statements, declarations and classes, too."""

    # --- comments, and what is passed over ---------------------------------------------------------------------------

    def comment(self) -> str:
        out = ""
        while self.kinds[self.i] == "string":
            out += unescaped(self.words[self.i])
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

    def pass_to(self, sign: str) -> None:
        """Goes past the next one of this sign."""
        while not self.take(sign):
            if self.kinds[self.i] == "stop":
                self._fail(f"expected '{sign}'")
            self.i += 1

    def pass_annotation(self) -> None:
        if self.take("annotation"):
            self.pass_parentheses()

    def pass_constraint(self) -> None:
        if self.take("constrainedby"):
            self.path()
            self.pass_parentheses()

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
                whether = frozenset({"conditional"})  # front ends obey the condition itself when they flatten
            self.pass_constraint()
            comment = self.comment()
            self.pass_annotation()
            yield tree.Declaration(prefixes | whether, kind, name, dimensions, modifiers, value, comment, line)
        self.need(";")

    def file(self) -> tree.Class:
        if self.take("within"):
            self.pass_to(";")
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
            if self.kinds[self.i] == "stop":
                self._fail("expected ';'")
            if self.keys[self.i + 1] == "(" and self.kinds[self.i] == "word" and not called:
                called = self.words[self.i]
            if self.at("annotation"):
                self.pass_annotation()
            else:
                self.i += 1
        return called
