"""Where in a step the first guard falls through zero."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax

# Were every iteration a bisection, 44 would shorten the bracket to 1e-13 of it, below which the search ends.
ITERATIONS = 48
# Regula falsi creeps where a guard meets zero flatly: bisection now and then bounds the number of iterations.
BISECT_EVERY = 6


def first_crossing(
    guards: Callable[[Array], Array],
    falling: Array,
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
    going: Array,
) -> Array:
    """The first zero of the guards that are `falling`, positive at `low` and not so at `high`.

    The Illinois variant of regula falsi (Dowell & Jarratt 1971) on the guard that comes first by linear interpolation;
    bisection now and then, while the bracket begins where a guard is nearly zero because its event has just been, and
    while it ends where one is exactly zero, for it may have been so for long. Of a guard that stays at zero, as
    max(1 − t, 0) does, the last time at which it is positive is returned: there it still has the rate at which it
    falls.
    """
    one = jnp.array(1, jnp.int32)
    eps = jnp.finfo(jnp.result_type(high)).eps
    floor = jnp.maximum(1e-13 * (high - low), 4 * eps * jnp.abs(high))
    tiny = jnp.finfo(jnp.result_type(at_low)).tiny
    start = low

    def estimate(low, high, at_low, at_high):
        each = low + (high - low) * at_low / jnp.maximum(at_low - at_high, tiny)
        return jnp.min(jnp.where(falling & (at_high <= 0), each, jnp.inf))

    def body(carry):
        low, high, at_low, at_high, side, last, _, k = carry
        # Strictly inside the bracket, so that each evaluation makes it shorter.
        width = high - low
        t = jnp.clip(estimate(low, high, at_low, at_high), low + 1e-13 * width, high - 1e-13 * width)
        # Behind the last event the guard is nearly zero at `low`, and interpolation would stay there: bisection takes
        # 15 evaluations instead of 37.
        begins_at_zero = (low == start) & jnp.any(falling & (at_high <= 0) & (at_low <= 1e-6 * jnp.abs(at_high)))
        ends_at_zero = jnp.any(falling & (at_high == 0))
        t = jnp.where((k % BISECT_EVERY == BISECT_EVERY - 1) | begins_at_zero | ends_at_zero, 0.5 * (low + high), t)
        value = guards(t)
        hit = jnp.any(falling & (value <= 0))
        again = jnp.where(hit, side == 1, side == -1)
        new_low = jnp.where(hit, jnp.where(again, 0.5 * at_low, at_low), value)
        new_high = jnp.where(hit, value, jnp.where(again, 0.5 * at_high, at_high))
        return (
            jnp.where(hit, low, t),
            jnp.where(hit, t, high),
            new_low,
            new_high,
            jnp.where(hit, one, -one),
            t,
            jnp.abs(t - last),
            k + 1,
        )

    def unfinished(carry):
        *_, moved, k = carry
        return going & (k < ITERATIONS) & (moved > floor)

    zero = jnp.zeros_like(one)
    carry = (low, high, jnp.maximum(at_low, 0.0), at_high, zero, high, high - low, zero)
    low, high, _, _, _, last, _, _ = lax.while_loop(unfinished, body, carry)
    return jnp.where(high - low <= 2 * floor, low, last)
