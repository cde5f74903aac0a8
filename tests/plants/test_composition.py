"""A compiled system among other things: modules, transforms, solvers, files, jit."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from problems import angle_solution, compiled, mlp, pendulum, rc_circuit, rc_voltage
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der, simulate
from jaxonomy_dae.solvers import Projected

TS = jnp.array([0.5, 1.0, 2.0])


def kvaerno5():
    """Kvaerno5 whose Newton iteration does not give up after two steps."""
    return diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(optx.Chord)())


@pytest.fixture(scope="module")
def rc():
    return rc_circuit()


@pytest.fixture(scope="module")
def plain():
    return pendulum()


# --- as a module -------------------------------------------------------------------------------------------------


class Sensor(eqx.Module):
    """A user's model: a circuit read by an instrument with a gain."""

    circuit: eqx.Module
    gain: jax.Array

    def __call__(self, ts):
        return self.gain * simulate(self.circuit, ts[-1], ts=ts, rtol=1e-10, atol=1e-12)["c.v"]


@pytest.mark.slow
def test_inside_a_users_module_gradients_reach_everything(rc):
    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def last(model):
        return model(TS)[-1]

    value, gradient = last(Sensor(rc, jnp.array(1.5)))
    t, R, C, V = 2.0, 2.0, 0.5, 3.0
    e = np.exp(-t / (R * C))
    assert float(value) == pytest.approx(1.5 * float(rc_voltage(t)), rel=1e-8)  # a hundred times the tolerance
    expected = {"r.R": -V * e * t / (R**2 * C), "c.C": -V * e * t / (R * C**2), "source.V": 1 - e}
    for name, slope in expected.items():
        assert float(gradient.circuit.parameters[name]) == pytest.approx(1.5 * slope, rel=1e-8)
    assert float(gradient.gain) == pytest.approx(V * (1 - e), rel=1e-8)


@pytest.mark.slow
def test_serialised_and_read_back(rc, plain, tmp_path):
    field = jax.jit(lambda system, x: system.vector_field(0.0, x))
    for system in (rc, plain):
        changed = jax.tree.map(lambda leaf: leaf * 1.25, system)
        eqx.tree_serialise_leaves(tmp_path / "system.eqx", changed)
        back = eqx.tree_deserialise_leaves(tmp_path / "system.eqx", system)
        assert eqx.tree_equal(back, changed)
        x = jnp.linspace(0.2, 0.8, len(system.states))
        np.testing.assert_array_equal(field(back, x), field(changed, x))


def test_tree_at_replaces_parameters_and_networks():
    system = learned_decay(mlp(1, 1))
    other = mlp(1, 1, seed=1)
    x = jnp.array([0.7])
    changed = eqx.tree_at(lambda s: s.neural["c.law"], system, other)
    field = eqx.filter_jit(lambda system: (system.vector_field(0.0, x), other(x)))
    np.testing.assert_allclose(*field(changed), rtol=1e-12)  # rounding
    slower = eqx.tree_at(lambda s: s.parameters.values, changed, changed.parameters.values * 3)
    found, law = field(slower)
    np.testing.assert_allclose(found, 3 * np.asarray(law), rtol=1e-12)


def test_systems_are_pytrees_of_arrays(rc):
    leaves = jax.tree.leaves(rc)
    assert leaves and all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert jax.tree.structure(rc) == jax.tree.structure(rc_circuit(R=1.7))  # values are not part of the structure
    assert jax.tree.structure(rc) != jax.tree.structure(pendulum())


def test_systems_of_one_structure_are_stacked(rc):
    """Values are no part of a plan. Of a system's static part, they tell only how fast it decays, to a decade: for
    traced values a solver is chosen by that. So members of an ensemble are one model with other values, however far
    these are apart, and a model compiled with values of another decade says what it differs in.
    """
    far = rc_circuit(R=2e4)
    assert far.plan == rc.plan
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), rc, rc.with_parameters({"r.R": 2e4}))
    rows = eqx.filter_vmap(lambda s: s.vector_field(0.0, jnp.array([1.0])))(stacked)
    np.testing.assert_allclose(rows[:, 0], [(3.0 - 1.0) / (R * 0.5) for R in (2.0, 2e4)], rtol=1e-12)  # rounding
    with pytest.raises(ValueError, match=r"Stiffness\(decays by about 1e-04 per unit of time\)"):
        jax.tree.map(lambda *leaves: jnp.stack(leaves), far, rc)


