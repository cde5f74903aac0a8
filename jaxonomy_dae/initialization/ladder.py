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

All rungs are states of one machine, the body of a single loop: one residual, one Jacobian and one QR factorization are
traced and compiled, whichever rung is at work. Under `vmap` each member is on its own rung. Where values are known, the
same machine runs in NumPy (`arrays.py`), and only the residual and its Jacobian are compiled.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..tolerances import NOISE, ZERO_WITHIN, solved, spacing
from ..tolerances import close as close_within
from .arrays import Numbers, loop, namespace, triangular
from .machine import Machine, Scalars
from .probing import SIZED, probed
from .sizes import Sizes, column_sizes, row_sizes, soft_weight, weighed

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

# Evaluations each rung may take.
NEWTON_LIMIT, MARQUARDT_LIMIT, HOMOTOPY_LIMIT, NEAREST_LIMIT = 60, 100, 200, 200
SHORTEST = 1e-4  # of a Newton step: where not even this part lowers |F|, the rung has failed
# Armijo's constant: the part of the decrease by the linear model that is asked for (Dennis & Schnabel 1983, section
# 6.3).
DECREASE = 1e-4
FIRST_DAMPING = 1e-3  # τ of Nielsen (1999), who multiplies it by the largest entry: rows have one of 1 at the start
FIRST_ARC, SHORTEST_ARC = 0.1, 1e-8  # of the curve, in units of the unknowns' sizes
CORRECTIONS = 4  # of a predicted point on the curve
SMALLEST_COSINE = 0.8  # between the tangents of neighbouring points: after a sharper turn it may be another curve
STEPS_OFF = 8  # points tried around a start where F or its Jacobian is not finite
# Rows whose largest slope is below FLAT·|value| are scaled by |value| instead: such slopes do not tell the row's size.
FLAT = 1e-3
# A step that would cross a bound goes this part of the way to it: at the bound itself a root or logarithm may have no
# slope.
TO_BOUND = 0.9
SETTLED = 1e-2  # steps of this times √eps end the search for the nearest point

AGAIN = SIZED - 1  # what `Scalars.begun` is at the start of the second climb, and one less for each further one
CLIMBS = 3  # from the start; then with unknowns without a guess at their sizes; then with every other one negative

_NEWTON, _MARQUARDT, _TRACK, _LAND, _POLISH, _NEAREST, _DONE, _FAILED = range(8)


class Found(NamedTuple):
    """A root, or the best point met; the Jacobian there; the largest value of each row that counts as zero; the sizes
    of the unknowns; the rung that succeeded, an index into `METHODS`."""

    x: Any
    jacobian: Any
    limit: Any
    unit: Any
    method: Any
    evaluations: Any


class Look(NamedTuple):
    """The rows at a point: F, its Jacobian, and how large the terms of each row are, beside which it counts as zero;
    not finite where that is not known, None where it is known of no row. There Σ |∂F/∂x|·|x| stands for it."""

    value: Any
    jacobian: Any
    terms: Any


def looking(function: Callable[[Any], Any], magnitude: Callable[[Any], Any] | None = None) -> Callable[[Any], Look]:
    """The rows at a point, from the function F and that of the magnitudes of its terms."""

    def look(x: Any) -> Look:
        jacobian, value = jax.jacfwd(lambda y: (function(y),) * 2, has_aux=True)(x)
        # What functions of the user's close over may be differentiated elsewhere: not in here.
        return jax.lax.stop_gradient(Look(value, jacobian, None if magnitude is None else magnitude(x)))

    return look


