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

STILL = 1e-9  # what a relative change of the state by so much would also bring about is no motion
GROWTH = 2.0  # of steps, from which on it is looked whether the state rests
REACH = 0.1  # of the time scale, for a step at rest: a method of order 5 errs by less than 1e-8 there


def steps_at_rest(terms: Any, solver: Any, controller: Any, t: Any, y: Any, args: Any) -> tuple[Any, list]:
    """The function `rest` of a `Program`, and the arrays it closes over: None and none where steps are not held
    back."""
    if not is_held_back(terms, solver, controller, y):
        return None, []
    return closure_convert(lambda t, h, y0, y1: _longest(terms, t, h, y0, y1, args), t, t, y, y)


def is_held_back(terms: Any, solver: Any, controller: Any, y: Any) -> bool:
    """Whether steps may be held back: those of explicit methods, for a state that is one array (beside what events
    keep), unless they are prescribed."""
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    while hasattr(controller, "controller"):
        controller = controller.controller
    prescribed = isinstance(controller, diffrax.StepTo | diffrax.ConstantStepSize)
    x = _moving(y)
    is_plain = isinstance(getattr(terms, "term", terms), diffrax.ODETerm) or x is not y
    is_array = isinstance(x, jax.Array) and x.ndim == 1 and x.size > 0
    return is_plain and is_array and isinstance(solver, diffrax.AbstractERK) and not prescribed


def _moving(y: Any) -> Any:
    """What the field moves: y, or `y.x` where events keep more beside it."""
    return y if isinstance(y, jax.Array) else getattr(y, "x", y)


def _longest(terms: Any, t: Any, used: Array, y0: Any, y1: Any, args: Any) -> Array:
    """How long the step may be that follows one of length `used` from y0 to y1: infinite unless the state rests, and
    otherwise a part of the time in which a small push grows or turns at first, √(|v|/|J²v|), J by differences."""
    x0, x = _moving(y0), _moving(y1)
    eps = jnp.finfo(x.dtype).eps
    largest = jnp.max(jnp.abs(x))
    size = jnp.sqrt(eps) * jnp.where(largest > 0, jnp.abs(x) + 1e-3 * largest, 1.0)
    # A push without pattern.
    k = jnp.arange(x.size, dtype=x.dtype)
    pattern = jnp.where(jnp.sin(12.9898 * k + 1.0) > 0, 1.0, -1.0) * (1.0 + 0.5 * jnp.sin(78.233 * k))

    def field(x):
        return terms.vf(t, x if _moving(y1) is y1 else eqx.tree_at(lambda y: y.x, y1, x), args)

    def once(carry, k):
        # The field itself, what relative changes do to it, then its differences along the push and along where that
        # leads.
        at_rest, blurred, push, product = carry
        here = field(x + jnp.where(k == 0, 0.0, jnp.where(k == 1, STILL * jnp.abs(x) * pattern, push)))
        change = here - at_rest
        factor = jnp.max(jnp.abs(change / size)) / jnp.max(jnp.abs(push / size))
        along = jnp.where(factor > 0, change / jnp.where(factor > 0, factor, 1.0), push)
        turns = k > 1
        after = (
            jnp.where(k == 0, here, at_rest),
            jnp.where(k == 1, jnp.abs(change), blurred),
            jnp.where(turns, along, push),
            jnp.where(turns, product * factor, product),
        )
        return after, None

    none = jnp.zeros_like(x)
    (_, blurred, _, product), _ = lax.scan(once, (none, none, size * pattern, jnp.ones((), x.dtype)), jnp.arange(4))
    rests = jnp.all(jnp.abs(x - x0) <= STILL * jnp.abs(x) + used * blurred)
    scale = REACH / jnp.sqrt(jnp.where(product > 0, product, 1.0))
    longest = jnp.where(product > 0, jnp.maximum(used, scale), jnp.inf)
    return jnp.where(rests, longest, jnp.inf).astype(used.dtype)


def held_back(
    state: Any, new: Any, accepted: Bool[Array, ""], numbers: dict[str, Any], program: Program
) -> tuple[Any, Bool[Array, ""]]:
    """Diffrax's state after an attempted step, its next step shortened where y rests; and whether it was."""
    if program.rest is None:
        return new, jnp.array(False)
    used, asked = state.tnext - state.tprev, new.tnext - new.tprev
    longest = _where_steps_grow(
        accepted & (asked > GROWTH * used),
        lambda used, y0, y1: program.rest(numbers["rest"], new.tprev, used, y0, y1), used, state.y, new.y,
    )  # fmt: skip
    held = asked > longest
    return dataclasses.replace(new, tnext=jnp.where(held, new.tprev + longest, new.tnext)), held


def _where_steps_grow(grows: Bool[Array, ""], longest: Any, used: Array, y0: Any, y1: Any) -> Array:
    """`longest(used, y0, y1)`, infinite where steps do not grow."""
    found = lax.cond(any_member(grows), longest, lambda used, *_: jnp.full_like(used, jnp.inf), used, y0, y1)
    return jnp.where(grows, found, jnp.inf)


class HeldBack(diffrax.AbstractAdaptiveStepSizeController):
    """The step sizes of another controller, held back where the state rests, as `StoredAdjoint` does by itself: for
    derivatives by other adjoints."""

    controller: Any
    terms: Any

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
        return HeldBack(self.controller.wrap(direction), self.terms)  # pyright: ignore[reportCallIssue]

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """As the other controller's."""
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, controller_state):
        """Whether the step is kept, and the next one."""
        keep, start, end, jump, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1, args, y_error, error_order, controller_state
        )
        given = (self.terms, t1, args, y0, y1, t1 - t0, end - start)
        terms, t, args, a, b, used, asked = jax.tree.map(
            lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, given
        )
        longest = _where_steps_grow(
            keep & (asked > GROWTH * used),
            lambda used, y0, y1: _longest(terms, t, used, y0, y1, args), used, a, b,
        )  # fmt: skip
        return keep, start, jnp.where(asked > longest, start + longest, end), jump, state, result
