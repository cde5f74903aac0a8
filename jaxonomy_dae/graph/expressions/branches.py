"""Where the nodes of a graph are needed: the conditions under which a value reaches the results.

A node that stands only in a branch is not needed where another branch is taken. There its value may be infinite or not
a number, and so may its derivative, which a product with zero does not remove. The kernels put a harmless argument in
its place, so that values and derivatives of any order, forward and reverse, never see it.
"""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from .functions import TABLE
from .node import Node, postorder

Literal = tuple[Hashable, bool]
Needed = frozenset[frozenset[Literal]]  # a union of intersections of conditions and their negations

ALWAYS: Needed = frozenset([frozenset()])
NEVER: Needed = frozenset()
LARGEST = 32  # intersections, above which a node counts as always needed


def is_partial(node: Node) -> bool:
    """True if the node, or one of its derivatives, can be infinite or NaN for some finite arguments."""
    if node.operation == "product":
        return any(not isinstance(e, int) or e < 0 for e in node.data)
    if node.operation == "power":
        return True
    return node.operation in TABLE and any(s is not None for s in TABLE[node.operation].safe)


def needed_where(roots: Sequence[Node]) -> dict[Node, Needed]:
    """The conditions under which each node below the roots is needed."""
    order = postorder(roots)
    if not any(n.operation == "select" for n in order):
        return dict.fromkeys(order, ALWAYS)
    needed: dict[Node, Needed] = dict.fromkeys(order, NEVER)
    for root in roots:
        needed[root] = ALWAYS
    # From results downwards: all that uses a node is known when its turn comes.
    for node in reversed(order):
        here = needed[node]
        if node.operation == "select":
            condition, yes, no = node.arguments
            needed[condition] = union(needed[condition], here)
            needed[yes] = union(needed[yes], within(here, (condition, True)))
            needed[no] = union(needed[no], within(here, (condition, False)))
        else:
            for argument in node.arguments:
                needed[argument] = union(needed[argument], here)
    return needed


def guards(roots: Sequence[Node]) -> dict[Node, Needed]:
    """The conditions under which nodes below the roots are needed that can be infinite or NaN elsewhere, as far as
    these conditions can be evaluated before the node. A branch may stand in another condition, too: then it is needed
    more often than its guard can tell."""
    needed = needed_where(roots)
    wanted = {n: parts for n, parts in needed.items() if parts != ALWAYS and is_partial(n)}
    place = {n: k for k, n in enumerate(postorder(roots, lambda n: before(n, wanted)))}
    # A node may stand below the condition of its own guard, where it is shared with it. Then neither can be evaluated
    # first, and such conditions are left out of guards.
    if all(place[a] < place[n] for n in place for a in before(n, wanted)):
        return wanted
    kept: dict[Node, Needed] = {}
    for n in postorder(roots):
        if n in wanted:
            parts = [{(c, holds) for c, holds in part if n not in _below(c, kept)} for part in wanted[n]]
            if all(parts):
                kept[n] = _shortened(frozenset(map(frozenset, parts)))
    return kept


def before(node: Node, guard: Mapping[Node, Needed]) -> tuple[Node, ...]:
    """What is evaluated before a node: its arguments, and the conditions of its guard."""
    conditions: set[Any] = {c for part in guard.get(node, ()) for c, _ in part}
    return (*node.arguments, *sorted(conditions, key=lambda c: c.digest))


def _below(node: Any, guard: Mapping[Node, Needed]) -> set[Node]:
    return set(postorder([node], lambda n: before(n, guard)))


def within(needed: Needed, literal: Literal) -> Needed:
    """Restricts `needed` to the case that `literal` (condition, truth) holds: each intersection gets it added, and
    those that contain its opposite are dropped."""
    opposite = (literal[0], not literal[1])
    return frozenset(parts | {literal} for parts in needed if opposite not in parts)


def union(a: Needed, b: Needed) -> Needed:
    """The union of two sets of intersections, shortened where both are non-empty."""
    if a is b or not b:
        return a
    return _shortened(a | b) if a else b


def _shortened(needed: Needed) -> Needed:
    """Removes redundant intersections from a union: (c ∧ p) ∨ (¬c ∧ p) becomes p, and p ∨ (p ∧ q) becomes p. A union of
    more than `LARGEST` intersections becomes `ALWAYS`."""
    parts = set(needed)
    while len(parts) > 1:
        # All pairs at once (Quine 1955): of c ∧ d, c ∧ ¬d and ¬c ∧ ¬d, the second goes with either other one, and the
        # order of a set, which differs between processes, would choose.
        merged, used = set(), set()
        for part in parts:
            for condition, holds in part:
                rest = part - {(condition, holds)}
                if rest | {(condition, not holds)} in parts:
                    merged.add(rest)
                    used.add(part)
        shorter = merged | (parts - used)
        shorter = {part for part in shorter if not any(other < part for other in shorter)}
        if shorter == parts:
            break
        parts = shorter
    return frozenset(parts) if len(parts) <= LARGEST else ALWAYS
