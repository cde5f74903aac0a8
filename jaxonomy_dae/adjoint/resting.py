"""Steps of explicit methods while the state rests.

The error of a step is that of the state. Where the state rests, it is zero whatever the step, but the derivative of the
solution, which is the motion after a small push, needs steps that are short beside the field's own time scale.
"""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from .closure_conversion import Program, any_member, closure_convert

STILL = 1e-9  # of the largest entry: a state that moves less during a step rests
GROWTH = 2.0  # of steps, from which on it is looked whether the state rests
REACH = 0.1  # of the time scale, for a step at rest: a method of order 5 errs by less than 1e-8 there


def resting_rate(terms: Any, solver: Any, controller: Any, t: Any, y: Any, args: Any) -> tuple[Any, list]:
    """The function `rate` of a `Program`, and the arrays it closes over: for explicit methods and states that are one
    array, unless steps are prescribed."""
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    while hasattr(controller, "controller"):
        controller = controller.controller
    prescribed = isinstance(controller, diffrax.StepTo | diffrax.ConstantStepSize)
    is_plain = isinstance(getattr(terms, "term", terms), diffrax.ODETerm) and isinstance(y, jax.Array) and y.ndim == 1
    if prescribed or not is_plain or not isinstance(solver, diffrax.AbstractERK) or not y.size:
        return None, []
    return closure_convert(lambda t, y: _rate(lambda y: terms.vf(t, y, args), y), t, y)


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
    moved = jnp.max(jnp.abs(new.y - state.y))
    rests = accepted & (asked > GROWTH * used) & (moved <= STILL * jnp.max(jnp.abs(state.y)))
    rate = lax.cond(
        any_member(rests),
        lambda y: program.rate(numbers["rate"], new.tprev, y),
        lambda y: jnp.zeros((), y.dtype),
        new.y,
    )
    longest = jnp.maximum(used, jnp.where(rate > 0, REACH / jnp.where(rate > 0, rate, 1.0), jnp.inf).astype(used.dtype))
    held = rests & (asked > longest)
    return dataclasses.replace(new, tnext=jnp.where(held, new.tprev + longest, new.tnext)), held
