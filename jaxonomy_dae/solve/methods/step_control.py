"""Step sizes: the first one, what follows a step, and the end when nothing helps."""

from collections.abc import Callable
from typing import Any, Protocol

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ...base.aliases import Args, Numeric, State, Time, Tolerance
from ..adjoint.ends import End

SAFETY = 0.9  # of the step that would just meet the tolerance (Hairer, Nørsett & Wanner 1993, II.4)
# The first step is chosen as if everything moved by so many tolerances in the problem's own time. Motion below the
# tolerance, at rest or nearly so, is then resolved, too: its derivatives may be asked for, though no error shows it.
UNSEEN = 1e3
# Steps of so many spacings of floating-point numbers at t make no way, and time itself is known to four digits in them.
SHORT = 1e4
# A run ends after so many rejections with no step of ordinary length between them. A jump of 1e6 tolerances inside a
# step takes 20 of them. At a turning point, beyond which there is no solution, steps of a few spacings are accepted and
# rejected in turn.
MOST_TRIES = 100
# Up to so many errors are squared and added one by one: a sum over a short last axis, of each member of a batch, took a
# tenth of the time of 10,000 rollouts of a pendulum. As many states are traced as scalars (`lowering.gather.SCALARS`).
FEW = 32
# A solver that chooses its own step sizes writes them into its error estimate, whose norm e a controller reads back:
# e = SAFETY/φ for a growth or a rejection by the factor φ (what the ordinary formula for order 1 makes of it too), and
# e = SAFETY + (1 − SAFETY)·φ for a step that is kept though the next shall be smaller.


def encoded(factor: Numeric, keep: Numeric) -> Numeric:
    """The error norm by which a multistep solver asks the controller to change the step size by a factor."""
    smaller = keep & (factor < 1)
    return jnp.where(smaller, SAFETY + (1 - SAFETY) * factor, SAFETY / factor)


def decoded(norm: Numeric) -> Numeric:
    """The factor that `encoded` stands for."""
    shrunk = (norm - SAFETY) / (1 - SAFETY)
    factor = jnp.where((norm > SAFETY * (1 + 1e-5)) & (norm < 1), shrunk, SAFETY / norm)
    return jnp.where(jnp.abs(factor - 1) < 1e-5, 1.0, factor)


def tolerance_like(atol: Tolerance, y: State) -> Tolerance:
    """An absolute tolerance for every leaf of y, from one number for all or a tree like y."""
    if jax.tree.structure(atol) == jax.tree.structure(y):
        return atol
    return jax.tree.map(lambda _: atol, y)


def rms_norm(tree: State) -> Array:
    """The root mean square of all entries of a tree, not differentiated."""
    leaves = [jnp.ravel(jax.lax.stop_gradient(leaf)) for leaf in jax.tree.leaves(tree)]
    count = sum(leaf.size for leaf in leaves)
    parts = [leaf[k] for leaf in leaves for k in range(leaf.size)] if count <= FEW else leaves
    return jnp.sqrt(sum(jnp.sum(jnp.real(v * jnp.conj(v))) for v in parts) / max(count, 1))


class Beside(Protocol):
    """What has errors beside the states: see `StepControl`."""

    @property
    def atol(self) -> Array: ...

    def __call__(
        self, t0: Time, t1: Time, y0: State, y1: State, error: State, args: Args, /
    ) -> tuple[Array, Array, Array]: ...


