"""Intervals of what was estimated: linear ones, and those of the profile likelihood (Venzon & Moolgavkar 1988, Applied
Statistics 37:87)."""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy.optimize
import scipy.stats
from jaxtyping import Float

from ..base.errors import ModelError
from .at_bounds import AtBound
from .coordinates import end_text
from .descent import Minimum
from .evaluation import Weights
from .objective import AWAY, Objective
from .priors import is_finite
from .table import Row, Table

FURTHEST = 10  # doublings of the linear interval before an end counts as infinite
# Data that leave more than this part of a prior's spread say nothing: a sample of five times that spread would narrow
# it as much.
SILENT = 0.98


def checked_level(level: object) -> float:
    """The probability that an interval is to have, or a `ModelError`."""
    if not (is_finite(level) and 0 < level < 1):
        raise ModelError(f"level is a probability between 0 and 1, such as 0.95; got {level!r}")
    return float(level)


def profile(
    objective: Objective, minimum: Minimum, point: Float[np.ndarray, " p"], spread: float, position: int, level: float,
    reach: Callable[[Objective, np.ndarray, Weights], Minimum | None],
) -> tuple[float, float]:  # fmt: skip
    """The interval of one coordinate, in natural values.

    **Arguments:**

    - `point`: all coordinates at the minimum; `spread`: the standard deviation of this one.
    - `reach`: `reach(objective, start, weights)` is the minimum next to a start, with weights that stay as they are.
    """
    c = objective.coordinates
    if c.shifts is not None and position in c.shifts.into:
        raise ModelError(
            f"profile: '{c.names[position]}' is a bias of a network, and is searched as the value at the centre of its "
            "inputs: nothing can be said of it by itself. See fit.band for the law"
        )
    allowed = 0.5 * float(scipy.stats.chi2.ppf(checked_level(level), 1))
    held = np.array(c.fixed)
    held[position] = True
    free = objective.free
    others = np.flatnonzero(np.flatnonzero(free) != position)
    weights = dataclasses.replace(
        minimum.weights, precision=minimum.weights.precision[others], mean=minimum.weights.mean[others]
    )
    own = int(np.flatnonzero(np.flatnonzero(free) == position)[0])
    prior, mean = minimum.weights.precision[own], minimum.weights.mean[own]
    best = minimum.cost
    warm = [minimum.z[others]]

    def excess(z: float) -> float:
        """By how much the cost exceeds the allowed one when the coordinate is held at z and everything else is
        fitted."""
        start = np.array(c.start)
        start[free] = c.natural(point)[free]
        start[position] = c.natural_at(position, z)
        at = dataclasses.replace(objective, coordinates=dataclasses.replace(c, start=start, fixed=held))
        own_cost = 0.5 * prior * (z - mean) ** 2
        reached = reach(at, warm[0], weights if weights.bends is None else dataclasses.replace(weights, bends=at.bends))
        cost = np.inf if reached is None else reached.cost
        if reached is not None:
            warm[0] = reached.z
        # Finite where a run fails, since the search for a root needs numbers.
        return min(cost + own_cost - best, 1e6) - allowed

    centre = float(point[position])
    ends = []
    for sign, bound in zip((-1, 1), (b[position] for b in c.z_bounds), strict=True):
        warm[0] = minimum.z[others]
        step = spread if np.isfinite(spread) and spread > 0 else 1.0
        inner, z, end = centre, centre, sign * np.inf
        for _ in range(FURTHEST):
            z = centre + sign * 2 * step
            z = max(z, bound) if sign < 0 else min(z, bound)
            if excess(z) > 0:
                end = float(scipy.optimize.brentq(excess, inner, z, xtol=1e-3 * step))  # pyright: ignore[reportArgumentType]
                break
            if z == bound:
                end = bound
                break
            inner, step = z, 2 * step
        ends.append(c.natural_at(position, end))
    return ends[0], ends[1]


