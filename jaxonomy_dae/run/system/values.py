"""What equations are at a point: gathers become the arguments of their templates, over all instances at once."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Time
from ...compile.lowering.gather import FEW, Chunk, Gather, entries, take, times
from ...compile.lowering.program import PlannedEquation, PlannedSparse, PlannedStep
from ...compile.model.linear_template import LinearTemplate
from ...compile.model.opaque import Networks
from ...compile.model.tables import ZERO
from ...solve.linear.arrays import Scalar

LONG_SUM = 16  # linear equations with more terms are one gather and one sum


def still(tree: Any) -> Array:
    """The same, constant under differentiation."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf, tree)


def scaled_by(factor: Scalar, value: Scalar, dtype) -> Array:
    return times(factor if isinstance(factor, float) else jnp.asarray(factor, dtype), value)


def filled(value: Scalar, shape: tuple[int, ...], dtype) -> Array:
    return jnp.broadcast_to(jnp.asarray(value, dtype), shape)


class EquationAt(NamedTuple):
    """An equation with the arguments of its template."""

    planned: PlannedEquation
    arguments: tuple[Any, ...]  # (slots, parameters, coefficients, t, networks)
    dtype: np.dtype

    @property
    def slots(self) -> list[Array]:
        return self.arguments[0]

    def filled(self, value: Scalar) -> Array:
        """A value for each instance: a scalar of one."""
        n = len(self.planned.equation)
        return filled(value, () if n == 1 else (n,), self.dtype)

    def residual(self) -> Array:
        return self.planned.equation.template.residual(*self.arguments)

    def magnitude(self, sizes: Sequence[Scalar] | None = None) -> Array:
        """The magnitude of the terms, given those of the slots, or where these are as large as they are."""
        sizes = [jnp.abs(s) for s in self.slots] if sizes is None else sizes
        return self.planned.equation.template.magnitude(sizes, *self.arguments)

    def partials(self, through_networks: bool = False) -> Sequence[Scalar]:
        """The partial derivatives by slots; of a network's output, y − N(u), perhaps those by y alone."""
        template = self.planned.equation.template
        if template.opaque is not None and not through_networks:
            return (1.0,)
        return template.partial_values(*self.arguments)

    def of_slots(self, bounds: Sequence[Scalar]) -> list[Scalar]:
        """Bounds of the errors of the slots, given those of local unknowns; other slots have none."""
        pairs = zip(self.planned.equation.local, self.planned.factors, strict=True)
        return [0.0 if u < 0 else scaled_by(abs(f), bounds[u], self.dtype) for u, f in pairs]

    def slope(self, unknown: int, partials: Sequence[Scalar]) -> Scalar:
        """The derivative by a local unknown."""
        pairs = zip(self.planned.equation.local, self.planned.factors, partials, strict=False)
        return sum(scaled_by(factor, p, self.dtype) for u, factor, p in pairs if u == unknown)


Rest = Callable[[EquationAt, Sequence[Scalar], list[Scalar], int], Scalar]