class StepControl(diffrax.AbstractAdaptiveStepSizeController):
    """Step sizes from tolerances of the local error.

    Differs from `diffrax.PIDController` in three points. The first step (`dt0=None`) follows from the slopes of the
    equations, in their own time scale. `RESULTS.dt_min_reached` ends an integration whose step size falls below the
    spacing of floating-point numbers, or that has rejected 100 steps without a step of ordinary length between them. A
    `steered` solver, such as `BDF`, chooses step sizes itself and may shorten the next step after an accepted one.

    **Arguments:**

    - `rtol`, `atol`: of the local error; `atol` may be an array that looks like y.
    - `norm`: of scaled errors; root mean square by default.
    - `steered`: for `BDF`.
    - `dtmax`: the longest step.
    - `beside`: what else has errors: a function of a step (t0, t1, y0, y1, error, args) that returns further values
        before and after it and their errors, all of shape (m,), and has their absolute tolerances as `atol`. For states
        that are one array.
    """

    rtol: Tolerance
    atol: Tolerance
    norm: Callable[[State], Numeric] = rms_norm
    steered: bool = eqx.field(static=True, default=False)
    dtmax: Time = None
    beside: Beside | None = None

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step, and the state of the controller: the number of rejections since the last step of
        ordinary length, negative if the last step was accepted."""
        if dt0 is None:
            dt0 = self._first(terms, t0, t1, y0, args, func, 1 if self.steered else int(error_order or 1))
        if self.dtmax is not None:
            dt0 = jnp.minimum(dt0, self.dtmax)
        return t0 + dt0, jnp.zeros((), jnp.int32)

    def _first(self, terms, t0, t1, y0, args, func, order):
        """h with c = h^(p+1)·|y'|·r^p in units of the tolerance, where r = |y''|/|y'| is the problem's own rate."""
        frozen = jax.tree.map(lambda v: jax.lax.stop_gradient(v) if eqx.is_array(v) else v, (terms, y0, args))
        terms, y0, args = frozen
        t0, t1 = jax.lax.stop_gradient((t0, t1))
        interval = t1 - t0
        atol = tolerance_like(self.atol, y0)

        def size(v):
            return self.norm(jax.tree.map(lambda a, y, atol: a / (atol + jnp.abs(y) * self.rtol), v, y0, atol))

        # After Hairer, Nørsett & Wanner (1993), II.4: a first guess by |y|/|y'|, an Euler step of that size, and from
        # the change of the slope the size at which the error term is 0.01 of the tolerance.
        tiny = jnp.finfo(interval.dtype).tiny
        slope = func(terms, t0, y0, args)
        d0, d1 = size(y0), size(slope)
        h0 = jnp.minimum(1e-3 * interval, 0.01 * d0 / jnp.maximum(d1, tiny))
        h0 = jnp.where(h0 > 0, h0, 1e-6 * interval)
        ahead = func(terms, t0 + h0, jax.tree.map(lambda y, s: y + (h0 * s).astype(y.dtype), y0, slope), args)
        d2 = size(jax.tree.map(jnp.subtract, ahead, slope)) / h0
        d1 = jnp.maximum(d1, d2 * h0)
        rests = d1 == 0
        rate = jnp.maximum(d2 / jnp.maximum(d1, tiny), 1 / interval)
        d1 = jnp.maximum(d1, UNSEEN * rate)
        target = 0.25 if order == 1 else 0.01
        h = (target / jnp.maximum(d1 * rate**order, tiny)) ** (1 / (order + 1))
        h = jnp.where(jnp.isfinite(h) & (h > 0) & ~rests, h, 1e-6 * interval)
        return jax.lax.stop_gradient(jnp.minimum(h, 0.1 * interval).astype(interval.dtype))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Accepts or rejects the step and proposes the next one; see `diffrax.AbstractStepSizeController`."""
        rejected, tries = controller_state > 0, jnp.abs(controller_state)
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)

        def scaled(a, b, e, atol):
            # Beside an infinite value every error would be zero, and the step would be kept.
            b = jnp.where(jnp.isfinite(b).all(), b, a)
            return e / (atol + jnp.maximum(jnp.abs(a), jnp.abs(b)) * self.rtol)

        atol = tolerance_like(self.atol, y0)
        if self.beside is not None:
            more = self.beside(t0, t1, y0, y1_candidate, y_error, args)
            atol = jnp.concatenate([jnp.broadcast_to(atol, y0.shape), self.beside.atol])
            pairs: Any = zip((y0, y1_candidate, y_error), more, strict=True)
            y0, y1_candidate, y_error = (jnp.concatenate(pair) for pair in pairs)
        norm = jax.lax.stop_gradient(self.norm(jax.tree.map(scaled, y0, y1_candidate, y_error, atol)))
        norm = jnp.where(jnp.isfinite(norm), norm, jnp.inf)
        keep = norm < 1
        if self.steered:
            factor = jnp.where(jnp.isfinite(norm), decoded(norm), 0.25)
        else:
            factor = SAFETY * jnp.exp(jnp.log(norm) * (-1 / error_order))  # a power is not vectorized in batches
            most = jnp.where(rejected, 1.0, 8.0)  # no growth at once after a rejection
            factor = jnp.clip(factor, 0.2, jnp.where(keep, most, SAFETY))
        dt = (t1 - t0) * factor.astype(t1.dtype)
        if self.dtmax is not None:
            dt = jnp.minimum(dt, self.dtmax)
        start = jnp.where(keep, t1, t0)
        # A step of a few spacings of floating-point numbers cannot be shortened in a useful way.
        spacing = jnp.finfo(t1.dtype).eps * jnp.abs(start)
        tries = jnp.where(keep, jnp.where(t1 - t0 > SHORT * spacing, 0, -tries), tries + 1)
        failed = ~keep & ((dt <= 4 * spacing) | (dt == 0) | (tries > MOST_TRIES))
        # A length of a few spacings counts as zero: Diffrax would go on with steps that leave time where it is.
        result = diffrax.RESULTS.where(failed, diffrax.RESULTS.dt_min_reached, diffrax.RESULTS.successful)
        dt = jax.lax.stop_gradient(dt)
        return keep, start, start + dt, False, tries, result


class ConstantLengths(End):
    """The lengths of steps after the first one are constant under differentiation."""

    def first(self, t, end, y, args, span):
        return end, ()

    def moved(self, start: Time, end: Time) -> Time:
        return start + jax.lax.stop_gradient(end - start)
