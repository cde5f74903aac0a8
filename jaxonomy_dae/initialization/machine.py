"""The state of the loop that climbs the ladder."""

from typing import Any, NamedTuple


class Machine(NamedTuple):
    """The state of the ladder. Points are (x, s). It is packed into few arrays: XLA compiles a kernel for each."""

    scalars: Any  # see Scalars
    points: Any  # trial, base (the last one accepted), best, the tangent, where rungs start, and the units
    rows: Any  # F at the base, F at the start, the weight of each equation, and what counts as zero at the base
    jacobian: Any  # at the base, columns scaled


class Scalars(NamedTuple):
    """`size` is the fraction of a Newton step, the damping, or the length of arc."""

    phase: Any
    method: Any
    fresh: Any  # whether the trial point is where a rung starts
    begun: Any  # the number of the climb once F has been finite; on the way there, see `probing`
    count: Any  # evaluations on this rung
    evaluations: Any
    size: Any
    growth: Any  # of the damping when a step is rejected; on the curve, the length of the last correction
    square: Any  # |F|² at the base, weighted
    gain: Any  # by which the linear model says it will fall
    holds: Any  # whether |F| at the base counts as zero
    turn: Any  # which way the curve is followed
    corrections: Any
