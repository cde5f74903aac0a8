"""Learned terms: corrections of derivatives, networks in algebraic equations, networks that constraints reach.

The networks here are known laws, written as functions, so that the solutions have closed forms.
"""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from problems import GRAVITY, RELEASE, compiled, drag_on, mlp, oscillator, pendulum
from shared_models import LearnedResistor, discharge
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, NeuralDAEBlock, der, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground
from jaxonomy_dae.library.planar import PlanarPendulum

TS = jnp.linspace(0.0, 2.0, 9)
T = np.asarray(TS)
SOLVE = dict(rtol=1e-9, atol=1e-11)
CLOSE = dict(rtol=0, atol=1e-7)  # a hundred times the tolerance of the solves


class Free(Component):
    """dx/dt = 0, dy/dt = 0: all motion comes from corrections."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=1.0, fixed=True), self.variable("y", start=2.0, fixed=True)
        self.add_equations(Eq(der(x), 0), Eq(der(y), 0))


def corrected(*blocks, **options):
    ev, diagram = EqnEnv(), AcausalDiagram()
    component = Free(ev, "c")
    diagram.add(component)
    for k, block in enumerate(blocks):
        given = {"name": f"block{k}", "targets": [(component, "x")]} | block
        diagram.add_neural_correction_block(NeuralDAEBlock(given.pop("network"), given.pop("theta", None), **given))
    return AcausalCompiler(ev, diagram, **options)()


def slopes(system, t=0.0, **at):
    """The vector field by name, at a point given by name."""
    x = jnp.array([at[n.removeprefix("c.")] for n in system.states])
    return {n.removeprefix("c."): float(v) for n, v in zip(system.states, field(system, t, x), strict=True)}


@eqx.filter_jit
def field(system, t, x):
    return system.vector_field(t, x)


# --- corrections -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.long("all models with networks in one program")
def test_several_blocks_on_one_target_add_up():
    solution = together()
    assert [name for name in plant().neural if name.startswith("block")] == ["block0", "block1", "block2"]
    np.testing.assert_allclose(solution["free.x"], 2.0 - np.exp(-1.5 * T), **CLOSE)
    np.testing.assert_allclose(solution["block1[0]"], -0.5 * (2.0 - np.exp(-1.5 * T)), **CLOSE)
    np.testing.assert_allclose(solution["free.y"], 2.0, **CLOSE)


@pytest.mark.parametrize("inject", ["equation", "row"])
def test_module_and_function_with_weights_are_the_same(inject):
    options = {"state_selection": "dummy_derivatives"}
    module = mlp(2, 2)
    targets = {"targets": ["c.x", "c.y"], "inject": inject}
    a = corrected({"network": module, "name": "law", **targets}, **options)
    weights, static = eqx.partition(module, eqx.is_array)
    b = corrected(
        {"network": lambda t, u, theta: eqx.combine(theta, static)(u), "theta": weights, "name": "law", **targets},
        **options,
    )
    assert jax.tree.leaves(a.neural["law"]) == jax.tree.leaves(b.neural["law"]) or eqx.tree_equal(
        eqx.filter(a.neural["law"], eqx.is_array), b.neural["law"]
    )
    expected = module(jnp.array([0.3, -0.8]))
    for system in (a, b):
        found = slopes(system, x=0.3, y=-0.8)
        np.testing.assert_allclose([found["x"], found["y"]], expected, rtol=1e-14)  # rounding


def test_a_flat_theta_of_numbers_becomes_an_array():
    system = corrected({"network": lambda t, u, theta: -theta[0] * u, "theta": np.array([2.0])})
    assert isinstance(system.neural["block0"], jax.Array)
    assert slopes(system, x=3.0, y=0.0) == {"x": -6.0, "y": 0.0}


@pytest.mark.parametrize("inject", ["equation", "row"])
def test_inputs_in_the_order_given_with_time_among_them(inject):
    block = {
        "network": lambda u: jnp.array([u[0] + 10 * u[1] + 100 * u[2]]),
        "inputs": ["c.y", "time", "c.x"],
        "inject": inject,
    }
    system = corrected(block, state_selection="dummy_derivatives")
    assert slopes(system, t=0.5, x=0.25, y=2.0) == {"x": 2.0 + 5.0 + 25.0, "y": 0.0}


@pytest.mark.slow
def test_time_reaches_a_function_with_weights():
    np.testing.assert_allclose(together()["timed.x"], 3.0 - 2.0 * np.cos(T), **CLOSE)


def test_the_order_of_targets_is_the_order_of_outputs():
    system = corrected({"network": lambda u: jnp.array([1.0, 2.0]) + 0 * u, "targets": ["c.y", "c.x"]})
    assert slopes(system, x=0.0, y=0.0) == {"x": 2.0, "y": 1.0}


class Nested(Component):
    """A component around another."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        self.add(Free(ev, "inner"))