# --- ensembles ---------------------------------------------------------------------------------------------------


class LearnedDecay(Component):
    """dx/dt = scale·network(x)."""

    def __init__(self, ev, name, network):
        super().__init__(ev, name)
        scale = self.parameter("scale", 1.0)
        x = self.variable("x", start=1.0, fixed=True)
        (law,) = self.learned("law", network, inputs=[x])
        self.add_equations(Eq(der(x), scale * law))


def learned_decay(network):
    return compiled(LearnedDecay(EqnEnv(), "c", network))


@pytest.mark.slow
def test_vmap_over_an_ensemble_of_parameters(rc):
    resistances = jnp.array([0.5, 1.0, 4.0])
    ensemble = eqx.filter_vmap(lambda r: rc.with_parameters({"r.R": r}))(resistances)
    run = eqx.filter_jit(eqx.filter_vmap(lambda s: simulate(s, 2.0, ts=TS, rtol=1e-9, atol=1e-11)))
    solutions = run(ensemble)
    expected = np.array([rc_voltage(TS, R=float(r)) for r in resistances])
    np.testing.assert_allclose(solutions["c.v"], expected, rtol=0, atol=1e-7)  # a hundred times the tolerance
    currents = (3.0 - expected) / np.asarray(resistances)[:, None]
    np.testing.assert_allclose(solutions["r.i"], currents, rtol=0, atol=1e-6)  # solved for, not a state
    assert solutions.constraint_residual().shape == (3, 3, 0) and solutions["time"].shape == (3, 3)


class Decay(eqx.Module):
    """The network u ↦ −k·u, whose ensemble has a closed form."""

    k: jax.Array

    def __call__(self, u):
        return -self.k * u


@pytest.mark.slow
def test_vmap_over_an_ensemble_of_networks():
    rates = jnp.array([0.3, 1.0, 2.5])
    system = learned_decay(Decay(jnp.array(1.0)))
    ensemble = eqx.filter_vmap(lambda k: eqx.tree_at(lambda s: s.neural["c.law"].k, system, k))(rates)
    run = eqx.filter_jit(eqx.filter_vmap(lambda s: simulate(s, 2.0, ts=TS, rtol=1e-9, atol=1e-11)["c.x"]))
    found = run(ensemble)
    np.testing.assert_allclose(found, np.exp(-rates[:, None] * TS), rtol=0, atol=1e-7)  # as above


@pytest.mark.slow
def test_vmap_over_release_angles_at_the_charts_singular_points(plain):
    angles = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2, -1.2, 0.5])
    ts = jnp.array([0.4, 0.8, 1.2])

    @jax.jit
    @jax.vmap
    def swing(angle):
        solution = simulate(
            plain.with_parameters({"pend.initial_theta": angle}), 1.2, ts=ts, rtol=1e-10, atol=1e-12
        )  # fmt: skip
        return jnp.stack([solution[f"pend.{n}"] for n in ("x", "y", "vx", "vy", "lam")])

    found = swing(jnp.asarray(angles))
    expected = [np.stack(angle_solution(a, 0.0, ts)) for a in angles]
    # A thousand times the tolerance: the upright pendulum amplifies errors by exp(3.1·1.2) = 43.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


@pytest.fixture(scope="module")
def ramp_response():
    """dx/dt = u − x from 0 with u = a·t, as a function of a: x(1) = a/e."""
    system = compiled(Driven(EqnEnv(), "c"))

    def last(a):
        return simulate(system, 1.0, ts=jnp.array([1.0]), inputs={"c.u": lambda t: a * t})["c.x"][0]

    return last


