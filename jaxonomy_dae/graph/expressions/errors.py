"""Error bounds beside values: running error analysis of expression graphs (Wilkinson 1963; Higham 2002, section 3.3).

Given bounds of the errors of a graph's leaves, each node gets the bound

    err(f) = Σ |∂f/∂aₖ|·err(aₖ) + u·Σ|terms of f|,    u the unit of rounding,

so that a value below its bound cannot be told from zero: 0.1 + 0.2 − 0.3, or sin(π) with π = 3.14159…. The first order
is enough where errors are of the size of rounding; products are bounded to all orders, since a factor may be zero.
Which branch is taken, and between which of its jumps a step is, counts as known.
"""

import functools
from collections.abc import Hashable, Sequence

import numpy as np

from ...base.aliases import Numeric
from ...base.tolerances import EPS, KNOWN
from .functions import TABLE
from .kernel import Kernel, is_active
from .node import Node, Number, leaf

# Functions that take arguments of any unit and size. All others take dimensionless arguments of order one, for which an
# absolute error of eps is assumed: a computed angle of 1e-17 is zero to rounding.
WITHOUT_SCALE = frozenset(
    {"abs", "sign", "floor", "ceiling", "heaviside", "max", "min", "mod", "hypot", "atan2", "log", "loggamma"}
)


class KernelWithErrors:
    """A function of the leaves' values and of bounds of their errors, in the order of `labels`, that returns the roots'
    values and bounds of their errors, in NumPy."""

    def __init__(self, roots: Sequence[Node], labels: Sequence[Hashable]):
        self._kernel = Kernel(roots, labels)

    def __call__(self, values: Sequence[Numeric], errors: Sequence[Numeric]) -> tuple[list[Numeric], list[Numeric]]:
        """A value of `errors` is absolute; it has the shape of the leaf's value, or one that is broadcast."""
        with np.errstate(all="ignore"):
            found = self._kernel.all_values([np.asarray(v, float) for v in values])
            errors = [np.asarray(e, float) for e in errors]
            bounds: list[Numeric] = [0.0] * len(found)
            for k, position in self._kernel.leaves:
                bounds[k] = errors[position]
            for k, value in self._kernel.constants:
                is_exact = isinstance(value, np.bool_) or value.is_integer()
                bounds[k] = 0.0 if is_exact else EPS * abs(value)
            for k, node, places, guard in self._kernel.steps:
                inside = [found[a] for a in places]
                bound = _bound(node, found[k], inside, [bounds[a] for a in places])
                # Where a branch is not taken its values are arbitrary, and so would be their errors.
                bounds[k] = bound if guard is None else np.where(is_active(found, guard), bound, 0.0)
        results = self._kernel.results
        return [found[r] for r in results], [bounds[r] for r in results]


def _bound(node: Node, value: Numeric, inside: list[Numeric], errors: list[Numeric]) -> Numeric:
    operation = node.operation
    if operation == "sum":
        start, coefficients = node.data
        terms = [abs(float(c)) * np.abs(a) for c, a in zip(coefficients, inside, strict=True)]
        carried = [abs(float(c)) * e for c, e in zip(coefficients, errors, strict=True)]
        return sum(carried) + EPS * (abs(float(start)) + sum(terms))
    if operation == "product":
        return _product(node.data, value, inside, errors)
    if operation == "power":
        base, exponent = inside
        by_base = np.abs(value * exponent / base)
        by_exponent = np.abs(value * np.log(np.abs(base)))
        return _times(by_base, errors[0]) + _times(by_exponent, errors[1]) + EPS * np.abs(value)
    if operation == "select":
        return np.where(inside[0], errors[1], errors[2])
    if operation not in TABLE:
        return 0.0  # a condition
    slopes = _slopes(operation, len(inside))(inside, "numpy")
    if operation not in WITHOUT_SCALE:
        errors = [np.where(e == 0.0, 0.0, np.maximum(e, KNOWN)) for e in errors]
    carried = [_times(np.abs(s), e) for s, e in zip(slopes, errors, strict=True)]
    return sum(carried) + EPS * np.abs(value)


def _product(exponents: Sequence[Number], value: Numeric, bases: list[Numeric], errors: list[Numeric]) -> Numeric:
    """Π(|b| + err(b))^e − Π|b|^e, and a rounding for each factor."""
    growth, largest = 0.0, 1.0
    for base, error, exponent in zip(bases, errors, exponents, strict=True):
        size = np.abs(base)
        relative = np.where(error == 0.0, 0.0, error / size)
        e = float(exponent)
        # A divisor that may be zero leaves the quotient open to the first order alone.
        growth = growth + (e * np.log1p(relative) if e > 0 else -e * relative)
        largest = largest * (size + error) ** e if e > 0 else largest * size**e
    grown = np.where(value == 0.0, largest, np.abs(value) * np.expm1(growth))
    return grown + EPS * len(bases) * np.abs(value)


def _times(slope: Numeric, error: Numeric) -> Numeric:
    """slope·error, which is zero for an exact value (error 0) even if the slope is infinite."""
    return np.where(error == 0.0, 0.0, slope * error)


@functools.cache
def _slopes(operation: str, count: int) -> Kernel:
    arguments = [leaf(("argument", k)) for k in range(count)]
    return Kernel(TABLE[operation].partials(*arguments), [a.data for a in arguments])
