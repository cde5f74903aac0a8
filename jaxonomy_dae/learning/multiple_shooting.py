"""Multiple shooting: the states at the nodes of each experiment are unknowns beside the parameters, and continuity is a
constraint (Bock 1981, 1987; van Domselaar & Hemker 1975).

Where trajectories diverge, a run over the whole time depends on parameters so strongly that least squares sees nothing
but local minima. Over a segment the dependence is mild, and the data keep the nodes near the truth.

Continuity is brought about by an augmented Lagrangian (Hestenes 1969, Powell 1969): residuals of least squares
w·c + u for the gaps c, with a weight w that grows, and multipliers u that then make the gaps vanish at a finite weight.
So every step is one of Levenberg and Marquardt, on rows that `block_elimination` reduces. At the end, continuity holds,
and the Jacobian in which nodes are eliminated is that of single shooting: the optimum and its covariance are the same.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..base.errors import explained, whole_number
from .block_elimination import Blocks, eliminate, linear
from .clock import Clock
from .descent import FIRST, OFFSET, PATIENCE, SETTLED, TRIALS, Minimum, can_move, damping_after, offset
from .evaluation import Weights
from .evidence import Evidence
from .factors import Factors
from .least_squares import GAIN
from .node_guesses import node_guesses, sizes
from .objective import Objective
from .segments import Point, Segments

# Weights of gaps, which are measured in the states' ranges. At first a gap of a tenth costs as much as an error of one
# σ.
WEIGHTS = (10.0, 1e2, 1e3)
# The weight grows up to this one if multipliers alone do not close the gaps.
HEAVIEST = 1e7
# If a new set of multipliers leaves more than this part of the gaps, the weight grows, as in LANCELOT (Conn, Gould &
# Toint 1992).
SHRINK = 0.25
FEW = 10  # steps at each of these weights
SLOW = 0.01  # relative decrease of the cost by a step, below which the weight grows
CLOSED = 0.1  # gaps that count as none, in units of the integration's relative tolerance
ROUNDED = 1e-12  # relative rounding errors of a segment's Jacobian, of some thousand operations


@explained
@dataclasses.dataclass(frozen=True)
class Shooting:
    """Multiple shooting (Bock 1981), for `Problem(method=...)`.

    - `nodes`: the number of segments of each experiment. Over one segment, the model should amplify errors by at most
        about ten.

    The differential states at the nodes are unknowns; they begin at smoothed samples if they, or their integrals, were
    measured. With hidden constraints, nodes move along the constraints.
    """

    nodes: int = 30

    def __post_init__(self):
        object.__setattr__(self, "nodes", whole_number(self.nodes, "Shooting: nodes"))


@dataclasses.dataclass(frozen=True)
class ShootingMinimum(Minimum):
    """The end of multiple shooting: also the times at which the segments of e experiments begin, the states there, and
    the gaps between segments, in units of the states' ranges."""

    nodes: Float[np.ndarray, "e N"]
    states: Float[np.ndarray, "e N n"]
    gaps: Float[np.ndarray, "e M g"]


@dataclasses.dataclass(frozen=True)
class Merit:
    """The augmented Lagrangian: weights of data and priors, the weight of continuity, and its multipliers."""

    segments: Segments
    weights: Weights
    continuity: float
    multiplier: Float[np.ndarray, "e M g"]

    def cost(self, point: Point) -> float:
        """½ Σ |rows|²."""
        b = self.blocks(point.blocks)
        return 0.5 * float(np.sum(b.residual**2) + np.sum(b.gap**2)) + self.weights.prior_cost(point.z)

    def blocks(self, blocks: Blocks) -> Blocks:
        """Weighted rows."""
        return blocks.weighted(self.segments.by_sample(self.weights.row), self.continuity, self.multiplier)

    def heavier(self, continuity: float) -> "Merit":
        """A copy with a larger weight `continuity` and the same Lagrange multipliers."""
        return dataclasses.replace(
            self, continuity=continuity, multiplier=self.multiplier * (self.continuity / continuity)
        )

    def updated(self, point: Point) -> "Merit":
        """Multipliers that make this point stationary, if it is a minimum."""
        return dataclasses.replace(self, multiplier=self.multiplier + self.continuity * point.blocks.gap)


