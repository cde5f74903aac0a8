"""Reads Modelica source as far as functions need it: packages, functions, records, types and constants.

Of models, blocks and connectors, the equations are passed over, and so are all annotations.
"""

import dataclasses
from pathlib import Path
from typing import Any

from ..errors import ModelError
from .read_base import CLASSES, PREFIXES, SECTION_ENDS, Reader
from .tree import Declaration, Expression, Statement

_WITH_EQUATIONS = ("model", "block", "connector", "class")
_BEFORE = frozenset(
    "redeclare replaceable final partial encapsulated inner outer pure impure operator expandable".split()
)


@dataclasses.dataclass
class Source:
    """A class of Modelica source.

    - `bases`: what it extends: the name, the modifiers and the redeclared classes among them.
    - `imports`: pairs (local name, full name); `*` is the local name of all that a package holds.
    - `alias`: what a short definition stands for.
    - `extends_inherited`: true for `redeclare function extends f`: it continues the inherited class of its name.
    - `folder`: where classes of a package stand that are in files of their own.
    """

    kind: str
    name: str
    declarations: list[Declaration] = dataclasses.field(default_factory=list)
    algorithms: list[tuple[Statement, ...]] = dataclasses.field(default_factory=list)
    classes: dict[str, "Source"] = dataclasses.field(default_factory=dict)
    bases: list[tuple[str, dict[str, Any]]] = dataclasses.field(default_factory=list)
    imports: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    literals: tuple[str, ...] = ()
    alias: Declaration | None = None
    external: str | None = None
    comment: str = ""
    extends_inherited: bool = False
    folder: Path | None = None


def read_source(file: Path) -> Source:
    """The class of a file.

    **Raises:**

    - `ModelError` for what is not Modelica, with file, line and column.
    """
    try:
        out = _SourceReader(file.read_text(encoding="utf-8-sig")).whole()
    except ModelError as error:
        raise ModelError(f"{file}: {str(error).removeprefix('Base Modelica, ')}") from None
    if file.name == "package.mo":
        out.folder = file.parent
    return out


