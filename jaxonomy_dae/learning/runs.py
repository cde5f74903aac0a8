"""Ordinary simulations of experiments, beside the compiled program: to look at them, and to say why they fail."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import InitializationError, ModelError, SimulationError
from ..simulation.simulate import simulate
from .objective import Objective
from .program import with_values


def run(objective: Objective, z: Float[np.ndarray, " p"], experiment: int, ts: Any = None) -> Any:
    """An ordinary simulation of one experiment at a point."""
    layout, s = objective.layout, objective.stacked
    shared, own = objective.numbers(objective.coordinates.natural(z))
    system, _, starts = with_values(objective.system, objective.observers, layout, shared)
    initial = dict(zip(layout.shared, starts, strict=True))
    initial |= dict(zip(layout.own, own[experiment], strict=True))
    initial |= dict(zip(layout.known, objective.conditions.known[experiment], strict=True))
    given = {name: float(v) for name, v in initial.items() if name in system.parameters}
    system = system.with_parameters(given) if given else system
    initial = {name: v for name, v in initial.items() if name not in given}
    inputs = {n: (t[experiment], v[experiment], dict(s.kinds)[n]) for n, (t, v) in s.inputs.items()}
    end = s.counts[experiment]
    times = s.times[experiment, :end] if ts is None else ts
    t1 = max(float(times[-1]), np.nextafter(s.t0[experiment], math.inf))
    return simulate(
        system,
        t1,
        t0=s.t0[experiment],
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
