"""Tsit5 for states that are one array: with its stages written out, or looped over."""

import functools
import operator

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linear.once import joined, once_in_batches
from .field_size import is_large
from .switching import Watch

# Up to so many states, reverse mode computes a looped field again rather than storing what it needs of every stage: the
# gradient of the tutorial's pendulum takes 0.37 ms for 0.49. Where stages are written out it is the other way round,
# 0.40 ms for 0.29, since nothing need be stored. Larger fields were not measured.
COMPUTED_AGAIN = 32

# Entries from which the point of each stage is computed once where stages are written out. XLA would add up the terms
# anew for all that reads it, backwards those of all later stages, too. The gradient of a ladder of 4,000 cells takes
# 5.7 ms for 7.1, of 1,000 cells the same.
LONG = 1024


class Tsit5(diffrax.Tsit5):
    """Tsitouras' 5(4) method (2011) for a state that is one array; differs from `diffrax.Tsit5` by rounding alone.

    Diffrax loops over the stages and writes each slope into a buffer. Unrolled stages fuse: under `vmap` and in forward
    mode, a step of a small model takes about half of the time. A loop compiles a large field once instead of six times.

    **Arguments:**

    - `looped`: whether to loop over the stages; None decides by the size of the field.
    - `watch`: ends the run with `switching.STIFF` if stability limits the steps; None continues.
    """

    looped: bool | None = eqx.field(static=True, default=None)
    watch: Watch | None = None

    def init(self, terms, t0, t1, y0, args):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Returns (the slope at the start, since the last stage of a step is the first of the next one; the count of
        `watch`)."""
        return terms.vf(t0, y0, args), None if self.watch is None else self.watch.start()

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step with its error estimate and dense output; see `diffrax.AbstractSolver.step`."""
        tableau = self.tableau
        control = terms.contr(t0, t1)
        slope, count = solver_state  # pyright: ignore[reportGeneralTypeIssues]
        looped = is_large(lambda t, y: terms.vf(t, y, args), t0, y0) if self.looped is None else self.looped
        stages = self._looped if looped else self._written_out
        before, y1, slope, k = stages(terms, t0, t1, y0, args, control, slope, made_jump)
        y_error = _combine(tableau.b_error, k)
        result = diffrax.RESULTS.successful
        if self.watch is not None:
            count = self.watch.after(count, t0, t1, (before, y1), (k[-2], k[-1]))
            result = self.watch.result(count)
        return y1, y_error, dict(y0=y0, y1=y1, k=jnp.stack(k)), (slope, count), result

    def _written_out(self, terms, t0, t1, y0, args, control, slope, made_jump):
        """The stages written out. Returns (the points of the last two stages, the slope at the last, all increments);
        `slope` is the last slope of the step before."""
        tableau = self.tableau
        if made_jump is not False:
            # Behind a jump the last slope of the step before is that of another field.
            slope = jax.lax.cond(made_jump, lambda _: terms.vf(t0, y0, args), lambda s: s, slope)
        k, points = [terms.prod(slope, control)], [y0]
        for a, c in zip(tableau.a_lower, tableau.c, strict=True):
            point = y0 + _combine(a, k)
            points.append(joined([point]) if y0.size > LONG else once_in_batches(point))
            slope = terms.vf(t0 + float(c) * (t1 - t0), points[-1], args)
            k.append(terms.prod(slope, control))
        return points[-2], points[-1], slope, k

    def _looped(self, terms, t0, t1, y0, args, control, slope, made_jump):
        """The stages computed in a loop, so that XLA compiles the field once; returns as `_written_out`. Where the
        field may have jumped, the loop begins one stage earlier: the last slope of the step before may no longer be
        that of the state."""
        tableau = self.tableau
        n, last = len(tableau.c), slope
        evaluate = eqx.filter_checkpoint(terms.vf) if y0.size <= COMPUTED_AGAIN else terms.vf
        weights = np.zeros((n + 1, n + 1))
        for row, a in zip(weights[1:], tableau.a_lower, strict=True):
            row[: len(a)] = a
        nodes = np.concatenate([[0.0], tableau.c])

        def stage(carry, here):
            k, _, _ = carry
            row, c, i = here
            y = y0 + jnp.tensordot(row, k, 1)

            def field():
                return evaluate(t0 + c * (t1 - t0), y, args)

            slope = field() if made_jump is False else jax.lax.cond((i > 0) | made_jump, field, lambda: last)
            return (k.at[i].set(terms.prod(slope, control)), y, slope), None

        first = 1 if made_jump is False else 0
        rows = jnp.asarray(weights, y0.dtype), jnp.asarray(nodes, jnp.asarray(t1 - t0).dtype), np.arange(n + 1)
        k = jnp.zeros((n + 1, *y0.shape), y0.dtype)
        if made_jump is False:
            k = k.at[0].set(terms.prod(slope, control))
        given = jax.tree.map(lambda v: v[first:], rows)
        (k, y1, slope), _ = jax.lax.scan(stage, (k, y0, jnp.zeros_like(slope)), given)
        before = y0 + jnp.tensordot(jnp.asarray(weights[-2], y0.dtype), k, 1)
        return before, y1, slope, list(k)


def _combine(coefficients: Float[np.ndarray, " stages"], k: list[Float[Array, "*shape"]]) -> Float[Array, "*shape"]:
    terms = [float(c) * slope for c, slope in zip(coefficients, k, strict=True) if c != 0]
    return functools.reduce(operator.add, terms)