@dataclasses.dataclass
class Descent:
    """Steps of Levenberg and Marquardt."""

    segments: Segments
    size: Float[np.ndarray, " n"]
    bounds: tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]
    tolerance: float
    damping: float = FIRST
    evaluations: int = 1

    def step(self, merit: Merit, point: Point) -> tuple[Point, float] | None:
        """A point of less cost, and by how much; None if none was found."""
        blocks, cost = merit.blocks(point.blocks), merit.cost(point)
        size = blocks.sizes
        size = np.maximum(size, ROUNDED * size.max(initial=0.0))
        for _ in range(TRIALS):
            trial = self._trial(merit, point, blocks, size)
            if trial is None:
                return None
            z, states, promised = trial
            new = self.segments.evaluate(z, states, self.size)
            self.evaluations += 1
            gain = -np.inf if new is None else cost - merit.cost(new)
            if new is not None and gain > 0:
                self.damping = damping_after(self.damping, gain / max(cost - promised, np.finfo(float).tiny))
                return new, gain
            self.damping *= 6
        self.damping = FIRST  # other multipliers and weights are another function
        return None

    def _trial(
        self, merit: Merit, point: Point, blocks: Blocks, size: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float] | None:
        """(coordinates, states at the nodes, cost that the linear rows promise) of a damped step."""
        segments, z = self.segments, point.z
        left = eliminate(blocks, np.sqrt(self.damping) * size)
        off, prior = merit.weights.prior(z)
        rows = np.concatenate([segments.spread_out(left.rows), prior])
        residual = np.concatenate([left.residual.ravel(), off])
        gradient = rows.T @ residual
        moves = can_move(z, gradient, self.bounds)
        step = np.zeros_like(z)
        if moves.any():
            # Directions that no segment shows beyond the integration's error are not followed.
            alone = segments.spread_out(blocks.local)[:, moves]
            alone = np.concatenate([alone, prior[:, moves]])
            seen = Factors.of(np.zeros(len(alone)), alone, self.tolerance).directions(self.tolerance)
            # Damped by what they do to all segments' rows, of which but a part is left when nodes are eliminated: else
            # continuity, to second order, would forbid the steps.
            damped = np.concatenate([rows[:, moves] @ seen, np.sqrt(self.damping) * np.eye(seen.shape[1])])
            right = np.concatenate([-residual, np.zeros(seen.shape[1])])
            step[moves] = seen @ np.linalg.lstsq(damped, right, rcond=ROUNDED)[0]
        new = np.clip(z + step, *self.bounds)
        common = segments.common(new - z)
        nodes = left.nodes(common)
        if np.array_equal(new, z) and not np.any(nodes):
            return None
        data, gap = linear(blocks, common, nodes)
        promised = 0.5 * float(np.sum(data**2) + np.sum(gap**2) + np.sum((off + prior @ (new - z)) ** 2))
        states = np.array(point.states)
        if nodes.shape[1]:
            states[:, 1:] += np.einsum("eknd,ekd->ekn", point.bases[:, 1:], nodes)
        return new, states, promised


