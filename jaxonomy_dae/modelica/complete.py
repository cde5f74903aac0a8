"""Functions and records that a flat text calls but does not define, from the sources of the library that defines them.

A name is looked up as it is written. Where its beginning is a part of the model, as in `pipe.WallFriction.Internal.f`,
the text does not say which package that part stands for: it is the one whose functions have the same declarations as
those of the text with that beginning.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

from .builtin import FUNCTIONS
from .flat_model import FlatModel
from .sources import Constant, Found, Member, Sources
from .tree import (
    BUILT_IN,
    Call,
    Class,
    Comprehension,
    Declaration,
    Effect,
    Loop,
    Part,
    Reference,
    Statement,
    each_part,
)

_RECORDS = ("record", "class")


def completed(flat: FlatModel, library: Sources, known: frozenset[str]) -> FlatModel:
    """The model with the definitions that its text lacks, as far as the library has them; `known` are the functions
    that need none."""
    classes = dict(flat.classes)
    writer = _Writer(library, classes)
    for name in dict.fromkeys(e.function for e in each_part((flat.model, classes)) if isinstance(e, Call)):
        last = name.rpartition(".")[2]
        if (
            name in classes
            or name in known
            or last in known
            or name in (last, f"Modelica.Math.{last}")
            and last in FUNCTIONS
        ):
            continue
        found = library.find(name) or _of_a_part(name, flat, library)
        if isinstance(found, Found):
            writer.write(found, name)
    return dataclasses.replace(flat, classes=classes)


def definitions_written(
    statements: tuple[Statement, ...], library: Sources, of: Found, local: frozenset[str], classes: dict[str, Class]
) -> tuple[Statement, ...]:
    """Statements of a class with full names for the functions, records and enumerations that they use, which are
    written into `classes`, and with values for constants; `local` are names that stay."""
    return _Writer(library, classes)._renamed(statements, of.inside, local)


def _of_a_part(name: str, flat: FlatModel, library: Sources) -> Member | None:
    """What a name within a part of the model stands for, judged by the functions beside it."""
    parts = name.split(".")
    for k in range(len(parts) - 1, 1, -1):
        prefix, rest = ".".join(parts[:k]), parts[k:]
        beside = [c for n, c in flat.classes.items() if n.rpartition(".")[0] == prefix and c.kind == "function"]
        if beside:
            break
    else:
        return None
    found: dict[int, Member] = {}
    for package in library.packages_with(beside[0].name.rpartition(".")[2]):
        if all(_is_like(library, package, c) for c in beside):
            member: Member | None = package
            for part in rest:
                member = library.member(member, part) if isinstance(member, Found) else None
            if isinstance(member, Found):
                found.setdefault(id(member.source), member)
    return next(iter(found.values())) if len(found) == 1 else None


def _is_like(library: Sources, package: Found, c: Class) -> bool:
    """True if the function of this name in a package declares the same variables."""
    found = library.member(package, c.name.rpartition(".")[2])
    if not isinstance(found, Found):
        return False
    ours = {d.name for d, _ in library.declarations(found)}
    return ours == {d.name for d in c.declarations} and found.source.comment in ("", c.comment)


class _Writer:
    """Writes classes of a library into `classes` as flat ones, those that they use included."""

    def __init__(self, library: Sources, classes: dict[str, Class]):
        self.library, self.classes = library, classes

    def write(self, found: Found, name: str | None = None) -> str:
        """Writes a function, record or enumeration; returns its name."""
        name = name or found.path
        if name in self.classes:
            return name
        source = found.source
        empty = Class(source.kind, name, literals=source.literals, external=source.external)
        # Noted before what is inside is written, since a function may call itself.
        self.classes[name] = empty
        if source.literals:
            return name
        pairs = self.library.declarations(found)
        local = frozenset(d.name for d, _ in pairs)
        declarations = tuple(self._declaration(d, scopes, local) for d, scopes in pairs)
        algorithms = [
            tuple(self._renamed(s, part.inside, local) for s in section)
            for part in self.library.lineage(found)
            for section in part.source.algorithms
        ]
        external = next((p.source.external for p in self.library.lineage(found) if p.source.external is not None), None)
        self.classes[name] = empty._replace(
            declarations=declarations, algorithms=tuple(algorithms), external=external
        )  # fmt: skip
        return name

    def _declaration(self, d: Declaration, scopes: tuple[Found, ...], local: frozenset[str]) -> Declaration:
        kind, more = self._type(d.type, scopes)
        return d._replace(
            type=kind, value=self._renamed(d.value, scopes, local), modifiers={},
            dimensions=self._renamed((*d.dimensions, *more), scopes, local),
        )  # fmt: skip

    def _type(self, name: str, scopes: Sequence[Found]) -> tuple[str, tuple]:
        """(A built-in type or the name of a record or enumeration, dimensions that belong to the type); the name as it
        is for a type that no source holds."""
        if name in BUILT_IN:
            return name, ()
        found = self.library.class_of(name, scopes)
        if found is None:
            return name, ()  # it may be an array
        alias = found.source.alias
        if alias is not None:
            kind, more = self._type(alias.type, found.scopes)
            return kind, (*self._renamed(alias.dimensions, found.scopes, frozenset()), *more)
        if found.source.literals or found.source.kind in _RECORDS:
            return self.write(found), ()
        return "Real", ()

    def _renamed(self, e: Any, scopes: tuple[Found, ...], local: frozenset[str]) -> Any:
        """A part of a tree with full names for functions and records, and values for constants."""
        if isinstance(e, Reference):
            return self._reference(e, scopes, local)
        if isinstance(e, Comprehension):
            inner = local | {n for n, _ in e.iterators}
            return Comprehension(*(self._renamed(x, scopes, inner) for x in e))
        if isinstance(e, Loop):
            inner = local | {n for n, _ in e.iterators}
            return e._replace(
                iterators=self._renamed(e.iterators, scopes, local),
                condition=self._renamed(e.condition, scopes, local),
                body=self._renamed(e.body, scopes, inner),
            )  # fmt: skip
        if isinstance(e, Effect):
            return e  # a check or a message
        if isinstance(e, Call):
            return Call(
                self._function(e.function, scopes, local), self._renamed(e.arguments, scopes, local),
                tuple((n, self._renamed(v, scopes, local)) for n, v in e.named),
            )  # fmt: skip
        if isinstance(e, tuple):
            parts = [self._renamed(x, scopes, local) for x in e]
            return tuple(parts) if type(e) is tuple else type(e)(*parts)
        return e

    def _function(self, name: str, scopes: tuple[Found, ...], local: frozenset[str]) -> str:
        if name in local:
            return name
        found = self.library.class_of(name, scopes)
        if found is None or found.source.kind == "type":
            return name
        last = found.path.rpartition(".")[2]
        if found.path == f"Modelica.Math.{last}" and last in FUNCTIONS:
            return last
        return self.write(found)

    def _reference(self, e: Reference, scopes: tuple[Found, ...], local: frozenset[str]) -> Any:
        subscripts = tuple(self._renamed(s, scopes, local) for s in e.subscripts)
        if e.parts[0] in local:
            return Reference(e.parts, subscripts)
        found = self.library.lookup(e.path, scopes)
        if found is None:
            return Reference(e.parts, subscripts)
        member, rest = found
        at = len(e.parts) - len(rest)
        if isinstance(member, Found):
            if member.source.literals and len(rest) == 1:
                return Reference((self.write(member), *rest), ((), ()))
            return Reference(e.parts, subscripts)
        given = member.declaration.modifiers.get(rest[0]) if rest and member.declaration.value is None else None
        if given is not None and not subscripts[at - 1]:  # one field: it may be what another field is computed from
            out, rest, at = self._renamed(given, member.scopes, frozenset()), rest[1:], at + 1
        else:
            out = self._value(member)
        if subscripts[at - 1]:
            out = Part(out, None, subscripts[at - 1])
        for part, s in zip(rest, subscripts[at:], strict=True):
            out = Part(out, part, ())
            if s:
                out = Part(out, None, s)
        return out

    def _value(self, constant: Constant) -> Any:
        """The value of a constant; a record of which modifiers give the fields is a call of its constructor."""
        d = constant.declaration
        if d.value is not None:
            return self._renamed(d.value, constant.scopes, frozenset())
        kind, _ = self._type(d.type, constant.scopes)
        fields = tuple((n, self._renamed(v, constant.scopes, frozenset())) for n, v in d.modifiers.items())
        return Call(kind, (), fields) if kind in self.classes else Reference((d.name,))
