"""Roots of an unknown itself, whose slope is infinite where the unknown is zero."""

from collections.abc import Callable, Hashable, Iterable

from .node import Node, postorder


def takes_roots(graphs: Iterable[Node], is_unknown: Callable[[Hashable], bool]) -> bool:
    """True if an unknown, its size or a multiple of one of these is raised to a power between 0 and 1, as in √|x|.
    A length √(x² + y²) is not of this kind."""
    for n in postorder(list(graphs)):
        if n.operation == "product":
            steep = [base for base, e in zip(n.arguments, n.data, strict=True) if not isinstance(e, int) and 0 < e < 1]
        else:
            steep = [n.arguments[0]] if n.operation == "power" else []
        if any(_is_multiple(base, is_unknown) for base in steep):
            return True
    return False


def _is_multiple(node: Node, is_unknown: Callable[[Hashable], bool]) -> bool:
    """True for an unknown and its absolute value, times anything else."""
    while node.operation in ("abs", "smooth", "sum") and len(node.arguments) == 1:
        if node.operation == "sum" and node.data[0] != 0:
            return False
        node = node.arguments[0]
    if node.operation == "product":
        return any(_is_multiple(argument, is_unknown) for argument in node.arguments)
    return node.operation == "leaf" and is_unknown(node.data)
