"""Newton's method for batches of small systems, and the verdict that ends it."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ...base.tolerances import NOISE, ZERO_WITHIN, spacing
from ...solve.linear.arrays import Scalar
from ...solve.linear.dense import solve_dense
from ...solve.linear.newton import Tried, newton
from ...solve.linear.written_out import UNROLLED, solve

NEWTON_STEPS = 120  # to the root of a nonlinear block, at most, halvings included; a double root takes 27
SURE = 1e-6  # residuals so small, relative to their terms at the start, need not fall: rounding has a part in them


class Beside(NamedTuple):
    """The sizes beside which a residual counts as zero.

    - `terms`: the magnitude of its terms.
    - `typical`: Σ |∂r/∂s|·size(s) over all that stands in the equation, with typical sizes.
    - `noise`: Σ |∂r/∂s|·δs, with what rounding may have left in s beyond its own.
    """

    terms: Scalar
    typical: Scalar
    noise: Scalar

    @classmethod
    def of(
        cls, terms: Scalar, partials: Sequence[Scalar], typical: Sequence[Scalar], noise: Sequence[Scalar]
    ) -> "Beside":
        """From partial derivatives, typical sizes and rounding errors by slots."""
        pairs = zip(partials, typical, strict=False)  # of a network, its output alone
        floor = _weighed([(p, s) for p, s in pairs if not _is_nothing(s)])
        return cls(
            terms, floor, _weighed([(p, n) for p, n in zip(partials, noise, strict=False) if not _is_nothing(n)])
        )

    @property
    def size(self) -> Scalar:
        """How large the residual is where its unknowns are off by their sizes. Terms alone do not tell: those of a flow
        that a valve has just stopped are 1e-45."""
        return self.terms + self.typical

    def is_small(self, residual: Scalar, tolerated: float) -> Array:
        """True if a residual is small beside its terms, or beside the rounding of what it is computed from."""
        eps = spacing(jnp.result_type(residual))
        allowed = tolerated * self.terms + ZERO_WITHIN * eps * self.typical + NOISE * self.noise
        # Where a slope is infinite, as that of a root at zero, the equation holds exactly or not at all.
        return (jnp.abs(residual) <= allowed) & ((allowed < jnp.inf) | (residual == 0))


def _weighed(pairs: Sequence[tuple[Scalar, Scalar]]) -> Scalar:
    """Σ |a|·b."""
    return sum((abs(a) * b for a, b in pairs), 0.0)


def _is_nothing(value: Scalar) -> bool:
    """True if a value is the Python number 0.0, known while a program is traced."""
    return isinstance(value, float) and value == 0.0


def find_root(
    judged: Callable[[list[Array]], tuple[Array, list[Array]]],
    stepped: Callable[[list[Array]], tuple[list[Array], list[Array]]],
    differentiable: Callable[[list[Array]], list[Array]],
    z: list[Array],
    batch: tuple[int, ...],
) -> tuple[list[Array], Array]:
    """Newton's method from z until the equations hold, one verdict for each of a batch of problems; and the verdicts.

    `judged` gives the verdicts and the sizes of the residuals, `stepped` the residuals and the step. A step is halved
    until the largest residual falls, relative to the sizes at the start: whole steps go back and forth between the
    branches of a law with a kink.

    The search is not differentiated; two steps of the `differentiable` correction follow, written out.
    """
    z = jax.lax.stop_gradient(z)

    def look(z, part, memory):
        least, sizes = memory
        residuals, step = stepped(z)
        holds, own = judged(z)
        # Sizes stay those at the start: beside the terms of each iterate, a residual would seem to fall where only the
        # terms grow.
        sizes = [jnp.where(least == jnp.inf, a, b) for a, b in zip(own, sizes, strict=True)]
        off = [jnp.abs(r) / jnp.where(s > 0, s, 1) for r, s in zip(residuals, sizes, strict=True)]
        largest = functools.reduce(jnp.maximum, off)
        # A block that stays whole has one verdict for all of its equations.
        largest = jnp.max(largest) if len(batch) < jnp.ndim(largest) else largest
        # A decrease in proportion to the part of the step that is tried (Armijo 1966): with a mere decrease, ever
        # smaller gains would do, and the search could stop where no equation holds.
        falls = (largest <= (1 - part / 4) * least) | (least <= SURE)
        return Tried(falls, holds, step, (largest, sizes))

    begin = jnp.full(batch, jnp.inf, z[0].dtype), [jnp.zeros_like(r) for r in jax.eval_shape(stepped, z)[0]]
    found = newton(look, z, begin, NEWTON_STEPS, batch=batch)
    z = jax.lax.stop_gradient(found.x)
    # The root is held constant. One step from it has the first derivatives of the solution, a second one the second
    # derivatives.
    for _ in range(2):
        z = differentiable(z)
    return z, jnp.asarray(found.holds)


def newton_step(residuals: Callable[[list[Array]], list[Array]], z: list[Array]) -> tuple[list[Array], list[Array]]:
    """(r(z), a Newton step), for lists of arrays of one shape (a batch of problems); exact if r is affine."""
    m = len(z)
    if m <= UNROLLED:
        value, push = jax.linearize(residuals, z)
        columns = [push([jnp.ones_like(a) if j == k else jnp.zeros_like(a) for j, a in enumerate(z)]) for k in range(m)]
        step = solve([[column[r] for column in columns] for r in range(m)], value)
        return value, [-d for d in step]
    stacked = jnp.stack(z)
    value, push = jax.linearize(lambda v: jnp.stack(residuals(list(v))), stacked)
    basis = jnp.eye(m, dtype=stacked.dtype).reshape(m, m, *([1] * z[0].ndim))
    columns = jax.vmap(push)(jnp.broadcast_to(basis, (m, *stacked.shape)))  # (unknown, equation, *batch)
    matrix = jnp.moveaxis(columns, (1, 0), (-2, -1))
    step = solve_dense(matrix, jnp.moveaxis(value, 0, -1))
    return list(value), list(-jnp.moveaxis(step, -1, 0))
