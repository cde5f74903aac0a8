"""Steps of Levenberg and Marquardt inside bounds, for sums of squares and for likelihoods: one Jacobian and one
factorization each.

Bounds are kept by projection: a coordinate that lies on one, and would be pushed out, is left out of the step (Moré
1978 for the scaling by columns, Madsen, Nielsen & Tingleff 2004 for the damping, Bertsekas 1982 for the active set).
What is descended on, an `AbstractMerit`, says what a point costs, how much is left to go, and what gain is not noticed.

Costs come from an integration, whose error is a noise of its own. Where no step gains, the search measures that noise
by one more point beside the one at hand, and goes on with a tighter tolerance if the noise is what stops it.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .clock import Clock
from .evaluation import Evaluation, Rows, Weights
from .factors import Factors

TRIALS = 12  # dampings tried from one point: the last is 6¹² times the first
PATIENCE = 3  # steps in a row without gain
PERSISTENCE = 12  # the same, where what is reported still has a way to go: small gains add up along a curved valley
OFFSET = 1e-3  # of the confidence region's radius, what may be left to go (Bates & Watts 1981, Technometrics 23:179)
# Where no step gains more, anything that is reported may have so many of its standard deviations left to go. Errors
# grow by 2 % for it.
CLOSE = 0.2
POLISHED = 12  # steps at the end, as long as three of them leave less than a third
MIXED = 4  # earlier steps that these are mixed with (Walker & Ni 2011: three to five suffice)
ROUNDED = 1e-10  # relative rounding of differences of steps
EXACT = 1e-7  # of the radius, below which rounding decides: the square root of eps, as the cost is quadratic
ASIDE = 0.1  # of a step, over which second derivatives are taken (Transtrum & Sethna 2012)
CURVED = 0.375  # of a step, what its correction may be (the same: 2 |a|/|v| ≤ 0.75)
SHORTENED = 6  # lengths of an undamped step that are tried, each a quarter of the one before
FIRST = 1e-3  # damping to begin with, for columns of norm one (Madsen, Nielsen & Tingleff 2004, section 3.2)
BESIDE = 1e-8  # relative step by which noise is measured: what the cost truly changes by is less than its rounding
SETTLED = 0.01  # relative change of a precision or noise level, which changes no interval by as much


@dataclasses.dataclass(frozen=True)
class Minimum:
    """The end of a descent."""

    z: Float[np.ndarray, " p"]
    found: Evaluation
    weights: Weights
    cost: float
    history: list[float]  # of the cost before each step, and the last
    evaluations: int
    converged: bool
    message: str
    noise: float  # relative error of the Jacobian: directions within it count as not determined
    left: float  # what is left to go, in radii of the confidence region
    tolerance: float  # of the integration, relative
    # The integration's error in units of the noise, root of the sum of squares; NaN where it was not measured.
    resolution: float = dataclasses.field(default=np.nan, kw_only=True)


# A function to better weights, and to the part by which noise levels and precisions change. Its last argument says
# whether the point is a minimum for the present weights.
Reweigh = Callable[[np.ndarray, Evaluation, Weights, Factors, np.ndarray, bool], tuple[Weights, float]]


class Reached(NamedTuple):
    """A point that costs less, with what was found there, its weights and its cost."""

    z: Float[np.ndarray, " p"]
    found: Evaluation
    weights: Weights
    cost: float


@dataclasses.dataclass(frozen=True)
class AbstractMerit(abc.ABC):
    """The function that a descent decreases.

    - `evaluate`: residuals and Jacobian at a point; None where they cannot be found, so that a trial is rejected.
    - `weights`: those of a point that was evaluated: the first ones, at the start.
    - `noise`: the relative error of the Jacobian, the tolerance of the integration: directions within it are not
        followed.
    - `finer`: the same with a tolerance that is less by a factor; None where the precision does not allow it.
    - `hidden`: the coordinates that are not reported by themselves, weights of networks. Damping treats them as equals.
    """

    evaluate: Callable[[Float[np.ndarray, " p"]], Evaluation | None]
    weights: Callable[[Float[np.ndarray, " p"], Evaluation], Weights]
    noise: float
    finer: Callable[[float], "AbstractMerit | None"]
    hidden: Bool[np.ndarray, "*p"]

    @abc.abstractmethod
    def cost(self, z: Float[np.ndarray, " p"], weights: Weights) -> float:
        """The cost of a point, infinite where it cannot be found."""

    @abc.abstractmethod
    def reach(self, z: Float[np.ndarray, " p"], weights: Weights, below: float) -> Reached | None:
        """A point, if it costs less than `below`."""

    @abc.abstractmethod
    def unnoticed(self, cost: float, rows: float, columns: int) -> float:
        """A gain by a step that counts as none."""

    @abc.abstractmethod
    def at(self, z: Float[np.ndarray, " p"], found: Evaluation, weights: Weights) -> Weights:
        """The weights at another point, with noise levels and precisions of those given."""

    @abc.abstractmethod
    def next_weights(self, here: Weights, better: Weights) -> Weights:
        """The weights for the next step: `here` are those at the current point, `better` those found with the last
        step."""

    def rows(self, z: Float[np.ndarray, " p"], weights: Weights) -> Float[np.ndarray, " r"] | None:
        """The residuals of `Weights.applied` without their Jacobian; None if that costs as much."""
        return None

    def shortened(self, step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """A step, no longer than the linearization goes."""
        return step


def can_move(
    z: Float[np.ndarray, " p"],
    gradient: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
) -> Bool[np.ndarray, " p"]:
    """True for coordinates that do not lie on a bound across which descent would push them."""
    low, high = bounds
    return ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))


def damping_after(damping: float, ratio: float) -> float:
    """The damping after a step that gained this part of what its linearization promised."""
    if ratio > 0.7:
        damping /= 5
    elif ratio < 0.3:
        damping *= 3
    return max(damping, 1e-12)


def offset(factors: Factors, noise: float) -> float:
    """The remaining step in radii of the confidence region, which noise levels set: the relative offset."""
    rank = factors.rank(noise)
    return float(np.sqrt(np.mean(factors.projected[:rank] ** 2))) if rank else 0.0


@dataclasses.dataclass(frozen=True)
class _Here:
    """A point with all that follows from one factorization there: better weights, how much these change, and what is
    left to go. `paces` are the factors for steps that are damped."""

    z: Float[np.ndarray, " p"]
    found: Evaluation
    weights: Weights
    rows: Rows
    cost: float
    free: Bool[np.ndarray, " p"]
    factors: Factors
    paces: Factors
    following: Weights
    change: float
    left: float

    @classmethod
    def of(
        cls, merit: AbstractMerit, z: np.ndarray, found: Evaluation, weights: Weights, bounds: tuple, reweigh: Any,
        is_minimum: bool = False,
    ) -> "_Here":  # fmt: skip
        rows, cost = weights.applied(z, found), weights.cost(z, found.residual)
        free = can_move(z, rows.jacobian.T @ rows.residual, bounds)
        factors = Factors.of(rows.residual, rows.jacobian[:, free], merit.noise)
        left = offset(factors, merit.noise)
        is_minimum = is_minimum or left <= OFFSET
        following, change = (weights, 0.0) if reweigh is None else reweigh(z, found, weights, factors, free, is_minimum)
        paces = factors.alike(np.broadcast_to(merit.hidden, z.shape)[free])
        return cls(
            z, found, weights, rows, cost, free=free, factors=factors, paces=paces, following=following,
            change=change, left=left,
        )  # fmt: skip

    def open(self, merit: AbstractMerit) -> tuple[float, float]:
        """By how much of their standard deviations a full step moves (the coordinates that are reported, at most; the
        predictions of the data, in root mean square). Weights of networks are not reported: they may have far to go
        along a curved valley in which laws and predictions stay what they are."""
        rank = self.factors.rank(merit.noise)
        step, root = self.factors.step(0.0, rank), self.factors.root(rank)
        spread, shown = np.linalg.norm(root, axis=1), ~np.broadcast_to(merit.hidden, self.z.shape)[self.free]
        single = np.abs(step[shown]) / np.where(spread[shown] > 0, spread[shown], 1.0)
        prior = self.weights.prior(self.z).jacobian[:, self.free]
        known = rank - float(np.sum((prior @ root) ** 2))  # directions that the data determine
        moved = float(np.sum(self.factors.projected[:rank] ** 2) - np.sum((prior @ step) ** 2))
        return float(np.max(single, initial=0.0)), float(np.sqrt(max(moved, 0.0) / max(known, 1.0)))

    @property
    def settled(self) -> bool:
        """True if weights are as good as those they would become."""
        return self.change <= SETTLED

    @property
    def worst(self) -> float:
        """What is left to go, of coordinates or of weights."""
        return max(self.left, self.change)

    @property
    def heavy(self) -> float:
        """How many rows there are, weights counted, and priors."""
        return self.weights.samples + len(self.rows.residual) - len(self.weights.row)


def descend(
    merit: AbstractMerit,
    start: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    reweigh: Reweigh | None,
    steps: int,
    watch: Callable[[int, float, float, float], Any] | None = None,
    clock: Clock | None = None,
) -> Minimum | None:
    """Descends from a start. Where the clock or an interrupt ends the search, the best point so far is its end.

    **Arguments:**

    - `reweigh`: `(z, found, weights, factors, free, is_minimum)` to better weights, and how much they change; called
        for each factorization, and where the search would end.

    **Returns:**

    The point; None if the start itself cannot be evaluated.
    """
    z = np.clip(start, *bounds)
    found = merit.evaluate(z)
    if found is None:
        return None
    here = _Here.of(merit, z, found, merit.weights(z, found), bounds, reweigh)
    path = _Path(merit, here, [], 1, f"stopped after {steps} steps, not yet converged; steps= allows more")
    try:
        _descend(path, bounds, reweigh, steps, watch, clock or Clock())
    except KeyboardInterrupt:
        if clock is None:  # nobody who asked for this search would learn of it
            raise
        clock.interrupt()
        path.reason = clock.after(max(len(path.history) - 1, 0))
    here, merit = path.here, path.merit
    return Minimum(
        here.z, here.found, here.weights, here.cost, history=path.history, evaluations=path.count,
        converged=path.reason.startswith("converged"), message=path.reason, noise=merit.noise, left=here.left,
        tolerance=merit.noise,
    )  # fmt: skip


@dataclasses.dataclass
class _Path:
    """How far a search has come."""

    merit: AbstractMerit
    here: _Here
    history: list[float]
    count: int  # of evaluations
    reason: str


def _descend(
    path: _Path, bounds: tuple[np.ndarray, np.ndarray], reweigh: Reweigh | None, steps: int,
    watch: Callable[[int, float, float, float], Any] | None, clock: Clock,
) -> None:  # fmt: skip
    """Goes on until the search ends, and leaves its point in the path after each step."""
    merit, here, history, damping, idle, tightened = path.merit, path.here, path.history, FIRST, 0, np.inf
    for k in range(steps + 1):
        path.here, path.merit = here, merit
        history.append(here.cost)
        if watch is not None:
            misfit = float(np.sum(here.weights.bent(here.found.residual)[0] ** 2))
            watch(k, here.cost, misfit / max(here.weights.samples, 1.0), here.worst)
        if here.settled and here.left <= OFFSET:
            path.reason = f"converged after {k} steps"
            break
        if k == steps:
            break
        if clock.is_over:
            path.reason = clock.after(k)
            break
        better, tried, damping = _better(merit, here, bounds, damping)
        path.count += tried
        least = merit.unnoticed(here.cost, here.heavy, len(here.z))
        gained = 0.0 if better is None else here.cost - better.cost
        idle = 0 if gained > least else idle + 1
        if better is not None:
            here = _there(merit, better, bounds, reweigh)
        if better is not None and (idle < PATIENCE or (idle < PERSISTENCE and max(here.open(merit)) > CLOSE)):
            continue
        stuck = better is None or damping > 1  # columns have norm one: beyond, damping alone keeps steps short
        along, tried = _along(merit, here, bounds, least) if stuck else (None, 0)
        path.count += tried
        if along is not None:
            here, damping, idle = _there(merit, along, bounds, reweigh), FIRST, 0
            continue
        finer, tried = _finer(merit, here, least)
        if finer is None and here.cost < tightened - least and max(here.open(merit)) > CLOSE:
            finer, tightened = merit.finer(0.1), here.cost  # noise that jumps between steps is not seen so close
        path.count += tried
        found = None if finer is None else finer.evaluate(here.z)
        if finer is not None and found is not None:
            merit, damping, idle = finer, FIRST, 0
            path.count += 1
            here = _Here.of(merit, here.z, found, merit.at(here.z, found, here.weights), bounds, reweigh)
            continue
        # Weights that stay until the search has found its minimum are now free to change.
        here = _Here.of(merit, here.z, here.found, here.weights, bounds, reweigh, is_minimum=True)
        if here.settled or idle > PERSISTENCE + PATIENCE:
            closed = max(here.open(merit)) <= CLOSE
            path.reason = f"{'converged' if closed else 'stopped'} after {k} steps: no step gains more"
            break
        if better is None:
            weights = merit.next_weights(here.weights, here.following)
            here, damping = _Here.of(merit, here.z, here.found, weights, bounds, reweigh), FIRST
    path.here, path.merit = here, merit
    if path.reason.startswith("converged"):
        path.here, polished = _polished(merit, here, bounds, reweigh, history)
        path.count += polished


def _there(merit: AbstractMerit, to: Reached, bounds: tuple, reweigh: Reweigh | None) -> _Here:
    """A point that was reached, with the weights that are better there. With those of the point before, point and
    weights oscillate around each other: fits of networks took twice as many steps, or did not end."""
    here = _Here.of(merit, to.z, to.found, to.weights, bounds, reweigh)
    if reweigh is None:
        return here
    return _Here.of(merit, to.z, to.found, merit.next_weights(to.weights, here.following), bounds, reweigh)


def _better(
    merit: AbstractMerit, here: _Here, bounds: tuple[np.ndarray, np.ndarray], damping: float
) -> tuple[Reached | None, int, float]:
    """A point that costs less, how many were tried, and the next damping."""
    rank, rows = here.paces.rank(merit.noise), here.rows
    for trial in range(TRIALS):
        step = np.zeros_like(here.z)
        step[here.free] = here.paces.step(damping, rank)
        step += _bend(merit, here, step, damping, rank)
        new = np.clip(here.z + merit.shortened(step), *bounds)
        if np.array_equal(new, here.z):
            return None, trial, damping
        reached = merit.reach(new, here.weights, here.cost)
        if reached is not None:
            moved = rows.residual + rows.jacobian @ (new - here.z)
            promised = 0.5 * float(np.sum(rows.residual**2) - np.sum(moved**2))
            floor = max(np.finfo(float).eps * abs(here.cost), np.finfo(float).tiny)
            return reached, trial + 1, damping_after(damping, (here.cost - reached.cost) / max(promised, floor))
        damping *= 6
    return None, TRIALS, damping


def _bend(
    merit: AbstractMerit, here: _Here, step: Float[np.ndarray, " p"], damping: float, rank: int
) -> Float[np.ndarray, " p"]:
    """What makes a straight step follow the curve of a valley: its correction of second order, from the residuals'
    second derivative along it (geodesic acceleration; Transtrum & Sethna 2012, arXiv:1201.5885). Zero where it is too
    large to be one."""
    beside = merit.rows(here.z + ASIDE * step, here.weights)
    if beside is None or not np.isfinite(beside).all():
        return np.zeros_like(step)
    second = 2 / ASIDE * ((beside - here.rows.residual) / ASIDE - here.rows.jacobian @ step)
    bend = np.zeros_like(step)
    bend[here.free] = 0.5 * here.paces.solved(here.rows.jacobian[:, here.free].T @ second, damping, rank)
    sizes = [float(np.linalg.norm(here.paces.scale * part[here.free])) for part in (bend, step)]
    return bend if sizes[0] <= CURVED * sizes[1] else np.zeros_like(step)


def _along(
    merit: AbstractMerit, here: _Here, bounds: tuple[np.ndarray, np.ndarray], least: float
) -> tuple[Reached | None, int]:
    """(a point on the way of an undamped step that gains enough to count; how many were tried). Damping takes long to
    shorten steps along a curved valley, and leaves out the directions in which the valley runs."""
    step = np.zeros_like(here.z)
    step[here.free] = here.factors.step(0.0, here.factors.rank(merit.noise))
    if here.left <= OFFSET:
        return None, 0
    for trial in range(SHORTENED):
        new = np.clip(here.z + 0.25**trial * merit.shortened(step), *bounds)
        reached = merit.reach(new, here.weights, here.cost - least)
        if reached is not None:
            return reached, trial + 1
    return None, SHORTENED


def _finer(merit: AbstractMerit, here: _Here, least: float) -> tuple[AbstractMerit | None, int]:
    """(the merit with a tighter tolerance, if the integration's noise hides gains that would count; evaluations)."""
    step = np.zeros_like(here.z)
    step[here.free] = here.factors.step(0.0, here.factors.rank(merit.noise))
    size = float(np.max(np.abs(step), initial=0.0))
    if here.left <= OFFSET or not size:
        return None, 0
    beside = merit.cost(here.z + step * (BESIDE / size), here.weights)
    noise = abs(beside - here.cost)
    if not noise > 0.1 * least:
        return None, 1
    return merit.finer(float(np.clip(0.1 * least / noise, 1e-4, 0.1))), 1


def _polished(
    merit: AbstractMerit, here: _Here, bounds: tuple[np.ndarray, np.ndarray], reweigh: Reweigh | None,
    history: list[float],
) -> tuple[_Here, int]:  # fmt: skip
    """(the point after full steps, as long as these converge; evaluations): so that a fit ends at its minimum, wherever
    it began, and not at the edge of what counts as near.

    Full steps, and better weights with each, converge by a factor that the residuals' curvature and the priors set.
    Anderson's mixing of the last few (1965, J. ACM 12:547) makes of that what a secant makes of a slope."""
    best, count, scale = here, 0, np.ones_like(here.z)
    scale[here.free] = here.factors.scale
    points: list[np.ndarray] = []
    steps: list[np.ndarray] = []
    marks = [here.worst]
    while count < POLISHED and best.worst > EXACT:
        step = np.zeros_like(here.z)
        step[here.free] = here.factors.step(0.0, here.factors.rank(merit.noise))
        new, weights = here.z + step, here.following
        points = [*points[-MIXED:], _packed(scale * here.z, here.weights)]
        steps = [*steps[-MIXED:], _packed(scale * new, weights) - points[-1]]
        if len(steps) > 1:
            by_point, by_step = np.diff(points, axis=0).T, np.diff(steps, axis=0).T
            mixed = np.linalg.lstsq(by_step, steps[-1], rcond=ROUNDED)[0]
            packed = points[-1] + steps[-1] - (by_point + by_step) @ mixed
            new, weights = packed[: len(new)] / scale, _unpacked(packed[len(new) :], weights)
        z = np.clip(new, *bounds)
        found = merit.evaluate(z)
        count += 1
        if found is None:
            break
        here = _Here.of(merit, z, found, merit.at(z, found, weights), bounds, reweigh, is_minimum=True)
        if here.worst < best.worst:
            best = here
            history.append(here.cost)
        marks.append(best.worst)
        if len(marks) > PATIENCE and marks[-1] > marks[-1 - PATIENCE] / 3:
            break
    return best, count


def _packed(z: Float[np.ndarray, " p"], weights: Weights) -> Float[np.ndarray, " n"]:
    """Coordinates, and the logarithms of weights and precisions."""
    return np.concatenate(
        [z, np.log(weights.row), np.log(weights.precision[weights.precision > 0]), np.log(weights.stiffness)]
    )


def _unpacked(logs: Float[np.ndarray, " n"], weights: Weights) -> Weights:
    """Weights with other rows and precisions."""
    precision, m = np.array(weights.precision), len(weights.row)
    end = m + int(np.sum(precision > 0))
    precision[precision > 0] = np.exp(logs[m:end])
    return dataclasses.replace(weights, row=np.exp(logs[:m]), precision=precision, stiffness=np.exp(logs[end:]))
