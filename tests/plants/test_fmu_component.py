"""FMUs as components: runs and gradients beside closed forms."""

import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fmus import fmpy
from hybrid_models import Ball, SampledPI
from hybrid_models import compiled as hybrid
from problems import compiled

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi import FmuComponent
from jaxonomy_dae.fmi.calls import Calls, Point
from jaxonomy_dae.fmi.compilers import compiler_for, this_platform
from jaxonomy_dae.fmi.described import Described
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
    other = tmp_path / "other.fmu"
    with zipfile.ZipFile(other, "w") as file:
        file.writestr("modelDescription.xml", '<fmiModelDescription fmiVersion="1.0"/>')
    with pytest.raises(ModelError, match="'other.fmu' is of FMI 1.0: export it for FMI 3.0 or 2.0"):
        imported(other)
    other.write_text("none")
    with pytest.raises(ModelError, match="'other.fmu' is no FMU"):
        imported(other)


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


class Resting(Component):
    """x' = u − k·x at rest at first, so that x = u/k."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        k, u, x = self.parameter("k", 0.5), self.input("u", default=0.0), self.variable("x")
        self.add_equations(Eq(der(x), u - k * x))
        self.initially(Eq(der(x), 0))


@pytest.mark.slow
def test_the_start_of_an_fmu_depends_on_its_inputs(tmp_path):
    """The states at the start were those for the inputs that the FMU names."""
    path = compiled(Resting(EqnEnv(), "d")).export_fmu(tmp_path / "resting.fmu", kinds=["model_exchange"])
    fmu = Described(path, "f: ")
    calls = Calls(fmu, [], ["d.k"])
    assert calls.starts_of([0.5])[0] == 0
    np.testing.assert_allclose(calls._starts(np.array([0.0, 3.0, 0.5])), [6.0])
    np.testing.assert_allclose(calls._jacobian_of_starts(np.array([0.0, 3.0, 0.5])), [[0.0, 2.0, -12.0]], atol=1e-6)
    np.testing.assert_allclose(calls._values(Point(0.0, np.array([1.0]), np.array([3.0]), (0.5,), 0)), [2.5])


# --- events ---------------------------------------------------------------------------------------------------------

FALL, G = np.sqrt(2 / 9.81), 9.81


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return hybrid(Ball, "b").export_fmu(folder / "ball.fmu", kinds=["model_exchange"])


@pytest.mark.parametrize("saves", [True, False])
def test_an_event_of_an_fmu_and_its_derivatives(ball, saves):
    """A ball at the floor: (h, v) → (0, −e·v), whether the FMU's state is saved or events are repeated; a state that is
    before the crossing by rounding has the event, too; histories are found again after others."""
    fmu = Described(ball, "f: ")
    assert fmu.saves_states
    fmu.saves_states = saves
    calls = Calls(fmu, ["b.n"], ["b.e", "b.g"])
    p, none = (0.8, G), np.zeros(0)
    begun = calls._after(None, Point(0.0, np.array([1.0, 0.0]), none, p, 0), 0.0)
    down = calls._after((0, False), Point(FALL, np.array([1e-16, -G * FALL]), none, p, int(begun[2])), 0.0)
    np.testing.assert_allclose(down[:2], [0.0, 0.8 * G * FALL], rtol=1e-12, atol=1e-12)
    before, after = (Point(0.5, np.array([0.3, 1.0]), none, p, int(n)) for n in (begun[2], down[2]))
    assert [calls._values(at)[-1] for at in (after, before, after)] == [1.0, 0.0, 1.0]
    idle = calls._after((0, False), Point(0.0, np.array([1.0, 0.0]), none, p, int(begun[2])), 0.0)
    np.testing.assert_array_equal(idle[:2], [1.0, 0.0])  # the map of events asks where nothing happens, at zero, too
    at = Point(FALL, np.array([0.0, -G * FALL]), none, p, int(begun[2]))
    # By (t, h, v, the next time event), and by (e, g).
    slopes = calls._jacobian_of_after((0, False), at, 0.0, False)
    np.testing.assert_allclose(slopes[:2, :3], [[0, 0, 0], [0, 0, -0.8]], atol=1e-7)
    slopes = calls._jacobian_of_after((0, False), at, 0.0, True)
    np.testing.assert_allclose(slopes[:2], [[0, 0], [G * FALL, 0]], atol=1e-6)


def test_a_parameter_at_its_bound_moves_to_one_side(decay):
    """x' = u − k·x with k between 0 and 10: ∂x'/∂k = −x, at a bound, too."""
    calls = Calls(Described(decay, "f: "), [], ["d.k"])
    for k in (0.0, 5.0, 10.0):
        at = Point(0.0, np.array([3.0]), np.zeros(1), (k,), 0)
        np.testing.assert_allclose(calls._jacobian(at, True), [[-3.0]], rtol=1e-9)


@pytest.mark.slow
def test_gradients_through_events_of_an_fmu(ball):
    """Two members of a batch that bounce once, and the gradient of the height by e: g·T·(t − T)."""
    _, system = imported(ball)
    ts = jnp.array([0.4, 0.9])

    def heights(e):
        return simulate(system.with_parameters({"f.b_e": e}), 0.9, rtol=1e-9, atol=1e-11, ts=ts)["f.b_h"]

    e, s = np.array([0.7, 0.8]), 0.9 - FALL
    expected = np.stack([np.full(2, 1 - G * 0.4**2 / 2), e * G * FALL * s - G * s**2 / 2], axis=1)
    np.testing.assert_allclose(jax.vmap(heights)(jnp.asarray(e)), expected, atol=1e-8)
    assert jax.grad(lambda e: heights(e)[-1])(0.8) == pytest.approx(G * FALL * s, rel=1e-6)


@pytest.mark.slow
def test_a_gradient_through_hidden_variables_is_refused(tmp_path):
    """A sampled controller keeps what it computed from the state: the run is right, and no gradient is given."""
    original = hybrid(SampledPI, "c")
    _, system = imported(original.export_fmu(tmp_path / "loop.fmu", kinds=["model_exchange"]))
    ts = jnp.linspace(0.0, 1.05, 8)
    expected = simulate(original, 1.05, rtol=1e-9, atol=1e-11, ts=ts)
    run = simulate(system, 1.05, rtol=1e-9, atol=1e-11, ts=ts)
    np.testing.assert_allclose(run["f.c_x"], expected["c.x"], atol=1e-9)

    def last(gain):
        return simulate(system.with_parameters({"f.c_Kp": gain}), 1.05, ts=ts)["f.c_x"][-1]

    with pytest.raises(Exception, match=r"'der\(c.x\)' depends on 'c.x' at the event, through a discrete variable"):
        jax.grad(last)(2.0)
