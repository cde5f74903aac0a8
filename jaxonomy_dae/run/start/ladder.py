"""A ladder of methods for F(x) = 0 with at least as many equations as unknowns, consistent ones.

Each rung starts at the given point, and only if the one before failed:

1. Newton's method with a line search (Gauss–Newton where there are more equations than unknowns;
   Deuflhard 2004, ch. 3);
2. Levenberg–Marquardt, the damping changed as by Nielsen (1999): starts where the Jacobian is singular;
3. Newton homotopy, F(x) = (1 − s)·F(x0) followed from s = 0 to 1 in arc length (Keller 1977; Allgower & Georg 1990),
   to the one side and then to the other: past the local minima of |F|, where descent methods stop;
4. if some rows are soft (guesses), the nearest point: Gauss–Newton steps for the least Σ (soft rows)² on F = 0, by the
   method of weighting (Van Loan 1985).

Where unknowns have no guess, zero stands for one, and there slopes may vanish, as of q·|q|: no rung leads away. So, if
all have failed, the ladder is climbed again with those unknowns at their sizes, then with every other one negative.

Units decide nothing: unknowns are measured by their sizes, rows by the sizes of their terms.

All rungs are states of one search (`search.py`), the body of a single loop: one residual, one Jacobian and one QR
factorization are traced and compiled, whichever rung is at work. Its steps are those of `gauss_newton.py` or of
`homotopy.py`; what comes next is decided here. Under `vmap` each member is on its own rung. Where values are known, the
same search runs in NumPy (`arrays.py`), and only the residual and its Jacobian are compiled.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from ...base.tolerances import close, solved
from ...solve.linear.arrays import Numbers, Verdict, loop, namespace, where
from . import gauss_newton, homotopy
from .following import followed
from .probing import Probed, probed
from .search import Base, Curve, Descent, Equations, Judged, Look, Probe, Rung, Search
from .sizes import Sizes, column_sizes, row_sizes, terms_of, weighed

METHODS = (
    "the start was consistent",
    "Newton",
    "Levenberg–Marquardt",
    "homotopy",
    "the nearest point",
    "the solver asked for",
    "one block after the other",
    "none",
)
NEAREST = METHODS.index("the nearest point")
GIVEN = METHODS.index("the solver asked for")
STAGED = METHODS.index("one block after the other")
FAILED = len(METHODS) - 1

STEPS_OFF = 8  # points tried around a start where F or its Jacobian is not finite
CLIMBS = 3  # from the start; then with unknowns without a guess at their sizes; then with every other one negative


class Found(NamedTuple):
    """A root, or the best point met; the Jacobian there; the largest value of each row that counts as zero; the sizes
    of the unknowns; the rung that succeeded, an index into `METHODS`."""

    x: Numbers
    jacobian: Numbers
    limit: Numbers
    unit: Numbers
    method: Numbers
    evaluations: Numbers


def looking(
    function: Callable[[jax.Array], jax.Array], magnitude: Callable[[jax.Array], jax.Array] | None = None
) -> Callable[[Numbers], Look]:
    """The rows at a point, from the function F and that of the magnitudes of its terms."""

    def look(x: Numbers) -> Look:
        x = jnp.asarray(x)
        jacobian, value = jax.jacfwd(lambda y: (function(y),) * 2, has_aux=True)(x)
        # What functions of the user's close over may be differentiated elsewhere: not in here.
        return jax.lax.stop_gradient(Look(value, jacobian, None if magnitude is None else magnitude(x)))

    return look


def find_root(
    look: Callable[[Numbers], Look],
    m: int,
    start: Float[Numbers, " n"],
    sizes: Sizes,
    core: np.ndarray | None,
    soft: Bool[np.ndarray, " m"] | None = None,
    bounds: Float[np.ndarray, "n 2"] | None = None,
    typical: Float[Numbers, " n"] | None = None,
) -> Found:
    """Climbs the ladder: in a program, or in NumPy if `start` is an array of NumPy.

    **Arguments:**

    - `look`: the `m` rows at a point of shape (n,), as `looking` makes it.
    - `start`: where every rung starts, shape (n,).
    - `sizes`: of unknowns and of the rows' data.
    - `core`: n rows of F that are independent and determine x, for the homotopy; None leaves that rung out.
    - `soft`: which rows are guesses: they hold if they can; else the nearest point is taken. Without a `core` they
        outnumber what they can choose, and the nearest point is looked for at once.
    - `bounds`: of the unknowns; no iterate leaves them.
    - `typical`: sizes of the unknowns where nothing is known, as powers of two: the search is in units of these.
    """
    limits, xp, unit = None, namespace(start), None
    if bounds is not None and np.isfinite(bounds).any():
        limits = xp.asarray(bounds[:, 0], start.dtype), xp.asarray(bounds[:, 1], start.dtype)
    # Typical sizes are powers of two, so that scaling rounds nothing and leaves zeros and equal numbers what they are.
    if typical is not None:
        unit = jax.lax.stop_gradient(typical) if xp is jnp else typical
        sizes = sizes._replace(nominal=sizes.nominal / unit, known=sizes.known / unit)
        limits = None if limits is None else (limits[0] / unit, limits[1] / unit)
        start = start / unit
    if limits is not None:
        start = _inside(start, *limits, sizes.known)

    def in_units(y: Numbers) -> Look:
        assert unit is not None
        value, jacobian, terms = look(y * unit)
        return Look(value, jacobian * unit, terms)

    found = _climb(
        Equations(
            look=look if unit is None else in_units,
            sizes=sizes,
            soft=np.zeros(m, bool) if soft is None else soft,
            core=core,
            limits=limits,
            origin=xp.append(start, xp.zeros((1,), start.dtype)),
            in_units=np.False_ if unit is None else xp.any(unit != 1),
        )
    )
    if unit is None:
        return found
    return found._replace(x=found.x * unit, jacobian=found.jacobian / unit, unit=found.unit * unit)


def _climb(equations: Equations) -> Found:
    """Climbs the ladder in the units that `find_root` has chosen."""
    xp, sizes, start, dtype = equations.xp, equations.sizes, equations.origin[: equations.n], equations.dtype
    # A start that holds, as most do, needs no rung: in a batch of such starts the loop does not run at all.
    at = equations.look(start)
    unit = column_sizes(terms_of(at.value, at.terms), at.jacobian, sizes)
    size, noise = row_sizes(weighed(at.jacobian), start, sizes, unit, at.terms)
    stays = xp.all(xp.abs(at.value) <= close(dtype) * size) & xp.all(xp.isfinite(at.jacobian))
    # An unknown without a size on which nothing depends may be at a point where its slope vanishes, as of q·|q| at
    # zero: there the equations hold for any size, and its size has to be found first.
    stays &= xp.all((sizes.known > 0) | xp.any(at.jacobian != 0, axis=0))
    search = _begun(equations, at.jacobian, unit, solved(dtype) * size + noise, stays)
    search = loop(lambda search: search.rung < Rung.DONE, lambda search: _advanced(equations, search), search)
    done, base = search.rung == Rung.DONE, search.base
    found, jacobian = where(done, base.at, search.best)[: equations.n], base.jacobian / search.unit[None, :]
    # Where nothing was found, the best point met is not the one at which the last rung ended.
    size, noise = row_sizes(weighed(jacobian), found, sizes, search.unit)
    limit = where(done, base.limit, xp.minimum(base.limit, solved(dtype) * size + noise))
    method, evaluations = (xp.asarray(count, np.int32) for count in (search.method, search.evaluations))
    return Found(found, jacobian, limit, search.unit, method, evaluations)


def _begun(equations: Equations, jacobian: Numbers, unit: Numbers, limit: Numbers, stays: Verdict) -> Search:
    """Where a search begins; it is done if the point stays as it is."""
    xp, n = equations.xp, equations.n
    first = int(equations.first_rung)

    def number(value: ArrayLike) -> Numbers:
        return equations.array(value)

    def whole(value: ArrayLike) -> Numbers:
        return xp.asarray(value, np.int32)

    origin, along, one_each = equations.origin, equations.along, xp.ones_like(limit)
    base = Base(origin, one_each, jacobian * unit[None, :], limit, xp.asarray(False), number(0.0))
    return Search(
        rung=whole(where(stays, int(Rung.DONE), first)), fresh=xp.asarray(True), count=whole(0), climb=whole(1),
        probe=whole(Probe.START), method=whole(where(stays, 0, FAILED)), evaluations=whole(where(stays, 1, 0)),
        trial=origin, start=origin, best=origin, first=one_each, weight=one_each,
        unit=where(stays, unit, xp.ones_like(unit)), flat=xp.zeros((n,), bool), open=equations.sizes.known == 0,
        base=base,
        descent=Descent(number(1.0), number(1.0), number(1.0), number(0.0), along),
        curve=Curve(number(1.0), along, whole(0), number(1.0), number(1.0)),
    )  # fmt: skip


def _advanced(equations: Equations, search: Search) -> Search:
    """The search after a look at its trial point."""
    at = equations.look(search.trial[: equations.n])
    sized = probed(equations, search, at)
    search = search._replace(unit=sized.unit, flat=sized.flat)
    tried, judged = gauss_newton.judged_at(equations, search, at)
    search = search._replace(weight=judged.weight, first=where(search.begins, at.value, search.first))
    base = Base(*(where(judged.accepted, new, old) for new, old in zip(tried, search.base, strict=True)))
    damping = gauss_newton.damping_of(equations, search, judged)
    linear = gauss_newton.linear_model(equations, search, base, judged, damping)
    down = gauss_newton.descended(equations, search, base, judged, linear, damping)
    curve = None if equations.core is None else homotopy.followed(equations, search, base.at, judged, linear)
    return _next(equations, search, at, sized, judged, base, down, curve)


def _next(
    equations: Equations,
    search: Search,
    at: Look,
    sized: Probed,
    judged: Judged,
    base: Base,
    down: gauss_newton.Descended,
    curve: homotopy.Followed | None,
) -> Search:
    """What comes next: another step, another rung, another climb, or the end."""
    rung, count, begins, first = search.rung, search.count, search.begins, int(equations.first_rung)
    going, nearest = ~sized.goes_on, rung == Rung.NEAREST if equations.has_soft else np.False_
    # A start that is not finite is no failure of a rung: what follows from guesses is set, and points around it are
    # tried, so that a logarithm of zero does not end the search.
    lost = going & begins & ~(judged.finite & (~nearest | down.determined))
    following, as_given = followed(equations, search, at), equations.xp.all(search.open == (equations.sizes.known == 0))
    follows = lost & ~judged.finite & following.some & (search.climb == 1)
    steps_off = lost & ~follows & (count < STEPS_OFF)
    fails = down.fails if curve is None else where(search.tracking, curve.fails, down.fails)
    stop = judged.reached & going
    failed = going & ~stop & ~down.settled & ~steps_off & ~follows & (fails | (search.fresh & ~judged.finite))
    # A method that cannot lower |F| any more has arrived if all that is left is rounding.
    rounded = failed & base.holds & ~nearest & ~search.fresh
    stepped, foot, landed, follow = down.trial, base.at, np.False_, rung
    if curve is not None:
        rounded &= ~search.tracking
        landed = search.tracking & curve.landed
        stepped, foot, follow = (
            where(search.tracking, a, b)
            for a, b in zip((curve.trial, curve.foot, curve.rung), (stepped, foot, follow), strict=True)
        )
    done = stop | rounded | (down.settled & going)
    above = where(lost, int(Rung.FAILED), _above(equations, search))
    at_the_top = (above == Rung.FAILED) & equations.xp.any(equations.sizes.known == 0)
    climbs_again = failed & ~lost & at_the_top & (search.climb < CLIMBS)

    start = where(begins & ~lost, search.trial, search.start)
    restart = _restarted(equations, search, above, climbs_again, start, base.at)
    ahead = where(failed, restart, equations.bounded(stepped, base.at))
    ahead = where(sized.goes_on, sized.trial, where(steps_off, _off(equations, count), ahead))
    ahead = where(follows, following.trial, ahead)
    probe = where(lost & (search.climb == 1), int(Probe.START), int(Probe.NONE))
    probe = where(climbs_again | (lost & (search.climb > 1)), int(Probe.SIZED), probe)
    here = where(sized.goes_on, sized.start, foot)
    turn = where(failed & (search.tracking | nearest), -1.0, search.curve.turn)  # to the other side of the curve
    return search._replace(
        rung=where(done, int(Rung.DONE), where(failed, where(climbs_again, first, above), follow)),
        fresh=sized.goes_on | failed | landed | lost,
        count=where(failed | landed, 0, where(sized.goes_on | follows, count, count + 1)),
        climb=where(climbs_again, search.climb + 1, search.climb),
        probe=where(sized.goes_on, search.probe + 1, probe),
        method=where(done, where(stop & begins & as_given, 0, rung), search.method),
        evaluations=search.evaluations + 1,
        trial=ahead,
        start=start,
        open=where(follows, following.open, search.open),
        # Where all rungs fail, the point where descent ended tells most about what does not hold.
        best=where((rung == Rung.MARQUARDT) & failed, base.at, search.best),
        base=base._replace(at=here, jacobian=where(sized.goes_on, sized.slopes, base.jacobian)),
        descent=down.descent,
        curve=(search.curve if curve is None else curve.curve)._replace(turn=where(climbs_again, 1.0, turn)),
    )


def _above(equations: Equations, search: Search) -> ArrayLike:
    """The rung after this one, if it fails."""
    rung, last = search.rung, int(Rung.NEAREST if equations.has_soft else Rung.FAILED)
    above = where(rung == Rung.NEWTON, int(Rung.MARQUARDT), last)
    if equations.core is not None:
        other_side = search.tracking & (search.curve.turn > 0)
        above = where((rung == Rung.MARQUARDT) | other_side, int(Rung.TRACK), above)
    if equations.has_soft:
        # Where the nearest point was looked for at once, Marquardt's method follows, and then the nearest point again.
        again = where(search.curve.turn > 0, int(Rung.MARQUARDT), int(Rung.FAILED))
        again = again if equations.nearest_first else int(Rung.FAILED)
        above = where(rung == Rung.NEAREST, again, above)
    return above


def _restarted(
    equations: Equations, search: Search, above: ArrayLike, climbs_again: ArrayLike, start: Numbers, here: Numbers
) -> Numbers:
    """Where the next rung, or the next climb, begins."""
    xp, along, generic = equations.xp, equations.along, equations.generic
    unit, restart = xp.append(search.unit, equations.array(1.0)), start
    if equations.has_soft:  # a compromise of all rows, where the nearest point is looked for
        compromise = where(search.rung == Rung.MARQUARDT, here, search.best)
        restart = where(above == Rung.NEAREST, compromise, start)
    if equations.nearest_first:  # where the Jacobian vanishes, descent needs a direction
        beside = equations.bounded(start + 1e-3 * unit * generic * (1 - along), restart)
        restart = where(above == Rung.MARQUARDT, beside, restart)
    alternating = equations.array((-1.0) ** np.arange(equations.n + 1))
    elsewhere = generic * where(equations.in_units, 1.0, unit) * where(search.climb > 1, alternating, 1.0)
    unguessed = xp.append(equations.sizes.known == 0, False)
    again = equations.bounded(where(unguessed, elsewhere, equations.origin), equations.origin)
    return where(climbs_again, again, restart)


def _off(equations: Equations, count: Numbers | np.integer | int) -> Numbers:
    """A point around a start that is not finite: closer ones first, on either side."""
    xp, known = equations.xp, equations.sizes.known
    amount = where(count % 2 == 0, 1.0, -1.0) * 10 ** (0.5 * xp.asarray(count, equations.dtype) - 4)
    size = xp.append(where(known > 0, known, 1.0), equations.array(0.0))
    return equations.bounded(equations.origin + amount * equations.generic * size, equations.origin)


def _inside(x: Numbers, low: Numbers, high: Numbers, known: Numbers) -> Numbers:
    """The point moved off its bounds, into the interval."""
    xp = namespace(x)
    size = xp.maximum(known, xp.abs(x))
    width = xp.where(xp.isfinite(high - low), high - low, xp.where(size > 0, size, 1))
    # Off the bounds for the reason of `TO_BOUND`: there the Jacobian may not be finite.
    margin = 1e-3 * width
    return xp.where(x <= low, low + margin, xp.where(x >= high, high - margin, x))
