"""FMUs as components: runs and gradients beside closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fmus import fmpy
from problems import compiled

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi import FmuComponent
from jaxonomy_dae.fmi.compilers import compiler_for, this_platform
from jaxonomy_dae.write import Eq

pytestmark = pytest.mark.skipif(compiler_for(this_platform()) is None, reason="no C compiler on this machine")
assert fmpy


class Decay(Component):
    """x' = u − k·x from x = b."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        k, b, u = self.parameter("k", 0.5, bounds=(0, 10)), self.parameter("b", 2.0), self.input("u", default=0.0)
        x = self.variable("x", start=b, fixed=True)
        self.output("y", x**2 + u)
        self.add_equations(Eq(der(x), u - k * x))


@pytest.fixture(scope="module")
def decay(tmp_path_factory):
    folder = tmp_path_factory.mktemp("decay")
    return compiled(Decay(EqnEnv(), "d")).export_fmu(folder / "decay.fmu", kinds=["model_exchange"])


def imported(path, **options):
    ev = EqnEnv()
    component = FmuComponent(ev, "f", path, **options)
    diagram = AcausalDiagram()
    diagram.add(component)
    return component, AcausalCompiler(ev, diagram)()


def test_an_fmu_comes_back_as_a_component(decay):
    component, system = imported(decay)
    assert component.derivatives == "directional derivatives"
    assert component.names == {"d.k": "d_k", "d.b": "d_b", "d.x": "d_x", "d.u": "d_u", "d.y": "d_y"}
    assert system.states == ["f.d_x"] and system.inputs == ["f.d_u"]
    args = {"f.d_u": 0.7}
    with jax.disable_jit():
        x = jnp.array([3.0])
        assert system.vector_field(0.0, x, args)[0] == pytest.approx(0.7 - 0.5 * 3.0)
        assert jax.jvp(lambda x: system.vector_field(0.0, x, args), (x,), (x,))[1][0] == pytest.approx(-1.5, rel=1e-12)
        (back,) = jax.vjp(lambda x: system.vector_field(0.0, x, args), x)[1](jnp.array([2.0]))
        assert back[0] == pytest.approx(-1.0, rel=1e-12)


def test_what_cannot_be_a_component_is_refused_by_name(decay, tmp_path):
    with pytest.raises(ModelError, match="f: there is no file '.*none.fmu'"):
        imported(tmp_path / "none.fmu")
    with pytest.raises(ModelError, match="f: 'd.z' is not a scalar output of the FMU: .*d.y"):
        imported(decay, outputs=["d.z"])
    with pytest.raises(ModelError, match="f: 'd.x' is not a scalar parameter of the FMU"):
        imported(decay, parameters=["d.x"])
    bare = compiled(Decay(EqnEnv(), "d")).export_fmu(tmp_path / "bare.fmu", kinds=["model_exchange"], platforms=())
    with pytest.raises(ModelError, match="has no binary for .*, only for none"):
        imported(bare)


@pytest.mark.slow
def test_runs_and_gradients_of_an_fmu(decay):
    """x(t) = b·exp(−k·t), by k and by b, in both modes and in a batch."""
    _, system = imported(decay)
    ts = jnp.linspace(0.0, 2.0, 5)
    solution = simulate(system, 2.0, rtol=1e-9, atol=1e-11, ts=ts)
    np.testing.assert_allclose(solution["f.d_x"], 2 * np.exp(-0.5 * ts), atol=1e-8)
    np.testing.assert_allclose(solution["f.d_y"], 4 * np.exp(-ts), atol=1e-8)

    def last(k, b):
        at = system.with_parameters({"f.d_k": k, "f.d_b": b})
        return simulate(at, 2.0, rtol=1e-9, atol=1e-11, ts=ts)["f.d_x"][-1]

    expected = -4 * np.exp(-1.0), np.exp(-1.0)
    np.testing.assert_allclose(jax.grad(last, (0, 1))(0.5, 2.0), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(last, (0.5, 2.0), (1.0, 0.0))[1], expected[0], rtol=1e-6)
    np.testing.assert_allclose(
        jax.vmap(last, (0, None))(jnp.array([0.5, 1.0]), 2.0), [2 * np.exp(-1.0), 2 * np.exp(-2.0)], rtol=1e-7
    )


@pytest.mark.slow
def test_an_fmu_inside_a_diagram(decay):
    """A lag of our own drives the FMU: x' = w − k·x, w' = 1 − w."""

    class Lag(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            w = self.variable("w", start=0.0, fixed=True)
            self.add_equations(Eq(der(w), 1 - w))

    ev, diagram = EqnEnv(), AcausalDiagram()
    lag, fmu = Lag(ev, "lag"), FmuComponent(ev, "f", decay, parameters=[])
    diagram.add(lag, fmu)
    diagram.connect(lag, "w", fmu, "d_u")
    solution = simulate(AcausalCompiler(ev, diagram)(), 3.0, rtol=1e-9, atol=1e-11, ts=jnp.array([1.0, 3.0]))
    t = np.array([1.0, 3.0])  # x = 2 + 2·exp(−t) + c·exp(−t/2), x(0) = 2
    np.testing.assert_allclose(solution["f.d_x"], 2 + 2 * np.exp(-t) - 2 * np.exp(-t / 2), atol=1e-7)
