"""A ladder of methods for F(x) = 0 with at least as many equations as unknowns, consistent ones.

Each rung starts at the given point, and only if the one before failed:

1. Newton's method with a line search (Gauss–Newton where there are more equations than unknowns;
   Deuflhard 2004, ch. 3);
2. Levenberg–Marquardt, the damping changed as by Nielsen (1999): starts where the Jacobian is singular;
3. Newton homotopy, F(x) = (1 − s)·F(x0) followed from s = 0 to 1 in arc length (Keller 1977; Allgower & Georg 1990),
   to the one side and then to the other: past the local minima of |F|, where descent methods stop.

All rungs are states of one machine, the body of a single loop: one residual, one Jacobian and one QR factorization are
traced and compiled, whichever rung is at work. Under `vmap` each member is on its own rung.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

METHODS = ("the start was consistent", "Newton", "Levenberg–Marquardt", "homotopy", "none")
FAILED = len(METHODS) - 1

# Evaluations each rung may take.
NEWTON_LIMIT, MARQUARDT_LIMIT, HOMOTOPY_LIMIT = 60, 100, 200
SHORTEST = 1e-4  # of a Newton step
DECREASE = 1e-4  # Armijo's constant
FIRST_DAMPING = 1e-3  # rows have a largest entry of 1 at the start
FIRST_ARC, SHORTEST_ARC = 0.1, 1e-8
CORRECTIONS = 4  # of a predicted point on the curve
SMALLEST_COSINE = 0.8  # between the tangents of neighbouring points on the curve

_NEWTON, _MARQUARDT, _TRACK, _LAND, _POLISH, _DONE, _FAILED = range(7)


class Found(NamedTuple):
    """A root, or the best point met; the Jacobian there; the rung that succeeded, an index into `METHODS`."""

    x: Any
    jacobian: Any
    method: Any
    evaluations: Any


class _Machine(NamedTuple):
    """Points are (x, s). Packed into few arrays: XLA compiles a kernel for each."""

    scalars: Any  # see _Scalars
    points: Any  # trial, base (the last one accepted), best, and the tangent
    rows: Any  # F at the base, F at the start, and the weight of each equation
    jacobian: Any  # at the base, columns scaled


class _Scalars(NamedTuple):
    """`size` is the fraction of a Newton step, the damping, or the length of arc."""

    phase: Any
    method: Any
    fresh: Any  # whether the trial point is where a rung starts
    count: Any  # evaluations on this rung
    evaluations: Any
    size: Any
    growth: Any  # of the damping when a step is rejected; on the curve, the length of the last correction
    square: Any  # |F|² at the base, weighted
    gain: Any  # by which the linear model says it will fall
    holds: Any  # whether |F| at the base counts as zero
    turn: Any  # which way the curve is followed
    corrections: Any


def find_root(
    function: Callable[[Any], Any],
    m: int,
    start: Any,
    scale: np.ndarray,
    core: np.ndarray | None,
    close: Callable[[Any], Any],
    enough: Callable[[Any], Any],
) -> Found:
    """Climbs the ladder.

    **Arguments:**

    - `function`: F, from shape (n,) to `(m,)`.
    - `start`: where every rung starts, shape (n,).
    - `scale`: the typical size of each unknown.
    - `core`: n rows of F that are independent and determine x, for the homotopy; None leaves that rung out.
    - `close`, `enough`: functions of x that give the largest |F| at which to stop, and the largest that counts as
        zero where rounding prevents more.
    """
    dtype, n = start.dtype, start.shape[0]
    eps = float(jnp.finfo(dtype).eps)
    where, one = jnp.where, jnp.ones((), dtype)
    unit = jnp.append(jnp.maximum(jnp.asarray(scale, dtype), jnp.abs(start)), one)
    origin = jnp.append(start, 0 * one)
    along = np.append(np.zeros(n), 1.0)  # the direction of s
    # The first border: no direction of its own, so that it is regular where the Jacobian at the start is not.
    generic = 1.0 + 0.5 * np.cos(np.arange(1, n + 2))
    along, generic = jnp.asarray(along, dtype), jnp.asarray(generic, dtype)
    inside = jnp.asarray(np.ones(m) if core is None else np.isin(np.arange(m), core), dtype)
    floor = 0.0 if m >= n else 1e2 * eps  # with fewer equations than unknowns, steps of least norm

    def packed(*scalars) -> Any:
        place = np.arange(len(scalars))  # selects, unlike a stack, become one kernel
        out = jnp.zeros((len(scalars),), dtype)
        for k, s in enumerate(scalars):
            out = where(jnp.asarray(place == k), jnp.asarray(s, dtype), out)
        return out

    def evaluate(state: _Machine) -> _Machine:
        x = state.points[0, :n]
        jacobian, value = jax.jacfwd(lambda y: (function(y),) * 2, has_aux=True)(x)
        # What a function of the user's closes over may be differentiated elsewhere: not in here.
        value, jacobian = jax.lax.stop_gradient((value, jacobian * unit[:n]))
        worst = jnp.max(jnp.abs(value), initial=0.0)
        return advance(state, value, jacobian, worst <= close(x), worst <= enough(x))

    def advance(state: _Machine, value, jacobian, reached, holds) -> _Machine:
        s = _Scalars(*state.scalars)
        phase, fresh, arc = s.phase, s.fresh > 0, s.size
        trial, base, best, last_tangent = state.points
        descending, marquardt = (phase == _NEWTON) | (phase == _POLISH), phase == _MARQUARDT
        tracking, landing = (phase == _TRACK) | (phase == _LAND), phase == _LAND
        begins = s.evaluations == 0
        # A root is a root on any rung; but what the homotopy lands on is polished first.
        stop = reached & ~tracking

        # Is the trial point accepted?
        largest = jnp.max(jnp.abs(jacobian), axis=1, initial=0.0)
        w = where(
            begins,
            1 / where((largest > 1e-8) & (largest < 0.1 * float(jnp.finfo(largest.dtype).max)), largest, one),
            state.rows[2],
        )
        first = where(begins, value, state.rows[1])
        square = jnp.sum((w * value) ** 2 + 0 * largest)
        finite = jnp.isfinite(square)
        ratio = (s.square - square) / where(s.gain > 0, s.gain, one)
        falls = where(marquardt, ratio > 0, jnp.sqrt(square) < (1 - DECREASE * s.size) * jnp.sqrt(s.square))
        accepted = stop | (finite & (fresh | tracking | falls))
        value = where(accepted, value, state.rows[0])
        jacobian = where(accepted, jacobian, state.jacobian)
        here = where(accepted, trial, base)
        square = where(accepted, square, s.square)
        holds = where(accepted, holds, s.holds > 0)

        # One factorization for all rungs, of the Jacobian bordered by s and stacked on the damping; two right sides
        # give the step and the tangent.
        held = where(tracking, inside * w, w)
        short = held * (value - where(tracking, 1 - here[n], 0 * one) * first)
        curve = where(tracking, held * first, jnp.zeros_like(first))
        matrix = held[:, None] * jacobian
        relaxed = s.size * where(accepted, jnp.maximum(0.1, 1 - (2 * ratio - 1) ** 3), s.growth)
        damping = where(fresh, FIRST_DAMPING, relaxed)
        border = where(tracking & ~landing, where(fresh, generic, last_tangent), along)
        shift = jnp.sqrt(where(marquardt, damping, 0 * one) + floor)
        stacked = jnp.concatenate([
            jnp.concatenate([matrix, curve[:, None], -short[:, None], jnp.zeros((m, 1), dtype)], axis=1),
            jnp.concatenate([border, jnp.asarray([0.0, 1.0], dtype)])[None, :],
            shift * jnp.asarray(np.eye(n + 1, n + 3), dtype),
        ])  # fmt: skip
        r = jnp.linalg.qr(stacked, mode="raw")[0].T[: n + 1]  # below the diagonal lie the reflections, not read
        solved = jax.scipy.linalg.solve_triangular(r[:, : n + 1], r[:, n + 1 :])
        step, tangent = solved[:, 0], solved[:, 1]
        columns = jnp.concatenate([solved, r[:, n + 1 : n + 2], (here / unit)[:, None]], axis=1)
        length, stretch, explained, extent = jnp.sqrt(jnp.sum(columns**2, axis=0))

        # Newton
        fraction = where(fresh, one, where(accepted, jnp.minimum(one, 4 * s.size), 0.5 * s.size))
        newton_fails = ~jnp.isfinite(length) | (fraction < SHORTEST) | (s.count >= NEWTON_LIMIT)

        # Levenberg–Marquardt
        gain = explained**2 + damping * length**2  # by which the linear model says that |F|² falls
        marquardt_fails = ~((length > 4 * eps * (1 + extent)) & (gain > 1e-10 * square)) | (s.count >= MARQUARDT_LIMIT)

        # Homotopy: a tangent predicts the next point of the curve, Newton steps across the tangent correct it.
        tangent = tangent * (where(fresh & ((tangent[n] < 0) ^ (s.turn < 0)), -one, one) / stretch)
        on_curve = finite & (stretch < jnp.inf) & (fresh | (length <= 0.02 * jnp.minimum(arc, one)))
        on_curve &= fresh | landing | (stretch * SMALLEST_COSINE <= 1)  # with the last tangent, a unit vector
        within = where(s.corrections == 0, arc, 0.5 * s.growth)
        correcting = finite & ~on_curve & (s.corrections < CORRECTIONS) & (length <= within)
        landed, passes = on_curve & landing, on_curve & ~landing
        corrected = here + where(fresh, 0 * one, one) * unit * step
        arc = where(passes, where(s.corrections <= 1, 2 * arc, arc), arc / 3)
        arc = where(fresh, FIRST_ARC, jnp.minimum(arc, 1 + extent))
        rest = (1 - corrected[n]) / tangent[n]  # of the way to s = 1, along the tangent
        lands = passes & (rest > 0) & (rest <= arc)
        arc = where(correcting, s.size, where(lands, rest, arc))
        foot, direction = where(passes, corrected, base), where(passes, tangent, last_tangent)
        ahead = where(correcting | landed, corrected, foot + arc * unit * direction)
        ahead = where(lands & (along > 0), one, ahead)
        homotopy_fails = ~landed & ((arc < SHORTEST_ARC) | (s.count >= HOMOTOPY_LIMIT))
        follow = where(landed, _POLISH, where(lands | (correcting & landing), _LAND, _TRACK))

        # What comes next
        fails = where(descending, newton_fails, where(marquardt, marquardt_fails, homotopy_fails))
        failed = ~stop & (fails | (fresh & ~finite))
        rounded = failed & holds & ~tracking & ~fresh
        by = where(phase == _POLISH, 3, 1 + phase)
        above = where(phase == _NEWTON, _MARQUARDT, _FAILED)
        if core is not None:
            above = where(marquardt | (tracking & (s.turn > 0)), _TRACK, above)
        above = where(rounded, _DONE, where(fresh & ~finite, _FAILED, above))
        restarts = failed | (tracking & landed)
        stepped = where(tracking, ahead, here + where(descending, fraction, one) * unit * step)
        damped = where(accepted, 2 * one, 2 * s.growth)
        scalars = packed(
            *_Scalars(
                phase=where(stop, _DONE, where(failed, above, where(tracking, follow, phase))),
                method=where(stop | rounded, where(begins, 0, by), s.method),
                fresh=restarts,
                count=where(restarts, 0, s.count + 1),
                evaluations=s.evaluations + 1,
                size=where(descending, fraction, where(marquardt, damping, arc)),
                growth=where(tracking, length, damped),
                square=square,
                gain=gain,
                holds=holds,
                turn=where(tracking & failed, -one, s.turn),
                corrections=where(tracking & correcting, s.corrections + 1, 0),
            )
        )
        points = jnp.stack([
            where(failed, origin, stepped),
            where(tracking, foot, here),
            where(marquardt & failed, here, best),
            where(tracking, direction, last_tangent),
        ])  # fmt: skip
        return _Machine(scalars, points, jnp.stack([value, first, w]), jacobian)

    begin = _Scalars(_NEWTON, FAILED, 1.0, 0, 0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0)
    points = jnp.stack([origin, origin, origin, along])
    state = _Machine(
        jnp.asarray([float(v) for v in begin], dtype), points, jnp.ones((3, m), dtype), jnp.zeros((m, n), dtype)
    )
    state = jax.lax.while_loop(lambda s: s.scalars[0] < _DONE, evaluate, state)
    s = _Scalars(*state.scalars)
    found = where(s.phase == _DONE, state.points[1], state.points[2])[:n]
    return Found(found, state.jacobian / unit[:n], s.method.astype(jnp.int32), s.evaluations.astype(jnp.int32))
