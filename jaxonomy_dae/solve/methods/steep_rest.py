"""States that rest where they return with an infinite slope, as x' = −√|x|·sign(x) does at zero.

There, ∂f/∂x is minus infinity. A neighbouring solution meets the one at rest at once, so that the derivative of the
state is zero, whatever it was before. Automatic differentiation makes 0·∞ of it, which is not a number.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import Array, lax

from ...base.aliases import Args, State, Terms, Time
from ...base.private_names import rewrapped, unwrapped
from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from .dae_term import DAETerm
from .wrapped import WrappedSolver

# A distance from zero at which roots have finite slopes. Its own root is below any rounding, in single precision, too.
NEAR = 1e-30
# A component returns at once if a step is so many times longer than the time in which it returns from where its slope
# takes it: e^−1000 of a displacement is left.
AT_ONCE = 1e3


class AtSteepRest(WrappedSolver):
    """Wraps a solver for a state that is one array: derivatives of components are dropped that rest at zero with an
    infinitely stable slope. Values are those of the wrapped solver.

    A component is dropped if it is zero at the start of a step, is not on its way, and returns at once when it is
    displaced; and if no other component answers to it with an infinite slope. A flow that leaves the component passes
    derivatives on while their state has none: those are not a number, as they were.
    """

    solver: diffrax.AbstractSolver

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_compatible_contr_kwargs

    def init(self, terms, t0, t1, y0, args):
        kept = _rests_steeply(terms, t0, t1, y0, args)
        return self.solver.init(_dropped(terms, kept, t1 - t0), t0, t1, _constant(kept, y0), args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        kept = _rests_steeply(terms, t0, t1, y0, args)
        terms = _dropped(terms, kept, t1 - t0)
        return self.solver.step(terms, t0, t1, _constant(kept, y0), args, solver_state, made_jump)


def _rests_steeply(terms: Terms, t0: Time, t1: Time, y: State, args: Args) -> Array:
    """The components whose derivatives are dropped in the step from t0 to t1, shape (n,)."""
    terms, t0, t1, y, args = still((terms, t0, t1, y, args))

    def field(point: State) -> Array:
        return terms.vf(t0, point, args)

    def looked_at() -> Array:
        slope, steep = _steep(field, y)
        returns = field(jnp.where(steep, NEAR, y)) < slope
        return returns & _at_once(field, y, slope, steep, t1 - t0)

    return lax.cond(any_member(jnp.any(y == 0)), looked_at, lambda: jnp.zeros(y.shape, bool))


def without_idle_roots(field: Callable[[State], Array], y: State) -> Array:
    """The field, dy/dt, at y. A component that is zero, and whose root nothing reads in the mode that holds, as in
    s·√|x| with s = 0, has the derivative zero there, not 0·∞."""
    at = lax.stop_gradient(y)

    def looked_at() -> Array:
        slope, steep = _steep(field, at)
        return steep & (field(jnp.where(steep, NEAR, at)) == slope)

    idle = lax.cond(any_member(jnp.any(at == 0)), looked_at, lambda: jnp.zeros(y.shape, bool))
    return lax.cond(any_member(jnp.any(idle)), lambda: _beside(field, y, idle), lambda: field(y))


def _steep(field: Callable[[State], Array], y: State) -> tuple[Array, Array]:
    """Returns (the slope at y, the components that are zero and answer to themselves with a slope that is not finite),
    none where components answer to each other in this way."""
    ones = jnp.ones_like(y)
    slope, along = jax.jvp(field, (y,), (ones,))
    (back,) = jax.vjp(field, y)[1](ones)
    answers, is_answered = ~jnp.isfinite(along), ~jnp.isfinite(back)
    return slope, (y == 0) & answers & is_answered & jnp.all(answers == is_answered)


def _beside(field: Callable[[State], Array], y: State, here: Array) -> Array:
    """The field at y, with the derivatives beside zero of the components `here`, where they are finite."""
    beside = field(jnp.where(here, jnp.asarray(NEAR, y.dtype), y))
    return beside + lax.stop_gradient(field(y) - beside)


def _at_once(field: Callable[[State], Array], y: State, slope: Array, steep: Array, h: Time) -> Array:
    """Of the components `steep`, those that return at once from where their slope takes them in a step of length h."""
    reached = y + jnp.where(steep, h * slope, 0.0)
    rate = jax.jvp(field, (reached,), (steep.astype(y.dtype),))[1]
    return steep & ~(jnp.abs(h * rate) <= AT_ONCE)  # an infinite rate may show as not a number


def _dropped(terms: Terms, kept: Array, h: Time) -> Any:
    """The terms for a step of length h, whose slopes have derivatives where the components `kept` are zero."""
    inner, _ = unwrapped(terms)

    def field(t: Time, y: State, args: Args) -> State:
        here = kept & (y == 0)

        def aside() -> State:
            slope = _beside(lambda v: inner.vf(t, v, args), y, here)
            fixed, time, point, given, length = still((inner, t, y, args, h))
            rests = _at_once(lambda v: fixed.vf(time, v, given), point, still(slope), here, length)
            return _constant(rests, slope)

        return lax.cond(any_member(jnp.any(here)), aside, lambda: inner.vf(t, y, args))

    if isinstance(inner, DAETerm):
        return rewrapped(terms, DAETerm(field, mass=inner.mass, pattern=inner.pattern))
    return rewrapped(terms, diffrax.ODETerm(field))


def _constant(here: Array, y: Array) -> Array:
    """The values, constant under differentiation where `here`."""
    return jnp.where(here, lax.stop_gradient(y), y)
