"""Clocked partitions of a model that rumoca has flattened: the equations of each clock as a `when` of its ticks.

A clocked variable has a value at the ticks of its clock, which it keeps in between: `hold` reads it there, and
`previous` what it was at the tick before (Modelica Language Specification 3.6, chapter 16). So its equation is one of a
`when`, in which `pre` is `previous`. What a partition samples is what it was before anything happened at the instant.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ..base.errors import ModelError
from . import tree
from .definitions import matched
from .rumoca_expressions import RumocaExpressions

SAMPLED = "sampled"  # the call sampled(u, start, interval): u before the ticks of a clock


def with_clocked_equations(
    of: RumocaExpressions, equations: Sequence[tree.Statement]
) -> tuple[list[tree.Branches], list[tree.Statement]]:
    """Splits the equations of discrete variables: those of clocked ones as whens, one for each clock, and all others.

    **Raises:**

    - `ModelError` for a clocked equation without a variable alone on one side that it could determine.
    """
    clocks: dict[str, int] = {}
    sampled: set[str] = set()
    for each in of.storage["clock_ownerships"]:
        name = of.variables[each["variable"]]["name"]
        clocks[name] = each["clock"]
        if each.get("sampled"):
            sampled.add(name)
    if not clocks:
        return [], list(equations)
    # Of Boolean and Integer variables, rumoca says which equation determines them: their sides are not exchanged.
    owned = {v["name"] for v in of.variables if v["role"] == "discrete_value"}
    candidates = [(e, _sides(e, clocks, owned)) for e in equations]
    others = [e for e, sides in candidates if not sides]
    values, left = matched([each for each in candidates if each[1]], lambda name: _whole(name) in clocks)
    if left:
        raise ModelError(f"{of.name}, line {left[0].line}: a clocked equation does not say what it determines")
    lines = {name: e.line for e, sides in candidates for name, _ in sides}
    bodies: dict[int, list[tree.Statement]] = {}
    for name, value in values.items():
        clock = clocks[_whole(name)]
        if _whole(name) in sampled:
            value = tree.Call(SAMPLED, (_at_present(value, clocks), *of.clock(clock).arguments), ())
        bodies.setdefault(clock, []).append(tree.Equality(tree.Reference((name,)), value, lines[name]))
    whens = [tree.Branches("when", ((of.clock(clock), tuple(body)),), body[0].line) for clock, body in bodies.items()]
    return whens, others


def _sides(e: tree.Statement, clocks: Mapping[str, int], owned: Collection[str]) -> list[tuple[str, tree.Expression]]:
    """The clocked variables that an equation can determine, each with its value."""
    if not isinstance(e, tree.Equality):
        return []
    pairs = [(e.left, e.right), (e.right, e.left)]
    if isinstance(e.left, tree.Reference) and _whole(e.left.path) in owned:
        pairs = pairs[:1]
    return [
        (_name(side), other)
        for side, other in pairs
        if isinstance(side, tree.Reference) and _whole(side.path) in clocks
    ]


def _name(e: tree.Reference) -> str:
    places = ",".join(str(s.value) for s in e.subscripts[-1] if isinstance(s, tree.Number))
    return f"{e.path}[{places}]" if places else e.path


def _whole(name: str) -> str:
    """The array of an entry."""
    return re.sub(r"\[[\d,]+\]$", "", name)


def _at_present(e: Any, clocks: Mapping[str, int]) -> Any:
    """A sampled value without the `pre` that rumoca writes around what is Boolean or Integer in it."""
    if isinstance(e, tree.Call) and e.function == "pre":
        (of,) = e.arguments
        return of if isinstance(of, tree.Reference) and _whole(of.path) not in clocks else e
    if isinstance(e, tuple):
        parts = [_at_present(part, clocks) for part in e]
        return type(e)(*parts) if hasattr(e, "_fields") else tuple(parts)
    return e
