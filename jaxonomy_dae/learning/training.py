"""Steps of an Optax optimizer on the cost of a problem, by the compiled program of least squares."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

from ..base.aliases import PyTree
from ..base.errors import ModelError, SimulationError, explained, whole_number
from ..base.optional import Axes, new_axes
from ..host.content import content
from .beginnings import silent
from .checkpoint import Described, fingerprint, read_facts, read_state, save
from .evaluation import Evaluation, Weights
from .gradient import Batches
from .objective import Objective
from .runs import why_not


def shares_of_time(given: Any) -> tuple[float, ...]:
    """The horizons that are given, if they are shares of the time and end with all of it."""
    try:
        shares = tuple(float(share) for share in given)
    except (TypeError, ValueError):
        shares = ()
    if not shares or shares[-1] != 1.0 or any(not 0 < share <= 1 for share in shares):
        raise ModelError(f"horizons are shares in (0, 1], the last of them 1; got {given!r}")
    return shares


@explained
@dataclasses.dataclass(frozen=True)
class GradientSteps:
    """Settings of training by gradients, for `Problem.train(...)` and `Problem.fit(first=...)`.

    - `optimizer`: of Optax, such as `optax.adam(0.02)` with a number or a schedule, or
        `optax.chain(optax.clip_by_global_norm(1.0), optax.adam(0.02))`. It moves the coordinates: logarithms of
        positive parameters, other numbers in units of their size.
    - `steps`: the number of updates.
    - `batch`: the number of experiments in each step, drawn by `seed`; None: all, with the program of least squares. A
        batch needs another program, which is compiled once.
    - `horizons`: shares of the record's length, each for an equal part of the steps.
    - `patience`: training ends after this number of steps without a better score of held-out experiments.
    - `callback`: called after each step with an `Update`. If it returns True, training ends.
    - `checkpoint`: a file, written every `every` steps and at the end. If it exists, training continues from it and
        ends bit for bit as without interruption. Other models, data, tolerances or settings are refused. The rates of
        the optimizer are not compared: give the same ones.
    - `every`: the number of steps between scores of held-out experiments, at the whole horizon, and between
        checkpoints.
    """

    optimizer: optax.GradientTransformation
    steps: int
    batch: int | None = None
    horizons: Sequence[float] = (1.0,)
    patience: int | None = None
    callback: Callable[["Update"], object] | None = None
    checkpoint: str | Path | None = None
    every: int = 20
    seed: int = 0

    def __post_init__(self):
        if not isinstance(self.optimizer, optax.GradientTransformation):
            raise ModelError(f"optimizer must be one of Optax, such as optax.adam(0.02); got {self.optimizer!r}")
        for name, least in (("steps", 0), ("every", 1), ("batch", 1), ("patience", 1)):
            given = getattr(self, name)
            if given is not None or name in ("steps", "every"):
                object.__setattr__(self, name, whole_number(given, f"GradientSteps: {name}", least))
        object.__setattr__(self, "horizons", shares_of_time(self.horizons))

    def share(self, step: int) -> float:
        """The horizon of a step."""
        return self.horizons[min(step * len(self.horizons) // max(self.steps, 1), len(self.horizons) - 1)]


@dataclasses.dataclass(frozen=True)
class Update:
    """The argument of a callback after `step` updates: the `loss` for each sample before the last update; the latest
    `score` of held-out experiments, NaN if there is none; and `values` by name."""

    step: int
    loss: float
    score: float
    values: dict[str, float]


@dataclasses.dataclass(frozen=True, repr=False)
class Training:
    """The result of `Problem.train`.

    - `z`: the best point in the searched coordinates: that with the best score of held-out experiments, or without any,
        that with the least loss at the whole horizon. With batches, whose losses cannot be compared, it is the last
        point.
    - `history`: the loss at each step, ½ (residual/σ)² for each sample. The loss of a batch is scaled to all
        experiments.
    - `scores`: `(steps, score)` of experiments held out.
    - `step`: the number of updates to the best point.
    """

    objective: Objective
    z: Float[np.ndarray, " f"]
    history: Float[np.ndarray, " steps"]
    scores: tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]
    step: int
    message: str

    def __repr__(self):
        return f"Training({self.message}: the best point is that after {self.step})"

    @property
    def values(self) -> dict[str, float]:
        """Parameters, starts and weights by name, at the best point."""
        return values_at(self.objective, self.z)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draws the history and the scores of held-out experiments; returns Matplotlib axes."""
        ax = new_axes(ax)
        ax.semilogy(np.arange(len(self.history)), np.sqrt(2 * self.history), label="fitted")
        if len(self.scores[0]):
            ax.semilogy(*self.scores, "o-", markersize=3, label="held out")
        ax.axvline(self.step, color="0.7", linewidth=0.8)
        ax.set_xlabel("Updates")
        ax.set_ylabel("RMS residual / σ")
        ax.legend()
        return ax


