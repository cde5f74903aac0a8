"""Where equations, connections and algorithms stand in Modelica sources, and what their names are."""

import dataclasses
import re
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

from ..base.errors import ModelError
from . import tree
from .read_base import SECTION_ENDS, Reader
from .sources import Constant, Found, Sources

Change: TypeAlias = tuple[int, int, str]  # the places between which a text gets another one


@dataclasses.dataclass(frozen=True)
class Mark:
    """An equation, a connection, or the value of a declaration or modifier, between two places of a text.

    - `path`: the classes around it. `local`: the iterators around it.
    - `left`, `right`: its sides; a value has no left side, and a connection is a call `connect` on the right.
    - `declared`: the component whose value it is, if it is that of a declaration.
    """

    path: tuple[str, ...]
    begin: int
    end: int
    left: tree.Expression | None
    right: tree.Expression
    local: tuple[str, ...] = ()
    declared: tree.Declaration | None = None


@dataclasses.dataclass(frozen=True)
class Section:
    """A section of equations or of an algorithm, between two places of a text, from the word that begins it.

    - `path`: the classes around it. `kind`: the words that begin it, such as `initial equation`.
    - `number`: how many sections of this kind stand before it in its class.
    """

    path: tuple[str, ...]
    kind: str
    number: int
    begin: int
    end: int


class Marked(Reader):
    """A reader that notes where equations, values and sections stand."""

    def __init__(self, text: str):
        super().__init__(text)
        self.path_of_class: list[str] = []
        self.local: list[str] = []
        self.marks: list[Mark] = []
        self.sections: list[Section] = []
        self._by_class: dict[tuple[str, ...], list[Mark]] = {}

    def _long(self, kind: str, name: str, continues: bool) -> tree.Class:
        self.path_of_class.append(name)
        try:
            return super()._long(kind, name, continues)
        finally:
            self.path_of_class.pop()

    def statements(self, *ends: str) -> tuple[tree.Statement, ...]:
        begin = self.i - 1
        out = super().statements(*ends)
        if ends == SECTION_ENDS:
            initial = self.keys[begin - 1] == "initial"
            kind, path = ("initial " if initial else "") + self.keys[begin], tuple(self.path_of_class)
            number = sum(s.path == path and s.kind == kind for s in self.sections)
            places = self.places[begin - initial], self.places[self.i - 1] + len(self.words[self.i - 1])
            self.sections.append(Section(path, kind, number, *places))
        return out

    def statement(self) -> tree.Statement:
        outer = list(self.local)
        try:
            return super().statement()
        finally:
            self.local = outer

    def _iterators(self) -> tuple[tuple[str, tree.Expression | None], ...]:
        out = super()._iterators()
        self.local += [name for name, _ in out]
        return out

    def _simple(self, line: int) -> tree.Statement:
        begin, local = self.i, tuple(self.local)
        out = super()._simple(line)
        if isinstance(out, tree.Equality):
            self._mark(begin, out.left, out.right, local)
        elif isinstance(out, tree.Effect) and out.call.function == "connect":
            self._mark(begin, None, out.call, local)
        return out

    def _value(self) -> tree.Expression | None:
        begin = self.i
        out = super()._value()
        if out is not None:
            self._mark(begin, None, out, ())
        return out

    def declarations(self) -> Iterator[tree.Declaration]:
        for d in super().declarations():
            if d.value is not None:
                k = max(k for k, mark in enumerate(self.marks) if mark.right is d.value)
                self.marks[k] = dataclasses.replace(self.marks[k], declared=d)
            yield d

    def marks_of(self, path: tuple[str, ...]) -> list[Mark]:
        """The marks of a class."""
        if not self._by_class:
            for m in self.marks:
                self._by_class.setdefault(m.path, []).append(m)
        return self._by_class.get(path, [])

    def _mark(self, begin: int, left: tree.Expression | None, right: tree.Expression, local: tuple[str, ...]) -> None:
        places = self.places[begin], self.places[self.i - 1] + len(self.words[self.i - 1])
        self.marks.append(Mark(tuple(self.path_of_class), *places, left, right, local))


