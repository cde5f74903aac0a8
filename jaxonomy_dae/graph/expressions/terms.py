"""The terms that an expression is a sum of, products of sums multiplied out."""

from .node import Node, constant, multiply, power, scale, split

MOST = 64  # terms that a product is multiplied out to: their number is a product of the factors' numbers of terms


def terms(node: Node) -> list[Node]:
    """Nodes whose sum is `node`. Arguments of functions are not taken apart."""
    factor, rest = split(node)
    if rest.operation == "sum":
        start, factors = rest.data
        found = [scale(factor * c, t) for c, a in zip(factors, rest.arguments, strict=True) for t in terms(a)]
        return [constant(factor * start), *found] if start else found
    if rest.operation != "product":
        return [node]
    found = [constant(factor)]
    for base, exponent in zip(rest.arguments, rest.data, strict=True):
        parts = terms(base) if exponent == 1 else [power(base, exponent)]
        if len(found) * len(parts) > MOST:
            parts = [base]
        found = [multiply(f, p) for f in found for p in parts]
    return found