def values_at(objective: Objective, z: Float[np.ndarray, " f"]) -> dict[str, float]:
    """Values by name."""
    c = objective.coordinates
    return dict(zip(c.names, c.natural(objective.full(z)).tolist(), strict=True))


@dataclasses.dataclass
class State:
    """All that training goes on from."""

    z: Float[np.ndarray, " f"]
    best: Float[np.ndarray, " f"]
    optimizer: optax.OptState
    weights: Weights
    history: list[float]
    scored: list[int]
    scores: list[float]
    best_step: int = 0
    best_value: float = np.inf

    @property
    def step(self) -> int:
        """The number of updates that were taken."""
        return len(self.history)

    def arrays(self) -> list[PyTree]:
        """The arrays that a checkpoint keeps."""
        w = self.weights
        return [
            self.z, self.best, self.optimizer, w.row, w.precision, w.mean, w.share,
            np.array(self.history, float), np.array(self.scored, int), np.array(self.scores, float),
            np.array(self.best_step), np.array(self.best_value),
        ]  # fmt: skip


def train(objective: Objective, start: Float[np.ndarray, " f"], plan: GradientSteps) -> Training:
    """Trains from a point."""
    held_out = bool(objective.stacked.holdout.any())
    if plan.patience is not None and not held_out:
        raise ModelError("patience needs experiments that are held out: Experiment(..., holdout=True)")
    if plan.checkpoint is not None and not Path(plan.checkpoint).parent.is_dir():
        raise ModelError(f"checkpoint: there is no folder for '{plan.checkpoint}': make it first")
    low, high = objective.limits
    near = silent(objective, start)
    stages = {share: Batches(objective.until(share, near), plan.batch, plan.seed) for share in plan.horizons}
    z = np.clip(start, low, high)
    weights = _weights(stages[plan.share(0)], z)
    if weights is None:
        raise SimulationError(why_not(objective))
    with jax.numpy_dtype_promotion("standard"):
        optimizer = plan.optimizer.init(jnp.asarray(z))
    state = State(z, z, optimizer, weights, [], [], [])
    facts = _facts(objective, plan, optimizer)
    if plan.checkpoint is not None and Path(plan.checkpoint).exists():
        state = _resumed(plan.checkpoint, facts, state)
    message, stopped = "", False
    writes = objective.layout.mesh is None or jax.process_index() == 0  # one process of all that train together
    while state.step < plan.steps and not stopped:
        if plan.patience is not None and state.scores and state.step - state.best_step >= plan.patience:
            message = f"ended after {state.step} updates: {plan.patience} without a better score"
            break
        following = plan.share(state.step)
        batches = stages[following]
        if state.step and following != plan.share(state.step - 1):
            weights = _weights(batches, state.z)
            if weights is None:
                message = f"stopped after {state.step} updates: a run over {following:g} of the time fails"
                break
            state.weights = weights
        found = batches.cost_and_gradient(state.z, state.weights, batches.chosen(state.step))
        if found is None:
            message = f"stopped after {state.step} updates, where a run fails: a smaller rate or clipping may help"
            break
        loss, gradient = found
        if not held_out and plan.batch is None and following == 1.0 and loss < state.best_value:
            state.best, state.best_value, state.best_step = state.z, loss, state.step
        # Optax raises floats to integer powers, which strict promotion of dtypes refuses.
        with jax.numpy_dtype_promotion("standard"):
            updates, state.optimizer = plan.optimizer.update(
                jnp.asarray(gradient), state.optimizer, jnp.asarray(state.z)
            )
        state.z = np.clip(state.z + np.asarray(updates, np.float64), low, high)
        state.history.append(loss)
        due = state.step % plan.every == 0
        if due and held_out and following == 1.0:
            score = objective.holdout_score(state.z, state.weights)
            state.scored.append(state.step)
            state.scores.append(score)
            if score < state.best_value:
                state.best, state.best_value, state.best_step = state.z, score, state.step
        if plan.callback is not None:
            score = state.scores[-1] if state.scores else float("nan")
            found = plan.callback(Update(state.step, loss, score, values_at(objective, state.z)))
            if isinstance(found, bool | np.bool_) and found:  # a comparison of NumPy's numbers is no bool of Python
                message, stopped = f"ended by the callback after {state.step} updates", True
        if plan.checkpoint is not None and writes and (due or stopped or state.step == plan.steps):
            counts = {"taken": len(state.history), "scored": len(state.scores), "rows": len(state.weights.row)}
            save(plan.checkpoint, facts | counts, state.arrays())
    last = not np.isfinite(state.best_value)  # nothing to choose by
    if not held_out and plan.batch is None and state.step == plan.steps:
        # The last point has not been looked at yet.
        found = stages[1.0].cost_and_gradient(state.z, state.weights, None)
        last = found is not None and found[0] < state.best_value
    if last:
        state.best, state.best_step = state.z, state.step
    return Training(
        objective, state.best, np.array(state.history), (np.array(state.scored, float), np.array(state.scores)),
        state.best_step, message or f"all {state.step} updates were taken",
    )  # fmt: skip