def intervals(
    objective: Objective, point: Float[np.ndarray, " p"], spreads: Float[np.ndarray, " p"],
    scale: Float[np.ndarray, " p"], factor: float, level: float, noise: list[Row], ends: dict[int, AtBound],
) -> Table:  # fmt: skip
    """As `Estimate.table`: parameters and starts, with what is to be said of each, and noise levels. `scale`: the
    spread at which a coordinate counts as not determined; `ends`: the coordinates that ended at a bound."""
    c = objective.coordinates
    low, high = c.z_bounds
    natural = c.natural(point)
    moved, rows = set(np.flatnonzero(objective.free)), []
    away = objective.ran_away(point)
    scalars = np.array([not name.endswith("]") for name in c.names])  # such as a sensor law's gain
    for k in np.flatnonzero(~c.is_weight | scalars).tolist():
        at = ends.get(k, AtBound(0.0, spreads[k]))
        z, spread, note = point[k], at.spread, ""
        inside_of = z + at.beyond - factor * spread, z + at.beyond + factor * spread
        if k not in moved:
            note = "frozen" if c.fixed[k] else "held out: fitted to this experiment alone"
            if not c.fixed[k] and objective.has_no_weight[k]:
                note = "no weight: kept at its guess"
        elif k in ends and (spread < scale[k] or at.is_pushed):
            note = f"bound reached: {end_text(natural[k])}"
        elif away[k]:
            note = "ran away"
            spread = np.inf
        elif np.isfinite(c.spread[k]) and spread > SILENT * c.spread[k]:
            note = "by its prior"
        elif spread >= scale[k]:
            note = "not determined"
        inside = (-np.inf, np.inf)
        # A factor beyond which no search goes says nothing, however many digits its ends have.
        if np.isfinite(spread) and not (c.log[k] and factor * spread > np.log(AWAY)):
            inside = np.clip([c.natural_at(k, e) for e in inside_of], c.low[k], c.high[k])
        rows.append(Row(c.names[k], float(natural[k]), float(inside[0]), float(inside[1]), c.units[k], note))
    return Table((*rows, *noise), level)


def noise_intervals(objective: Objective, minimum: Minimum, taken: Float[np.ndarray, " m"], level: float) -> list[Row]:
    """Noise levels that were estimated: ν·s²/σ² is χ² of ν degrees of freedom, those of the samples less what the
    coordinates took of them."""
    weights, evidence = minimum.weights, objective.evidence
    variables = objective.system.plan.flat.variables
    units = dict(zip(variables.names, variables.unit, strict=True))
    rows = []
    for k, name in enumerate(evidence.labels):
        own = evidence.noise == k
        freedom = max(float(np.sum(weights.share[own] ** 2) - np.sum(taken[own])), 1.0)
        # ln σ² of errors of first order has a variance (1 + ρ²)/(1 − ρ²) times that of independent ones.
        squares = np.mean(objective.rho[objective.rows[2][own]] ** 2)
        freedom = max(freedom * (1 - squares) / (1 + squares), 1.0)
        value = float(1 / (weights.scale * evidence.unit)[own][0])
        low, high = (value * np.sqrt(freedom / scipy.stats.chi2.ppf(0.5 + s * level / 2, freedom)) for s in (1, -1))
        rows.append(Row(f"sigma of {name}", value, float(low), float(high), units.get(name, ""), ""))
    for j in np.flatnonzero(np.isnan(objective.stacked.rho)):
        own, rho = objective.rows[2] == j, float(objective.rho[j])
        # The variance of ρ is (1 − ρ²)/n, and that of artanh ρ, which is more nearly normal, 1/(n (1 − ρ²)).
        freedom = max(float(np.sum(weights.share[own] ** 2) - np.sum(taken[own])), 1.0)
        wide = scipy.stats.norm.ppf(0.5 + level / 2) / np.sqrt(freedom * (1 - rho**2))
        low, high = np.tanh(np.arctanh(rho) - wide), np.tanh(np.arctanh(rho) + wide)
        rows.append(Row(f"rho of {objective.stacked.outputs[j]}", rho, float(low), float(high), "", ""))
    return rows