@pytest.mark.parametrize("by_name", [False, True])
def test_targets_inside_other_components(by_name):
    ev, diagram = EqnEnv(), AcausalDiagram()
    outer = Nested(ev, "outer")
    diagram.add(outer)
    target = "outer.inner.y" if by_name else (outer.inner, "y")
    diagram.add_neural_correction_block(NeuralDAEBlock(lambda u: 3 * u, targets=[target], name="b"))
    system = AcausalCompiler(ev, diagram)()
    slope = dict(zip(system.states, field(system, 0.0, jnp.array([2.0, 2.0])), strict=True))
    assert float(slope["outer.inner.x"]) == 0.0 and float(slope["outer.inner.y"]) == 6.0


@pytest.mark.parametrize("mode", ["auto", "dummy_derivatives"])
def test_a_corrected_position_moves_what_is_attached(mode):
    """x' = v + N is the velocity that the damper sees: M·v' = −K·x − D·(v + N)."""
    system = oscillator(
        drag_on("s", network=lambda u: 0.5 * u), compiler={"state_selection": mode}, M=2.0, D=0.6, K=5.0
    )  # fmt: skip
    at = {"mass.s": 0.4, "mass.v": -0.3}
    x = jnp.array([at[n] for n in system.states])
    slope = dict(zip(system.states, field(system, 0.0, x), strict=True))
    assert float(slope["mass.s"]) == pytest.approx(-0.3 + 0.2, rel=1e-12)
    assert float(slope["mass.v"]) == pytest.approx((-5.0 * 0.4 - 0.6 * (-0.3 + 0.2)) / 2.0, rel=1e-12)


# --- in algebraic equations --------------------------------------------------------------------------------------


def diode_discharge(t, a=0.4, C=0.5, v0=1.0):
    """C·dv/dt = −a·(exp(v) − 1) in closed form."""
    return -np.log(1 - (1 - np.exp(-v0)) * np.exp(-a * t / C))


def explicit_law(v):
    return 0.4 * jnp.expm1(v)


def implicit_law(i):
    """The current is found from v = law(i): a nonlinear block around the network."""
    return jnp.log1p(i / 0.4)


