"""What a class declares and where its equations stand, for a message that it has too many or too few of them."""

from . import tree
from .sources import Found, Sources

_OUTSIDE = {"parameter", "constant", "input"}


def balance(sources: Sources, found: Found) -> str:
    """The variables of a class, with those that none of its equations names, and the lines of its equations."""
    declared = [d for d, _ in sources.declarations(found) if not d.prefixes & _OUTSIDE]
    equations = [e for part in sources.lineage(found) for e in part.source.equations]
    read = tree.each_part((tuple(equations), tuple(d.value for d in declared)))
    named = {r.parts[0] for r in read if isinstance(r, tree.Reference)}
    loose = [d.name for d in declared if d.name not in named and d.value is None]
    lines = ", ".join(map(str, sorted({e.line for e in equations}))) or "none"
    text = f"Variables: {', '.join(d.name for d in declared)}. Lines of equations: {lines}"
    return f"{text}. No equation names {', '.join(loose)}" if loose else text