def changed_text(sources: Sources, text: str, change: Callable[[Found, Mark], Iterator[Change]]) -> str:
    """The text of a file of a library with what `change` says of each mark of its models. No line moves."""
    return changed_classes(
        sources, text, lambda of, marked: (c for m in marked.marks_of(of.marked) for c in change(of.found, m))
    )


class MarkedClass(NamedTuple):
    """A model of a file, and the path to it within the file."""

    found: Found
    marked: tuple[str, ...]


def changed_classes(sources: Sources, text: str, change: Callable[[MarkedClass, Marked], Iterator[Change]]) -> str:
    """The text of a file of a library with what `change` says of each of its models that have equations, values or
    sections. No line moves."""
    within = re.match(r"(?:\s|//[^\n]*\n)*within\s+([\w.]*)\s*;", text)
    prefix = [*within[1].split(".")] if within and within[1] else []
    try:
        marked = Marked(text)
        marked.file()
    except ModelError:  # what this reader does not read, rumoca may
        return text
    changes: list[Change] = []
    for path in dict.fromkeys([*(m.path for m in marked.marks), *(s.path for s in marked.sections)]):
        of = sources.find(".".join([*prefix, *path]))
        if isinstance(of, Found) and of.source.kind not in ("function", "record", "type", "operator"):
            changes += change(MarkedClass(of, path), marked)
    # From the end of the text, so that the places of changes before stay valid.
    for begin, end, new in sorted(changes, reverse=True):
        text = text[:begin] + new + "\n" * (text.count("\n", begin, end) - new.count("\n")) + text[end:]
    return text


def type_of(
    sources: Sources, of: Found, e: tree.Reference, local: frozenset[str] = frozenset()
) -> tuple[Found | None, int, int]:
    """What a name of a class is: (its class, or that of the innermost part of it that has one; how many dimensions it
    has; how many of its parts were followed)."""
    if e.parts[0] in local:
        return None, 0, 1
    found = next(((d, s) for d, s in sources.declarations(of) if d.name == e.parts[0]), None)
    at = 0
    if found is None:
        constant = sources.lookup(e.path, of.inside)
        if constant is None or not isinstance(constant[0], Constant):
            return None, 0, 0
        found = constant[0].declaration, constant[0].scopes
        at = len(e.parts) - len(constant[1]) - 1
    rank = 0
    while True:
        declaration, scopes = found
        single = sum(not isinstance(s, tree.Whole | tree.Range) for s in e.subscripts[at])
        rank += max(len(declaration.dimensions) - single, 0)
        kind = sources.class_of(declaration.type, scopes)
        at += 1
        if kind is None or at == len(e.parts):
            return kind, rank, at
        inner = next(((d, s) for d, s in sources.declarations(kind) if d.name == e.parts[at]), None)
        if inner is None:
            return kind, rank, at
        found = inner


def where_array(sources: Sources, of: Found, e: tree.Reference) -> int | None:
    """The part of a name with one dimension that has it; None if it is an entry or a range there."""
    for at in range(len(e.parts)):
        if type_of(sources, of, tree.Reference(e.parts[: at + 1], e.subscripts[: at + 1]))[1]:
            return at if e.subscripts[at] in ((), (tree.Whole(),)) else None
    return None


def with_entry(e: tree.Reference, at: int, place: tree.Expression) -> tree.Reference:
    subscripts = [*e.subscripts]
    subscripts[at] = (place,)
    return tree.Reference(e.parts, tuple(subscripts))


def size_of(e: tree.Reference, at: int) -> tree.Expression:
    return tree.Call("size", (tree.Reference(e.parts[: at + 1], ((),) * (at + 1)), tree.Number(1)), ())
