"""Connections of discrete connectors in Modelica sources, written as equations that give an input its value.

rumoca 0.10.2 takes connections of Boolean connectors in arrays, some of others, and all of enumerations for equations
between numbers. It reads an equation `input = output` of them, entry by entry.
"""

import functools
import re
from collections.abc import Iterator

from . import tree
from .marked_source import Change, Mark, changed_text, size_of, type_of, where_array, with_entry
from .sources import Found, Sources
from .tree_text import text_of

_PLACE = "k__"
# Files that may hold such connections.
_MENTIONED = re.compile(r"\bBoolean|\bLogical\b|\.(fire|control)|\bDigital\b|\benumeration\b")


def with_single_connections(sources: Sources, text: str) -> str:
    """The text of a file of a library without connections that are not read."""
    if "connect" not in text or not _MENTIONED.search(text):
        return text
    return changed_text(sources, text, functools.partial(_written_out, sources))


def _written_out(sources: Sources, of: Found, mark: Mark) -> Iterator[Change]:
    call = mark.right
    if not isinstance(call, tree.Call) or call.function != "connect" or len(call.arguments) != 2:
        return
    sides = [e for e in call.arguments if isinstance(e, tree.Reference)]
    ranks = [_rank(sources, of, e, frozenset(mark.local)) for e in sides]
    if len(sides) < 2 or len(set(ranks)) > 1 or ranks[0] not in (0, 1):
        return
    declared = {d.name: d for d, _ in sources.declarations(of)}
    # A connection to what is not there is none, while an equation would lack a name.
    loose = any("conditional" in declared[e.parts[0]].prefixes for e in sides)
    if not ranks[0]:
        if not loose:
            yield mark.begin, mark.end, _given(sources, of, sides, sides)
        return
    places = [where_array(sources, of, e) for e in sides]
    pairs = [(e, at) for e, at in zip(sides, places, strict=True) if at is not None]
    if len(pairs) < 2:
        return
    entries = [with_entry(e, at, tree.Reference((_PLACE,))) for e, at in pairs]
    sizes = [_declared_size(sources, of, *pair) for pair in pairs]
    size = next((s for s in sizes if s is not None), size_of(*pairs[0]))
    connection = f"connect({', '.join(map(text_of, entries))})" if loose else _given(sources, of, sides, entries)
    loop = f"for {_PLACE} in 1:{text_of(size)} loop {connection}; end for"
    yield mark.begin, mark.end, loop


def _rank(sources: Sources, of: Found, e: tree.Reference, local: frozenset[str]) -> int | None:
    """How many dimensions a discrete connector has; None for what is none."""
    kind, rank, followed = type_of(sources, of, e, local)
    known = any(d.name == e.parts[0] for d, _ in sources.declarations(of))
    discrete, causality = _discrete(sources, kind)
    return rank if known and discrete and followed == len(e.parts) and (rank or causality) else None


def _discrete(sources: Sources, kind: Found | None) -> tuple[bool, set[str]]:
    """(True for a connector of Booleans or of an enumeration; whether it is an input or an output)."""
    prefixes: set[str] = set()
    name = ""
    while kind is not None and kind.source.alias is not None:
        prefixes |= kind.prefixes | kind.source.alias.prefixes
        name = kind.source.alias.type
        kind = sources.class_of(name, kind.scopes)
    prefixes |= kind.prefixes if kind is not None else set()
    discrete = name == "Boolean" or kind is not None and bool(kind.source.literals)
    return discrete, prefixes & {"input", "output"}


def _given(sources: Sources, of: Found, sides: list[tree.Reference], written: list[tree.Reference]) -> str:
    """The equation of a connection: an input of a part, or an output of the class, is what the other side is."""
    left, right = (text_of(e) for e in written)
    # A connection of two inputs of parts, or of what is called alike, says by itself which one gives the value.
    receives = [_receives(sources, of, e) for e in sides]
    if receives[0] == receives[1]:
        return f"connect({left}, {right})"
    return f"{left} = {right}" if receives[0] else f"{right} = {left}"


def _receives(sources: Sources, of: Found, e: tree.Reference) -> bool:
    """True for an input of a part, and for an output of the class."""
    first, _, _ = type_of(sources, of, tree.Reference(e.parts[:1], e.subscripts[:1]))
    inside = len(e.parts) > 1 and (first is None or first.source.kind != "connector")
    kind, _, _ = type_of(sources, of, e)
    return ("input" in _discrete(sources, kind)[1]) == inside


def _declared_size(sources: Sources, of: Found, e: tree.Reference, at: int) -> tree.Expression | None:
    """How many entries the declaration of an array of the class gives it, by parameters of the class: rumoca does not
    evaluate the `size` of a connector of the class in the range of a loop."""
    if at > 0:
        return None
    members = {d.name: d for d, _ in sources.declarations(of)}
    size = members[e.parts[0]].dimensions[0] if e.parts[0] in members else tree.Whole()
    known = all(not isinstance(x, tree.Reference) or x.path in members for x in tree.each_part(size))
    return size if known and not isinstance(size, tree.Whole) else None
