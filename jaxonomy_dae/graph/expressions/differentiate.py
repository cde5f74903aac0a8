"""Derivatives of expressions by forward accumulation: each node is visited once."""

from collections.abc import Hashable, Mapping

from .functions import TABLE, apply
from .node import ONE, ZERO, Node, both, compare, leaf, linear, multiply, postorder, power, scale, select
from .smooth import marked


def directional_derivative(node: Node, direction: Mapping[Hashable, Node]) -> Node:
    """Σ ∂node/∂leaf · direction[leaf], over the labels of leaves in `direction`.

    The derivative of a step is zero, and that of a branch is taken inside the branch.
    """
    moving = frozenset(direction)
    slope: dict[Node, Node] = {}
    if node.leaves.isdisjoint(moving):
        return ZERO
    for n in postorder([node], lambda n: [a for a in n.arguments if not a.leaves.isdisjoint(moving)]):
        if n.operation == "leaf":
            slope[n] = direction[n.data]
        else:
            slope[n] = _slope(n, [slope.get(a, ZERO) for a in n.arguments])
    return slope[node]


def partial_derivative(node: Node, label: Hashable) -> Node:
    """∂node/∂leaf."""
    if label not in node.leaves:
        return ZERO
    return directional_derivative(node, {label: ONE})


def _slope(n: Node, inner: list[Node]) -> Node:
    operation = n.operation
    if operation == "sum":
        return linear(zip(n.data[1], inner, strict=True))
    if operation == "product":
        return _product_slope(n, inner)
    if operation == "select":
        condition, _, _ = n.arguments
        return select(condition, inner[1], inner[2])
    if operation == "smooth":
        # The derivative has the same branches, and they are no events either.
        return marked(inner[0])
    if operation == "power":
        base, exponent = n.arguments
        terms = []
        # The two parts stand apart: where the exponent does not move there is no logarithm of the base, which may be
        # negative.
        if inner[0] is not ZERO:
            terms.append((1, multiply(exponent, power(base, linear([(1, exponent)], -1)), inner[0])))
        if inner[1] is not ZERO:
            # 0^p·log 0 is zero for p > 0, and no number as it stands.
            vanishes = both(compare("equal", base, ZERO), compare("less", ZERO, exponent))
            terms.append((1, multiply(select(vanishes, ZERO, multiply(n, apply("log", base))), inner[1])))
        return linear(terms)
    if operation not in TABLE:
        return ZERO  # conditions
    terms = []
    for partial, direction in zip(TABLE[operation].partials(*n.arguments), inner, strict=True):
        if direction is not ZERO:
            terms.append((1, multiply(partial, direction)))
    return linear(terms)


def _product_slope(n: Node, inner: list[Node]) -> Node:
    """Σ exponent · base^(exponent − 1) · slope · (the other factors), a product tree where there are many."""
    factors = [power(b, e) for b, e in zip(n.arguments, n.data, strict=True)]
    slopes = [
        ZERO if s is ZERO else scale(e, multiply(power(b, e - 1), s))
        for b, e, s in zip(n.arguments, n.data, inner, strict=True)
    ]
    # Each slope beside all the other factors would be n² products. Merging pairs halves the factors at each pass.
    while len(factors) > 8:
        paired, moved = [], []
        for k in range(0, len(factors) - 1, 2):
            paired.append(multiply(factors[k], factors[k + 1]))
            terms = [(1, multiply(slopes[k], factors[k + 1])), (1, multiply(factors[k], slopes[k + 1]))]
            moved.append(linear(terms))
        if len(factors) % 2:
            paired.append(factors[-1])
            moved.append(slopes[-1])
        factors, slopes = paired, moved
    return linear((1, multiply(*factors[:k], s, *factors[k + 1 :])) for k, s in enumerate(slopes) if s is not ZERO)


def raised(labels: Mapping[Hashable, Hashable], time: Hashable | None) -> dict[Hashable, Node]:
    """The direction of a total time derivative: each label's leaf moves by the leaf it is mapped to, time by one."""
    direction = {label: leaf(above) for label, above in labels.items()}
    if time is not None:
        direction[time] = ONE
    return direction