def _weights(batches: Batches, z: Float[np.ndarray, " f"]) -> Weights | None:
    """Noise levels that are known or as large as residuals are, and priors; at the beginning of a horizon."""
    o = batches.objective
    known = not o.evidence.labels
    found = Evaluation(np.zeros(0), np.zeros((0, len(z)))) if known else o.evaluate(z)
    return None if found is None else o.weights(z, found)


def _facts(objective: Objective, plan: GradientSteps, optimizer: optax.OptState) -> dict[str, Described]:
    """The facts that must agree for a checkpoint to fit, by name."""
    s, c = objective.stacked, objective.coordinates
    data = [
        s.times,
        s.t0,
        s.values,
        s.observed,
        s.sigma,
        s.unit,
        s.tails,
        s.weight,
        s.holdout,
        dict(s.inputs),
        repr(s.starts),
        repr(s.level_of),
        s.rho,
    ]
    searched = [np.array(objective.free), c.low, c.high, c.start[~objective.free], c.size, c.spread, c.centre, c.shifts]
    functions = eqx.partition((objective.system.neural, objective.observers), eqx.is_array)[1]
    return {
        "model": content(objective.system.plan).digest,
        "set of unknowns": json.dumps(
            [list(c.names), fingerprint(searched), sorted(map(str, objective.penalties.items()))]
        ),
        "set of values": fingerprint(eqx.filter((objective.system, objective.observers), eqx.is_array)),
        "set of networks and sensor laws": content(*jax.tree.flatten(functions)).digest,
        "set of data": fingerprint(data),
        "kind of inputs": [list(pair) for pair in s.kinds],
        "integration": content(dict(objective.layout.options)).digest,
        "precision": str(objective.system.parameters.values.dtype),
        "optimizer": str(jax.tree.structure(optimizer)),
        "batch": plan.batch,
        "seed": plan.seed,
        "every": plan.every,
        "horizons": [[share, plan.steps] for share in plan.horizons] if len(plan.horizons) > 1 else [],
    }


def _resumed(path: str | Path, facts: dict[str, Described], like: State) -> State:
    """The state in a checkpoint."""
    counts = read_facts(path, facts)
    taken, scored, rows = (int(counts[name]) for name in ("taken", "scored", "rows"))
    shape = dataclasses.replace(
        like, history=[0.0] * taken, scored=[0] * scored, scores=[0.0] * scored,
        weights=dataclasses.replace(like.weights, row=np.zeros(rows), share=np.zeros(rows)),
    )  # fmt: skip
    z, best, optimizer, row, precision, mean, share, history, at, scores, best_step, best_value = read_state(
        path, shape.arrays()
    )
    weights = dataclasses.replace(like.weights, row=row, precision=precision, mean=mean, share=share)
    return State(
        z, best, optimizer, weights, history=history.tolist(), scored=at.tolist(), scores=scores.tolist(),
        best_step=int(best_step), best_value=float(best_value),
    )  # fmt: skip
