"""Groups of equations, and their numbers in NumPy.

A group is a template and the integers that fill it, one row for each instance. Here is the only place that puts the
arguments of a template together in NumPy; `system.evaluate` does so for traced values.
"""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from ..aliases import Numeric
from .opaque import Networks
from .template import AbstractTemplate

G = TypeVar("G", bound="Group")


@dataclasses.dataclass(frozen=True)
class Point:
    """Where equations are evaluated: the values of all quantities and parameters, the time, and networks."""

    values: np.ndarray  # (quantities + 1,): the last entry is the constant zero, which ZERO = −1 reads
    parameters: np.ndarray  # (parameters,)
    t: float
    networks: Networks = dataclasses.field(default_factory=lambda: Networks(()))

    @classmethod
    def of(cls, values: np.ndarray, parameters: np.ndarray, t: float, networks: Networks | None = None) -> "Point":
        """A point, from the values of the quantities alone, (quantities,)."""
        return cls(np.append(values, 0.0), parameters, t, Networks(()) if networks is None else networks)

    def at(self, values: np.ndarray) -> "Point":
        """A copy with other values of the quantities, (quantities,)."""
        return dataclasses.replace(self, values=np.append(values, 0.0))


@dataclasses.dataclass(frozen=True)
class Group:
    """n instances of one template: slot k of instance i is factor[i, k]·quantity[i, k].

    Numbers that are not finite are returned without a warning: those who ask for them name the equation.
    """

    template: AbstractTemplate
    equation: np.ndarray  # (n,): the numbers of the equations
    quantity: np.ndarray  # (n, slots); ZERO: the constant zero
    factor: np.ndarray  # (n, slots)
    parameter: np.ndarray  # (n, parameters of the template)
    coefficient: np.ndarray  # (n, coefficients of the template)

    def __len__(self):
        return len(self.equation)

    def take(self: G, rows: np.ndarray | Sequence[int] | slice) -> G:
        """The instances of these rows."""
        columns = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return dataclasses.replace(self, **{n: c[rows] for n, c in columns.items() if isinstance(c, np.ndarray)})

    def apart(self) -> "Group":
        """The instances with a quantity and a parameter for each place in which one reads them, by rows: moving one of
        them moves nothing in other places."""
        quantities, parameters = (np.arange(ids.size).reshape(ids.shape) for ids in (self.quantity, self.parameter))
        return Group(self.template, self.equation, quantities, self.factor, parameters, self.coefficient)

    def slots(self, values: np.ndarray) -> list[np.ndarray]:
        """The values of each slot, (n,), where the quantities have values of shape (quantities + 1,)."""
        return list((self.factor * values[self.quantity]).T)

    def numbers(self, at: Point) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The parameters and the coefficients of the template, each (n,)."""
        return list(at.parameters[self.parameter].T), list(self.coefficient.T)

    @np.errstate(all="ignore")
    def residual(self, at: Point) -> Float[np.ndarray, " n"]:
        """The residuals."""
        out = self.template.residual(self.slots(at.values), *self.numbers(at), at.t, at.networks, backend="numpy")
        return np.broadcast_to(np.asarray(out, float), (len(self),))

    @np.errstate(all="ignore")
    def partials(self, at: Point) -> Float[np.ndarray, "n slots"]:
        """∂(residual)/∂(quantity), by slots."""
        slots = self.slots(at.values)
        out = self.template.partial_values(slots, *self.numbers(at), at.t, at.networks, backend="numpy")
        return self._stacked(out) * self.factor

    @np.errstate(all="ignore")
    def partial_errors(self, at: Point, errors: np.ndarray) -> Float[np.ndarray, "n slots"]:
        """Bounds of the errors of these partial derivatives, given those of all quantities, (quantities + 1,)."""
        of_slots = [np.abs(e) for e in self.slots(errors)]
        out = self.template.partial_errors(self.slots(at.values), of_slots, *self.numbers(at), at.t, at.networks)
        return self._stacked(out) * np.abs(self.factor)

    @np.errstate(all="ignore")
    def partials_along(self, at: Point, move: np.ndarray) -> Float[np.ndarray, "n slots"]:
        """The derivatives of these partial derivatives where all quantities move by `move`, (quantities + 1,): what
        moves so makes them the partial derivatives of the residual's time derivative."""
        place = {slot: k for k, slot in enumerate(self.template.slots)}
        there, derivative = self.slots(at.values), self.template.derivative

        def partials(moved: Sequence[np.ndarray]) -> tuple:
            slots = [there[place[s]] if s in place else moved[place[s[0], s[1] - 1]] for s in derivative.slots]
            return derivative.partial_values(slots, *self.numbers(at), at.t, at.networks, backend="numpy")

        moving = partials(self.slots(move))
        still = partials([np.zeros(len(self))] * len(there))  # what changes with time alone
        out = np.zeros(self.factor.shape)
        for slot, a, b in zip(derivative.slots, moving, still, strict=True):
            if slot in place:
                out[:, place[slot]] = np.asarray(a, float) - np.asarray(b, float)
        return out * self.factor

    @np.errstate(all="ignore")
    def terms(self, at: Point) -> Float[np.ndarray, "n terms"]:
        """The terms that the residuals are sums of; none where partial derivatives show them all."""
        found = self.template.term_values(self.slots(at.values), *self.numbers(at), at.t)
        return np.array([np.broadcast_to(v, (len(self),)) for v in found], float).reshape(-1, len(self)).T

    @np.errstate(all="ignore")
    def solved(self, slot: int, at: Point) -> Float[np.ndarray, " n"]:
        """The quantities in a slot for which the residuals, affine in it, are zero."""
        out = self.template.solve(slot, self.slots(at.values), *self.numbers(at), at.t, at.networks, backend="numpy")
        return np.broadcast_to(np.asarray(out, float), (len(self),)) / self.factor[:, slot]

    def _stacked(self, by_slot: Sequence[Numeric]) -> np.ndarray:
        shape = (len(self),)
        columns = [v if np.shape(v) == shape else np.broadcast_to(np.asarray(v, float), shape) for v in by_slot]
        return np.array(columns, float).T if columns else np.zeros((*shape, 0))
