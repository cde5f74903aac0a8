"""Runs of a linear DAE of index 2 (`shared_models.MIXED`) against its solution in Weierstrass form."""

import dataclasses

import numpy as np
import pytest
from problems import compiled
from shared_models import MIXED, written

from jaxonomy_dae import simulate


@pytest.mark.slow
def test_trajectories_in_any_order_under_any_name():
    rng = np.random.default_rng(0)
    rows, columns = (tuple(rng.permutation(MIXED.n).tolist()) for _ in range(2))
    shuffled = dataclasses.replace(MIXED, rows=rows, columns=columns)
    names = [f"{'zyxw'[k]}0" for k in range(MIXED.n)]
    system = compiled(written(shuffled, "other", names))
    ts = np.array([0.5, 1.0, 2.0])
    start = MIXED.solution([0.0], np.array([1.0, -0.5]))[0][0]
    initial = {f"other.{name}": value for name, value in zip(names, start, strict=True)}
    solution = simulate(system, 2.0, ts=ts, initial=initial, rtol=1e-9, atol=1e-11)
    expected = MIXED.solution(ts, np.array([1.0, -0.5]))[0]
    found = np.stack([solution[f"other.{n}"] for n in names], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)  # a hundred times the tolerance
