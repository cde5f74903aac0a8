"""Groups of equations, and their numbers in NumPy.

A group is a template and the integers that fill it, one row for each instance. Equations, accounts of energy, waves and
expressions in parameters are groups; they differ in what their slots hold. Here is the only place that puts the
arguments of a template together in NumPy; `system.values` does so for traced values.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float

from ...base.aliases import Numeric
from .linear_template import MANY, LinearTemplate
from .opaque import Networks
from .provenance import Provenances
from .template import AbstractTemplate

Rows: TypeAlias = np.ndarray | list[int] | slice
C = TypeVar("C", bound="Columns")
G = TypeVar("G", bound="Group")


@dataclasses.dataclass(frozen=True)
class Columns:
    """A record whose arrays have one row for each of n things."""

    def take(self: C, rows: Rows) -> C:
        """The record of these rows."""
        # Columns of a large model are not copied for nothing.
        if isinstance(rows, np.ndarray) and rows.dtype == bool and rows.all():
            return self
        columns = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        chosen = {n: c[rows] for n, c in columns.items() if isinstance(c, np.ndarray)}
        chosen |= {n: c.take(rows) for n, c in columns.items() if isinstance(c, Provenances)}
        return dataclasses.replace(self, **chosen)


@dataclasses.dataclass(frozen=True)
class Group(Columns):
    """n instances of one template. What its slots hold is said by the groups that are made of this one."""

    template: AbstractTemplate
    factor: np.ndarray  # (n, slots), by which what stands in a slot is multiplied
    parameter: np.ndarray  # (n, parameters of the template)
    coefficient: np.ndarray  # (n, coefficients of the template)

    def __len__(self):
        return len(self.parameter)

    @classmethod
    def joined(cls, groups: Sequence[G]) -> G:
        """One group of all instances of groups of one template."""
        first = groups[0]
        columns = {f.name: [getattr(g, f.name) for g in groups] for f in dataclasses.fields(first)}
        arrays = {n: np.concatenate(c) for n, c in columns.items() if isinstance(c[0], np.ndarray)}
        texts = {n: Provenances.joined(c) for n, c in columns.items() if isinstance(c[0], Provenances)}
        return dataclasses.replace(first, **arrays, **texts)

    def reading(self, quantity: np.ndarray, equation: np.ndarray | None = None) -> "QuantityGroup":
        """The instances with these quantities in their slots, (n, slots); equations are numbered through by default."""
        equation = np.arange(len(self)) if equation is None else equation
        return QuantityGroup(self.template, self.factor, self.parameter, self.coefficient, quantity, equation)

    def apart(self) -> "QuantityGroup":
        """The instances with a quantity and a parameter for each place in which one is read, by rows: moving one of
        them moves nothing in other places."""
        quantities, parameters = (np.arange(ids.size).reshape(ids.shape) for ids in (self.factor, self.parameter))
        return dataclasses.replace(self.reading(quantities), parameter=parameters)

    def numbers(self, parameters: Numeric) -> tuple[list[Numeric], list[np.ndarray]]:
        """The parameters and the coefficients of the template, each (*batch, n), given all parameters."""
        return [parameters[..., column] for column in self.parameter.T], list(self.coefficient.T)


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
class QuantityGroup(Group):
    """Equations in quantities: slot k of instance i is factor[i, k]·quantity[i, k].

    Numbers that are not finite are returned without a warning: those who ask for them name the equation.
    """

    quantity: np.ndarray  # (n, slots); ZERO: the constant zero
    equation: np.ndarray  # (n,): the numbers of the equations

    def slots(self, values: np.ndarray) -> list[np.ndarray]:
        """The values of each slot, (n,), where the quantities have values of shape (quantities + 1,)."""
        return list((self.factor * values[self.quantity]).T)

    def _arguments(self, at: Point) -> tuple[Any, ...]:
        return self.slots(at.values), *self.numbers(at.parameters), at.t, at.networks

    @np.errstate(all="ignore")
    def residual(self, at: Point) -> Float[np.ndarray, " n"]:
        """The residuals."""
        # A sum of columns one by one takes Python's time for each term. `np.sum` would add in pairs: other roundings
        # than those of the short equations.
        if isinstance(self.template, LinearTemplate) and self.factor.shape[1] > MANY:  # from the first term to the last
            return np.cumsum(self.coefficient * (self.factor * at.values[self.quantity]), axis=1)[:, -1]
        out = self.template.residual(*self._arguments(at), backend="numpy")
        return np.broadcast_to(np.asarray(out, float), (len(self),))

    @np.errstate(all="ignore")
    def partials(self, at: Point) -> Float[np.ndarray, "n slots"]:
        """∂(residual)/∂(quantity), by slots."""
        if isinstance(self.template, LinearTemplate):
            return self.coefficient * self.factor
        out = self.template.partial_values(*self._arguments(at), backend="numpy")
        return self._stacked(out) * self.factor

    @np.errstate(all="ignore")
    def partials_with_errors(
        self, at: Point, errors: np.ndarray
    ) -> tuple[Float[np.ndarray, "n slots"], Float[np.ndarray, "n slots"]]:
        """These partial derivatives and bounds of their errors, given those of all quantities, (quantities + 1,)."""
        slots, *others = self._arguments(at)
        values, bounds = self.template.partials_with_errors(slots, [np.abs(e) for e in self.slots(errors)], *others)
        return self._stacked(values) * self.factor, self._stacked(bounds) * np.abs(self.factor)

    @np.errstate(all="ignore")
    def partials_along(self, at: Point, move: np.ndarray) -> Float[np.ndarray, "n slots"]:
        """The derivatives of these partial derivatives where all quantities move by `move`, (quantities + 1,): what
        moves so makes them the partial derivatives of the residual's time derivative."""
        place = {slot: k for k, slot in enumerate(self.template.slots)}
        (there, *others), derivative = self._arguments(at), self.template.derivative

        def partials(moved: Sequence[np.ndarray]) -> tuple:
            slots = [there[place[s]] if s in place else moved[place[s[0], s[1] - 1]] for s in derivative.slots]
            return derivative.partial_values(slots, *others, backend="numpy")

        # The derivative of the template is affine in the slots that are new in it, so one difference gives all that
        # moves with them.
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
        found = self.template.term_values(*self._arguments(at)[:-1])
        return np.array([np.broadcast_to(v, (len(self),)) for v in found], float).reshape(-1, len(self)).T

    @np.errstate(all="ignore")
    def solved(self, slot: int, at: Point) -> Float[np.ndarray, " n"]:
        """The quantities in a slot for which the residuals, affine in it, are zero."""
        out = self.template.solve(slot, *self._arguments(at), backend="numpy")
        return np.broadcast_to(np.asarray(out, float), (len(self),)) / self.factor[:, slot]

    def _stacked(self, by_slot: Sequence[Numeric]) -> np.ndarray:
        shape = (len(self),)
        columns = [v if np.shape(v) == shape else np.broadcast_to(np.asarray(v, float), shape) for v in by_slot]
        return np.array(columns, float).T if columns else np.zeros((*shape, 0))
