"""Templates: canonical residuals with slots.

An equation of the model is a template and a row of integers that fill its slots. All symbolic work — derivatives,
partial derivatives, solving for a slot, compilation — is done once per distinct equation shape.

A slot is a pair (base, q): the q-th time derivative of what stands in base slot `base`. A template as written has the
slots (0, 0), (1, 0), …; its derivative has slots with higher q too.
"""

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...base.aliases import Numeric
from ...base.tolerances import KNOWN

Slot = tuple[int, int]


class AbstractTemplate(abc.ABC):
    """One residual shape, and all that can be asked of it.

    Values are given as lists: of slots in the order of `slots`, of parameters, of coefficients; each a scalar or an
    array over instances, of one shape. `backend` is "jax" or "numpy". `networks` evaluates opaque functions.
    """

    slots: tuple[Slot, ...]
    n_parameters: int
    n_coefficients: int
    key: str  # equal for equal templates
    opaque: Any = None  # the function that is evaluated in JAX only, if any

    @property
    @abc.abstractmethod
    def derivative(self) -> "AbstractTemplate":
        """The template of the residual's time derivative."""

    @abc.abstractmethod
    def residual(self, slots, parameters, coefficients, t, networks, backend="jax") -> Any:
        """The residual's value."""

    @abc.abstractmethod
    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax") -> tuple:
        """The values of ∂(residual)/∂(slot), one for each slot."""

    @abc.abstractmethod
    def magnitude(self, sizes, slots, parameters, coefficients, t, networks, backend="jax") -> Numeric:
        """The magnitude of the residual's terms (see `expressions.magnitude`); `sizes` are the magnitudes of slots."""

    def partials_with_errors(self, slots, errors, parameters, coefficients, t, networks) -> tuple[tuple, tuple]:
        """`partial_values` in NumPy and bounds of their errors, where `errors` are those of slots, and parameters and
        coefficients are known to `KNOWN`. Here for partial derivatives that are given numbers, or in which nothing is
        seen."""
        found = self.partial_values(slots, parameters, coefficients, t, networks, backend="numpy")
        return tuple(found), tuple(KNOWN * np.abs(v) for v in found)

    def term_values(self, slots, parameters, coefficients, t) -> list:
        """The values of the terms that the residual is a sum of, in NumPy; none where the partial derivatives show them
        all, in a linear equation."""
        return []

    def readers_of_partials(self) -> tuple[list[frozenset[int]], list[frozenset[int]]]:
        """For each slot, and for each parameter, the positions of the partial derivatives that depend on it. Here for
        partial derivatives that are numbers."""
        return [frozenset()] * len(self.slots), [frozenset()] * self.n_parameters

    def readers_of_terms(self) -> tuple[list[frozenset[int]], list[frozenset[int]]]:
        """As `readers_of_partials`, of the values of `term_values`."""
        return [frozenset()] * len(self.slots), [frozenset()] * self.n_parameters

    @abc.abstractmethod
    def solve(self, position: int, slots, parameters, coefficients, t, networks, backend="jax") -> Numeric:
        """The value of the slot at `position` for which the residual, affine in it, is zero; the value given there is
        not read."""

    @abc.abstractmethod
    def slots_of_partial(self, position: int) -> frozenset[int]:
        """The positions of the slots on which ∂(residual)/∂(slot at `position`) depends."""

    @abc.abstractmethod
    def coefficient_is_constant(self, position: int) -> bool:
        """True if ∂(residual)/∂(slot) depends on parameters and numbers only."""

    @abc.abstractmethod
    def coefficient_is_number(self, position: int) -> bool:
        """True if ∂(residual)/∂(slot) is a number other than zero."""

    @abc.abstractmethod
    def coefficient_never_vanishes(self, position: int) -> bool:
        """True if ∂(residual)/∂(slot) is a nonzero number or a product of parameters, safe to divide by."""

    @abc.abstractmethod
    def numbers(self, coefficients: np.ndarray) -> np.ndarray:
        """∂(residual)/∂(slot) where it is a number, else NaN: shape (n, slots), for coefficients of n instances."""

    @abc.abstractmethod
    def is_unmoved(self, direction: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """True if Σ direction·∂(residual)/∂(slot) is zero wherever the slots are; `direction` has shape (n, slots),
        the result (n,). Sums of rounding errors are zero."""

    def is_affine_in(self, positions: Sequence[int]) -> bool:
        """True if the residual is affine, jointly, in the slots at these positions."""
        chosen = frozenset(positions)
        return all(self.slots_of_partial(k).isdisjoint(chosen) for k in positions)