class _SourceReader(Reader):
    def whole(self) -> Source:
        if self.take("within"):
            while not self.take(";"):
                self.i += 1
        return self._class()

    def primary(self) -> Expression:
        self.take(".")  # of a name from the outermost package, such as `.Modelica.Constants.pi`
        return super().primary()

    def _path(self) -> str:
        self.take(".")
        out = self.name()
        while self.take("."):
            out += "." + self.name()
        return out

    # --- what is passed over -----------------------------------------------------------------------------------------

    def _pass_parentheses(self) -> None:
        self.need("(")
        depth = 1
        while depth:
            if self.kinds[self.i] == "stop":
                self._fail("expected ')'")
            depth += {"(": 1, ")": -1}.get(self.keys[self.i], 0)
            self.i += 1

    def _pass_annotation(self) -> None:
        if self.take("annotation"):
            self._pass_parentheses()

    def _pass_constraint(self) -> None:
        if self.take("constrainedby"):
            self._path()
            if self.at("("):
                self._pass_parentheses()

    def _pass_body(self, name: str) -> None:
        while not (self.keys[self.i] == "end" and self.words[self.i + 1] == name and self.keys[self.i + 2] == ";"):
            if self.kinds[self.i] == "stop":
                self._fail(f"expected 'end {name}'")
            self.i += 1
        self.i += 3

    # --- classes -----------------------------------------------------------------------------------------------------

    def _begins_class(self) -> bool:
        i = self.i
        while self.keys[i] in _BEFORE:
            i += 1
        before = self.keys[i - 1] if i > self.i else ""
        return (self.keys[i] in CLASSES and self.kinds[i + 1] in ("word", "quoted")) or (
            before == "operator" and self.kinds[i] == "quoted"
        )

    def _class(self) -> Source:
        while self.take(*_BEFORE):
            pass
        kind = self.take(*CLASSES) or "package"  # `operator 'constructor'` holds functions
        continues = bool(self.take("extends"))
        out = Source(kind, self.name(), extends_inherited=continues)
        if self.take("="):
            self._stands_for(out)
        else:
            if self.at("("):  # of `redeclare function extends f(…)`
                self._pass_parentheses()
            self._body(out)
        return out

    def _stands_for(self, out: Source) -> None:
        if self.take("enumeration"):
            self.need("(")
            literals = []
            while not self.take(")"):
                if not self.take(":"):
                    literals.append(self.name())
                self.comment()
                self._pass_annotation()
                self.take(",")
            out.literals = tuple(literals)
        else:
            out.alias = self._short_declaration(out.name)
        out.comment = self.comment()
        self._pass_constraint()
        self.comment()
        self._pass_annotation()
        self.need(";")

    def _short_declaration(self, name: str) -> Declaration:
        line = self.line()
        while self.take("input", "output", "flow", "stream"):
            pass
        of = self._path()
        dimensions = self._subscripts()
        if of == "der":
            self._pass_parentheses()
        modifiers = self.modifiers() if self.at("(") else {}
        return Declaration(frozenset(), of, name, dimensions, modifiers, None, "", line)

    def _body(self, out: Source) -> None:
        out.comment = self.comment()
        while not self.take("end"):
            if self.take("protected", "public"):
                continue
            if out.kind in _WITH_EQUATIONS and self.at("equation", "algorithm", "initial"):
                self._pass_body(out.name)
                return
            if self.take("algorithm"):
                out.algorithms.append(self.statements(*SECTION_ENDS))
            elif self.at("annotation"):
                self._pass_annotation()
                self.need(";")
            elif self.take("external"):
                out.external = self._external()
            elif self.take("import"):
                self._import(out)
            elif self.take("extends"):
                name = self._path()
                out.bases.append((name, self.modifiers() if self.at("(") else {}))
                self._pass_annotation()
                self.need(";")
            elif self._begins_class():
                inner = self._class()
                out.classes[inner.name] = inner
            else:
                out.declarations.extend(self._components())
        self.name()
        self.need(";")

    def _import(self, out: Source) -> None:
        name = self.name()
        if self.take("="):
            out.imports.append((name, self._path()))
        else:
            self._import_by_name(out, name)
        self.comment()
        self.need(";")

    def _import_by_name(self, out: Source, name: str) -> None:
        while self.take("."):
            if self.take("{"):
                while not self.take("}"):
                    each = self.name()
                    out.imports.append((each, f"{name}.{each}"))
                    self.take(",")
                return
            name += "." + self.name()
        local = "*" if self.take(".*") else name.rpartition(".")[2]
        out.imports.append((local, name))

    def _components(self) -> list[Declaration]:
        """The declarations of one clause, such as `Real a, b = 1;`."""
        line, prefixes = self.line(), set()
        while self.kinds[self.i] == "word" and self.words[self.i] in PREFIXES | _BEFORE:
            prefixes.add(self.words[self.i])
            self.i += 1
        kind, shared, out = self._path(), self._subscripts(), []
        while True:
            name = self.name()
            dimensions = self._subscripts() + shared
            modifiers = self.modifiers() if self.at("(") else {}
            value = self.expression() if self.take("=", ":=") else None
            if self.take("if"):
                self.expression()
            self._pass_constraint()
            comment = self.comment()
            self._pass_annotation()
            out.append(Declaration(frozenset(prefixes), kind, name, dimensions, modifiers, value, comment, line))
            if not self.take(","):
                self.need(";")
                return out

    def modifiers(self) -> dict[str, Any]:
        """As in flat texts; a redeclared class is noted as the declaration of what it stands for."""
        out: dict[str, Any] = {}
        self.need("(")
        while not self.take(")"):
            while self.take("final", "each", "redeclare", "replaceable"):
                pass
            if self.keys[self.i] in CLASSES and self.kinds[self.i + 1] == "word":
                self.i += 1
                name = self.name()
                self.need("=")
                out[name] = self._short_declaration(name)
                self._pass_constraint()
            else:
                name = self._path()
                if self.kinds[self.i] in ("word", "quoted"):  # a redeclared component with its type
                    name = self.name()
                inner = self.modifiers() if self.at("(") else None
                value = self.expression() if self.take("=", ":=") else None
                out[name] = value if inner is None else inner if value is None else {**inner, "=": value}
            self.comment()
            self._pass_annotation()
            if not self.at(")"):
                self.need(",")
        return out