def shoot(
    objective: Objective,
    shooting: Shooting,
    start: Float[np.ndarray, " f"],
    steps: int,
    tolerance: float,
    weights: Weights | None = None,
) -> ShootingMinimum | None:
    """Descends from a start by multiple shooting.

    **Arguments:**

    - `steps`: how many at most with multipliers; a few come before, while the weight of gaps grows.
    - `tolerance`: of the integration, relative.
    - `weights`: of data and priors, if they are to stay as they are.

    **Returns:**

    The point; None if the segments cannot be run from the start.
    """
    segments = Segments(objective, shooting.nodes)
    z = np.clip(start, *objective.limits)
    states = node_guesses(segments, z)
    if states is None:
        return None
    size = sizes(states)
    point = segments.evaluate(z, states, size)
    if point is None:
        return None
    descent = Descent(segments, size, objective.limits, tolerance)
    evidence = objective.evidence
    if weights is None:
        weights = objective.weights(z, segments.evaluation(point))
    else:
        evidence = None
    merit = Merit(segments, weights, WEIGHTS[0], np.zeros_like(point.blocks.gap))
    history = []
    for continuity in WEIGHTS:
        merit = merit.heavier(continuity)
        for _ in range(FEW):
            cost = merit.cost(point)
            history.append(cost)
            found = descent.step(merit, point)
            if found is None:
                break
            point, gain = found
            if gain < SLOW * cost:
                break
        merit, _, _ = _reweighed(merit, point, evidence, tolerance, ended=False)
    converged, message = False, f"stopped after {steps} steps, not yet converged; steps= allows more"
    remaining, idle, before = np.inf, 0, np.inf
    clock = objective.clock or Clock()
    for k in range(steps + 1):
        if clock.is_over:
            message = clock.after(len(history))
            break
        history.append(merit.cost(point))
        gain = 0.0
        try:
            found = descent.step(merit, point) if k < steps else None
        except KeyboardInterrupt:
            if objective.clock is None:
                raise
            clock.interrupt()
            continue
        if found is not None:
            point, gain = found
        left = 0.5 * merit.continuity**2 * float(np.sum(point.blocks.gap**2))
        idle = 0 if gain > max(GAIN * history[-1], OFFSET * len(point.z)) else idle + 1
        if gain > left and not idle and k < steps:
            continue
        merit, settled, remaining = _reweighed(merit, point, evidence, tolerance, ended=idle > PATIENCE)
        if objective.watch is not None:
            data = merit.weights.row * segments.evaluation(point).residual
            objective.watch(k, history[-1], float(data @ data) / max(merit.weights.samples, 1.0), remaining)
        widest = float(np.abs(point.blocks.gap).max(initial=0.0))
        if settled and widest <= CLOSED * tolerance and (remaining <= OFFSET or idle > PATIENCE):
            converged, message = True, f"converged after {len(history)} steps"
            break
        if idle > 3 * PATIENCE:
            message = f"stopped after {len(history)} steps: none gains more, and gaps of {widest:.2g} are left"
            break
        merit = merit.updated(point)
        if widest > SHRINK * before and merit.continuity < HEAVIEST:
            merit = merit.heavier(10 * merit.continuity)
        before = widest
    found = segments.evaluation(point)
    noise = _noise(merit, point, merit.weights.applied(point.z, found).jacobian, tolerance)
    return ShootingMinimum(
        point.z, found, merit.weights, merit.weights.cost(point.z, found.residual), history=history,
        evaluations=descent.evaluations, converged=converged, message=message, noise=noise, left=remaining,
        tolerance=tolerance, nodes=segments.nodes[:, :-1], states=point.states, gaps=point.blocks.gap,
    )  # fmt: skip


def _noise(merit: Merit, point: Point, jacobian: Float[np.ndarray, "m f"], tolerance: float) -> float:
    """The relative error of a Jacobian without nodes: a segment's is known to the tolerance, and what amplifies it does
    so by factors that are known as well."""
    alone = np.linalg.norm(merit.segments.spread_out(merit.blocks(point.blocks).local), axis=0).max(initial=0.0)
    largest = np.linalg.norm(jacobian, axis=0).max(initial=0.0)
    return float(np.clip(tolerance * alone / largest if largest > 0 else tolerance, ROUNDED, tolerance))


def _reweighed(
    merit: Merit, point: Point, evidence: Evidence | None, tolerance: float, ended: bool
) -> tuple[Merit, bool, float]:
    """The merit with better noise levels and priors, whether these have settled, and the remaining step in radii of the
    confidence region, were continuity to hold. `ended`: no step gains more."""
    z = point.z
    found = merit.segments.evaluation(point)
    residual, jacobian = merit.weights.applied(z, found)
    moves = can_move(z, jacobian.T @ residual, merit.segments.objective.limits)
    noise = _noise(merit, point, jacobian, tolerance)
    factors = Factors.of(residual, jacobian[:, moves], noise)
    remaining = offset(factors, noise)
    if evidence is None or evidence.is_idle:
        return merit, True, remaining
    weights, change = evidence.reweigh(z, found, merit.weights, factors, moves, ended or remaining <= OFFSET)
    return dataclasses.replace(merit, weights=weights), change <= SETTLED, remaining