def find_root(
    look: Callable[[Any], Look],
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
    limits, xp = None, namespace(start)
    if bounds is not None and np.isfinite(bounds).any():
        limits = xp.asarray(bounds[:, 0], start.dtype), xp.asarray(bounds[:, 1], start.dtype)
    if typical is None:
        return _climb(look, m, start, sizes, core, soft, limits, np.zeros((), bool))
    unit: Any = jax.lax.stop_gradient(typical) if xp is jnp else typical
    measured = sizes._replace(nominal=sizes.nominal / unit, known=sizes.known / unit)
    limits = None if limits is None else (limits[0] / unit, limits[1] / unit)

    def in_units(y: Any) -> Look:
        value, jacobian, terms = look(y * unit)
        return Look(value, jacobian * unit, terms)

    found = _climb(in_units, m, start / unit, measured, core, soft, limits, xp.any(unit != 1))
    return found._replace(x=found.x * unit, jacobian=found.jacobian / unit, unit=found.unit * unit)


def _climb(
    look: Callable[[Any], Look],
    m: int,
    start: Float[Numbers, " n"],
    sizes: Sizes,
    core: np.ndarray | None,
    soft: Bool[np.ndarray, " m"] | None,
    limits: tuple[Any, Any] | None,
    in_units: Any,
) -> Found:
    """Climbs the ladder in the units that `find_root` has chosen. `in_units` is true where unknowns are measured in
    typical sizes; otherwise slopes at the start show their sizes."""
    dtype, n = start.dtype, start.shape[0]
    eps, close, enough = spacing(dtype), close_within(dtype), solved(dtype)
    xp: Any = namespace(start)
    where, one = xp.where, xp.ones((), dtype)
    is_soft = np.zeros(m, bool) if soft is None else soft
    hard, weighted = xp.asarray(~is_soft), xp.asarray(np.where(is_soft, soft_weight(dtype), 1.0), dtype)
    has_soft = bool(is_soft.any())
    nearest_first = has_soft and core is None
    alternating = (-1.0) ** np.arange(n + 1)
    first_rung = _NEAREST if nearest_first else _NEWTON
    if limits is not None:
        low, high = limits
        start = _inside(start, low, high, sizes.known)
    origin = xp.append(start, 0 * one)
    along = np.append(np.zeros(n), 1.0)  # the direction of s
    # The first border: no direction of its own, so that it is regular where the Jacobian at the start is not.
    generic = 1.0 + 0.5 * np.cos(np.arange(1, n + 2))
    along, generic = xp.asarray(along, dtype), xp.asarray(generic, dtype)
    inside = xp.asarray(np.ones(m) if core is None else np.isin(np.arange(m), core), dtype)
    # Steps of least norm, with fewer equations than unknowns; and on the way to the nearest point, which may lie where
    # an unknown has no slope, as at the side of a circle.
    least = ZERO_WITHIN * eps
    floor = 0.0 if m >= n else least

    def packed(*scalars) -> Any:
        if xp is np:
            return np.array(scalars, dtype)
        place = np.arange(len(scalars))  # selects, unlike a stack, become one kernel
        out = xp.zeros((len(scalars),), dtype)
        for k, s in enumerate(scalars):
            out = where(xp.asarray(place == k), xp.asarray(s, dtype), out)
        return out

    def is_nearest(phase) -> Any:
        return phase == _NEAREST if has_soft else np.zeros((), bool)  # a constant, with all that hangs on it

    def bounded(ahead, here) -> Any:
        """A step that goes most of the way to the bounds it would cross."""
        if limits is None:
            return ahead
        x, base = ahead[:n], here[:n]
        x = where(x < low, base + TO_BOUND * (low - base), where(x > high, base + TO_BOUND * (high - base), x))
        return xp.append(x, ahead[n])

    def sizes_of_rows(at: Look, x, unit) -> tuple[Any, Any]:
        return row_sizes(weighed(at.jacobian), x, sizes, unit, at.terms)

    def evaluate(state: Machine) -> Machine:
        x = state.points[0, :n]
        at = look(x)
        value, jacobian = at.value, at.jacobian
        probing, probe, unit = probed(state, value, jacobian, sizes, ~hard)
        size, noise = sizes_of_rows(at, x, unit)
        reached = xp.all(xp.abs(value) <= close * size)
        # Soft rows pull at the others until the last step, which carries the derivative, sets these right.
        pulled = where(hard, 0.1 * float(np.sqrt(enough)) * size, xp.inf)
        allowed = where(is_nearest(state.scalars[0]), pulled, enough * size) if has_soft else enough * size
        holds = xp.all(xp.abs(value) <= allowed + noise)
        limit = enough * size + noise
        ahead = advance(state, value, jacobian * unit[None, :], xp.append(unit, one), reached, holds, limit)
        return jax.tree.map(lambda a, b: where(probing, a, b), probe, ahead)

    def advance(state: Machine, value, jacobian, unit, reached, holds, limit) -> Machine:
        s = Scalars(*state.scalars)
        phase, fresh, arc = s.phase, s.fresh > 0, s.size
        trial, base, best, last_tangent, beginning, _ = state.points
        nearest, marquardt = is_nearest(phase), phase == _MARQUARDT
        descending = (phase == _NEWTON) | (phase == _POLISH) | nearest
        tracking, landing = (phase == _TRACK) | (phase == _LAND), phase == _LAND
        begins = s.begun <= 0
        climb = where(begins, where(s.begun <= AGAIN, AGAIN + 2 - s.begun, one), s.begun)
        # A root is a root on any rung; but what the homotopy lands on is polished first.
        stop = reached & ~tracking

        # Is the trial point accepted?
        largest = xp.maximum(xp.max(xp.abs(jacobian), axis=1, initial=0.0), FLAT * xp.abs(value))
        usable = (largest > 0) & (largest < 0.1 * float(xp.finfo(largest.dtype).max))
        balanced = 1 / where(usable, largest, one)
        w = where(begins, where(hard | (sizes.soft == 0), balanced, 1 / sizes.soft), state.rows[2])
        first = where(begins, value, state.rows[1])
        # Where soft rows outnumber their freedom, all rungs weigh them down.
        w_here = where(nearest | nearest_first, w * weighted, w)
        square = xp.sum((w_here * value) ** 2 + 0 * largest)
        finite = xp.isfinite(square)
        if limits is not None:
            finite &= ~tracking | xp.all((trial[:n] >= low) & (trial[:n] <= high))
        ratio = (s.square - square) / where(s.gain > 0, s.gain, one)
        falls = where(marquardt, ratio > 0, xp.sqrt(square) < (1 - DECREASE * s.size) * xp.sqrt(s.square))
        accepted = stop | (finite & (fresh | tracking | nearest | falls))
        value, limit = where(accepted, value, state.rows[0]), where(accepted, limit, state.rows[3])
        jacobian = where(accepted, jacobian, state.jacobian)
        here = where(accepted, trial, base)
        square = where(accepted, square, s.square)
        holds = where(accepted, holds, s.holds > 0)

        # One factorization for all rungs, of the Jacobian bordered by s and stacked on the damping; two right sides
        # give the step and the tangent.
        held = where(tracking, inside * w, w_here)
        short = held * (value - where(tracking, 1 - here[n], 0 * one) * first)
        curve = where(tracking, held * first, xp.zeros_like(first))
        matrix = held[:, None] * jacobian
        relaxed = s.size * where(accepted, xp.maximum(0.1, 1 - (2 * ratio - 1) ** 3), s.growth)
        damping = where(fresh, FIRST_DAMPING, relaxed)
        border = where(tracking & ~landing, where(fresh, generic, last_tangent), along)
        shift = xp.sqrt(where(marquardt, damping, 0 * one) + where(nearest, least, floor))
        stacked = xp.concatenate([
            xp.concatenate([matrix, curve[:, None], -short[:, None], xp.zeros((m, 1), dtype)], axis=1),
            xp.concatenate([border, xp.asarray([0.0, 1.0], dtype)])[None, :],
            shift * xp.asarray(np.eye(n + 1, n + 3), dtype),
        ])  # fmt: skip
        r = xp.linalg.qr(stacked, mode="raw")[0].T[: n + 1]  # below the diagonal lie the reflections, not read
        solved = triangular(r[:, : n + 1], r[:, n + 1 :])
        step, tangent = solved[:, 0], solved[:, 1]
        columns = xp.concatenate([solved, r[:, n + 1 : n + 2], (here / unit)[:, None]], axis=1)
        length, stretch, explained, extent = xp.sqrt(xp.sum(columns**2, axis=0))
        size = xp.maximum(xp.abs(here[:n]), sizes.nominal)
        still = xp.all(xp.abs(unit * step)[:n] <= NOISE * eps * size)

        # Newton
        fraction = where(fresh, one, where(accepted, xp.minimum(one, 4 * s.size), 0.5 * s.size))
        newton_fails = ~xp.isfinite(length) | (fraction < SHORTEST) | (s.count >= NEWTON_LIMIT) | (still & holds)

        # The nearest point: the curvature of the equations makes Gauss–Newton steps too long, by a factor that the
        # change from the last one shows (Barzilai & Borwein 1988).
        last_step = last_tangent
        turned = xp.dot(last_step, last_step - step)
        fitting = s.size * xp.dot(last_step, last_step) / where(turned > 0, turned, one)
        fitting = where(turned > 0, xp.clip(fitting, 10 * SHORTEST, one), one)
        fitting = where(fresh, one, where(finite, fitting, 0.5 * s.size))
        fraction = where(nearest, fitting, fraction)
        settled = nearest & holds & finite & (length <= SETTLED * xp.sqrt(eps) * (1 + extent))
        nearest_fails = ~xp.isfinite(length) | (fraction < SHORTEST) | (s.count >= NEAREST_LIMIT)

        # Levenberg–Marquardt
        gain = explained**2 + damping * length**2  # by which the linear model says that |F|² falls
        marquardt_fails = ~((length > 4 * eps * (1 + extent)) & (gain > 1e-10 * square)) | (s.count >= MARQUARDT_LIMIT)

        # Homotopy: a tangent predicts the next point of the curve, Newton steps across the tangent correct it.
        tangent = tangent * (where(fresh & ((tangent[n] < 0) ^ (s.turn < 0)), -one, one) / stretch)
        on_curve = finite & (stretch < xp.inf) & (fresh | (length <= 0.02 * xp.minimum(arc, one)))
        on_curve &= fresh | landing | (stretch * SMALLEST_COSINE <= 1)  # with the last tangent, a unit vector
        reach = where(s.corrections == 0, arc, 0.5 * s.growth)
        corrected = here + where(fresh, 0 * one, one) * unit * step
        # A correction past s = 1, from a prediction before it, would miss the root: a shorter arc lands.
        passed = on_curve & ~fresh & ~landing & ((corrected[n] - 1) * (base[n] - 1) < 0)
        on_curve &= ~passed
        correcting = finite & ~on_curve & ~passed & (s.corrections < CORRECTIONS) & (length <= reach)
        landed, passes = on_curve & landing, on_curve & ~landing
        arc = where(passes, where(s.corrections <= 1, 2 * arc, arc), arc / 3)
        arc = where(fresh, FIRST_ARC, xp.minimum(arc, 1 + extent))
        rest = (1 - corrected[n]) / tangent[n]  # of the way to s = 1, along the tangent
        lands = passes & (rest > 0) & (rest <= arc)
        arc = where(correcting, s.size, where(lands, rest, arc))
        foot, direction = where(passes, corrected, base), where(passes, tangent, last_tangent)
        ahead = where(correcting | landed, corrected, foot + arc * unit * direction)
        ahead = where(lands & (along > 0), one, ahead)
        homotopy_fails = ~landed & ((arc < SHORTEST_ARC) | (s.count >= HOMOTOPY_LIMIT))
        follow = where(landed, _POLISH, where(lands | (correcting & landing), _LAND, _TRACK))

        # What comes next
        lost = begins & ~(finite & (~nearest | xp.isfinite(length)))
        steps_off = lost & (s.count < STEPS_OFF)
        fails = where(descending, newton_fails, where(marquardt, marquardt_fails, homotopy_fails))
        fails = where(nearest, nearest_fails, fails)
        failed = ~stop & ~settled & ~steps_off & (fails | (fresh & ~finite))
        rounded = failed & holds & ~tracking & ~nearest & ~fresh
        done = stop | rounded | settled
        by = where(nearest, NEAREST, where(phase == _POLISH, 3, 1 + phase))
        last = _NEAREST if has_soft else _FAILED
        above = where(phase == _NEWTON, _MARQUARDT, last)
        if core is not None:
            above = where(marquardt | (tracking & (s.turn > 0)), _TRACK, above)
        if has_soft:
            again = (s.turn > 0) if nearest_first else xp.zeros((), bool)
            above = where(nearest, where(again, _MARQUARDT, _FAILED), above)
        above = where(lost, _FAILED, above)
        restarts = failed | (tracking & landed) | lost
        unguessed = xp.append(sizes.known == 0, False)
        climbs_again = failed & (above == _FAILED) & (climb < CLIMBS) & ~lost & xp.any(unguessed)
        stepped = where(tracking, ahead, here + where(descending, fraction, one) * unit * step)
        stepped = bounded(stepped, here)
        damped = where(accepted, 2 * one, 2 * s.growth)
        # Around a start that is not finite: closer points first, on either side.
        beginning = where(begins & ~lost, trial, beginning)
        amount = where(s.count % 2 == 0, one, -one) * 10 ** (0.5 * s.count - 4)
        off = bounded(origin + amount * generic * xp.append(where(sizes.known > 0, sizes.known, one), 0 * one), origin)
        compromise = where(marquardt, here, best)  # of all rows, where the nearest point is looked for
        restart = where(above == _NEAREST, compromise, beginning) if has_soft else beginning
        if nearest_first:  # where the Jacobian vanishes, descent needs a direction
            restart = where(
                above == _MARQUARDT, bounded(beginning + 1e-3 * unit * generic * (1 - along), restart), restart
            )
        climb_begins = AGAIN + 2 - climb
        elsewhere = generic * where(in_units, one, unit) * where(climb > 1, xp.asarray(alternating, dtype), one)
        restart = where(climbs_again, bounded(where(unguessed, elsewhere, origin), origin), restart)
        above = where(climbs_again, first_rung, above)
        scalars = packed(
            *Scalars(
                phase=where(done, _DONE, where(failed, above, where(tracking, follow, phase))),
                method=where(done, where(stop & begins, 0, by), s.method),
                fresh=restarts,
                begun=where(
                    climbs_again, climb_begins - 1, where(lost, where(climb > 1, climb_begins, 0 * one), climb)
                ),
                count=where(failed | (tracking & landed), 0, s.count + 1),
                evaluations=s.evaluations + 1,
                size=where(descending, fraction, where(marquardt, damping, arc)),
                growth=where(tracking, length, damped),
                square=square,
                gain=gain,
                holds=holds,
                turn=where(climbs_again, one, where(failed & (tracking | nearest), -one, s.turn)),
                corrections=where(tracking & correcting, s.corrections + 1, 0),
            )
        )
        points = xp.stack([
            where(steps_off, off, where(failed, restart, stepped)),
            where(tracking, foot, here),
            where(marquardt & failed, here, best),
            where(tracking, direction, where(nearest & finite, step, last_tangent)),
            beginning,
            unit,
        ])  # fmt: skip
        return Machine(scalars, points, xp.stack([value, first, w, limit]), jacobian)

    # A start that holds, as most do, needs no rung: in a batch of such starts the loop does not run at all.
    at = look(start)
    value, jacobian = at.value, at.jacobian
    unit = column_sizes(value, jacobian, sizes)
    size, noise = sizes_of_rows(at, start, unit)
    stays = xp.all(xp.abs(value) <= close * size) & xp.all(xp.isfinite(jacobian))
    stays &= xp.all((sizes.known > 0) | xp.any(jacobian != 0, axis=0))
    begin = Scalars(
        where(stays, _DONE, first_rung), where(stays, 0, FAILED), 1.0, 0.0, 0, where(stays, 1, 0), 1.0, 1.0, 0.0, 0.0,
        0.0, 1.0, 0,
    )  # fmt: skip
    points = xp.stack([origin, origin, origin, along, origin, xp.append(where(stays, unit, one), one)])
    one_each = xp.ones((m,), dtype)
    rows = xp.stack([one_each, one_each, one_each, enough * size + noise])
    state = Machine(packed(*begin), points, rows, jacobian * unit[None, :])
    state = loop(lambda s: s.scalars[0] < _DONE, evaluate, state)
    s = Scalars(*state.scalars)
    found = where(s.phase == _DONE, state.points[1], state.points[2])[:n]
    unit = state.points[5, :n]
    jacobian = state.jacobian / unit[None, :]
    # Where nothing was found, the best point met is not the one at which the last rung ended.
    size, noise = row_sizes(weighed(jacobian), found, sizes, unit)
    limit = where(s.phase == _DONE, state.rows[3], xp.minimum(state.rows[3], enough * size + noise))
    return Found(found, jacobian, limit, unit, s.method.astype(xp.int32), s.evaluations.astype(xp.int32))


def _inside(x: Any, low: Any, high: Any, known: Any) -> Any:
    """The point moved off its bounds, into the interval."""
    xp = namespace(x)
    size = xp.maximum(known, xp.abs(x))
    width = xp.where(xp.isfinite(high - low), high - low, xp.where(size > 0, size, 1))
    margin = 1e-3 * width
    return xp.where(x <= low, low + margin, xp.where(x >= high, high - margin, x))
