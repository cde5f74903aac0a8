"""Values together with their magnitudes: the sizes of the terms from which they are computed.

For x = −b/a the magnitude is Σ|terms of b|/|a|. For the unknowns u of a linear block A u = b it is
|A⁻¹|·(Σ|terms| of each equation), estimated from one right-hand side with mixed signs. Repeated steps are not followed:
the magnitudes of what they compute are unknown, infinity.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Time
from ...compile.lowering.gather import Chunk, Gather
from ...compile.lowering.program import PlannedLoop, PlannedSparse, PlannedStep
from ...compile.model.opaque import Networks
from ...solve.linear.arrays import Scalar
from .evaluate import Evaluation, Linear
from .nonlinear import AbstractBlock, Refinement
from .values import EquationAt, scaled_by, still


class Measured(Evaluation):
    """An evaluation, unknowns of nonlinear blocks read from the state as they are, not differentiated. `magnitudes` has
    a chunk for each of `chunks`."""

    def __init__(
        self, state: Chunk, sizes: Chunk, inputs: Chunk, parameters: Array, t: Time, networks: Networks, typical: Array
    ):
        """`sizes` are the magnitudes of the state's entries."""
        state, sizes, inputs, parameters, t, weights = still((state, sizes, inputs, parameters, t, networks.weights))
        super().__init__(state, inputs, parameters, t, Networks(weights), typical)
        self.magnitudes: list[Chunk] = [sizes, jax.tree.map(jnp.abs, inputs)]
        self.carried_magnitudes: list[Array] = []

    def size(self, gather: Gather) -> Array:
        """The magnitudes of gathered values: a scalar, or an array."""
        return Gather(gather.chunk, gather.offset, np.abs(gather.factor)).read(self.magnitudes, self.dtype)

    def terms_of(self, at: EquationAt, sizes: Sequence[Scalar] = ()) -> Array:
        """The magnitude of an equation, given those of local unknowns."""
        pairs = zip(at.planned.sources, at.planned.factors, strict=True)
        of_slots = [
            self.size(s) if isinstance(s, Gather) else scaled_by(np.abs(f), sizes[-1 - s], self.dtype) for s, f in pairs
        ]
        return at.filled(at.magnitude(of_slots))

    def follow(self, planned: PlannedStep, z: Sequence[Scalar]) -> list[Array]:
        local = super().follow(planned, z)

        def of_rest(at: EquationAt, partials: Sequence[Scalar], sizes: list[Scalar], unknown: int) -> Scalar:
            return self.terms_of(at, [0.0 if u == unknown else size for u, size in enumerate(sizes)])

        sizes: list[Any] = [None] * len(local)
        for u, gather, value in zip(planned.step.tearing.tearing, planned.guess, z, strict=True):
            sizes[u] = jnp.broadcast_to(jnp.asarray(self.size(gather), self.dtype), jnp.shape(value))
        self.magnitudes.extend(self.through(planned, local, sizes, of_rest))
        return local

    def nonlinear(self, block: AbstractBlock, refine: Refinement) -> list[Array]:
        if isinstance(block.planned, PlannedSparse):
            assert block.planned.guess is not None
            self.magnitudes.append(self.size(block.planned.guess))
        inside = block.at(block.guess)
        sizes = self.magnitudes[len(self.chunks) :]
        self.carried_magnitudes.extend(self.terms_of(at, sizes) for at in block.equations(inside, still=False))
        return inside.chunks

    def linear(self, block: Linear) -> list[Array]:
        unknowns = super().linear(block)
        values, local, _ = block.at(unknowns)
        # The equations of the block read the magnitudes of its own unknowns while these are being found. Their values
        # stand in for them.
        known = [jnp.abs(u) for u in unknowns]
        first = len(self.magnitudes)
        self.magnitudes.extend(known)
        terms = [self.terms_of(values.equation(equation, local), known) for equation in block.planned.equations]
        # The bound |A⁻¹|·terms would take a solve for each equation. One solve is enough for an estimate, because signs
        # without a pattern rarely cancel in a row of A⁻¹.
        right = [jnp.asarray(_signs(rows), self.dtype) * size for rows, size in zip(block.rows, terms, strict=True)]
        found = block.solve(right, False)
        self.magnitudes[first:] = [jnp.maximum(jnp.abs(f), k) for f, k in zip(found, known, strict=True)]
        return unknowns

    def loop(self, planned: PlannedLoop) -> list[Array]:
        chunks = super().loop(planned)
        self.magnitudes.extend(jnp.full_like(c, jnp.inf) for c in chunks)
        return chunks


def _signs(rows: int | np.ndarray) -> np.ndarray:
    """Signs without a pattern, the parities of the golden ratio's multiples."""
    return 1.0 - 2.0 * (np.floor(np.asarray(rows) * 1.618033988749895) % 2)