@pytest.mark.slow
def test_a_resistor_with_a_learned_law():
    solution, v = together(), diode_discharge(T)
    np.testing.assert_allclose(solution["store.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["leak.i"], 0.4 * np.expm1(v), **CLOSE)
    np.testing.assert_allclose(solution["leak.law"], solution["leak.i"], **CLOSE)


def test_a_law_that_is_solved_for_its_input():
    system = discharge(implicit_law, "v")

    @jax.jit
    @jax.vmap
    def begins(v):
        at = system.with_parameters({"c.initial_voltage": v})
        x = at.initialize()
        return at.observe("r.i", 0.0, x), at.vector_field(0.0, x)[0]

    v = np.array([0.2, 1.0, 2.0])
    current, slope = begins(v)
    np.testing.assert_allclose(current, 0.4 * np.expm1(v), rtol=1e-9)
    np.testing.assert_allclose(slope, -0.4 * np.expm1(v) / 0.5, rtol=1e-9)


@pytest.mark.slow
def test_a_run_with_a_law_that_is_solved_for_its_input():
    solution = simulate(discharge(implicit_law, "v"), 2.0, ts=TS, **SOLVE)
    v = diode_discharge(T)
    np.testing.assert_allclose(solution["c.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["r.i"], 0.4 * np.expm1(v), **CLOSE)
    np.testing.assert_allclose(solution["r.law"], solution["r.v"], **CLOSE)


def test_gradients_reach_the_weights_inside_an_algebraic_equation():
    """dv/dt of a discharge through i = k·v has the derivative −v/C with respect to k."""

    class Conductance(eqx.Module):
        k: jax.Array

        def __call__(self, v):
            return self.k * v

    system = discharge(Conductance(jnp.array(0.7)), "i")

    def slope(s):
        return s.vector_field(0.0, jnp.array([1.3]))[0]

    gradient = eqx.filter_jit(eqx.filter_grad(slope))(system)
    assert float(gradient.neural["r.law"].k) == pytest.approx(-1.3 / 0.5, rel=1e-12)


@pytest.mark.slow
def test_a_correction_that_depends_on_the_tension():
    """Friction of the link, N = −0.3·lam on vx: the multiplier depends on the force and the force on the multiplier."""
    solution, ts = together(), TS[TS <= 1.0]

    def tension(theta, omega):  # 2·lam = ω² − g·sin θ + cos θ·N, solved for lam
        return (omega**2 - GRAVITY * np.sin(theta)) / (2 + 0.3 * np.cos(theta))

    def angular(t, state):
        theta, omega = state
        return omega, -GRAVITY * np.cos(theta) + 0.3 * tension(theta, omega) * np.sin(theta)

    angle = scipy.integrate.solve_ivp(
        angular, (0.0, 1.0), (RELEASE, 0.0), "DOP853", np.asarray(ts), rtol=1e-12, atol=1e-12
    ).y
    np.testing.assert_allclose(solution["pend.x"][: len(ts)], np.cos(angle[0]), **CLOSE)
    np.testing.assert_allclose(
        solution["pend.lam"][: len(ts)], tension(*angle), rtol=0, atol=1e-6
    )  # as in test_pendulum.py


def test_networks_keep_their_precision():
    """Weights drawn in single precision stay so, in a model that runs in double."""
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_array(leaf) else leaf, mlp(1, 1))
    system = corrected({"network": single})

    def slope(system):
        return jnp.sum(system.vector_field(0.0, jnp.array([0.3, 0.0])))

    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(slope))(system)
    assert float(value) == pytest.approx(float(mlp(1, 1)(jnp.array([0.3]))[0]), abs=1e-6)  # single precision
    assert value.dtype == jnp.float64
    assert {leaf.dtype for leaf in jax.tree.leaves(gradient.neural)} == {jnp.dtype("float32")}


# --- in constraints ----------------------------------------------------------------------------------------------


class Cam(Component):
    """A follower at y = network(x) on a cam that moves harmonically; the force that moves it is m·d²y/dt².

    The constraint y − network(x) = 0 is differentiated twice, the network with it.
    """

    def __init__(self, ev, name, network):
        super().__init__(ev, name)
        m = self.parameter("m", 2.0)
        x, u = self.variable("x", start=0.8, fixed=True), self.variable("u", start=0.0, fixed=True)
        y, v, f = self.variable("y"), self.variable("v"), self.variable("f")
        (profile,) = self.learned("profile", network, inputs=[x])
        self.add_equations(Eq(der(x), u), Eq(der(u), -x))
        self.add_equations(Eq(der(y), v), Eq(m * der(v), f), Eq(y, profile))


@pytest.mark.parametrize("mode", ["auto", pytest.param("dummy_derivatives", marks=pytest.mark.slow)])
def test_constraints_differentiate_networks_exactly(mode):
    if mode == "auto":
        solution = together()
    else:
        solution = simulate(compiled(Cam(EqnEnv(), "cam", jnp.tanh), state_selection=mode), 2.0, ts=TS, **SOLVE)
    x, u = 0.8 * np.cos(T), -0.8 * np.sin(T)
    y = np.tanh(x)
    slope = 1 - y**2
    np.testing.assert_allclose(solution["cam.x"], x, **CLOSE)
    np.testing.assert_allclose(solution["cam.y"], y, **CLOSE)
    np.testing.assert_allclose(solution["cam.v"], slope * u, **CLOSE)
    np.testing.assert_allclose(solution["cam.f"], 2.0 * (-2 * y * slope * u**2 - slope * x), **CLOSE)


# --- one run ---------------------------------------------------------------------------------------------------------


@functools.cache
def plant():
    """Models with networks that know nothing of each other, in one system."""
    ev = EqnEnv()
    free, timed, cam = Free(ev, "free"), Free(ev, "timed"), Cam(ev, "cam", jnp.tanh)
    store, ground = Capacitor(ev, "store", 0.5, initial_voltage=1.0), Ground(ev, "g")
    leak = LearnedResistor(ev, "leak", explicit_law, "i")
    bob = PlanarPendulum(ev, "pend", initial_theta=RELEASE)
    speed = Speedometer(ev)

    def sine(t, u, theta):
        return theta * jnp.sin(t) + 0 * u

    laws = [lambda u: -u, lambda u: -0.5 * u, lambda u: 0 * u + 3.0]
    blocks = [NeuralDAEBlock(law, targets=[(free, "x")], name=f"block{k}") for k, law in enumerate(laws)]
    blocks += [
        NeuralDAEBlock(sine, jnp.array(2.0), targets=[(timed, "x")], name="sine"),
        drag_on("vx", network=lambda u: -0.3 * u, inputs=["pend.lam"])(bob),
        damping(speed, "equation"),
    ]
    return compiled(
        free, timed, cam, store, leak, ground, bob, speed, blocks=blocks,
        connect=[(store.p, leak.p), (store.n, leak.n, ground.p)],
    )  # fmt: skip


@functools.cache
def together():
    return simulate(plant(), 2.0, ts=TS, solver=diffrax.Tsit5(), adjoint=diffrax.ForwardMode(), **SOLVE)


class Bead(Component):
    """A bead on the wire y = network(x), no friction: m·r'' = λ·(−N'(x), 1) + (0, −m·g), N' by a second network."""

    def __init__(self, ev, name, network, slope):
        super().__init__(ev, name)
        m, g = self.parameter("m", 1.5), self.parameter("g", 9.81)
        x, y = self.variable("x", start=0.6, fixed=True), self.variable("y")
        vx, vy, lam = self.variable("vx", start=0.0, fixed=True), self.variable("vy"), self.variable("lam")
        (height,) = self.learned("height", network, inputs=[x])
        (rise,) = self.learned("rise", slope, inputs=[x])
        self.add_equations(
            Eq(der(x), vx), Eq(der(y), vy), Eq(m * der(vx), -lam * rise), Eq(m * der(vy), lam - m * g), Eq(y, height)
        )


@pytest.mark.slow
def test_a_bead_on_a_learned_wire_keeps_its_energy():
    system = compiled(Bead(EqnEnv(), "b", lambda x: x**2, lambda x: 2 * x))
    solution = simulate(system, 2.0, ts=TS, **SOLVE)
    x, y, vx, vy = (np.asarray(solution[f"b.{n}"]) for n in ("x", "y", "vx", "vy"))
    assert np.ptp(x) > 1.0  # it swings from side to side
    np.testing.assert_allclose(y, x**2, **CLOSE)
    np.testing.assert_allclose(vy, 2 * x * vx, **CLOSE)
    np.testing.assert_allclose(0.5 * (vx**2 + vy**2) + 9.81 * y, 9.81 * 0.36, rtol=0, atol=1e-6)  # summed over steps
    # At the start, at rest: x'' = −2x·g/(1 + 4x²), λ = m(g + y''), y'' = 2x·x''.
    a = -2 * 0.6 * 9.81 / (1 + 4 * 0.36)
    assert float(solution["b.lam"][0]) == pytest.approx(1.5 * (9.81 + 1.2 * a), abs=1e-7)


def test_the_structure_does_not_depend_on_the_weights():
    reports = {str(pendulum(drag_on("vx", "vy", network=mlp(2, 2, seed=k))).report) for k in range(3)}
    zero = jax.tree.map(lambda leaf: 0 * leaf if eqx.is_array(leaf) else leaf, mlp(2, 2))
    reports.add(str(pendulum(drag_on("vx", "vy", network=zero)).report))
    assert len(reports) == 1


def test_row_injection_leaves_the_constraint_alone():
    """What tells it from a force: λ is as if the correction were 0, and the other rows are untouched."""
    options = {"state_selection": "dummy_derivatives", "prefer_states": ("pend.vx", "pend.x")}
    plain = pendulum(compiler=options)
    row = pendulum(drag_on("vx", network=lambda u: 0 * u + 5.0, inject="row"), compiler=options)

    @eqx.filter_jit
    def released(system):
        return system.vector_field(0.0, at), system.observe("pend.lam", 0.0, at)

    at = jnp.array([np.cos(RELEASE), 0.0, np.sin(RELEASE)])
    (slope, lam), (slope_row, lam_row) = released(plain), released(row)
    assert (row.states, row.carried) == (["pend.x", "pend.vx"], ["pend.y"]) == (plain.states, plain.carried)
    np.testing.assert_allclose((slope_row - slope)[:2], [0.0, 5.0], atol=1e-12)  # rounding, here and below
    assert float(lam_row) == pytest.approx(float(lam), rel=1e-12)


class Speedometer(Component):
    """A mass on a spring whose speed `v` is shown in km/h for x in metre, and whose position `w` in other units."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x = self.variable("x", start=1.0, fixed=True)
        v, w = self.variable("v", start=0.0, fixed=True), self.variable("w")
        self.add_equations(v - 3.6 * der(x), der(v) + 3.6 * 2.0 * x, w + 5 * x)


def damping(part, inject):
    """A correction −v/2 of the rate of v."""
    law = jnp.array(-0.5)
    return NeuralDAEBlock(
        lambda t, u, theta: (theta * u[0])[None], law, targets=[(part, "v")], name="damping", inject=inject
    )  # fmt: skip


@pytest.mark.parametrize("inject", [pytest.param("row", marks=pytest.mark.slow), "equation"])
def test_a_correction_of_a_multiple(inject):
    """A correction −v/2 of the rate of v = 3.6·x' is the damping of x'' + x'/2 + 2·x = 0, in closed form."""
    if inject == "equation":
        solution = together()
    else:
        part = Speedometer(EqnEnv())
        system = compiled(part, blocks=[damping(part, inject)], state_selection="dummy_derivatives")
        assert len(system.states) == 2
        solution = simulate(system, 2.0, ts=TS, **SOLVE)
    a, w = 0.25, np.sqrt(2.0 - 0.25**2)
    x = np.exp(-a * T) * (np.cos(w * T) + a / w * np.sin(w * T))
    speed = -2.0 / w * np.exp(-a * T) * np.sin(w * T)
    np.testing.assert_allclose(solution["c.x"], x, **CLOSE)
    np.testing.assert_allclose(solution["c.v"], 3.6 * speed, **CLOSE)
    np.testing.assert_allclose(solution["c.w"], -5 * x, **CLOSE)
