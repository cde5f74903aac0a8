"""Values together with their magnitudes: how large the terms are of which they were computed.

Of what an equation is solved for explicitly, that is the magnitude of its other terms over the slope. Of the unknowns u
of a linear block A u = b it is |A⁻¹|·(Σ|terms| of each equation), estimated from one right-hand side with mixed signs.
Repeated steps are not followed: what they compute has no known magnitude, infinity.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..linear.torn import solve_torn
from ..linear.whole import solve_whole
from ..lowering.gather import Chunk, Gather
from ..lowering.program import PlannedEquation, PlannedLoop, PlannedSparse, PlannedStep
from ..model.networks import Networks
from .evaluate import Evaluation, Refinement, scaled_by


class Measured(Evaluation):
    """An evaluation, unknowns of nonlinear blocks read from the state as they are, not differentiated. `magnitudes` has
    a chunk for each of `chunks`."""

    def __init__(
        self, state: Chunk, sizes: Chunk, inputs: Chunk, parameters: Any, t: Any, networks: Networks, typical: Any
    ):
        """`sizes` are the magnitudes of the state's entries."""
        given = (state, sizes, inputs, parameters, t, networks.weights)
        state, sizes, inputs, parameters, t, weights = jax.tree.map(
            lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf, given
        )
        super().__init__(state, inputs, parameters, t, Networks(weights), typical)
        self.magnitudes: list[Chunk] = [sizes, jax.tree.map(jnp.abs, inputs)]
        self.carried_magnitudes: list[Any] = []

    def step(self, planned: PlannedStep, refine: Refinement) -> list[Any]:
        chunks = super().step(planned, refine)
        self.magnitudes.extend(self._step_magnitudes(planned, chunks))
        return chunks

    def sparse_step(self, planned: PlannedSparse, refine: Refinement) -> list[Any]:
        chunks = super().sparse_step(planned, refine)
        self.magnitudes.extend(self._sparse_magnitudes(planned, chunks[0]))
        return chunks

    def loop(self, planned: PlannedLoop) -> list[Any]:
        chunks = super().loop(planned)
        self.magnitudes.extend(jnp.full_like(c, jnp.inf) for c in chunks)
        return chunks

    def size(self, gather: Gather) -> Any:
        """The magnitudes of gathered values: a scalar, or an array."""
        return Gather(gather.chunk, gather.offset, np.abs(gather.factor)).read(self.magnitudes, self.dtype)

    def sizes_of_slots(self, planned: PlannedEquation, local: list[Any]) -> list[Any]:
        """The magnitudes of an equation's slots, given those of local unknowns."""
        pairs = zip(planned.sources, planned.factors, strict=True)
        return [
            self.size(s) if isinstance(s, Gather) else scaled_by(np.abs(f), local[-1 - s], self.dtype) for s, f in pairs
        ]

    def _terms_of(self, planned: PlannedEquation, values: list[Any], sizes: list[Any]) -> Any:
        """The magnitude of an equation."""
        arguments = self._arguments(planned, values)
        return planned.equation.template.magnitude(self.sizes_of_slots(planned, sizes), *arguments)

    def _step_magnitudes(self, planned: PlannedStep, values: list[Any]) -> list[Any]:
        step = planned.step
        shape = () if step.n == 1 else (step.n,)
        if step.tearing.tearing and not step.carried:
            return self._block_magnitudes(planned, values, shape)
        sizes: list[Any] = [None] * len(values)
        for u, gather in zip(step.tearing.tearing, planned.guess, strict=True):
            sizes[u] = self._filled(self.size(gather), shape)
        for e, u in step.tearing.sequence:
            equation = planned.equations[e]
            others = [0.0 if k == u else s for k, s in enumerate(sizes)]
            slope = self._slope_of(equation, u, values)
            sizes[u] = self._filled(self._terms_of(equation, values, others) / slope, shape)
        if step.carried:
            for e in step.tearing.residuals:
                self.carried_magnitudes.append(self._filled(self._terms_of(planned.equations[e], values, sizes), shape))
        return sizes

    def _slope_of(self, planned: PlannedEquation, unknown: int, values: list[Any]) -> Any:
        """|∂(residual)/∂(local unknown)|."""
        template = planned.equation.template
        if template.opaque is not None:
            return 1.0
        partials = template.partial_values(*self._arguments(planned, values))
        here = [k for k, u in enumerate(planned.equation.local) if u == unknown]
        return jnp.abs(sum(scaled_by(planned.factors[k], partials[k], self.dtype) for k in here))

    def _block_magnitudes(self, planned: PlannedStep, values: list[Any], shape: tuple[int, ...]) -> list[Any]:
        sizes = [jnp.abs(v) for v in values]
        matrix: dict[tuple[int, int], Any] = {}
        right = []
        blank = [0.0] * len(values)
        for e, equation in enumerate(planned.equations):
            _, slopes = self._affine_parts(equation, blank)
            right.append(_sign(e) * self._filled(self._terms_of(equation, values, sizes), shape))
            for u, slope in slopes:
                matrix[e, u] = matrix[e, u] + slope if (e, u) in matrix else slope
        found = solve_torn(planned.step.tearing, matrix, right)
        return [jnp.maximum(jnp.abs(f), s) for f, s in zip(found, sizes, strict=True)]

    def _sparse_magnitudes(self, planned: PlannedSparse, u: Any) -> list[Any]:
        there = self._beside(u)
        guessed = jnp.abs(u) if planned.guess is None else self.size(planned.guess)
        there.magnitudes = [*self.magnitudes, guessed]
        sizes = [
            self._filled(there._terms_of(equation, [], []), (len(equation.equation.equation),))
            for equation in planned.equations
        ]
        if planned.guess is not None:
            self.carried_magnitudes.extend(sizes)
            return [guessed]
        right = jnp.concatenate(sizes) * jnp.asarray([_sign(e) for e in range(planned.step.n)], self.dtype)
        values = self._entries(planned, self._whole(planned, jnp.zeros_like(u)))
        found = solve_whole(planned.pattern, values, right, checked=False, solver=planned.linear_solver)
        return [jnp.maximum(jnp.abs(found), jnp.abs(u))]


def _sign(e: int) -> float:
    """Signs without a pattern, the parities of the golden ratio's multiples."""
    return 1.0 if int(e * 1.618033988749895) % 2 == 0 else -1.0
