"""Steps that lower |F|: Newton's method, Levenberg–Marquardt, and the nearest point to guesses.

All three are one step of Gauss and Newton, the least-squares solution of the linear model. Newton's method takes a
fraction of it (Gauss–Newton where there are more equations than unknowns; Deuflhard 2004, ch. 3); Levenberg–Marquardt
damps it, the damping changed as by Nielsen (1999); the nearest point weighs guesses down (Van Loan 1985). The same
factorization has the tangent for the homotopy.
"""

from typing import NamedTuple

import numpy as np

from ...base.tolerances import NOISE, ZERO_WITHIN, close, solved, spacing
from ...solve.linear.arrays import Numbers, Verdict, triangular, where
from .search import Base, Descent, Equations, Judged, Linear, Look, Rung, Search
from .sizes import row_sizes, weighed

# Evaluations each method may take.
NEWTON_LIMIT, MARQUARDT_LIMIT, NEAREST_LIMIT = 60, 100, 200
SHORTEST = 1e-4  # of a Newton step: where not even this part lowers |F|, the rung has failed
# Armijo's constant: the part of the decrease by the linear model that is asked for (Dennis & Schnabel 1983, section
# 6.3).
DECREASE = 1e-4
FIRST_DAMPING = 1e-3  # τ of Nielsen (1999), who multiplies it by the largest entry: rows have one of 1 at the start
# Rows whose largest slope is below FLAT·|value| are scaled by |value| instead: such slopes do not tell the row's size.
FLAT = 1e-3
SETTLED = 1e-2  # steps of this times √eps end the search for the nearest point


class Descended(NamedTuple):
    """The state of the method, the point to look at next, whether it has failed, whether it has found the nearest
    point, and whether the linear model has a finite solution."""

    descent: Descent
    trial: Numbers
    fails: Verdict
    settled: Verdict
    determined: Verdict


def judged_at(equations: Equations, search: Search, at: Look) -> tuple[Base, Judged]:
    """What was found at the trial point, and whether it is accepted."""
    xp, sizes, dtype, unit, value = equations.xp, equations.sizes, equations.dtype, search.unit, at.value
    x, jacobian, before = search.trial[: equations.n], at.jacobian * unit[None, :], search.descent
    nearest = search.rung == Rung.NEAREST if equations.has_soft else np.False_
    size, noise = row_sizes(weighed(at.jacobian), x, sizes, unit, at.terms)
    limit = allowed = solved(dtype) * size + noise
    if equations.has_soft:
        # Guesses pull at the equations until the last step, which carries the derivative, sets these right.
        pulled = where(equations.soft, xp.inf, 0.1 * float(np.sqrt(solved(dtype))) * size)
        allowed = where(nearest, pulled + noise, limit)
    holds = xp.all(xp.abs(value) <= allowed)
    # A root is a root on any rung; but what the homotopy lands on is polished first.
    reached = xp.all(xp.abs(value) <= close(dtype) * size) & ~search.tracking

    largest = xp.maximum(xp.max(xp.abs(jacobian), axis=1, initial=0.0), FLAT * xp.abs(value))
    usable = (largest > 0) & (largest < 0.1 * float(xp.finfo(dtype).max))
    balanced = 1 / where(usable, largest, 1.0)
    if equations.has_soft:
        balanced = where(~equations.soft | (sizes.soft == 0), balanced, 1 / sizes.soft)
    # Rows are weighed once, where a climb begins. Weights that followed the point would change what is to fall, and a
    # step could lower |F| by them alone.
    weights = weight = where(search.begins, balanced, search.weight)
    if equations.has_soft:  # where guesses outnumber their freedom, all rungs weigh them down
        weights = where(nearest | equations.nearest_first, weight * equations.weights, weight)
    # Zero times the largest slope is not a number where a slope is not finite: one test serves values and slopes.
    square = xp.sum((weights * value) ** 2 + 0 * largest)

    finite = xp.isfinite(square)
    if equations.limits is not None:
        low, high = equations.limits
        finite &= ~search.tracking | xp.all((x >= low) & (x <= high))
    ratio = (search.base.square - square) / where(before.gain > 0, before.gain, 1.0)
    falls = xp.sqrt(square) < (1 - DECREASE * before.fraction) * xp.sqrt(search.base.square)
    falls = where(search.rung == Rung.MARQUARDT, ratio > 0, falls)
    accepted = reached | (finite & (search.fresh | search.tracking | nearest | falls))
    tried = Base(search.trial, value, jacobian, limit, holds, square)
    return tried, Judged(finite, accepted, reached, ratio, weight, weights)


def damping_of(equations: Equations, search: Search, judged: Judged) -> Numbers:
    """The damping of the next step of Levenberg and Marquardt."""
    damping, growth = search.descent.damping, search.descent.growth
    better = equations.xp.maximum(0.1, 1 - (2 * judged.ratio - 1) ** 3)
    return where(search.fresh, FIRST_DAMPING, damping * where(judged.accepted, better, growth))


