"""Newton homotopy: F(x) = (1 − s)·F(x0), followed from s = 0 to 1 in arc length (Keller 1977; Allgower & Georg 1990).

A tangent predicts the next point of the curve, Newton steps across the tangent correct it. So the local minima of |F|
are passed, where descent methods stop. Where the curve to one side ends, the other side is followed.
"""

from typing import NamedTuple

from ...solve.linear.arrays import Numbers, Verdict, where
from .search import Curve, Equations, Judged, Linear, Rung, Search

LIMIT = 200  # evaluations
FIRST_ARC, SHORTEST_ARC = 0.1, 1e-8  # of the curve, in units of the unknowns' sizes
CORRECTIONS = 4  # of a predicted point on the curve
SMALLEST_COSINE = 0.8  # between the tangents of neighbouring points: after a sharper turn it may be another curve
CLOSE = 0.02  # of the arc: corrections no longer than this end at a point of the curve


class Followed(NamedTuple):
    """The state of the curve, its last point (x, s), the point to look at next, the rung to go on with, whether s = 1
    is reached, and whether the curve is lost."""

    curve: Curve
    foot: Numbers
    trial: Numbers
    rung: Numbers
    landed: Verdict
    fails: Verdict


def followed(equations: Equations, search: Search, here: Numbers, judged: Judged, linear: Linear) -> Followed:
    """The next point to look at on the curve, or beside it. `here` is the trial point if it was accepted."""
    xp, n, along = equations.xp, equations.n, equations.along
    fresh, old, base = search.fresh, search.curve, search.base.at
    finite = judged.finite & search.tracking
    landing, length, stretch = search.rung == Rung.LAND, linear.length, linear.stretch
    unit = xp.append(search.unit, equations.array(1.0))

    # The null vector of a Jacobian has no sign. At the start the curve is followed towards s = 1; later the last
    # tangent, which is a row of the matrix, gives the sign.
    turned = where(fresh & ((linear.tangent[n] < 0) ^ (old.turn < 0)), -1.0, 1.0)
    tangent = linear.tangent * (turned / stretch)
    on_curve = finite & (stretch < xp.inf) & (fresh | (length <= CLOSE * xp.minimum(old.arc, 1.0)))
    on_curve &= fresh | landing | (stretch * SMALLEST_COSINE <= 1)  # with the last tangent, a unit vector
    corrected = here + where(fresh, 0.0, 1.0) * unit * linear.step
    # A correction past s = 1, from a prediction before it, would miss the root: a shorter arc lands.
    passed = on_curve & ~fresh & ~landing & ((corrected[n] - 1) * (base[n] - 1) < 0)
    on_curve &= ~passed
    # A correction that is not half as long as the last one does not converge: it may lead to another branch of the
    # curve.
    reach = where(old.corrections == 0, old.arc, 0.5 * old.corrected)
    correcting = finite & ~on_curve & ~passed & (old.corrections < CORRECTIONS) & (length <= reach)
    landed, passes = on_curve & landing, on_curve & ~landing

    arc = where(passes, where(old.corrections <= 1, 2 * old.arc, old.arc), old.arc / 3)
    arc = where(fresh, FIRST_ARC, xp.minimum(arc, 1 + linear.extent))
    rest = (1 - corrected[n]) / tangent[n]  # of the way to s = 1, along the tangent
    lands = passes & (rest > 0) & (rest <= arc)
    arc = where(correcting, old.arc, where(lands, rest, arc))
    foot, direction = where(passes, corrected, base), where(passes, tangent, old.tangent)
    ahead = where(correcting | landed, corrected, foot + arc * unit * direction)
    ahead = where(lands & (along > 0), 1.0, ahead)
    fails = ~landed & ((arc < SHORTEST_ARC) | (search.count >= LIMIT))
    rung = where(landed, int(Rung.POLISH), where(lands | (correcting & landing), int(Rung.LAND), int(Rung.TRACK)))
    corrections = where(correcting, old.corrections + 1, 0)
    return Followed(Curve(arc, direction, corrections, length, old.turn), foot, ahead, rung, landed, fails)
