"""On which side of zero a guard is.

An event happens where its guard falls through zero: it is armed while the guard is above zero, and disarmed once it is
below, or at zero for good. What a reset leaves at zero, as a ball on the floor, rests there: it is armed, too, for
leaving zero on the wrong side. What is zero is so up to rounding only, so that there is a band about it:

    ABOVE   falls where it reaches zero,
    RESTS   inside the band, falls where it leaves the band below, is above once it leaves the band above,
    BELOW   does not fall; is above once it leaves the band above.

A relation has two guards, each the other's negative, for it turns both ways. Where one of them falls the other one is
at zero, and would be so within the band only: it is armed by the fall of the first, and falls at once if the equations
lead back.
"""

import jax.numpy as jnp
from jax import Array

from ...base.tolerances import BAND

ABOVE, RESTS, BELOW = 1.0, 0.5, 0.0  # numbers, to be part of the integrated state; what is positive is armed


def rounding(size: Array) -> Array:
    """The distance from zero that rounding alone can give a guard of this size."""
    return BAND * jnp.finfo(size.dtype).eps * size
