"""Forms whose parts overflow though they are finite.

1/(1 + eˣ) is finite for all x, yet eˣ is not, and its derivative becomes 0·∞ far from the step; log(1 + eˣ) becomes
infinite. Powers, products and logarithms of such forms are read as functions that are finite with all their
derivatives: the logistic function, its integral, and the hyperbolic secant.
"""

from fractions import Fraction
from typing import NamedTuple

from .functions import HALF, apply
from .node import Node, Number, constant, linear, multiply, number, power, scale, split

FARTHEST = 300.0  # exp(300) and exp(−300) have room for other factors in double precision


class _OnePlusExp(NamedTuple):
    """factor·(1 + exp(exponent)), the factor positive."""

    factor: Number
    exponent: Node


def raised(base: Node, exponent: Node) -> Node:
    """base^exponent."""
    e = number(exponent)
    # Positive whole powers of 1 + eˣ are infinite in truth.
    if e is None or (e > 0 and e == int(e)):
        return power(base, exponent)
    seen = _one_plus_exp(base)
    if seen is not None:
        if e == int(e):
            overflows_nowhere = power(apply("logistic", scale(-1, seen.exponent)), -e)
        else:
            overflows_nowhere = apply("exp", scale(e, apply("softplus", seen.exponent)))
        return multiply(power(constant(seen.factor), e), overflows_nowhere)
    c, rest = split(base)
    if rest.operation == "cosh" and c > 0:
        (u,) = rest.arguments
        if e == int(e):
            return multiply(power(constant(c), e), power(apply("sech", u), -e))
        # log(2·cosh u) = softplus(2·u) − u
        logarithm_of_twice = linear([(1, apply("softplus", scale(2, u))), (-1, u)])
        return multiply(power(scale(HALF, constant(c)), e), apply("exp", scale(e, logarithm_of_twice)))
    return power(base, e)


def product(*nodes: Node) -> Node:
    """The product: eˣ·logistic(−x) is logistic(x), and the like."""
    found = multiply(*nodes)
    c, rest = split(found)
    if rest.operation != "product":
        return found
    powers = dict(zip(rest.arguments, rest.data, strict=True))
    for grows in rest.arguments:
        if grows.operation != "exp" or not powers[grows] > 0:
            continue
        (u,) = grows.arguments
        for falls in rest.arguments:
            if falls.operation != "logistic":
                continue
            shift = number(linear([(1, u), (1, falls.arguments[0])]))
            shared = min(powers[grows], powers[falls])
            if shift is None or not shared > 0:
                continue
            # exp(u)·logistic(d − u) = exp(d)·logistic(u − d)
            powers[grows] -= shared
            powers[falls] -= shared
            if abs(shared * shift) < FARTHEST:
                c = number(multiply(constant(c), power(apply("exp", constant(shift)), shared)))
                assert c is not None
                risen = apply("logistic", linear([(1, u)], -shift))
            else:  # exp(d) overflows, or is lost; so d stays beside the logarithm of the other factor
                risen = apply("exp", linear([(-1, apply("softplus", falls.arguments[0]))], shift))
            powers[risen] = powers.get(risen, 0) + shared
    return multiply(constant(c), *(power(b, e) for b, e in powers.items()))


def logarithm(u: Node) -> Node:
    """log u."""
    seen = _one_plus_exp(u)
    if seen is not None:
        return linear([(1, apply("log", constant(seen.factor))), (1, apply("softplus", seen.exponent))])
    c, rest = split(u)
    if rest.operation == "sum" and not rest.data[0] and c > 0:
        # log(eᵃ + eᵇ) = a + softplus(b − a), in which no exponential overflows.
        exponents = [_exponent(factor, node) for factor, node in zip(rest.data[1], rest.arguments, strict=True)]
        if len(exponents) == 2 and None not in exponents:
            one, other = (e for e in exponents if e is not None)
            return linear([
                (1, apply("log", constant(c))), (1, one), (1, apply("softplus", linear([(1, other), (-1, one)])))
            ])  # fmt: skip
    return apply("log", u)


def logarithm_of_one_plus(u: Node) -> Node:
    """log(1 + u)."""
    exponent = _exponent(*split(u))
    return apply("log1p", u) if exponent is None else apply("softplus", exponent)


def _one_plus_exp(node: Node) -> _OnePlusExp | None:
    c, rest = split(node)
    if rest.operation != "sum" or len(rest.arguments) != 1:
        return None
    start, (factor,) = rest.data
    if not (start > 0 and c > 0):
        return None
    exponent = _exponent(_ratio(factor, start), rest.arguments[0])
    return None if exponent is None else _OnePlusExp(c * start, exponent)


def _exponent(factor: Number, node: Node) -> Node | None:
    """w, where factor·node is exp(w)."""
    if node.operation != "exp" or not factor > 0:
        return None
    shift = number(apply("log", constant(factor)))
    assert shift is not None
    return linear([(1, node.arguments[0])], shift)


def _ratio(a: Number, b: Number) -> Number:
    return a / b if isinstance(a, float) or isinstance(b, float) else Fraction(a) / Fraction(b)
