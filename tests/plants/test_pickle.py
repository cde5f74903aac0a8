"""Systems and solutions survive `pickle` and `copy.deepcopy`, and find the programs that were compiled before."""

import copy
import pathlib
import pickle
import subprocess
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import ROOT, compiled, drag_on, mlp, pendulum, rc_circuit
from sympy import Eq, sqrt

from jaxonomy_dae import Component, EqnEnv, der, simulate


class Bent(Component):
    """A nonlinear block, a start and a parameter that are expressions."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a = self.parameter("a", 4.0)
        self.parameter("b", sqrt(a))
        x, z = self.variable("x", start=a / 2, fixed=True), self.variable("z", start=1.0)
        self.add_equations(Eq(der(x), -self.b * z), Eq(z**3 + z, x))


def round_trip(value):
    return pickle.loads(pickle.dumps(value))


MODELS = {
    "circuit": rc_circuit,
    "pendulum": pendulum,
    "nonlinear": lambda: compiled(Bent(EqnEnv(), "c")),
    "learned": lambda: pendulum(drag_on("vx", "vy", network=mlp(2, 2))),
}


@pytest.mark.parametrize(
    "name", ["nonlinear", "learned", *(pytest.param(n, marks=pytest.mark.slow) for n in ("circuit", "pendulum"))]
)
def test_systems(name):
    system = MODELS[name]()
    traced = []

    @eqx.filter_jit
    def started(system):
        traced.append(None)
        state = system.initialize()
        return state, system.vector_field(0.0, state)

    state, slope = started(system)
    for again in (round_trip, copy.deepcopy):
        copied = again(system)
        assert copied is not system
        assert copied.plan == system.plan and hash(copied.plan) == hash(system.plan)
        assert jax.tree.structure(copied) == jax.tree.structure(system)
        assert copied.parameters.table == system.parameters.table and copied.states == system.states
        np.testing.assert_array_equal(copied.parameters.array, system.parameters.array)
        found = started(copied)
        np.testing.assert_allclose(found[0], state, rtol=1e-12)
        np.testing.assert_allclose(found[1], slope, rtol=1e-12)
    if not system.neural:  # whose functions are copied, too
        assert len(traced) == 1  # equal as a key: the later calls found the first one's program


@pytest.mark.slow
def test_solutions():
    system = rc_circuit()
    solution = simulate(system, 1.0, ts=jnp.array([0.0, 0.5, 1.0]), adjoint=diffrax.ForwardMode())
    for again in (round_trip, copy.deepcopy):
        copied = again(solution)
        np.testing.assert_array_equal(copied["c.v"], solution["c.v"])
        np.testing.assert_array_equal(copied["r.i"], solution["r.i"])
        assert copied.stats == solution.stats and copied.result == solution.result


@pytest.mark.slow
def test_another_process_reads_it(tmp_path: pathlib.Path):
    system = compiled(Bent(EqnEnv(), "c")).with_parameters({"c.a": 9.0})
    (tmp_path / "system.pickle").write_bytes(pickle.dumps(system))
    code = (
        "import jax, pickle, sys; jax.config.update('jax_enable_x64', True)\n"
        "s = pickle.load(open(sys.argv[1], 'rb'))\n"
        "print(float(s.parameters['c.b']), s.initialize()[0], s.states)"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "system.pickle")],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    assert out.stdout.split() == ["3.0", "4.5", "['c.x']"]
