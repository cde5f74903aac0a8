"""Linear equations with numeric coefficients."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ...base.aliases import Numeric
from ...base.tolerances import EPS, NOISE
from .template import AbstractTemplate, Slot

MANY = 16  # terms, a junction of an array: the questions that `scaled` asks take longer than a product


class LinearTemplate(AbstractTemplate):
    """Σ coefficient·slot = 0 with numeric coefficients that belong to the instance, for any number of slots."""

    n_parameters = 0

    def __init__(self, n: int, q: int = 0):
        self.slots: tuple[Slot, ...] = tuple((k, q) for k in range(n))
        self.n_coefficients = n
        self._q = q
        self.key = f"linear|{n}|{q}"

    @functools.cached_property
    def derivative(self) -> "LinearTemplate":
        return LinearTemplate(self.n_coefficients, self._q + 1)

    def slots_of_partial(self, position: int) -> frozenset[int]:
        return frozenset()

    def is_affine_in(self, positions: Sequence[int]) -> bool:
        return True

    def coefficient_is_constant(self, position: int) -> bool:
        return True

    coefficient_is_number = coefficient_is_constant
    coefficient_never_vanishes = coefficient_is_constant

    def numbers(self, coefficients: np.ndarray) -> np.ndarray:
        return coefficients

    def is_unmoved(self, direction: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        terms = coefficients * direction
        return np.abs(terms.sum(axis=1)) <= NOISE * EPS * np.abs(terms).sum(axis=1)

    def residual(self, slots, parameters, coefficients, t, networks, backend="jax"):
        # A product with ±1 is exact, so the result is the same.
        if backend == "numpy" and len(slots) > MANY:
            return sum(c * s for c, s in zip(coefficients, slots, strict=True))
        total = 0.0
        for c, s in zip(coefficients, slots, strict=True):
            total = total + scaled(c, s)
        return total

    def magnitude(self, sizes, slots, parameters, coefficients, t, networks, backend="jax"):
        return self.residual(sizes, parameters, [abs(c) for c in coefficients], t, networks, backend)

    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax"):
        return tuple(coefficients)

    def solve(self, position, slots, parameters, coefficients, t, networks, backend="jax"):
        divisor = coefficients[position]
        total = None
        for k, s in enumerate(slots):
            if k != position:
                term = scaled(-coefficients[k] / divisor, s)
                total = term if total is None else total + term
        return 0.0 if total is None else total


def scaled(c: Numeric, s: Numeric) -> Numeric:
    """c·s for a numeric coefficient, a number or one for each instance."""
    # Products with ±1 would be operations of a program, for nothing.
    if np.ndim(c) == 0:
        if c == 1:
            return s
        if c == -1:
            return -s
        return float(c) * s
    if np.all(c == 1):
        return s
    if np.all(c == -1):
        return -s
    return (jnp.asarray(c, s.dtype) if isinstance(s, jax.Array) else c) * s
