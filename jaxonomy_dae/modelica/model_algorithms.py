"""Algorithms of models, which rumoca reads in part alone.

rumoca 0.10.2 makes equations of the algorithms of a model, and refuses what reads a variable between two assignments, a
`break`, assignments in loops, and so on. So in the copy that it reads, equations of the same number stand in place of
an algorithm that assigns discrete variables, with a constant that says which one it was. Each instance of the class has
this constant, under the name of which the algorithm is put back into the flattened model.
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from typing import Any

from . import tree
from .complete import definitions_written
from .definitions import assigned_in
from .flat_model import FlatModel
from .kept_inputs import KEPT, kept_inputs, with_kept
from .marked_source import Change, Marked, MarkedClass, changed_classes, type_of
from .sources import Found, Sources

_MARK = "algorithm__"  # begins the name of the constant
_NEVER = "time > 1e60"


def without_algorithms(sources: Sources, text: str) -> str:
    """The text of a file of a library without the algorithms of its models that assign discrete variables."""
    if "algorithm" not in text:
        return text
    return changed_classes(sources, text, lambda of, marked: _replaced(sources, of, marked))


def _replaced(sources: Sources, of: MarkedClass, marked: Marked) -> Iterator[Change]:
    for s in marked.sections:
        if s.path != of.marked or s.kind != "algorithm":
            continue
        statements = of.found.source.algorithms[s.number]
        in_place = [_in_place(sources, of.found, name, statements) for name in _assigned(statements)]
        if in_place and all(in_place):
            constant = f'protected constant String {_MARK}{s.number} = "{of.found.path}";'
            yield s.begin, s.end, f"{constant} equation {' '.join(map(str, in_place))}"


def _assigned(statements: Sequence[tree.Statement]) -> list[str]:
    """The variables that statements assign, whole or by entries."""
    return sorted({name.partition("[")[0] for name in assigned_in(tuple(statements))})


def _in_place(sources: Sources, of: Found, name: str, statements: Sequence[tree.Statement]) -> str | None:
    """An equation in place of what is assigned to a variable; None if it is not discrete."""
    kind, _, followed = type_of(sources, of, tree.Reference((name,)))
    if followed != 1 or "." in name:
        return None
    declared = next(d for d, _ in sources.declarations(of) if d.name == name)
    scalar = declared.type
    while kind is not None and kind.source.alias is not None:
        scalar = kind.source.alias.type
        kind = sources.class_of(scalar, kind.scopes)
    if scalar in ("Integer", "Boolean") or kind is not None and kind.source.literals:
        return f"{name} = pre({name});"
    whens = [s for s in statements if isinstance(s, tree.Branches) and s.kind == "when"]
    if scalar == "Real" and name not in _assigned([s for s in statements if s not in whens]):
        return f"when {_NEVER} then {name} = pre({name}); end when;"
    return None


def with_algorithms(flat: FlatModel, sources: Sources) -> FlatModel:
    """The flattened model with the algorithms of its instances put back."""
    marks = [d for d in flat.model.declarations if _is_mark(d)]
    if not marks:
        return flat
    classes = dict(flat.classes)
    algorithms, assigned = list(flat.model.algorithms), set[str]()
    for mark in marks:
        before, _, number = mark.name.rpartition(_MARK)
        assert isinstance(mark.value, tree.Text)
        of = sources.find(mark.value.text)
        assert isinstance(of, Found), mark
        statements = with_kept(of.source.algorithms[int(number)], kept_inputs(sources, of))
        members = frozenset(d.name for d, _ in sources.declarations(of))
        members |= {name + KEPT for name in kept_inputs(sources, of)}
        statements = definitions_written(statements, sources, of, members, classes)
        algorithms.append(_of_instance(statements, before, members))
        assigned |= {before + name for name in _assigned(of.source.algorithms[int(number)])}
    model = flat.model._replace(
        declarations=tuple(d for d in flat.model.declarations if d not in marks),
        equations=tuple(e for s in flat.model.equations for e in _without(s, assigned)),
        algorithms=tuple(algorithms),
    )
    return dataclasses.replace(flat, model=model, classes=classes)


def _is_mark(d: tree.Declaration) -> bool:
    return d.name.rpartition(".")[2].startswith(_MARK) and isinstance(d.value, tree.Text)


def _without(s: tree.Statement, assigned: set[str]) -> Iterator[tree.Statement]:
    """A statement without the equations that stood in place of algorithms."""
    if isinstance(s, tree.Branches):
        branches = [(c, tuple(e for inner in body for e in _without(inner, assigned))) for c, body in s.branches]
        left = tuple((c, body) for c, body in branches if body)
        if left:
            yield s._replace(branches=left)
    elif not (isinstance(s, tree.Equality) and _is_in_place(s, assigned)):
        yield s


def _is_in_place(s: tree.Equality, assigned: set[str]) -> bool:
    return (
        isinstance(s.left, tree.Reference)
        and re.sub(r"\[[\d,]*\]$", "", s.left.path) in assigned
        and isinstance(s.right, tree.Call)
        and s.right.function == "pre"
    )


def _of_instance(part: Any, before: str, members: frozenset[str]) -> Any:
    """Statements of a class as those of an instance of it, whose name and a dot are `before`."""
    if isinstance(part, tree.Reference) and part.parts[0] in members:
        subscripts = _of_instance(part.subscripts, before, members)
        return tree.Reference((before + part.parts[0], *part.parts[1:]), subscripts)
    if isinstance(part, tree.Comprehension | tree.Loop):
        members -= {name for name, _ in part.iterators}
    if isinstance(part, tuple):
        parts = [_of_instance(each, before, members) for each in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return part
