"""Trajectories of compiled systems by SciPy: what components compute, without compiling a run of ours.

A jitted vector field and a jitted reading of variables cost a third of what a program of `simulate` does. For systems
whose field is exact: with nonlinear blocks, it is only as good as a stage needs it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from reference_systems import ReferenceSystem, integrated, system_of, values_of

from jaxonomy_dae import AcausalSystem, Solution
from jaxonomy_dae.compile.model.consistent_point import initial_point
from jaxonomy_dae.compile.model.tables import Declared
from jaxonomy_dae.run.system.inputs import read_inputs

ASIDE = 1e-12  # of a run's length: as near to an edge as the field is evaluated, beside its jump
POINTS = 15  # of Gauss's quadrature in each panel


def read(
    system: AcausalSystem, names: Sequence[str], ts: Any, states: Any, inputs: Mapping[str, Any] | None = None
) -> dict[str, np.ndarray]:
    """Variables at times and states of shape (times, states), by name."""
    names = list(names)
    columns = jax.jit(jax.vmap(lambda t, x: system.observe(names, t, x, inputs)))(np.asarray(ts), np.asarray(states))
    return dict(zip(names, np.asarray(columns).T, strict=True))


def states_at(
    system: AcausalSystem,
    ts: np.ndarray,
    inputs: Mapping[str, Any] | None = None,
    *,
    edges: Sequence[float] = (),
    rtol: float = 1e-10,
) -> np.ndarray:
    """States at `ts`, shape (times, states), from the declared starts at ts[0] = 0, by DOP853 that begins anew at
    `edges`."""
    assert not system.carried, "the field of nonlinear blocks is only as good as a stage needs it"
    assert not system.plan.n_constraints, "inputs at the start move redundant states, and a run projects them"
    plan = system.plan
    declared = Declared(np.asarray(system.numbers), system.neural)
    start = initial_point(plan.model, declared).values[plan.states]  # by NumPy: `initialize` compiles its ladder
    field = jax.jit(lambda t, x: system.vector_field(t, x, inputs))
    aside = ASIDE * (ts[-1] - ts[0])
    return integrated(lambda t, x: np.asarray(field(t, x)), start, ts, ends=edges, rtol=rtol, aside=aside).T


def trajectory(
    system: AcausalSystem,
    ts: np.ndarray,
    names: Sequence[str],
    inputs: Mapping[str, Any] | None = None,
    *,
    edges: Sequence[float] = (),
    rtol: float = 1e-10,
) -> dict[str, np.ndarray]:
    """Variables at `ts`, by name."""
    return read(system, names, ts, states_at(system, ts, inputs, edges=edges, rtol=rtol), inputs)


def solution_of(system: AcausalSystem, ts: Any, states: Any, inputs: Mapping[str, Any] | None = None) -> Solution:
    """A `Solution` with given states, shape (times, states)."""
    ts, states = jnp.asarray(ts, float), jnp.asarray(states, float)
    return Solution(ts, states, system, read_inputs(system.plan, states.dtype, inputs), {}, diffrax.RESULTS.successful)


def balanced(
    system: AcausalSystem,
    end: float,
    inputs: Mapping[str, Any] | None = None,
    *,
    panels: int = 40,
    edges: Sequence[float] = (),
    rtol: float = 1e-7,
) -> Solution:
    """Asserts that what is stored until `end` was supplied and not lost, by Gauss's quadrature of these powers.

    Errors may be `rtol` of the energy that is exchanged. Returns the solution at the quadrature's nodes, with zero in
    front and `end` behind.
    """
    places, weights = np.polynomial.legendre.leggauss(POINTS)
    grid = np.linspace(0.0, end, panels + 1)
    apart = np.abs(grid[:, None] - np.asarray(edges, float)).min(axis=1, initial=np.inf)
    grid = grid[apart > 1e-9 * end]  # 0.3 and 3·0.1 are one knot
    knots = np.union1d(grid, edges)
    half = np.diff(knots)[:, None] / 2
    ts = np.concatenate([[0.0], (knots[:-1, None] + half * (1 + places)).ravel(), [end]])
    solution = solution_of(system, ts, states_at(system, ts, inputs, edges=edges, rtol=1e-11), inputs)
    energy, supply, lost = (np.asarray(v()) for v in (solution.energy, solution.supply, solution.dissipation))
    weights = (half * weights).ravel()
    work, exchanged = ((weights * f(supply, lost)[1:-1]).sum() for f in (np.subtract, lambda s, d: np.abs(s) + d))
    np.testing.assert_allclose(energy[-1] - energy[0], work, rtol=0, atol=rtol * exchanged)
    return solution


def check_trajectory(reference: Callable[[], ReferenceSystem]) -> None:
    """The reference beside SciPy's trajectory of the compiled field, as `check_solution` does with a run."""
    known, system = system_of(reference)
    expected = known.expected(values_of(system))
    found = trajectory(system, known.ts, list(expected), known.inputs)
    for name, true in expected.items():
        error = np.abs(found[name] - true).max() / np.abs(true).max()
        assert error <= known.tolerance, f"{name}: off by {error:.3g} of its largest value"
