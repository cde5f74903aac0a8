"""Inputs of which a class reads what they were before an event: by `pre`, `edge` or `change`.

rumoca 0.10.2 reads these of what an event or an equation determines, and of no input. So the class keeps the input in a
variable of its own, whose value before the event it reads.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping

from . import tree
from .flat_model import FlatModel
from .marked_source import Change, Marked, MarkedClass, changed_classes
from .sources import Found, Sources
from .tree_text import text_of

KEPT = "__kept"  # ends the name of the variable that keeps an input
_BEFORE = ("pre", "edge", "change")
_CALLED = re.compile(r"\b(?:pre|edge|change)\s*\(")


def with_kept_inputs(sources: Sources, text: str) -> str:
    """The text of a file of a library with variables that keep the inputs whose values before an event are read."""
    if not _CALLED.search(text):
        return text
    return changed_classes(sources, text, lambda of, marked: _kept(sources, of, marked))


def _kept(sources: Sources, of: MarkedClass, marked: Marked) -> Iterator[Change]:
    kept = kept_inputs(sources, of.found)
    sections = [s for s in marked.sections if s.path == of.marked]
    if not kept or not sections:
        return
    declared = []
    for name, (d, kind) in kept.items():
        size = f"[{', '.join(map(text_of, d.dimensions))}]" if d.dimensions else ""
        declared.append(f"protected {kind} {name}{KEPT}{size} = {name};")
    first = min(s.begin for s in sections)
    yield first, first, f"{' '.join(declared)} "
    for s in sections:
        yield from _of_calls(kept, marked, s.begin, s.end)


def _of_calls(kept: Mapping[str, object], marked: Marked, begin: int, end: int) -> Iterator[Change]:
    """The kept variables in place of inputs, in the calls between two places."""
    for i, (place, word) in enumerate(zip(marked.places, marked.keys, strict=True)):
        if begin <= place < end and word in _BEFORE and marked.keys[i + 1] == "(" and marked.words[i + 2] in kept:
            after = marked.places[i + 2] + len(marked.words[i + 2])
            yield after, after, KEPT


def kept_inputs(sources: Sources, of: Found) -> dict[str, tuple[tree.Declaration, str]]:
    """The inputs of a class whose values before an event its own sections read, and their types."""
    own = of.source
    statements = own.equations, own.initial_equations, own.algorithms, own.initial_algorithms
    read = {
        e.arguments[0].parts[0]
        for e in tree.each_part(statements)
        if isinstance(e, tree.Call) and e.function in _BEFORE and len(e.arguments) == 1
        if isinstance(e.arguments[0], tree.Reference) and len(e.arguments[0].parts) == 1
    }
    if not read:
        return {}
    out = {}
    for d, scopes in sources.declarations(of):
        if d.name in read and (kind := _kind(sources, d, scopes)) is not None:
            out[d.name] = d, kind
    return out


def _kind(sources: Sources, d: tree.Declaration, scopes: tuple[Found, ...]) -> str | None:
    """The type of an input; None for what is none."""
    is_input = "input" in d.prefixes
    name = d.type
    while name not in ("Boolean", "Integer", "Real"):
        found = sources.class_of(name, scopes)
        if found is None:
            return None
        is_input = is_input or "input" in found.prefixes
        if found.source.literals:
            return found.path if is_input else None
        alias = found.source.alias
        if alias is None or alias.dimensions:
            return None
        is_input = is_input or "input" in alias.prefixes
        name, scopes = alias.type, found.scopes
    return name if is_input else None


def with_kept(statements, kept: Mapping[str, object]):
    """Statements in which the kept variables stand in place of inputs."""
    if isinstance(statements, tree.Call) and statements.function in _BEFORE:
        (e,) = statements.arguments
        if isinstance(e, tree.Reference) and e.parts[0] in kept and len(e.parts) == 1:
            return statements._replace(arguments=(tree.Reference((e.parts[0] + KEPT,), e.subscripts),))
    if isinstance(statements, tuple):
        parts = [with_kept(part, kept) for part in statements]
        return type(statements)(*parts) if hasattr(statements, "_fields") else tuple(parts)
    return statements


def with_starts_of_inputs(flat: FlatModel) -> FlatModel:
    """The model whose kept variables start as the inputs do that they keep."""
    declared = {d.name: d for d in flat.model.declarations}
    if not any(KEPT in name for name in declared):
        return flat
    declarations = []
    for d in flat.model.declarations:
        of = declared.get(d.name.replace(KEPT, "")) if KEPT in d.name else None
        starts = {k: v for k, v in of.modifiers.items() if k in ("start", "fixed")} if of is not None else {}
        declarations.append(d._replace(modifiers={**d.modifiers, **starts}))
    return dataclasses.replace(flat, model=flat.model._replace(declarations=tuple(declarations)))
