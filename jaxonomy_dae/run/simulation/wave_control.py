"""Step sizes that see the waves by which a model is driven.

While the driven part is inactive, for example a rectifier whose diodes block, nothing limits steps: they grow over
whole periods, and no error estimate sees what happens within. So steps are at most a quarter of the fastest period.
Long steps also end at the zeros and extremes of the waves: at an extreme, a blocked diode would first conduct.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ...base.aliases import Time
from ...solve.adjoint.ends import End

QUARTER = 0.5 * jnp.pi  # of a turn, radians
# Steps shorter than this part of a quarter look at a wave 16 times in a period. They are left alone, because an
# implicit solver pays for every change of its step size.
SHORT = 0.25
HERE = 1e-6  # of a quarter: a step that ends at an extreme, or so close to it, leads to the next one
ROUNDINGS = 16  # of the angle: as far from an extreme as times are known, where many periods have passed


class AtWaves(End):
    """For inputs that are waves sin(ωt + φ): steps are at most a quarter of the shortest period, and long steps end
    where a wave is zero, one or minus one. Times are constants of differentiation, as step sizes are."""

    frequency: Float[Array, " waves"]
    phase: Float[Array, " waves"]

    def moved(self, start: Time, end: Time) -> Time:
        """The end of a step from `start` to `end`, moved so that steps end where a wave has turned by whole
        quarters."""
        begin, step, frequency, phase = lax.stop_gradient((start, end - start, self.frequency, self.phase))
        quarter = QUARTER / jnp.abs(frequency)  # infinite for what does not turn
        bounded = jnp.minimum(step, jnp.min(quarter))
        turned = (frequency * begin + phase) * jnp.sign(frequency) / QUARTER
        here = HERE + ROUNDINGS * jnp.finfo(begin.dtype).eps * jnp.max(jnp.abs(frequency * begin)) / QUARTER
        ahead = (jnp.floor(turned + here) + 1 - turned) * quarter
        ahead = jnp.min(jnp.where((bounded > SHORT * quarter) & jnp.isfinite(ahead), ahead, jnp.inf))
        # Two even steps where one would leave a remainder.
        length = jnp.where(bounded < (1 - here) * ahead, jnp.minimum(bounded, 0.5 * ahead), ahead)
        length = jnp.where(bounded > 0.5 * ahead, length, bounded)
        return jnp.where(length < step, start + length.astype(begin.dtype), end)