class Values:
    """What was computed at one point, in chunks: the state, the inputs, and one after the other what follows."""

    def __init__(self, chunks: list[Chunk], parameters: Array, t: Time, networks: Networks, typical: Array):
        """`typical` are the sizes of all quantities, by which nonlinear blocks are judged."""
        self.chunks = chunks
        self.parameters = parameters
        self.t = t
        self.networks = networks
        self.typical = typical
        self.dtype = parameters.dtype
        self._scalars: dict[str, list[Array]] = {}

    def frozen(self) -> Self:
        """A copy in which all arrays are constant under differentiation."""
        other = copy.copy(self)
        parts = self.chunks, self.parameters, self.t, self.networks.weights
        other.chunks, other.parameters, other.t, weights = still(parts)
        # Entries and outputs of networks that were remembered are differentiated ones.
        other.networks, other._scalars = Networks(weights), {}
        return other

    def beside(self, u: Array) -> Self:
        """A copy with one more chunk."""
        other = copy.copy(self)
        other.chunks = [*self.chunks, u]
        return other

    def _entry(self, name: str, k: int) -> Array:
        """An entry of the parameters or of the typical sizes, a scalar."""
        array = getattr(self, name)
        # Splitting an array makes all of its entries scalars of the program, so only short ones are split.
        if array.shape[0] > FEW:
            return array[k]
        if name not in self._scalars:
            self._scalars[name] = entries(array)
        return self._scalars[name][k]

    def read(self, gather: Gather) -> Array:
        """Gathered values: a scalar, or an array."""
        return gather.read(self.chunks, self.dtype)

    def equation(self, planned: PlannedEquation, local: Sequence[Scalar] = ()) -> EquationAt:
        """An equation, with the values of the local unknowns."""
        slots = [
            self.read(source) if isinstance(source, Gather) else scaled_by(factor, local[-1 - source], self.dtype)
            for source, factor in zip(planned.sources, planned.factors, strict=True)
        ]
        group = planned.equation
        if len(group) == 1:
            parameters = [self._entry("parameters", int(k)) for k in group.parameter[0]]
            coefficients: list[Scalar] = [float(c) for c in group.coefficient[0]]
        else:
            parameters = [
                # A parameter that all instances share stays a scalar. Gathered, it would be copied for each of them,
                # and reverse mode would scatter into all parameters.
                self._entry("parameters", int(column[0]))
                if (column == column[0]).all()
                else take(self.parameters, column)
                for column in group.parameter.T
            ]
            coefficients = [float(c[0]) if (c == c[0]).all() else c for c in group.coefficient.T]
        return EquationAt(planned, (slots, parameters, coefficients, self.t, self.networks), self.dtype)

    def still_equation(self, planned: PlannedEquation, local: Sequence[Scalar] = ()) -> EquationAt:
        """The same, not differentiated."""
        at = self.equation(planned, local)
        slots, parameters, *rest = at.arguments
        return at._replace(arguments=(*jax.lax.stop_gradient((slots, parameters)), *rest))

    def solved(self, planned: PlannedEquation, unknown: int, local: list[Any]) -> Array:
        """The local unknown for which the equation, affine in it, holds."""
        group = planned.equation
        # Slots with numeric coefficients are one product of arrays where they are many: written out, each term is an
        # operation of the program.
        positions = [k for k, u in enumerate(group.local) if u == unknown]
        outside = [k for k in range(len(group.local)) if k != positions[0]]
        is_long = isinstance(group.template, LinearTemplate) and len(outside) >= LONG_SUM
        if is_long and all(isinstance(planned.sources[k], Gather) for k in outside):
            weights = -group.coefficient[:, outside] / group.coefficient[:, [positions[0]]]
            return scaled_by(1 / planned.factors[positions[0]], self.long_sum(planned, outside, weights), self.dtype)
        local = list(local)
        # A Python number, which is folded while the program is traced: the residual at zero is what the equation is
        # solved from.
        local[unknown] = 0.0
        at = self.equation(planned, local)
        if len(positions) == 1:
            value = group.template.solve(positions[0], *at.arguments)
            return scaled_by(1 / planned.factors[positions[0]], value, self.dtype)
        # The unknown stands in several slots: the template cannot be solved for one of them.
        return -at.residual() / at.slope(unknown, at.partials())

    def long_sum(self, planned: PlannedEquation, positions: Sequence[int], weights: np.ndarray) -> Array:
        """Σ weight·slot over slots that are gathered."""
        n = len(weights)
        sources = [planned.sources[k] for k in positions]
        joined = Gather(*(np.concatenate([getattr(s, f) for s in sources]) for f in ("chunk", "offset", "factor")))
        values = joined.read(self.chunks, self.dtype)
        values = jnp.reshape(jnp.broadcast_to(values, (len(positions) * n,)), (len(positions), n))
        total = jnp.sum(values * jnp.asarray(weights.T, self.dtype), axis=0)
        return total[0] if n == 1 else total

    def follow(self, planned: PlannedStep, z: Sequence[Scalar]) -> list[Array]:
        """All unknowns of a step, from its tearing variables."""
        local: list[Any] = [None] * len(planned.step.unknown)
        shape = () if planned.step.n == 1 else (planned.step.n,)
        for u, value in zip(planned.step.tearing.tearing, z, strict=True):
            local[u] = value
        for e, u in planned.step.tearing.sequence:
            local[u] = filled(self.solved(planned.equations[e], u, local), shape, self.dtype)
        return local

    def through(self, planned: PlannedStep, local: list[Any], bounds: list[Scalar], of_rest: Rest) -> list[Scalar]:
        """Bounds of all unknowns of a step, from those of its tearing variables: `of_rest` bounds what an equation is
        solved for, times the slope."""
        for e, u in planned.step.tearing.sequence:
            at = self.still_equation(planned.equations[e], local)
            partials = at.partials()
            bounds[u] = at.filled(of_rest(at, partials, bounds, u) / abs(at.slope(u, partials)))
        return bounds

    def whole_system(self, planned: PlannedSparse, u: Array) -> tuple[Any, Any]:
        """The residuals of large blocks at their unknowns u, and the entries of their matrix."""
        values = self.beside(u)
        residuals, found = [], []
        for equation, entries_of in zip(planned.equations, planned.entries, strict=True):
            at, shape = values.equation(equation), (len(equation.equation),)
            residuals.append(filled(at.residual(), shape, self.dtype))
            partials = at.partials(through_networks=True)
            found += [
                scaled_by(factor, take(filled(partials[k], shape, self.dtype), instances), self.dtype)
                for k, instances, factor in entries_of
            ]
        return jnp.concatenate(residuals), jnp.concatenate(found)

    def typical_of(self, planned: PlannedEquation) -> list[Scalar]:
        """The typical sizes of an equation's slots; the constant zero has none."""
        out: list[Scalar] = []
        for quantity, factor in zip(planned.equation.quantity.T, planned.equation.factor.T, strict=True):
            if len(quantity) == 1:
                k = int(quantity[0])
                out.append(0.0 if k == ZERO else times(abs(float(factor[0])), self._entry("typical", k)))
            else:
                factors = np.where(quantity == ZERO, 0.0, np.abs(factor))
                out.append(jnp.asarray(factors, self.dtype) * take(self.typical, np.maximum(quantity, 0)))
        return out
