"""Steps of explicit methods while the state rests.

The error of a step is that of the state. Where the state rests, it is zero whatever the step, but the derivative of the
solution, which is the motion after a small push, needs steps that are short beside the field's own time scale.
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from .closure_conversion import Program, any_member, closure_convert

STILL = 1e-9  # of the largest entry: a state that moves less during a step rests
GROWTH = 2.0  # of steps, from which on it is looked whether the state rests
REACH = 0.1  # of the time scale, for a step at rest: a method of order 5 errs by less than 1e-8 there


def resting_rate(terms: Any, solver: Any, controller: Any, t: Any, y: Any, args: Any) -> tuple[Any, list]:
    """The function `rate` of a `Program`, and the arrays it closes over: None and none where steps are not held
    back."""
    if not is_held_back(terms, solver, controller, y):
        return None, []
    return closure_convert(lambda t, y: _rate(lambda y: terms.vf(t, y, args), y), t, y)


def is_held_back(terms: Any, solver: Any, controller: Any, y: Any) -> bool:
    """Whether steps may be held back: those of explicit methods, for a state that is one array, unless they are
    prescribed."""
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    while hasattr(controller, "controller"):
        controller = controller.controller
    prescribed = isinstance(controller, diffrax.StepTo | diffrax.ConstantStepSize)
    is_plain = isinstance(getattr(terms, "term", terms), diffrax.ODETerm) and isinstance(y, jax.Array) and y.ndim == 1
    return not prescribed and is_plain and isinstance(solver, diffrax.AbstractERK) and y.size > 0


def _rate(field: Any, y: Array) -> Array:
    """How fast a small push grows or turns at first: the square root of |J²v|/|v|, J by differences."""
    eps = jnp.finfo(y.dtype).eps
    largest = jnp.max(jnp.abs(y))
    size = jnp.sqrt(eps) * jnp.where(largest > 0, jnp.abs(y) + 1e-3 * largest, 1.0)
    # A push without pattern.
    k = jnp.arange(y.size, dtype=y.dtype)
    push = size * jnp.where(jnp.sin(12.9898 * k + 1.0) > 0, 1.0, -1.0) * (1.0 + 0.5 * jnp.sin(78.233 * k))

    def once(carry, k):
        # At k = 0 the field itself, then its differences along the push and along where that leads.
        at_rest, push, product = carry
        here = field(y + jnp.where(k == 0, 0.0, push))
        change = here - at_rest
        factor = jnp.linalg.norm(change / size) / jnp.linalg.norm(push / size)
        along = jnp.where(factor > 0, change / jnp.where(factor > 0, factor, 1.0), push)
        first = k == 0
        after = (
            jnp.where(first, here, at_rest),
            jnp.where(first, push, along),
            product * jnp.where(first, 1.0, factor),
        )
        return after, None

    (_, _, product), _ = lax.scan(once, (jnp.zeros_like(y), push, jnp.ones((), y.dtype)), jnp.arange(3))
    return jnp.sqrt(product)


def held_back(
    state: Any, new: Any, accepted: Bool[Array, ""], numbers: dict[str, Any], program: Program
) -> tuple[Any, Bool[Array, ""]]:
    """Diffrax's state after an attempted step, its next step shortened where y rests; and whether it was."""
    if program.rate is None:
        return new, jnp.array(False)
    used, asked = state.tnext - state.tprev, new.tnext - new.tprev
    longest = _longest(
        lambda y: program.rate(numbers["rate"], new.tprev, y), state.y, new.y, used, accepted & (asked > GROWTH * used)
    )
    held = asked > longest
    return dataclasses.replace(new, tnext=jnp.where(held, new.tprev + longest, new.tnext)), held


def _longest(rate_at: Any, y0: Array, y1: Array, used: Array, grows: Bool[Array, ""]) -> Array:
    """How long the step may be that follows one from y0 to y1 of length `used`; infinite unless the state rests."""
    rests = grows & (jnp.max(jnp.abs(y1 - y0)) <= STILL * jnp.max(jnp.abs(y0)))
    rate = lax.cond(any_member(rests), rate_at, lambda y: jnp.zeros((), y.dtype), y1)
    scale = jnp.where(rate > 0, REACH / jnp.where(rate > 0, rate, 1.0), jnp.inf).astype(used.dtype)
    return jnp.where(rests, jnp.maximum(used, scale), jnp.inf)


class HeldBack(diffrax.AbstractAdaptiveStepSizeController):
    """The step sizes of another controller, held back where the state rests, as `StoredAdjoint` does by itself: for
    derivatives by other adjoints. `field(t, y, args)` is the vector field."""

    controller: Any
    field: Any

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.norm

    def wrap(self, direction):
        return HeldBack(self.controller.wrap(direction), self.field)  # pyright: ignore[reportCallIssue]

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """As the other controller's."""
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, controller_state):
        """Whether the step is kept, and the next one."""
        keep, start, end, jump, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1, args, y_error, error_order, controller_state
        )
        given = (self.field, t1, args, y0, y1, t1 - t0, end - start)
        field, t, args, a, b, used, asked = jax.tree.map(
            lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, given
        )
        longest = _longest(lambda y: _rate(lambda y: field(t, y, args), y), a, b, used, keep & (asked > GROWTH * used))
        return keep, start, jnp.where(asked > longest, start + longest, end), jump, state, result
