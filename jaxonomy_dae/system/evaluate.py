"""Evaluation: steps become gathers, vectorised kernels and chunks of results.

The traced program grows with the number of steps, not of the equations in them.
"""

import copy
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..linear.torn import solve_torn
from ..linear.whole import solve_whole
from ..linear.written_out import UNROLLED, solve, solve_dense
from ..lowering.gather import Chunk, Gather, take
from ..lowering.program import PlannedEquation, PlannedRepeat, PlannedSparse, PlannedStep, Program
from ..model.evaluate_numpy import Networks

UNROLLED_REPETITIONS = 4  # of a loop, written out in each of its iterations
LONG_SUM = 16  # linear equations with more terms are one gather and one sum


class Evaluation:
    """One pass over a program's steps at one point."""

    def __init__(self, state: Chunk, inputs: Chunk, parameters: Any, t: Any, networks: Networks):
        self.chunks: list[Chunk] = [state, inputs]
        self.parameters = parameters
        self.dtype = parameters.dtype
        self.t = t
        self.networks = networks
        self.residuals: list[Any] = []  # of carried steps, if nothing is refined

    def run(self, program: Program, refine: int):
        """Evaluates all steps; the tearing variables of carried steps get `refine` Newton corrections."""
        for planned in program.steps:
            if isinstance(planned, PlannedRepeat):
                self.chunks.extend(self._repeat(planned))
            elif isinstance(planned, PlannedSparse):
                self.chunks.append(self._sparse_step(planned, refine))
            else:
                self.chunks.extend(self._step(planned, refine))
        return self

    def read(self, gather: Gather) -> Any:
        """Gathered values: a scalar, or an array."""
        return gather.read(self.chunks, self.dtype)

    def _arguments(self, planned: PlannedEquation, local: list[Any]):
        slots = []
        for source, sign in zip(planned.sources, planned.signs, strict=True):
            if isinstance(source, Gather):
                slots.append(self.read(source))
            else:
                slots.append(_signed(sign, local[-1 - source], self.dtype))
        equation = planned.equation
        n = equation.parameter.shape[0]
        if n == 1:
            parameters = [self.parameters[int(k)] for k in equation.parameter[0]]
            coefficients: list[Any] = [float(c) for c in equation.coefficient[0]]
        else:
            parameters = [
                self.parameters[int(column[0])] if (column == column[0]).all() else take(self.parameters, column)
                for column in equation.parameter.T
            ]
            coefficients = [float(c[0]) if (c == c[0]).all() else c for c in equation.coefficient.T]
        return slots, parameters, coefficients, self.t, self.networks

    def _residual(self, planned: PlannedEquation, local: list[Any]) -> Any:
        return planned.equation.template.residual(*self._arguments(planned, local))

    def _solved(self, planned: PlannedEquation, unknown: int, local: list[Any]) -> Any:
        """The local unknown for which the equation, affine in it, holds."""
        equation = planned.equation
        positions = [k for k, s in enumerate(equation.slots) if s.local == unknown]
        outside = [k for k in range(len(equation.slots)) if k != positions[0]]
        if equation.template.n_coefficients > LONG_SUM and all(isinstance(planned.sources[k], Gather) for k in outside):
            weights = -equation.coefficient[:, outside] / equation.coefficient[:, [positions[0]]]
            return _signed(planned.signs[positions[0]], self._long_sum(planned, outside, weights), self.dtype)
        local = list(local)
        local[unknown] = 0.0
        arguments = self._arguments(planned, local)
        if len(positions) == 1:
            value = equation.template.solve(positions[0], *arguments)
            return _signed(planned.signs[positions[0]], value, self.dtype)
        rest = equation.template.residual(*arguments)
        partials = equation.template.partial_values(*arguments)
        slope = sum(_signed(planned.signs[k], partials[k], self.dtype) for k in positions)
        return -rest / slope

    def _long_sum(self, planned: PlannedEquation, positions: Sequence[int], weights: np.ndarray) -> Any:
        """Σ weight·slot over slots that are gathered."""
        n = len(weights)
        sources = [planned.sources[k] for k in positions]
        joined = Gather(*(np.concatenate([getattr(s, f) for s in sources]) for f in ("chunk", "offset", "sign")))
        values = joined.read(self.chunks, self.dtype)
        values = jnp.reshape(jnp.broadcast_to(values, (len(positions) * n,)), (len(positions), n))
        total = jnp.sum(values * jnp.asarray(weights.T, self.dtype), axis=0)
        return total[0] if n == 1 else total

    def _step(self, planned: PlannedStep, refine: int) -> list[Any]:
        step = planned.step
        tearing = step.tearing
        shape = () if step.n == 1 else (step.n,)
        blank: list[Any] = [None] * len(step.unknown)

        def follow(z: list[Any]) -> list[Any]:
            local = list(blank)
            for u, value in zip(tearing.tearing, z, strict=True):
                local[u] = value
            for e, u in tearing.sequence:
                local[u] = self._filled(self._solved(planned.equations[e], u, local), shape)
            return local

        def residuals(z: list[Any]) -> list[Any]:
            local = follow(z)
            return [self._filled(self._residual(planned.equations[e], local), shape) for e in tearing.residuals]

        if not tearing.tearing:
            return follow([])
        if not step.carried:
            return self._linear_block(planned, shape)
        z = [self._filled(self.read(g), shape) for g in planned.guess]
        if refine == 0:
            self.residuals.extend(residuals(z))
        for _ in range(refine):
            z = newton(residuals, z)
        return follow(z)

    def _repeat(self, planned: PlannedRepeat) -> list[Any]:
        """The unknowns of all repetitions, each of shape (count · n,)."""

        def read(gather: Gather | None) -> Any:
            if gather is None:
                return jnp.zeros(0, self.dtype)
            return self._filled(self.read(gather), (len(gather.chunk),))

        def repetition(carried, given):
            outside, parameters = given
            inner = Evaluation(carried, outside, parameters, self.t, Networks(self.networks.weights))
            for step in planned.body:
                inner.chunks.extend(inner._step(step, refine=0))
            if planned.following is not None:
                carried = self._filled(inner.read(planned.following), carried.shape)
            return carried, tuple(inner.chunks[2:])

        count = planned.count
        parameters = self.parameters[planned.parameters.ravel()].reshape(planned.parameters.shape)
        given = jnp.reshape(read(planned.outside), (count, -1)), parameters
        _, chunks = jax.lax.scan(repetition, read(planned.first), given, unroll=UNROLLED_REPETITIONS)
        return [jnp.reshape(c, (-1,)) for c in chunks]

    def _sparse_step(self, planned: PlannedSparse, refine: int) -> Any:
        """The unknowns of large blocks, shape (n,)."""

        def solved(u: Any) -> Any:
            """One Newton step, exact if the equations are affine."""
            residual, values = self._whole(planned, u, partials=True)
            return u - solve_whole(planned.pattern, values, residual, checked=planned.guess is None)

        if planned.guess is None:
            return solved(jnp.zeros(planned.step.n, self.dtype))
        u = self.read(planned.guess)
        if refine == 0:
            self.residuals.append(self._whole(planned, u, partials=False)[0])
        for _ in range(refine):
            u = solved(u)
        return u

    def _whole(self, planned: PlannedSparse, u: Any, partials: bool) -> tuple[Any, Any]:
        """The residuals of a sparse step's equations at its unknowns u, and the values of their matrix."""
        there = copy.copy(self)
        there.chunks = [*self.chunks, u]
        residuals, values = [], []
        for equation, entries in zip(planned.equations, planned.entries, strict=True):
            template = equation.equation.template
            shape = (len(equation.equation.equation),)
            arguments: Any = there._arguments(equation, [])
            slots, rest = arguments[0], arguments[1:]

            def residual(*slots, template=template, rest=rest, shape=shape):
                return self._filled(template.residual(list(slots), *rest), shape)

            residuals.append(residual(*slots))
            if not partials:
                continue
            if template.opaque is not None:
                slots = [self._filled(s, shape) for s in slots]
                slopes = [_slope(residual, slots, k) for k in range(len(slots))]
            else:
                slopes = template.partial_values(slots, *rest)
            for k, instances, sign in entries:
                values.append(_signed(sign, take(self._filled(slopes[k], shape), instances), self.dtype))
        return jnp.concatenate(residuals), jnp.concatenate(values) if partials else None

    def _linear_block(self, planned: PlannedStep, shape: tuple[int, ...]) -> list[Any]:
        """The unknowns of linear blocks of one shape."""
        matrix: dict[tuple[int, int], Any] = {}
        right = []
        blank = [0.0] * len(planned.step.unknown)
        for e, equation in enumerate(planned.equations):
            rest, slopes = self._affine_parts(equation, blank)
            right.append(self._filled(-rest, shape))
            for u, slope in slopes:
                matrix[e, u] = matrix[e, u] + slope if (e, u) in matrix else slope
        return solve_torn(planned.step.tearing, matrix, right)

    def _affine_parts(self, planned: PlannedEquation, blank: list[Any]) -> tuple[Any, list[tuple[int, Any]]]:
        """The residual where all local unknowns are zero, and its slopes as (local unknown, slope)."""
        equation = planned.equation
        template = equation.template
        inside = [k for k, s in enumerate(equation.slots) if s.local >= 0]
        arguments = self._arguments(planned, blank)
        if template.n_coefficients:
            coefficients = arguments[2]
            outside = [k for k in range(len(equation.slots)) if k not in inside]
            partials: Any = {k: self._constant(coefficients[k]) for k in inside}
            if len(outside) > LONG_SUM:
                rest = self._long_sum(planned, outside, equation.coefficient[:, outside])
            else:
                rest = functools.reduce(
                    lambda total, k: total + self._constant(coefficients[k]) * arguments[0][k], outside, 0.0
                )
        else:
            rest = template.residual(*arguments)
            # A network's output stands alone, its inputs are outside.
            partials = {inside[0]: 1.0} if template.opaque is not None else template.partial_values(*arguments)
        return rest, [(equation.slots[k].local, _signed(planned.signs[k], partials[k], self.dtype)) for k in inside]

    def _constant(self, value: Any) -> Any:
        return value if isinstance(value, float) else jnp.asarray(value, self.dtype)

    def _filled(self, value: Any, shape: tuple[int, ...]) -> Any:
        return jnp.broadcast_to(jnp.asarray(value, self.dtype), shape)


