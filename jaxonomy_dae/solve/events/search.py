"""Where in a step the first guard falls through zero."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax

# The bracket ends at this part of its first length, or at the spacing of times.
SHORTEST = 1e-13
# Oliveira & Takahashi (2020), section 3: how far the estimate is moved towards the middle, as a part of the bracket
# (relative to its first length), and how many more evaluations than by bisection there may be.
TRUNCATION, SLACK = 0.2, 1
ITERATIONS = 48  # never reached: 44 bisections make a bracket as short as SHORTEST


def first_crossing(
    guards: Callable[[Array], Array],
    falling: Array,
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
    going: Array,
) -> Array:
    """The last place before the first zero of the guards that are `falling`, positive at `low` and not so at `high`;
    where none is wanted, without `going`, that is `high`.

    Only signs decide where the zero is: a guard may meet zero as flatly as it will, or stay there, as max(1 − t, 0)
    does. The last time at which it is positive is returned: there it still has the rate at which it falls.

    The places are those of ITP (Oliveira & Takahashi, ACM Transactions on Mathematical Software 47, 2020) for the guard
    that comes first by linear interpolation: it takes one evaluation more than bisection at worst, and one for
    rounding, and few where the guard is nearly linear.
    """
    eps = jnp.finfo(jnp.result_type(high)).eps
    tiny = jnp.finfo(jnp.result_type(at_low)).tiny
    whole = high - low
    floor = jnp.maximum(SHORTEST * whole, 4 * eps * jnp.abs(high))
    halvings = jnp.ceil(jnp.log2(jnp.maximum(whole / floor, 1.0)))

    def estimate(low, high, at_low, at_high):
        """Regula falsi, for the guard that comes first."""
        part = at_low / jnp.maximum(at_low - at_high, tiny)
        return low + (high - low) * jnp.min(jnp.where(falling & (at_high <= 0), part, 1.0))

    def body(carry):
        low, high, at_low, at_high, k = carry
        width, middle = high - low, 0.5 * (low + high)
        guess = estimate(low, high, at_low, at_high)
        towards, distance = jnp.sign(middle - guess), jnp.abs(middle - guess)
        truncation = TRUNCATION * width * (width / jnp.maximum(whole, tiny))
        truncated = jnp.where(truncation <= distance, guess + towards * truncation, middle)
        # What bisection would still have of the bracket, beyond what is left of it.
        radius = jnp.maximum(0.5 * (floor * jnp.exp2(halvings + SLACK - k) - width), 0.0)
        # The estimate may be anywhere, but not so far from the middle that the bracket would fall behind bisection.
        t = jnp.where(jnp.abs(truncated - middle) <= radius, truncated, middle - towards * radius)
        # Strictly inside the bracket, so that each evaluation makes it shorter.
        t = jnp.clip(t, low + SHORTEST * width, high - SHORTEST * width)
        value = guards(t)
        hit = jnp.any(falling & (value <= 0))
        return (
            jnp.where(hit, low, t), jnp.where(hit, t, high),
            jnp.where(hit, at_low, value), jnp.where(hit, value, at_high), k + 1,
        )  # fmt: skip

    def unfinished(carry):
        low, high, *_, k = carry
        return going & (k < ITERATIONS) & (high - low > floor)

    begin = (low, high, jnp.maximum(at_low, 0.0), at_high, jnp.zeros_like(whole))
    return jnp.where(going, lax.while_loop(unfinished, body, begin)[0], high)
