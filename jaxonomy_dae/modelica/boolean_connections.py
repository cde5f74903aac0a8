"""Connections of Boolean connectors in Modelica sources, written as rumoca reads them.

rumoca 0.10.2 takes the connection of two arrays of such connectors for an equation between numbers. It reads loops over
entries. It does the same with an input of a class and inputs of its components, but reads equations between them.
"""

import functools
import re
from collections.abc import Iterator, Sequence

from . import tree
from .marked_source import Change, Mark, changed_text, size_of, type_of, where_array, with_entry
from .sources import Found, Sources
from .tree_text import text_of

_PLACE = "k__"
_MENTIONED = re.compile(r"\bBoolean|\bLogical\b|\.(fire|control)\b")  # files that may hold such connections


def with_single_connections(sources: Sources, text: str) -> str:
    """The text of a file of a library without connections of arrays of Boolean connectors."""
    if "connect" not in text or not _MENTIONED.search(text):
        return text
    return changed_text(sources, text, functools.partial(_written_out, sources))


def _written_out(sources: Sources, of: Found, mark: Mark) -> Iterator[Change]:
    call = mark.right
    if not isinstance(call, tree.Call) or call.function != "connect" or len(call.arguments) != 2:
        return
    inside = _given_inside(sources, of, call.arguments)
    if inside is not None:
        yield mark.begin, mark.end, " = ".join(map(text_of, inside))
        return
    places: list[tuple[tree.Reference, int]] = []
    for side in call.arguments:
        if not isinstance(side, tree.Reference):
            return
        kind, rank, followed = type_of(sources, of, side, frozenset(mark.local))
        if not _is_boolean(kind) or rank != 1 or followed != len(side.parts):
            return
        at = where_array(sources, of, side)
        if at is None:
            return
        places.append((side, at))
    entries = [text_of(with_entry(side, at, tree.Reference((_PLACE,)))) for side, at in places]
    sizes = [_declared_size(sources, of, *place) for place in places]
    size = next((s for s in sizes if s is not None), size_of(*places[0]))
    loop = f"for {_PLACE} in 1:{text_of(size)} loop connect({', '.join(entries)}); end for"
    yield mark.begin, mark.end, loop


def _given_inside(
    sources: Sources, of: Found, sides: Sequence[tree.Expression]
) -> tuple[tree.Reference, tree.Reference] | None:
    """(An input of a component, the input of the class that gives it its value), if they are connected here."""
    outer, inner = sorted(sides, key=lambda e: len(e.parts) if isinstance(e, tree.Reference) else 0)
    if not isinstance(outer, tree.Reference) or not isinstance(inner, tree.Reference):
        return None
    if (len(outer.parts), len(inner.parts)) != (1, 2) or any((*outer.subscripts, *inner.subscripts)):
        return None
    members = {d.name: d for d, _ in sources.declarations(of)}
    declared = [members.get(side.parts[0]) for side in (outer, inner)]
    if any(d is None or d.dimensions or "conditional" in d.prefixes for d in declared):
        return None
    for side in (outer, inner):
        kind, rank, followed = type_of(sources, of, side)
        if not _is_boolean(kind) or rank or followed != len(side.parts) or "input" not in _prefixes(kind):
            return None
    return inner, outer


def _declared_size(sources: Sources, of: Found, e: tree.Reference, at: int) -> tree.Expression | None:
    """How many entries the declaration of an array of the class gives it, by parameters of the class: rumoca does not
    evaluate the `size` of a connector of the class in the range of a loop."""
    if at > 0:
        return None
    members = {d.name: d for d, _ in sources.declarations(of)}
    size = members[e.parts[0]].dimensions[0] if e.parts[0] in members else tree.Whole()
    known = all(not isinstance(x, tree.Reference) or x.path in members for x in tree.each_part(size))
    return size if known and not isinstance(size, tree.Whole) else None


def _prefixes(kind: Found | None) -> frozenset[str]:
    return kind.source.alias.prefixes if kind is not None and kind.source.alias is not None else frozenset()


def _is_boolean(kind: Found | None) -> bool:
    return kind is not None and kind.source.alias is not None and kind.source.alias.type == "Boolean"
