"""Trajectories of compiled systems by SciPy: what components compute, without compiling a run of ours.

A jitted vector field and a jitted reading of variables cost a third of what a program of `simulate` does. For systems
whose field is exact: with nonlinear blocks, it is only as good as a stage needs it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from reference_systems import integrated

from jaxonomy_dae import AcausalSystem

ASIDE = 1e-12  # of a run's length: as near to an edge as the field is evaluated, beside its jump


def read(
    system: AcausalSystem, names: Sequence[str], ts: Any, states: Any, inputs: Mapping[str, Any] | None = None
) -> dict[str, np.ndarray]:
    """Variables at times and states of shape (times, states), by name."""
    names = list(names)
    columns = jax.jit(jax.vmap(lambda t, x: system.observe(names, t, x, inputs)))(np.asarray(ts), np.asarray(states))
    return dict(zip(names, np.asarray(columns).T, strict=True))


def trajectory(
    system: AcausalSystem,
    ts: np.ndarray,
    names: Sequence[str],
    inputs: Mapping[str, Any] | None = None,
    *,
    edges: Sequence[float] = (),
    rtol: float = 1e-10,
) -> dict[str, np.ndarray]:
    """Variables at `ts` from the system's initial state at ts[0], by DOP853 that begins anew at each of `edges`."""
    assert not system.carried, "the field of nonlinear blocks is only as good as a stage needs it"
    start = np.asarray(system.initialize(float(ts[0]), inputs=inputs))
    field = jax.jit(lambda t, x: system.vector_field(t, x, inputs))
    aside = ASIDE * (ts[-1] - ts[0])
    states = integrated(lambda t, x: np.asarray(field(t, x)), start, ts, ends=edges, rtol=rtol, aside=aside)
    return read(system, names, ts, states.T, inputs)