def _slope(function, slots: list[Any], k: int) -> Any:
    """∂f/∂slot k of a function that acts on every instance alone."""
    return jax.jvp(lambda s: function(*slots[:k], s, *slots[k + 1 :]), (slots[k],), (jnp.ones_like(slots[k]),))[1]


def newton(residuals, z: list[Any]) -> list[Any]:
    """One Newton step for r(z) = 0, lists of arrays of one shape (a batch of problems); exact if r is affine."""
    m = len(z)
    if m <= UNROLLED:
        value, push = jax.linearize(residuals, z)
        columns = [push([jnp.ones_like(a) if j == k else jnp.zeros_like(a) for j, a in enumerate(z)]) for k in range(m)]
        step = solve([[column[r] for column in columns] for r in range(m)], value)
        return [a - b for a, b in zip(z, step, strict=True)]
    stacked = jnp.stack(z)
    value, push = jax.linearize(lambda v: jnp.stack(residuals(list(v))), stacked)
    basis = jnp.eye(m, dtype=stacked.dtype).reshape(m, m, *([1] * z[0].ndim))
    columns = jax.vmap(push)(jnp.broadcast_to(basis, (m, *stacked.shape)))  # (unknown, equation, *batch)
    matrix = jnp.moveaxis(columns, (1, 0), (-2, -1))
    step = solve_dense(matrix, jnp.moveaxis(value, 0, -1))
    return list(stacked - jnp.moveaxis(step, -1, 0))


def _signed(sign: Any, value: Any, dtype) -> Any:
    if isinstance(sign, int):
        return value if sign > 0 else -value
    return value * jnp.asarray(sign, dtype)
