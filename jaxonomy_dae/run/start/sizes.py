"""What measures unknowns and rows of initialization: so that units decide nothing."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float

from ...base.tolerances import DIGIT, NOISE, solved, spacing
from ...solve.linear.arrays import Numbers, namespace


class Sizes(NamedTuple):
    """The units of unknowns and rows; zero where nothing is known."""

    nominal: Float[Numbers, " n"]  # declared sizes of unknowns
    known: Float[Numbers, " n"]  # sizes of unknowns by their declarations, starts and guesses
    data: Float[Numbers, " m"]  # sizes of what each row is compared with
    soft: Float[Numbers, " m"]  # distances that weigh the same in soft rows


def soft_weight(dtype: DTypeLike) -> float:
    """The weight of soft rows beside others: they move these by its square, a tenth of what counts as rounding."""
    return float(np.sqrt(0.1 * solved(dtype)))


Weigh = Callable[[Numbers], Numbers]


def weighed(jacobian: Numbers) -> Weigh:
    """Σ |∂F/∂x|·v of each row as a function of v, for a dense Jacobian."""
    xp = namespace(jacobian)
    slopes = xp.where(xp.isfinite(jacobian), xp.abs(jacobian), 0)
    return lambda v: slopes @ v


def row_sizes(
    weigh: Weigh, x: Numbers, sizes: Sizes, unit: Numbers, terms: Numbers | None = None
) -> tuple[Numbers, Numbers]:
    """The size of each row's terms, and the rounding that the sizes of unknowns alone let expect.

    **Arguments:**

    - `weigh`: Σ |∂F/∂x|·v of each row, as a function of v.
    - `terms`: the magnitude of each row; where it is not known (infinite or not-a-number), and if nothing is given,
        slopes stand for it.
    """
    xp, eps = namespace(x), spacing(x.dtype)
    reach = xp.maximum(xp.abs(x), sizes.nominal)
    size = weigh(reach) if terms is None else xp.where(xp.isfinite(terms), terms, weigh(reach))
    size = size + sizes.data
    noise = NOISE * eps * (weigh(xp.maximum(unit, reach)) + sizes.data)
    # sin(10¹⁷) is not known to any digit: rounding of its argument excuses nothing.
    return size, xp.where(eps * weigh(xp.abs(x)) > DIGIT * size, 0, noise)


def terms_of(value: Numbers, terms: Numbers | None) -> Numbers:
    """The sizes of the terms of each row, or its value where they are not known. Where a row holds, its value is
    rounding and tells no size: the angle of a pendulum that hangs from a point found to 1e-16 is not of that size."""
    if terms is None:
        return value
    xp = namespace(value)
    return xp.where(xp.isfinite(terms), xp.maximum(terms, xp.abs(value)), value)


def column_sizes(value: Numbers, jacobian: Numbers, sizes: Sizes, power: Numbers | None = None) -> Numbers:
    """A size for every unknown: as known, or else what its rows imply, |∂F/∂xⱼ|·xⱼ being of the size of their other
    terms; 1 where nothing is known. With `power`, shape (m, n), terms are |jacobian|·xⱼ**power. `value` is the size of
    what stands in each row at the start, as by `terms_of`."""
    xp = namespace(jacobian)
    tiny, huge = float(xp.finfo(jacobian.dtype).tiny), 1 / float(xp.finfo(jacobian.dtype).eps)
    magnitude = xp.where(xp.isfinite(jacobian), xp.abs(jacobian), 0)
    offset = xp.maximum(sizes.data, xp.where(xp.isfinite(value), xp.abs(value), 0))
    size = sizes.known
    # Sizes of unknowns follow from rows, and those of rows from unknowns that have a size: the second round reaches
    # rows in which nothing was known before.
    for _ in range(2):
        terms = magnitude * (size[None, :] if power is None else size[None, :] ** power)
        row = xp.maximum(offset, xp.max(terms, axis=1, initial=0.0))
        seen = (magnitude > tiny) & (row > tiny)[:, None]
        ratio = xp.where(seen, row[:, None] / xp.where(seen, magnitude, 1), xp.inf)
        implied = xp.min(ratio if power is None else ratio ** (1 / power), axis=0, initial=xp.inf)
        size = xp.where(sizes.known > 0, sizes.known, xp.where(implied < huge, implied, 0))
    return xp.where(size > 0, size, 1)
