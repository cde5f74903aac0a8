"""Experiments outside of a fit: ordinary simulations, to look at them and to say why they fail; and residuals by name,
for losses of one's own."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..base.aliases import PyTree
from ..base.errors import InitializationError, ModelError, SimulationError, nearest
from ..run.simulation.simulate import simulate
from ..run.simulation.solution import Solution
from ..run.system.system import AcausalSystem
from .objective import Objective
from .program import Runs, SensorLaw, Setting, delays_of, placed, predict, run_end, with_kinds


def run(objective: Objective, z: Float[np.ndarray, " p"], experiment: int, ts: np.ndarray | None = None) -> Solution:
    """An ordinary simulation of one experiment at a point."""
    layout, s = objective.layout, objective.stacked
    shared, own = objective.numbers(objective.coordinates.natural(z))
    system, _, initial = placed(objective.setting, shared, own[experiment], objective.conditions.known[experiment])
    samples = {n: (t[experiment], v[experiment]) for n, (t, v) in objective.conditions.inputs.items()}
    inputs = with_kinds(samples, layout, delays_of(layout, shared))
    end = s.counts[experiment]
    times = s.times[experiment, :end] if ts is None else ts
    t0 = jnp.asarray(s.t0[experiment], objective.conditions.t0.dtype)
    return simulate(
        system,
        run_end(t0, jnp.asarray(times[-1], t0.dtype)),
        t0=t0,
        ts=times,
        inputs=inputs or None,
        initial=initial or None,
        **dict(layout.options),
    )


def why_not(objective: Objective) -> str:
    """The first reason for which a run from the start fails."""
    c, s = objective.coordinates, objective.stacked
    shared, own = objective.numbers(c.natural(c.z_start))
    outputs = np.asarray(objective.predicted(c.z_start).outputs)
    failed = [k for k in range(len(s.labels)) if not np.isfinite(outputs[k][s.observed[k]]).all()]
    k = failed[0] if failed else 0
    try:
        run(objective, c.z_start, k)
    except (InitializationError, ModelError, SimulationError) as error:
        return f"no start can be simulated; from the first, {s.labels[k]} fails: {error}"
    what = "its predictions are not finite" if failed else "their derivatives are not finite"
    return f"no start can be simulated; from the first, {s.labels[k]}: {what}"


def residuals(
    objective: Objective,
    model: AcausalSystem,
    starts: Mapping[str, ArrayLike | Sequence[float]],
    delay: Mapping[str, ArrayLike],
    observe: Mapping[str, SensorLaw],
    adjoint: PyTree,
) -> dict[str, dict[str, Array]]:
    """As `Problem.residuals`: predictions of a model like the objective's less its data, in units of the noise."""
    layout, s = objective.layout, objective.stacked
    shared, own = objective.numbers(objective.coordinates.start)
    first = len(layout.extra)
    shared = shared[len(shared) - len(layout.shared) - first :]
    for name, value in delay.items():
        if name not in layout.delayed:
            raise ModelError(f"delay: '{name}' has none in this problem: " + nearest(name, layout.delayed))
        shared = shared.at[layout.delayed.index(name)].set(jnp.asarray(value, shared.dtype))
    for name, value in starts.items():
        value = jnp.asarray(value, shared.dtype)
        if name in layout.shared:
            shared = shared.at[first + layout.shared.index(name)].set(value)
        elif name in layout.own:
            own = own.at[:, layout.own.index(name)].set(value)
        else:
            raise ModelError(f"the start of '{name}' is not unknown: " + nearest(name, layout.shared + layout.own))
    plain = dataclasses.replace(layout, parameters=(), modules=())
    setting = Setting(model, {**objective.observers, **observe}, plain, objective.setting.fine)
    outputs = predict(setting, Runs(adjoint), shared, own, objective.conditions).values
    sigma = np.where(np.isnan(s.sigma), 1.0, s.sigma)
    scaled = jnp.where(s.observed, (outputs - s.values) / sigma, 0.0)
    return {
        label: {name: scaled[k, :count, j] for j, name in enumerate(s.outputs) if s.observed[k, :, j].any()}
        for k, (label, count) in enumerate(zip(s.labels, s.counts, strict=True))
    }
