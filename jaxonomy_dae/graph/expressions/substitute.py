"""Replaces leaves of a graph."""

from collections.abc import Hashable, Mapping, Sequence

from .functions import TABLE, apply
from .node import (
    Node,
    both,
    compare,
    either,
    linear,
    make,
    multiply,
    negate,
    postorder,
    power,
    select,
)


def substitute(node: Node, replaced: Mapping[Hashable, Node]) -> Node:
    """The graph with other nodes in the place of leaves, simplified again."""
    chosen = frozenset(replaced)
    known: dict[Node, Node] = {}
    for n in postorder([node]):
        if n.leaves.isdisjoint(chosen):
            known[n] = n
        elif n.operation == "leaf":
            known[n] = replaced[n.data]
        else:
            known[n] = rebuilt(n, [known[a] for a in n.arguments])
    return known[node]


def rebuilt(n: Node, inside: Sequence[Node]) -> Node:
    """The node with other arguments, simplified."""
    operation = n.operation
    if operation == "sum":
        return linear(zip(n.data[1], inside, strict=True), n.data[0])
    if operation == "product":
        return multiply(*(power(b, e) for b, e in zip(inside, n.data, strict=True)))
    if operation in TABLE:
        return apply(operation, *inside)
    if operation in ("less", "less_equal", "equal"):
        return compare(operation, *inside)
    rebuild = {"power": power, "select": select, "not": negate, "and": both, "or": either}
    return rebuild[operation](*inside) if operation in rebuild else make(operation, tuple(inside), n.data)