def linear_model(equations: Equations, search: Search, base: Base, judged: Judged, damping: Numbers) -> Linear:
    """One factorization for all rungs, of the Jacobian bordered by s and stacked on the damping; two right sides give
    the step and the tangent."""
    xp, dtype, n, m = equations.xp, equations.dtype, equations.n, len(equations.soft)
    tracking, held, curve = search.tracking, judged.weights, equations.array(np.zeros(m))
    value, border = base.value, equations.along
    if equations.core is not None:
        held = where(tracking, equations.array(np.isin(np.arange(m), equations.core)) * search.weight, held)
        curve = where(tracking, held * search.first, curve)
        value = value - where(tracking, 1 - base.at[n], 0.0) * search.first
        across = where(search.fresh, equations.generic, search.curve.tangent)
        border = where(search.rung == Rung.TRACK, across, border)
    # Steps of least norm, with fewer equations than unknowns; and on the way to the nearest point, which may lie where
    # an unknown has no slope, as at the side of a circle.
    floor = least = ZERO_WITHIN * spacing(dtype)
    if m >= n:
        floor = where(search.rung == Rung.NEAREST, least, 0.0) if equations.has_soft else 0.0
    shift = xp.sqrt(where(search.rung == Rung.MARQUARDT, damping, 0.0) + floor)
    columns = [held[:, None] * base.jacobian, curve[:, None], -(held * value)[:, None], xp.zeros((m, 1), dtype)]
    stacked = xp.concatenate([
        xp.concatenate(columns, axis=1),
        xp.concatenate([border, equations.array([0.0, 1.0])])[None, :],
        shift * equations.array(np.eye(n + 1, n + 3)),
    ])  # fmt: skip
    # The right sides stand in the matrix as further columns, so that Q is never formed.
    r = xp.linalg.qr(stacked, mode="raw")[0].T[: n + 1]  # below the diagonal lie the reflections, not read
    both = triangular(r[:, : n + 1], r[:, n + 1 :])
    measured = base.at / xp.append(search.unit, equations.array(1.0))
    columns = xp.concatenate([both, r[:, n + 1 : n + 2], measured[:, None]], axis=1)
    return Linear(both[:, 0], both[:, 1], *xp.sqrt(xp.sum(columns**2, axis=0)))


def descended(
    equations: Equations, search: Search, base: Base, judged: Judged, linear: Linear, damping: Numbers
) -> Descended:
    """The next step of Newton's method, of Levenberg and Marquardt, or to the nearest point."""
    xp, n, eps = equations.xp, equations.n, spacing(equations.dtype)
    fresh, old, count, step, length = search.fresh, search.descent, search.count, linear.step, linear.length
    marquardt = search.rung == Rung.MARQUARDT
    unit = xp.append(search.unit, equations.array(1.0))

    fraction = where(fresh, 1.0, where(judged.accepted, xp.minimum(1.0, 4 * old.fraction), 0.5 * old.fraction))
    size = xp.maximum(xp.abs(base.at[:n]), equations.sizes.nominal)
    still = xp.all(xp.abs(unit * step)[:n] <= NOISE * eps * size)
    determined = xp.isfinite(length)
    fails = ~determined | (fraction < SHORTEST) | (count >= NEWTON_LIMIT) | (still & base.holds)

    gain = linear.explained**2 + damping * length**2  # by which the linear model says that |F|² falls
    moves = (length > 4 * eps * (1 + linear.extent)) & (gain > 1e-10 * base.square)
    fails = where(marquardt, ~moves | (count >= MARQUARDT_LIMIT), fails)

    settled, last_step = np.False_, old.step
    if equations.has_soft:
        # The curvature of the equations makes Gauss–Newton steps too long, by a factor that the change from the last
        # one shows (Barzilai & Borwein 1988).
        nearest = search.rung == Rung.NEAREST
        turned = xp.dot(last_step, last_step - step)
        fitting = old.fraction * xp.dot(last_step, last_step) / where(turned > 0, turned, 1.0)
        fitting = where(turned > 0, xp.clip(fitting, 10 * SHORTEST, 1.0), 1.0)
        fitting = where(fresh, 1.0, where(judged.finite, fitting, 0.5 * old.fraction))
        fraction = where(nearest, fitting, fraction)
        near = length <= SETTLED * np.sqrt(eps) * (1 + linear.extent)
        settled = nearest & base.holds & judged.finite & near
        fails = where(nearest, ~determined | (fraction < SHORTEST) | (count >= NEAREST_LIMIT), fails)
        last_step = where(nearest & judged.finite, step, last_step)
    growth = where(judged.accepted, 2.0, 2 * old.growth)
    trial = base.at + where(marquardt, 1.0, fraction) * unit * step
    return Descended(Descent(fraction, damping, growth, gain, last_step), trial, fails, settled, determined)
