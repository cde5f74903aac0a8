"""How large the terms of an expression are, beside which what is left of them is judged.

The magnitude of a sum is Σ |coefficient|·magnitude, where that of the sum itself may be zero: x + 10⁶ − 10⁶ has the
magnitude |x| + 2·10⁶, and is known to that times the unit of rounding (Wilkinson 1963). A function of an argument
without digits, such as sin(10¹³), is as large as its value, not as its argument. What cancels in the argument still
limits the value: f(a) has the magnitude |f(a)| + |f′(a)|·(magnitude of a − |a|), so that atan2(y − 1, x) is zero to the
digits of y.
"""

from collections.abc import Callable, Hashable

from ...base.tolerances import EPS
from .functions import TABLE, apply
from .node import Node, constant, leaf, linear, multiply, postorder, power, select

LARGER = frozenset({"max", "min", "hypot"})  # are as large as the largest of their arguments, or nearly so
STEEP = frozenset({"asin", "acos"})  # have an infinite slope where they are finite


def magnitude(node: Node, size_label: Callable[[Hashable], Hashable | None]) -> Node:
    """The magnitude of a node as an expression.

    **Arguments:**

    - `size_label`: the label of the magnitude of a leaf, given that of its value; None where it is |value|.
    """
    found: dict[Node, Node] = {}
    cancels: dict[Node, bool] = {}  # a sum in it may be smaller than its terms
    for n in postorder([node]):
        is_sum = n.operation == "sum" and (len(n.arguments) > 1 or n.data[0] != 0)
        cancels[n] = is_sum or any(cancels[a] for a in n.arguments)
        found[n] = _magnitude(n, found, cancels, size_label)
    return found[node]


def _magnitude(
    n: Node, found: dict[Node, Node], cancels: dict[Node, bool], size_label: Callable[[Hashable], Hashable | None]
) -> Node:
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
    size = apply("abs", n)
    if operation not in TABLE or operation in STEEP or not any(cancels[a] for a in n.arguments):
        return size
    excess = [linear([(1, found[a]), (-1, apply("abs", a))]) for a in n.arguments]
    if operation == "atan2":  # an angle, whose slopes are below 1/r
        r = apply("max", apply("hypot", *n.arguments), linear((EPS, found[a]) for a in n.arguments))
        return linear([(1, size), *((1, multiply(e, power(r, -1))) for e in excess)])
    slopes = TABLE[operation].partials(*n.arguments)
    return linear([(1, size), *((1, multiply(apply("abs", s), e)) for s, e in zip(slopes, excess, strict=True))])
