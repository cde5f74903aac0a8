"""Connections of arrays of Boolean connectors in Modelica sources, written entry by entry.

rumoca 0.10.2 takes the connection of two such arrays for an equation between numbers. It reads loops over entries.
"""

import functools
import re
from collections.abc import Iterator

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
    loop = f"for {_PLACE} in 1:{text_of(size_of(*places[0]))} loop connect({', '.join(entries)}); end for"
    yield mark.begin, mark.end, loop


def _is_boolean(kind: Found | None) -> bool:
    return kind is not None and kind.source.alias is not None and kind.source.alias.type == "Boolean"
