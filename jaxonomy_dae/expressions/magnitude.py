"""How large the terms of an expression are, beside which what is left of them is judged.

The magnitude of a sum is Σ |coefficient|·magnitude, where that of the sum itself may be zero: x + 10⁶ − 10⁶ has the
magnitude |x| + 2·10⁶, and is known to that times the unit of rounding (Wilkinson 1963). A function of an argument
without digits, such as sin(10¹³), is as large as its value, not as its argument.
"""

from collections.abc import Callable, Hashable

from .functions import apply
from .node import Node, constant, leaf, linear, multiply, postorder, power, select

LARGER = frozenset({"max", "min", "hypot"})  # are as large as the largest of their arguments, or nearly so


def magnitude(node: Node, size_label: Callable[[Hashable], Hashable | None]) -> Node:
    """The magnitude of a node as an expression.

    **Arguments:**

    - `size_label`: the label of the magnitude of a leaf, given that of its value; None where it is |value|.
    """
    found: dict[Node, Node] = {}
    for n in postorder([node]):
        found[n] = _magnitude(n, found, size_label)
    return found[node]


def _magnitude(n: Node, found: dict[Node, Node], size_label: Callable[[Hashable], Hashable | None]) -> Node:
    operation = n.operation
    if operation == "leaf":
        label = size_label(n.data)
        return apply("abs", n) if label is None else leaf(label)
    if operation == "constant":
        return constant(abs(n.data))
    if operation == "sum":
        start, coefficients = n.data
        sizes = ((abs(c), found[a]) for c, a in zip(coefficients, n.arguments, strict=True))
        return linear(sizes, abs(start))
    if operation == "product":
        pairs = zip(n.arguments, n.data, strict=True)
        return multiply(
            *(power(found[b], e) if isinstance(e, int) and e > 0 else power(apply("abs", b), e) for b, e in pairs)
        )
    if operation == "select":
        condition, yes, no = n.arguments
        return select(condition, found[yes], found[no])
    if operation in ("abs", "smooth"):
        return found[n.arguments[0]]
    if operation in LARGER:
        return linear((1, found[a]) for a in n.arguments)
    if operation in ("true", "false", "less", "less_equal", "equal", "not", "and", "or"):
        return n  # a condition
    return apply("abs", n)
