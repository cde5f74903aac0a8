"""The equations of a system without the solution of their blocks: the unknowns with which a block begins are given, the
others of the block follow, and what its last equations leave is a residual.

For users of the layered standard FMI-LS-DAE, who solve them together with the states.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import Time
from ..compile.lowering.gather import Chunk
from ..compile.lowering.plan import SystemPlan
from ..compile.lowering.program import PlannedLoop, PlannedSparse, PlannedStep, Program
from ..compile.model.opaque import Networks
from ..run.system.evaluate import Evaluation
from ..run.system.input_values import input_values
from ..run.system.nonlinear import AbstractBlock, Refinement, Whole, WrittenOut
from ..run.system.system_at import SystemAt


def _blocks(plan: SystemPlan) -> list[tuple[PlannedStep | PlannedSparse, Sequence[np.ndarray]]]:
    """The steps that solve equations simultaneously, with the quantities that are given instead. Those repeated in
    loops stay solved."""
    found = []
    for planned in plan.derivative.steps:
        if isinstance(planned, PlannedLoop):
            continue
        given = planned.step.unknown if isinstance(planned, PlannedSparse) else planned.step.torn
        if given:
            found.append((planned, given))
    return found


def given_quantities(plan: SystemPlan) -> np.ndarray:
    """The quantities that are given, shape (unknowns,)."""
    return np.concatenate([np.zeros(0, int), *(q for _, given in _blocks(plan) for q in given)]).astype(int)


def residual_equations(plan: SystemPlan) -> np.ndarray:
    """The extended equation of each residual: those of blocks, then hidden constraints."""
    planned = [e for step, _ in _blocks(plan) for e in step.left]
    return np.concatenate([np.zeros(0, int), *(e.equation.equation for e in (*planned, *plan.constraints))]).astype(int)


class _Open(Evaluation):
    """An evaluation to which the unknowns of blocks are given, one after the other."""

    given: Array
    used = 0

    def step(self, planned: PlannedStep, refine: Refinement) -> list[Array]:
        if not planned.step.tearing.tearing:
            return self.follow(planned, ())
        shape = () if planned.step.n == 1 else (planned.step.n,)
        return self._left(WrittenOut(self, planned), [self._next(shape) for _ in planned.step.torn])

    def _whole(self, planned: PlannedSparse, refine: Refinement) -> list[Array]:
        return self._left(Whole(self, planned), [self._next((planned.step.n,))])

    def _next(self, shape: tuple[int, ...]) -> Array:
        size = int(np.prod(shape, dtype=int))
        self.used += size
        return jnp.reshape(self.given[self.used - size : self.used], shape)

    def _left(self, block: AbstractBlock, z: list[Array]) -> list[Array]:
        inside = block.at(z)
        self.residuals.extend(block.residuals(inside))
        return inside.chunks


class _OpenAt(SystemAt):
    """A system at one time, with these unknowns of its blocks."""

    given: Array

    def run(self, program: Program, x: Chunk, refine: Refinement, t: Time = None) -> Evaluation:
        if program is not self.plan.derivative:
            return super().run(program, x, refine, t)
        inputs, networks = input_values(self.plan, self.inputs, self.t, self.dtype), Networks(self.networks)
        evaluation = _Open(self._chunk(x), inputs, self.parameters, self.t, networks, self.typical)
        evaluation.given = self.given
        return evaluation.run(program, refine)

    def opened(self, x: Array) -> Array:
        slopes, evaluation = self._slopes(x)
        parts = [self._array(slopes), *(jnp.reshape(r, (-1,)) for r in evaluation.residuals)]
        return jnp.concatenate([*parts, self.constraint_vector(x)])


def opened(at: SystemAt, x: Array, y: Array) -> Array:
    """dx/dt, then the residuals, of the states x and the given unknowns y."""
    plan, place = at.plan, {int(q): k for k, q in enumerate(given_quantities(at.plan))}
    carried = [y[place[int(q)]] if int(q) in place else jnp.zeros((), y.dtype) for q in plan.carried]
    here = _OpenAt(plan, at.parameters, at.networks, at.t, at.inputs, at.typical)
    here.given = y
    return here.opened(jnp.concatenate([x, jnp.stack(carried)]) if carried else x)
