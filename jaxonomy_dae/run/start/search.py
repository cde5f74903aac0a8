"""What a search for a root of F is about, and where it stands."""

import dataclasses
import enum
from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool

from ...solve.linear.arrays import Numbers, Verdict, namespace, where
from .sizes import Sizes, soft_weight

# A step that would cross a bound goes this part of the way to it: at the bound itself a root or logarithm may have no
# slope.
TO_BOUND = 0.9


class Rung(enum.IntEnum):
    """The methods that steps belong to. The first ones are numbered as in `METHODS`; homotopy is TRACK and LAND, and
    POLISH is Newton's method from where it landed."""

    NEWTON = 1
    MARQUARDT = 2
    POLISH = 3
    NEAREST = 4
    TRACK = 5  # the curve is followed
    LAND = 6  # onto the point of the curve at s = 1
    DONE = 7
    FAILED = 8


class Probe(enum.IntEnum):
    """What the trial point is for, until a climb has begun: see `probing`."""

    START = 0
    FAR = 1
    NEAR = 2
    SIZED = 3
    NONE = 4


class Look(NamedTuple):
    """The rows at a point: F, its Jacobian, and how large the terms of each row are, beside which it counts as zero;
    not finite where that is not known, None where it is known of no row. There Σ |∂F/∂x|·|x| stands for it."""

    value: Numbers
    jacobian: Numbers
    terms: Numbers | None


@dataclasses.dataclass(frozen=True)
class Equations:
    """F(x) = 0, as it is searched for.

    - `look`: the rows at a point; `sizes`: of unknowns and rows.
    - `soft`: which rows are guesses, shape (m,); `core`: rows for the homotopy, or None.
    - `limits`: bounds of the unknowns, or None; `in_units`: whether unknowns are measured in typical sizes.
    - `origin`: where the search begins. Points are (x, s), shape (n + 1,), with s the parameter of the homotopy.
    """

    look: Callable[[Numbers], Look]
    sizes: Sizes
    soft: Bool[np.ndarray, " m"]
    core: np.ndarray | None
    limits: tuple[Numbers, Numbers] | None
    origin: Numbers
    in_units: Verdict

    @property
    def xp(self) -> ModuleType:
        """NumPy or JAX."""
        return namespace(self.origin)

    @property
    def dtype(self) -> np.dtype:
        """The type of all numbers."""
        return self.origin.dtype

    @property
    def n(self) -> int:
        """The number of unknowns."""
        return len(self.origin) - 1

    @property
    def has_soft(self) -> bool:
        """True if some rows are guesses."""
        return bool(self.soft.any())

    @property
    def nearest_first(self) -> bool:
        """True if guesses outnumber what they can choose."""
        return self.has_soft and self.core is None

    @property
    def first_rung(self) -> Rung:
        """The rung that each climb begins with."""
        return Rung.NEAREST if self.nearest_first else Rung.NEWTON

    def array(self, values: ArrayLike | list[float]) -> Numbers:
        """Numbers in the kind of the search's arrays."""
        return self.xp.asarray(values, self.dtype)

    @property
    def along(self) -> Numbers:
        """The direction of s."""
        return self.array(np.append(np.zeros(self.n), 1.0))

    @property
    def generic(self) -> Numbers:
        """A direction of no symmetry, across which curves are followed at the start: so the first matrix is regular
        where the Jacobian is not."""
        return self.array(1.0 + 0.5 * np.cos(np.arange(1, self.n + 2)))

    @property
    def weights(self) -> Numbers:
        """One for rows that must hold, less for guesses."""
        return self.array(np.where(self.soft, soft_weight(self.dtype), 1.0))

    def bounded(self, ahead: Numbers, here: Numbers) -> Numbers:
        """A step that goes most of the way to the bounds it would cross."""
        if self.limits is None:
            return ahead
        (low, high), x, base = self.limits, ahead[: self.n], here[: self.n]
        x = where(x < low, base + TO_BOUND * (low - base), where(x > high, base + TO_BOUND * (high - base), x))
        return self.xp.append(x, ahead[self.n])


class Base(NamedTuple):
    """The last point that was accepted.

    - `at`: the point; `value`: F there; `jacobian`: with columns in units of the unknowns.
    - `limit`: the largest value of each row that counts as zero; `holds`: whether none is larger.
    - `square`: |F|², rows weighted.
    """

    at: Numbers
    value: Numbers
    jacobian: Numbers
    limit: Numbers
    holds: Verdict
    square: Numbers


class Descent(NamedTuple):
    """Steps that lower |F|: the fraction of a Newton step; the damping of a step of Levenberg and Marquardt, its growth
    when one is rejected, and by how much the linear model says |F|² will fall; the last step to the nearest point."""

    fraction: Numbers
    damping: Numbers
    growth: Numbers
    gain: Numbers
    step: Numbers


class Curve(NamedTuple):
    """Steps along the curve of the homotopy: the length of arc, the tangent, how often the predicted point has been
    corrected, by how much the last time, and which way the curve is followed."""

    arc: Numbers
    tangent: Numbers
    corrections: Numbers
    corrected: Numbers
    turn: Numbers


class Search(NamedTuple):
    """Where a search stands.

    - `rung`: at work; `fresh`: whether the trial point is where it starts; `count`: its evaluations.
    - `climb`: of the ladder, one to `CLIMBS`; `probe`: what is looked at before it begins.
    - `method`: the rung that succeeded; `evaluations`: of all.
    - `trial`: the point to look at next; `start`: where rungs begin; `best`: where descent ended.
    - `first`: F at the start; `weight`: of each row; `unit`: sizes of the unknowns; `flat`: those that nothing depends
      on at the start; `open`: those without a guess that have not followed from other ones (`following.py`).
    """

    rung: Numbers
    fresh: Verdict
    count: Numbers
    climb: Numbers
    probe: Numbers
    method: Numbers
    evaluations: Numbers
    trial: Numbers
    start: Numbers
    best: Numbers
    first: Numbers
    weight: Numbers
    unit: Numbers
    flat: Numbers
    open: Numbers
    base: Base
    descent: Descent
    curve: Curve

    @property
    def tracking(self) -> Verdict | bool:
        """Whether the homotopy is at work."""
        return (self.rung == Rung.TRACK) | (self.rung == Rung.LAND)

    @property
    def begins(self) -> Verdict | bool:
        """Whether the trial point is where a climb starts."""
        return (self.probe == Probe.START) | (self.probe == Probe.SIZED)


class Judged(NamedTuple):
    """What a trial point is worth: whether all is finite there, whether it is accepted, whether it is a root, the ratio
    of the decrease of |F|² to that of the linear model, the weights of the rows, and what this rung makes of them."""

    finite: Verdict
    accepted: Verdict
    reached: Verdict
    ratio: Numbers
    weight: Numbers
    weights: Numbers


class Linear(NamedTuple):
    """The linear model at the base, solved.

    - `step`: that lowers |F| most; `tangent`: of the curve; `length`, `stretch`: their norms.
    - `explained`: by how much the step lowers |F|; `extent`: the norm of the point. All in units of the unknowns.
    """

    step: Numbers
    tangent: Numbers
    length: Numbers
    stretch: Numbers
    explained: Numbers
    extent: Numbers