@pytest.mark.slow
def test_inputs_may_close_over_what_is_differentiated(ramp_response):
    # The first error estimates are exactly zero: no gradient may flow through the size of the first step.
    assert float(jax.jit(jax.grad(ramp_response))(2.0)) == pytest.approx(np.exp(-1), abs=1e-6)  # the default tolerance


@pytest.mark.slow
def test_inputs_may_close_over_what_is_batched(ramp_response):
    found = jax.jit(jax.vmap(ramp_response))(jnp.array([2.0, 3.0]))
    np.testing.assert_allclose(found, np.array([2, 3]) * np.exp(-1), rtol=0, atol=3e-6)  # the default tolerance


class Driven(Component):
    """dx/dt = u − x."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), self.input("u") - x))


@pytest.mark.slow
def test_jvp(rc):
    def voltage(r):
        system = rc.with_parameters({"r.R": r})
        return simulate(system, 2.0, ts=TS, rtol=1e-10, atol=1e-12)["c.v"]

    value, tangent = jax.jit(lambda r: jax.jvp(voltage, (r,), (jnp.array(1.0),)))(jnp.array(2.0))
    t = np.asarray(TS)
    np.testing.assert_allclose(value, rc_voltage(t), rtol=1e-8)  # a hundred times the tolerance
    np.testing.assert_allclose(tangent, -3.0 * np.exp(-t) * t / 2, rtol=1e-8)  # d/dR of V(1 − exp(−t/RC)), RC = 1


# --- solvers -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_raw_diffrax(rc):
    @jax.jit
    def solve():
        solved = diffrax.diffeqsolve(
            diffrax.ODETerm(rc.vector_field),
            diffrax.Tsit5(),
            0.0,
            2.0,
            0.1,
            rc.initialize(),
            saveat=diffrax.SaveAt(ts=TS),
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-11),
        )
        return jax.vmap(lambda t, x: rc.observe(["c.v", "r.i", "source.i"], t, x))(solved.ts, solved.ys)

    current = (3.0 - rc_voltage(TS)) / 2.0
    np.testing.assert_allclose(solve(), np.stack([rc_voltage(TS), current, -current], axis=1), rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, options",
    [
        pytest.param(kvaerno5(), {}, id="Kvaerno5", marks=pytest.mark.slow),
        # 400 steps of order 4 and h = 0.005: error below 1e-11.
        pytest.param(
            diffrax.Dopri5(), {"stepsize_controller": diffrax.StepTo(ts=jnp.linspace(0.0, 2.0, 401))}, id="StepTo"
        ),
        pytest.param(diffrax.Dopri8(), {}, id="Dopri8", marks=pytest.mark.slow),
    ],
)
def test_other_solvers(rc, solver, options):
    solution = simulate(rc, 2.0, ts=TS, solver=solver, rtol=1e-8, atol=1e-10, **options)
    np.testing.assert_allclose(solution["c.v"], rc_voltage(TS), rtol=0, atol=1e-6)  # a hundred times the tolerance
    if "stepsize_controller" in options:
        assert solution.stats["num_steps"] == 400


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(Projected(diffrax.Tsit5()), id="explicit", marks=pytest.mark.slow),
        pytest.param(diffrax.Dopri5(), id="Dopri5", marks=pytest.mark.slow),
        pytest.param(kvaerno5(), id="Kvaerno5", marks=pytest.mark.slow),
    ],
)
def test_projected_solvers(plain, solver):
    solution = simulate(plain, 1.2, ts=jnp.array([0.4, 0.8, 1.2]), solver=solver, rtol=1e-9, atol=1e-11)
    reference = angle_solution(-1.2, 0.0, solution.ts)
    np.testing.assert_allclose(solution["pend.x"], reference.x, rtol=0, atol=1e-7)  # a hundred times the tolerance
    assert np.max(np.abs(solution.constraint_residual())) < 1e-12
    assert solution.stats["num_steps"] < 200  # Kvaerno5's default iteration needs over 800


@pytest.mark.slow
def test_projection_may_be_given_by_hand(plain):
    solver = Projected(diffrax.Tsit5(), plain.project)
    solved = diffrax.diffeqsolve(
        diffrax.ODETerm(plain.vector_field),
        solver,
        0.0,
        1.2,
        0.01,
        plain.initialize(),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-11),
    )
    x = solved.ys[-1]
    assert np.max(np.abs(plain.constraint_residual(1.2, x))) < 1e-12
    names = ["pend.x", "pend.y", "pend.vx", "pend.vy"]
    expected = np.stack(angle_solution(-1.2, 0.0, [1.2]))[:4, 0]
    np.testing.assert_allclose(plain.observe(names, 1.2, x), expected, rtol=0, atol=1e-7)


def test_projected_without_a_projection_says_so(plain):
    with pytest.raises(ValueError, match=r"Projected\(solver, system\.project\)"):
        diffrax.diffeqsolve(
            diffrax.ODETerm(plain.vector_field), Projected(diffrax.Tsit5()), 0.0, 1.0, 0.1, jnp.zeros(4)
        )
    with pytest.raises(ValueError, match="wrapped in Projected already"):
        Projected(Projected(diffrax.Tsit5()))


# --- compilation -------------------------------------------------------------------------------------------------


class Traces:
    """How often Python ran a network, that is, how often it was traced. The count is no part of what is computed."""

    def __init__(self):
        self.count = 0

    def __content__(self):
        return "traces", ()


class Counting(eqx.Module):
    """The network u ↦ −k·u, counting its traces."""

    k: jax.Array
    traces: Traces = eqx.field(static=True)

    def __call__(self, u):
        self.traces.count += 1
        return -self.k * u


@pytest.mark.slow
def test_nothing_is_traced_again_for_new_values():
    traces = Traces()
    system = learned_decay(Counting(jnp.array(1.0), traces))

    def run(system, x0, ts):
        return simulate(system, 2.0, ts=ts, initial={"c.x": x0})["c.x"]

    first = run(system, 1.0, TS)
    before = traces.count
    assert before > 0
    second = run(system.with_parameters({"c.scale": 2.0}), 1.0, TS)
    third = run(eqx.tree_at(lambda s: s.neural["c.law"].k, system, jnp.array(3.0)), 1.0, TS + 0.0)
    fourth = run(system, 0.5, TS)
    np.testing.assert_allclose(second, np.exp(-2 * TS), atol=1e-5)  # the default tolerance 1e-6
    np.testing.assert_allclose(third, np.exp(-3 * TS), atol=1e-5)
    np.testing.assert_allclose(fourth, first / 2, atol=1e-5)
    assert traces.count == before
    run(system, 1.0, TS[:2])
    assert traces.count > before  # a new shape; so the count does count


@pytest.mark.slow
def test_inlines_inside_jit():
    traces = Traces()
    system = learned_decay(Counting(jnp.array(1.0), traces))

    @jax.jit
    def last(scale):
        return simulate(system.with_parameters({"c.scale": scale}), 2.0, ts=TS)["c.x"][-1]

    assert float(last(1.0)) == pytest.approx(np.exp(-2), abs=1e-5)
    before = traces.count
    assert float(last(0.5)) == pytest.approx(np.exp(-1), abs=1e-5)
    assert traces.count == before
    text = str(jax.make_jaxpr(last)(1.0))  # one program, which never calls back to Python
    assert "while" in text and "callback" not in text


def test_a_system_compiled_inside_a_traced_function():
    """Its parameters are numbers: it may be kept."""
    kept = []

    @jax.jit
    def slope(x0):
        if not kept:
            kept.append(rc_circuit())
        return kept[0].vector_field(0.0, kept[0].initialize(initial={"c.v": x0}))

    assert float(slope(0.5)[0]) == pytest.approx((3.0 - 0.5) / (2.0 * 0.5), rel=1e-12)
    assert float(kept[0].parameters["r.R"]) == 2.0
