"""Evaluation: steps become gathers, vectorised kernels and chunks of results.

The traced program grows with the number of steps, not of the equations in them.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Time
from ...compile.lowering.gather import Chunk, Gather
from ...compile.lowering.program import Planned, PlannedEquation, PlannedLoop, PlannedSparse, PlannedStep, Program
from ...compile.model.linear_template import LinearTemplate, scaled
from ...compile.model.opaque import Networks
from ...solve.linear.arrays import Scalar
from ...solve.linear.torn import solve_torn
from ...solve.linear.whole import solve_whole
from .nonlinear import AbstractBlock, Inside, Refinement, Whole, WrittenOut
from .values import LONG_SUM, Values, filled, scaled_by

UNROLLED_REPETITIONS = 4  # of a loop, written out in each of its iterations


class Linear(NamedTuple):
    """The linear blocks of one step."""

    planned: PlannedStep | PlannedSparse
    rows: Sequence[
        int | np.ndarray
    ]  # of each equation in one block, a number, or an array if its instances have different ones
    right: list[Array]
    solve: Callable[[list[Array], bool], list[Array]]  # the unknowns for a right-hand side, which is checked or not
    at: Callable[[list[Array]], Inside]  # where equations are evaluated, given the unknowns


class Evaluation(Values):
    """One pass over a program's steps at one point."""

    def __init__(self, state: Chunk, inputs: Chunk, parameters: Array, t: Time, networks: Networks, typical: Array):
        super().__init__([state, inputs], parameters, t, networks, typical)
        self.residuals: list[Array] = []  # of nonlinear blocks, if nothing is refined

    def run(self, program: Program, refine: Refinement):
        """Evaluates all steps."""
        for planned in program.steps:
            self.chunks.extend(self._computed(planned, refine))
        return self

    def _computed(self, planned: Planned, refine: Refinement) -> list[Array]:
        """The chunks of a step: one for each local unknown, of a sparse step one for all."""
        if isinstance(planned, PlannedLoop):
            return self.loop(planned)
        return self._whole(planned, refine) if isinstance(planned, PlannedSparse) else self.step(planned, refine)

    def step(self, planned: PlannedStep, refine: Refinement) -> list[Array]:
        if planned.step.carried:
            return self.nonlinear(WrittenOut(self, planned), refine)
        if not planned.step.tearing.tearing:
            return self.follow(planned, ())
        matrix: dict[tuple[int, int], Scalar] = {}
        right = []
        shape = () if planned.step.n == 1 else (planned.step.n,)
        # Python's zeros, so that products with unknowns are left out of the residual while the program is traced.
        blank = [0.0] * len(planned.step.unknown)
        for e, equation in enumerate(planned.equations):
            rest, slopes = self._affine_parts(equation, blank)
            right.append(filled(-rest, shape, self.dtype))
            for u, slope in slopes:
                matrix[e, u] = matrix[e, u] + slope if (e, u) in matrix else slope

        def solve(right: list[Array], checked: bool) -> list[Array]:
            return solve_torn(planned.step.tearing, matrix, right)

        rows = range(len(planned.equations))
        return self.linear(Linear(planned, rows, right, solve, lambda unknowns: Inside(self, unknowns, unknowns)))

    def _whole(self, planned: PlannedSparse, refine: Refinement) -> list[Array]:
        whole = Whole(self, planned)
        if planned.guess is not None:
            return self.nonlinear(whole, refine)
        residual, matrix = self.whole_system(planned, jnp.zeros(planned.step.n, self.dtype))

        def solve(right: list[Array], checked: bool) -> list[Array]:
            given = jnp.concatenate([jnp.reshape(r, (-1,)) for r in right])
            return [solve_whole(planned.pattern, matrix, given, checked=checked, solver=planned.linear_solver)]

        ends = np.cumsum([len(e.equation) for e in planned.equations])
        return self.linear(Linear(planned, np.split(np.arange(ends[-1]), ends[:-1]), [-residual], solve, whole.at))

    def nonlinear(self, block: AbstractBlock, refine: Refinement) -> list[Array]:
        """The unknowns of nonlinear blocks."""
        if refine is not Refinement.NONE:
            return block.unknowns(refine)
        inside = block.at(block.guess)
        self.residuals.extend(block.residuals(inside))
        return inside.chunks

    def linear(self, block: Linear) -> list[Array]:
        """The unknowns of linear blocks."""
        return block.solve(block.right, True)

    def loop(self, planned: PlannedLoop) -> list[Array]:
        """The unknowns of all repetitions, each of shape (count · n,)."""

        def read(gather: Gather | None) -> Array:
            if gather is None:
                return jnp.zeros(0, self.dtype)
            return filled(self.read(gather), (len(gather.chunk),), self.dtype)

        def repetition(carried, given):
            outside, parameters = given
            # A memory of its own: what networks remember are tracers of this iteration, which must not leave it.
            inner = Evaluation(carried, outside, parameters, self.t, Networks(self.networks.weights), self.typical)
            for step in planned.body:
                inner.chunks.extend(inner.step(step, Refinement.NONE))
            if planned.following is not None:
                carried = filled(inner.read(planned.following), carried.shape, self.dtype)
            return carried, tuple(inner.chunks[2:])

        count = planned.count
        # One gather for all repetitions. Inside the scan, each would gather from all parameters, and backwards scatter
        # into an array of their length.
        parameters = self.parameters[planned.parameters.ravel()].reshape(planned.parameters.shape)
        given = jnp.reshape(read(planned.outside), (count, -1)), parameters
        _, chunks = jax.lax.scan(repetition, read(planned.first), given, unroll=UNROLLED_REPETITIONS)
        return [jnp.reshape(c, (-1,)) for c in chunks]

    def _affine_parts(self, planned: PlannedEquation, blank: list[float]) -> tuple[Any, list[tuple[int, Scalar]]]:
        """The residual where all local unknowns are zero, and its slopes as (local unknown, slope)."""
        group = planned.equation
        inside = group.inside
        at = self.equation(planned, blank)
        if isinstance(group.template, LinearTemplate):
            slots, _, coefficients, *_ = at.arguments
            outside = [k for k in range(len(group.local)) if k not in inside]
            partials: Any = {k: self._constant(coefficients[k]) for k in inside}
            if len(outside) > LONG_SUM:
                rest = self.long_sum(planned, outside, group.coefficient[:, outside])
            else:
                terms = [scaled(coefficients[k], slots[k]) for k in outside]
                rest = functools.reduce(operator.add, terms) if terms else 0.0
        else:
            # A network's output stands alone, its inputs are outside.
            rest, partials = at.residual(), at.partials()
            partials = {inside[0]: partials[0]} if group.template.opaque is not None else partials
        return rest, [(group.local[k], scaled_by(planned.factors[k], partials[k], self.dtype)) for k in inside]

    def _constant(self, value: Scalar) -> Scalar:
        return value if isinstance(value, float) else jnp.asarray(value, self.dtype)
