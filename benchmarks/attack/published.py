"""The published problems of `benchmarks/testset` in other units: values and slopes at the start must be the same."""

import sys
from pathlib import Path

import numpy as np

from jaxonomy_dae import AcausalCompiler

from .case import TOLERANCE, Case, Expected
from .judge import read

sys.path.insert(0, str(Path(__file__).parents[1]))  # the test set is imported by its own name

from testset import PROBLEMS  # noqa: E402

# The plate's hundred unknowns, each with its own equations, are too much for a single random model.
NAMES = [name for name in PROBLEMS if name != "sundials_heat2d"]


def make(seed: int) -> Case:
    """The problem number `seed`, as its own reference: to be rescaled."""
    problem = PROBLEMS[NAMES[seed % len(NAMES)]]
    ev, diagram = problem.build()
    system = AcausalCompiler(ev, diagram)()
    x = system.initialize(problem.t0)
    names = [n for n in system.variables if n not in system.inputs]
    values, slopes = read(system, x, names, problem.t0)
    # Values of one unit are compared with the largest of them.
    largest: dict[str, float] = {}
    unit = dict(zip(system.plan.flat.variables.names, system.plan.flat.variables.unit, strict=True))
    for name, value in zip(names, values.tolist(), strict=True):
        largest[unit[name]] = max(largest.get(unit[name], 0.0), abs(value))
    expected = {
        name: Expected(value, TOLERANCE * max(largest[unit[name]], 1e-6))
        for name, value in zip(names, values.tolist(), strict=True)
    }
    fastest = float(np.max(np.abs(slopes), initial=1e-6))
    rates = {
        name: Expected(value, 10 * TOLERANCE * max(abs(value), 1e-3 * fastest))
        for name, value in zip(system.states, slopes.tolist(), strict=False)
        if name in expected
    }
    return Case(ev, diagram, {}, expected, rates, t0=problem.t0, note=problem.name)
