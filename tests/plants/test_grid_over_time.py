"""A large nonlinear block over time: against nodal analysis in SciPy at the end."""

import numpy as np
import pytest
from shared_models import Grid

from jaxonomy_dae import simulate


@pytest.mark.slow
def test_nonlinear_grid_over_time():
    """The rates of the algebraic unknowns keep them on the solution."""
    grid = Grid(7, cubic=0.5)
    system = grid.system()
    solution = simulate(system, 0.5, ts=np.array([0.5]), rtol=1e-8, atol=1e-10)
    residual = system.constraint_residual(0.5, solution.states[0])
    np.testing.assert_allclose(residual, 0.0, atol=1e-8)
    moved = Grid(7, cubic=0.5)
    moved.v0 = np.array([float(solution[f"c{k}.v"][0]) for k in range(3)])
    end = np.array([float(solution[f"c{k}.i"][0]) for k in range(3)])
    np.testing.assert_allclose(end, moved.reference(), rtol=1e-6)
