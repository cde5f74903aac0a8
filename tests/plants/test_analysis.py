"""Steady states, linear state spaces, frequency responses and sweeps, against closed forms."""

import functools
import sys

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, oscillator, pendulum, rc_circuit
from sympy import Eq
from trajectories import solution_of

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.thermal as th
import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import (
    Component,
    EqnEnv,
    ModelError,
    SteadyStateError,
    der,
    frequency_response,
    linearize,
    simulate,
    steady_state,
    sweep,
)

# Newton's last step leaves rounding errors, some of them magnified by the condition of these small models.
ROUNDING = 1e-11

R, L, K, J, D = 1.2, 1e-2, 0.1, 1e-3, 2e-3


@functools.cache
def motor():
    """A DC motor at a voltage given as an input; its angle is a free integrator."""
    ev = EqnEnv()
    machine, source = el.DCMotor(ev, "motor", R=R, L=L, k=K, J=J, d=D), el.SignalVoltage(ev, "source")
    ground = el.Ground(ev, "ground")
    return compiled(machine, source, ground, connect=[(source.p, machine.p), (source.n, machine.n, ground.p)])


@functools.cache
def radiator():
    """A body that is heated and loses the heat by radiation: C·dT/dt = Q − eps·sigma·A·(T⁴ − T0⁴)."""
    ev = EqnEnv()
    body, heater = th.HeatCapacitor(ev, "body", C=50.0), th.HeatFlowSource(ev, "heater")
    skin, space = th.Radiation(ev, "skin", eps=0.8, A=0.5), th.FixedTemperature(ev, "space", T=250.0)
    return compiled(
        body, heater, skin, space, connect=[(heater.heat, body.heat, skin.port_a), (skin.port_b, space.heat)]
    )


@functools.cache
def warm():
    return steady_state(radiator(), inputs={"heater.Q_flow": 100.0})


@functools.cache
def turning():
    """The motor at 3 V."""
    return steady_state(motor(), inputs={"source.u": 3.0}, drifting=["motor.rotor.phi"])


@functools.cache
def spring():
    return linearize(oscillator(), [], ["mass.s"])


@functools.cache
def run():
    """A run of the oscillator, as it might be."""
    return solution_of(oscillator(), [0.0, 0.4, 1.1], [[0.7, -0.4], [0.4, -0.9], [-0.1, 0.2]])


def radiating(Q, eps=0.8, A=0.5, T0=250.0):
    return (T0**4 + Q / (eps * th.STEFAN_BOLTZMANN * A)) ** 0.25


@functools.cache
def rectifier():
    """A source behind a resistor and a diode charges a capacitor with a load: the diode's voltage is implicit."""
    ev = EqnEnv()
    source, r, d = el.SignalVoltage(ev, "source"), el.Resistor(ev, "r", 10.0), el.Diode(ev, "d")
    c, load, ground = el.Capacitor(ev, "c", 1e-3), el.Resistor(ev, "load", 500.0), el.Ground(ev, "ground")
    return compiled(
        source, r, d, c, load, ground,
        connect=[(source.p, r.p), (r.n, d.p), (d.n, c.p, load.p), (c.n, load.n, source.n, ground.p)],
    )  # fmt: skip


# --- steady states -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_thermal_chain():
    """Five capacities between two temperatures, one of them heated: the temperatures solve a linear system."""
    ev = EqnEnv()
    G, Q = [3.0, 1.5, 4.0, 2.5, 1.0, 2.0], 40.0
    warm, cold = th.FixedTemperature(ev, "warm", T=350.0), th.FixedTemperature(ev, "cold", T=280.0)
    bodies = [th.HeatCapacitor(ev, f"b{k}", C=10.0 ** (k - 2)) for k in range(5)]
    links = [th.ThermalConductor(ev, f"g{k}", G=g) for k, g in enumerate(G)]
    heater = th.HeatFlowSource(ev, "heater")
    ends = [warm.heat, *(b.heat for b in bodies), cold.heat]
    joined = [(ends[k], links[k].port_a) for k in range(6)] + [(links[k].port_b, ends[k + 1]) for k in range(6)]
    system = compiled(warm, cold, *bodies, *links, heater, connect=[*joined, (heater.heat, bodies[2].heat)])
    point = steady_state(system, inputs={"heater.Q_flow": Q})
    matrix = np.diag(np.add(G[:-1], G[1:])) - np.diag(G[1:-1], 1) - np.diag(G[1:-1], -1)
    right = np.array([G[0] * 350.0, 0.0, Q, 0.0, G[-1] * 280.0])
    T = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(point[[f"b{k}.T" for k in range(5)]], T, rtol=ROUNDING)
    np.testing.assert_allclose(point["g5.Q_flow"], G[-1] * (T[-1] - 280.0), rtol=ROUNDING)
    np.testing.assert_allclose(point["der(b3.T)"], 0.0, atol=ROUNDING * G[3] * 350.0 / 10.0)
    assert point.residual <= 1 and float(point["time"]) == 0.0


def temperature(Q, eps):
    system = radiator().with_parameters({"skin.eps": eps})
    return steady_state(system, inputs={"heater.Q_flow": Q}, throw=False)["body.T"]


@pytest.mark.slow
def test_derivatives_of_a_steady_state():
    """T = (T0⁴ + Q/(eps·sigma·A))^¼: derivatives by parameters and inputs, inside jit and vmap."""
    at = jnp.array([20.0, 100.0, 500.0]), jnp.array([0.8, 0.8, 0.3])
    found, known = (
        jax.jit(jax.vmap(jax.value_and_grad(f, (0, 1))))(*at)
        for f in (temperature, functools.partial(radiating, A=0.5))
    )
    np.testing.assert_allclose(found[0], known[0], rtol=ROUNDING)
    np.testing.assert_allclose(found[1], known[1], rtol=1e-10)  # a division by the slope more


@pytest.mark.slow
def test_second_derivatives_of_a_steady_state():
    at = (jnp.array(100.0), jnp.array(0.8))
    found, known = (jax.jit(jax.hessian(f, (0, 1)))(*at) for f in (temperature, functools.partial(radiating, A=0.5)))
    np.testing.assert_allclose(found, known, rtol=1e-9)


@pytest.mark.slow
def test_redundant_states_of_a_pendulum():
    """All candidates are kept as states, with x² + y² = L² and its derivative: at rest the rod carries the weight,
    2·lam·L = m·g."""
    system = pendulum()
    assert len(system.states) == 4 and system.plan.n_constraints == 2
    point = steady_state(system)
    np.testing.assert_allclose(point[["pend.x", "pend.y", "pend.lam"]], [0.0, -1.0, 9.81 / 2], atol=ROUNDING)
    upright = steady_state(system, initial={"pend.x": 1e-3, "pend.y": jnp.sqrt(1 - 1e-6)})
    np.testing.assert_allclose(upright[["pend.x", "pend.y", "pend.lam"]], [0.0, 1.0, -9.81 / 2], atol=ROUNDING)

    def multiplier(length):
        return steady_state(system.with_parameters({"pend.L": length}))["pend.lam"]

    np.testing.assert_allclose(jax.jit(jax.grad(multiplier))(1.0), -9.81 / 2, rtol=1e-10)  # lam = m·g/(2·L)


@pytest.mark.slow
def test_an_implicit_block():
    point = steady_state(rectifier(), inputs={"source.u": 3.0})
    assert rectifier().carried
    i, v = float(point["d.i"]), float(point["d.v"])
    np.testing.assert_allclose(i, 1e-9 * np.expm1(v / 0.04) + v / 1e8, rtol=1e-9)  # exp magnifies rounding by v/Vt
    np.testing.assert_allclose(v + i * (10.0 + 500.0), 3.0, rtol=ROUNDING)


@pytest.mark.slow
def test_a_free_integrator_is_named():
    with pytest.raises(SteadyStateError, match=r"singular: nothing determines 'motor\.rotor\.phi'.*drifting=\['motor"):
        steady_state(motor(), inputs={"source.u": 0.0})
    message = r"no equilibrium.*der\(motor\.rotor\.phi\) = .*drifting=\['motor\.rotor\.phi'\]"
    with pytest.raises(SteadyStateError, match=message):
        steady_state(motor(), inputs={"source.u": 3.0})
    speed = 3.0 * K / (R * D + K**2)
    np.testing.assert_allclose(turning()[["motor.rotor.w", "der(motor.rotor.phi)"]], [speed, speed], rtol=ROUNDING)
    nothing = steady_state(motor(), inputs={"source.u": 3.0}, throw=False)
    assert np.isnan(nothing["motor.rotor.w"])


@pytest.mark.slow
def test_no_equilibrium_inside_jit():
    def state(u, throw=None):
        return steady_state(motor(), inputs={"source.u": u}, throw=throw).x

    assert np.isnan(jax.jit(state)(3.0)).all()
    with pytest.raises(Exception, match="no equilibrium was found"):
        jax.block_until_ready(eqx.filter_jit(state)(3.0, throw=True))


def test_a_common_change_is_named():
    """Two bodies that exchange heat with each other alone: their common temperature is free."""
    ev = EqnEnv()
    a, b, link = th.HeatCapacitor(ev, "a"), th.HeatCapacitor(ev, "b"), th.ThermalConductor(ev, "link")
    system = compiled(a, b, link, connect=[(a.heat, link.port_a), (link.port_b, b.heat)])
    with pytest.raises(SteadyStateError, match=r"a common change of a\.T, b\.T"):
        steady_state(system)


@pytest.mark.slow
@pytest.mark.parametrize("C1, C2, G", [(1.0, 1.0, 1.0), (1e-9, 1e6, 1e-6), (1e-12, 1e12, 1e5)])
def test_units_decide_nothing(C1, C2, G):
    """A body that hangs by a thousandth of the conductance between the two is held; without it, neither is."""
    for held in (True, False):
        ev = EqnEnv()
        a, b, link = th.HeatCapacitor(ev, "a", C=C1), th.HeatCapacitor(ev, "b", C=C2), th.ThermalConductor(ev, "l", G=G)
        thread = th.ThermalConductor(ev, "thread", G=1e-3 * G)
        room = th.FixedTemperature(ev, "room", T=310.0)
        parts = (a, b, link, thread, room) if held else (a, b, link)
        joined = [(a.heat, link.port_a), (link.port_b, b.heat)]
        system = compiled(
            *parts, connect=[*joined, (b.heat, thread.port_a), (thread.port_b, room.heat)][: 4 if held else 2]
        )
        if held:
            np.testing.assert_allclose(steady_state(system)[["a.T", "b.T"]], 310.0, rtol=ROUNDING)
            continue
        with pytest.raises(SteadyStateError, match=r"a common change of a\.T, b\.T"):
            steady_state(system)


@pytest.mark.slow
def test_no_equilibrium():
    class Fleeing(Component):
        """dx/dt = 1 + x² never vanishes."""

        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=0.5)
            self.add_equations(Eq(der(x), 1 + x**2))

    system = compiled(Fleeing(EqnEnv(), "c"))
    with pytest.raises(SteadyStateError, match=r"no equilibrium was found.*der\(c\.x\) = .*"):
        steady_state(system)


def test_arguments_of_a_steady_state():
    with pytest.raises(ModelError, match=r"drifting: 'motor\.resistor\.v' is neither a state"):
        steady_state(motor(), inputs={"source.u": 0.0}, drifting=["motor.resistor.v"])
    with pytest.raises(ModelError, match=r"write drifting=\['motor\.rotor\.phi'\]"):
        steady_state(motor(), inputs={"source.u": 0.0}, drifting="motor.rotor.phi")
    point = warm()
    with pytest.raises(ModelError, match=r"'body\.y' is not a variable"):
        point["body.y"]
    with pytest.raises(ModelError, match=r"by names, point\['m\.x'\]"):
        point[0]


def test_a_point_is_shown():
    point = warm()
    np.testing.assert_allclose(point["body.T"], radiating(100.0), rtol=ROUNDING)
    assert point.residual <= 1 and float(point["time"]) == 0.0
    assert set(point.to_dict()) == set(radiator().variables)
    assert repr(point) == f"OperatingPoint(body.T={radiating(100.0):.6g})"
    assert "body.T" in point._repr_html_()


@pytest.mark.slow
def test_a_run_goes_on_from_a_point():
    solution = simulate(
        radiator(), 100.0, ts=jnp.array([100.0]), inputs={"heater.Q_flow": 100.0}, initial=warm().start
    )  # fmt: skip
    np.testing.assert_allclose(solution["body.T"][0], radiating(100.0), rtol=1e-9)


@pytest.mark.slow
def test_a_batch_of_points():
    rest = eqx.filter_vmap(lambda q: steady_state(radiator(), inputs={"heater.Q_flow": q}))
    points = eqx.filter_jit(rest)(jnp.array([10.0, 100.0]))
    np.testing.assert_allclose(points["body.T"], [radiating(10.0), radiating(100.0)], rtol=ROUNDING)
    assert points[["body.T", "skin.Q_flow"]].shape == (2, 2) and "shape (2,)" in repr(points)


# --- linear state spaces -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_transfer_function_of_a_dc_motor():
    """w/u = k/((L·s + R)·(J·s + d) + k²), from rest, where the angle is free."""
    omega = np.array([0.0, 1.0, 30.0, 1e3])
    response = frequency_response(motor(), inputs={"source.u": 0.0}, outputs=["motor.rotor.w"], omega=omega[1:])
    s = 1j * omega
    expected = K / ((L * s + R) * (J * s + D) + K**2)
    np.testing.assert_allclose(response["motor.rotor.w", "source.u"], expected[1:], rtol=ROUNDING)
    space = linearize(motor(), {"source.u": 0.0}, ["motor.rotor.w", "motor.inductor.i"])
    assert space.inputs == ("source.u",) and space.outputs == ("motor.rotor.w", "motor.inductor.i")
    np.testing.assert_allclose(space.dx0, 0.0, atol=1e-15)
    poles = np.append(np.roots([L * J, L * D + R * J, R * D + K**2]), 0.0)
    # The slowest first; 1e-15·|A|·cond.
    np.testing.assert_allclose(space.poles(), np.sort(poles)[::-1], rtol=1e-9, atol=1e-9)
    same = linearize(motor(), ["source.u"], ["motor.rotor.w", "motor.inductor.i"], at=turning())
    np.testing.assert_allclose(same.A, space.A, rtol=ROUNDING)
    np.testing.assert_allclose([same.u0[0], same.y0[0]], [3.0, 3.0 * K / (R * D + K**2)], rtol=ROUNDING)


@pytest.mark.slow
def test_a_notch_filter():
    """A series resonance behind a resistor: v/u = (1 + L·C·s²)/(1 + R·C·s + L·C·s²), zero at 1/√(L·C)."""
    r, inductance, capacity = 50.0, 2e-3, 5e-7
    ev = EqnEnv()
    source, resistor = el.SignalVoltage(ev, "source"), el.Resistor(ev, "r", r)
    coil, c, ground = el.Inductor(ev, "l", inductance), el.Capacitor(ev, "c", capacity), el.Ground(ev, "ground")
    system = compiled(
        source, resistor, coil, c, ground,
        connect=[(source.p, resistor.p), (resistor.n, coil.p), (coil.n, c.p), (c.n, source.n, ground.p)],
    )  # fmt: skip
    notch = 1 / np.sqrt(inductance * capacity)
    omega = np.array([0.0, 0.3, 0.99, 1.0, 1.7, 40.0]) * notch
    found = frequency_response(system, inputs={"source.u": 0.0}, outputs=["l.p.v"], omega=omega)["l.p.v", "source.u"]
    s = 1j * omega
    expected = (1 + inductance * capacity * s**2) / (1 + r * capacity * s + inductance * capacity * s**2)
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)
    assert abs(found[3]) < ROUNDING


@pytest.mark.slow
def test_poles_and_their_gradient():
    """s = −D/(2·M) ± j·√(K/M − D²/(4·M²))."""
    system = oscillator()

    def pole(damping):
        space = linearize(system.with_parameters({"damper.d": damping}), [], ["mass.s"])
        return space.poles()[1]

    @jax.jit
    def with_slope(damping):
        parts = lambda d: jnp.stack([pole(d).real, pole(d).imag])  # noqa: E731
        return parts(damping), jax.jacrev(parts)(damping)

    a, w = 0.6 / 4, np.sqrt(2.5 - 0.15**2)
    found, slopes = with_slope(0.6)
    np.testing.assert_allclose(found, [-a, w], rtol=ROUNDING)
    np.testing.assert_allclose(slopes, [-1 / 4, -a / w / 4], rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [-np.pi / 2, -1.2], ids=["hanging", "released from -1.2"])
def test_poles_of_a_pendulum_with_redundant_states(angle):
    """±j·√(g/L), on the tangent of the constraints."""
    system = pendulum().with_parameters({"pend.initial_theta": angle})
    space = linearize(system, [], ["pend.lam", "pend.y", "pend.x"])
    assert space.states == ("pend.x", "pend.vx")
    np.testing.assert_allclose(space.A, [[0.0, 1.0], [-9.81, 0.0]], atol=ROUNDING)
    np.testing.assert_allclose(space.poles(), np.array([-1j, 1j]) * np.sqrt(9.81), atol=ROUNDING)
    np.testing.assert_allclose(space.C, [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]], atol=ROUNDING)


@pytest.mark.slow
def test_coordinates_on_constraints():
    system = pendulum()

    def square(length):
        space = linearize(system.with_parameters({"pend.L": length}), [], [], states=["pend.x", "pend.vx"])
        return -space.A[1, 0]

    np.testing.assert_allclose(jax.jit(jax.grad(square))(2.0), -9.81 / 4, rtol=1e-10)  # of g/L
    with pytest.raises(ModelError, match=r"name 2 of them, linearize\(\.\.\., states="):
        jax.jit(lambda m: linearize(system.with_parameters({"pend.m": m}), [], []).A)(1.0)
    with pytest.raises(ModelError, match=r"do not determine the other states.*\['pend\.x', 'pend\.vx'\] do"):
        linearize(system, [], [], states=["pend.y", "pend.vy"])
    with pytest.raises(ModelError, match=r"2 coordinates are needed.*got \['pend\.x'\]"):
        linearize(system, [], [], states=["pend.x"])
    with pytest.raises(ModelError, match=r"'pend\.z' is not a state"):
        linearize(system, [], [], states=["pend.x", "pend.z"])
    with pytest.raises(ModelError, match="no hidden constraint makes a state redundant"):
        linearize(oscillator(), [], [], states=["mass.s"])


@pytest.mark.slow
def test_an_implicit_block_is_eliminated():
    """C·dv/dt = i − v/R_load, with the slope g/(1 + g·R) of i by u − v, where g is the diode's."""
    point = steady_state(rectifier(), inputs={"source.u": 3.0})
    space = linearize(rectifier(), ["source.u"], ["d.i"], at=point)
    g = 1e-9 / 0.04 * np.exp(float(point["d.v"]) / 0.04) + 1e-8
    slope = g / (1 + g * 10.0)
    assert space.states == ("c.v",)
    np.testing.assert_allclose(space.A, [[-(slope + 1 / 500.0) / 1e-3]], rtol=1e-9)
    np.testing.assert_allclose(space.B, [[slope / 1e-3]], rtol=1e-9)
    np.testing.assert_allclose([space.C[0, 0], space.D[0, 0]], [-slope, slope], rtol=1e-9)


def test_arguments_of_linearize():
    with pytest.raises(ModelError, match=r"'source\.v' is not an input.*did you mean 'source\.u'"):
        linearize(motor(), ["source.v"], [])
    with pytest.raises(ModelError, match=r"input 'source\.u' has no default.*inputs=\{'source\.u': 0\.0\}"):
        linearize(motor(), ["source.u"], [])
    with pytest.raises(ModelError, match=r"at=steady_state\(system, inputs="):
        linearize(motor(), [], [])
    with pytest.raises(ModelError, match=r"write outputs=\['motor\.rotor\.w'\]"):
        linearize(motor(), {"source.u": 0.0}, "motor.rotor.w")
    with pytest.raises(ModelError, match="stands twice"):
        linearize(oscillator(), [], ["mass.s", "mass.s"])
    ev = EqnEnv()
    shaker, mass = tr.PositionSource(ev, "shaker"), tr.Mass(ev, "mass")
    driven = compiled(shaker, mass, connect=[(shaker.flange, mass.flange)])
    with pytest.raises(ModelError, match=r"the model differentiates input 'shaker\.u'.*lag"):
        linearize(driven, {"shaker.u": 0.0}, ["mass.v"])
    response = frequency_response(motor(), inputs={"source.u": 0.0}, outputs=["motor.rotor.w"], omega=[1.0])
    with pytest.raises(ModelError, match=r"omega is a row of real .*got complex128 of shape \(1,\)"):
        frequency_response(motor(), inputs={"source.u": 0.0}, outputs=["motor.rotor.w"], omega=[1.0j])
    with pytest.raises(ModelError, match=r"'source\.u' is not an output"):
        response["source.u", "motor.rotor.w"]
    with pytest.raises(ModelError, match=r"two names, response\['output', 'input'\]"):
        response["motor.rotor.w"]


def test_a_state_space_is_shown():
    space = linearize(motor(), {"source.u": 0.0}, ["motor.rotor.w"])
    text = repr(space)
    assert text.startswith("StateSpace(3 states, 1 input, 1 output)") and "B: motor.inductor.i, " in text
    html = space._repr_html_()
    assert "<th>motor.rotor.w</th>" in html and html.count("<table>") == 4
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), space)
    assert repr(batch).startswith("StateSpace(3 states")


def test_a_point_of_another_pendulum():
    """A point of a pendulum of one metre is none of one of four; its poles are ±j·√(g/4)."""
    system = compiled(pl.PlanarPendulum(EqnEnv(), "pend", initial_theta=-1.5))
    at, longer = steady_state(system), system.with_parameters({"pend.L": 4.0})
    with pytest.raises(ModelError, match=r"not one of this system: .*pend.* does not hold there.*same parameters"):
        linearize(longer, [], ["pend.x"], at=at)
    poles = linearize(longer, [], ["pend.x"], at=steady_state(longer)).poles()
    np.testing.assert_allclose(np.sort(poles.imag), np.sqrt(9.81 / 4) * np.array([-1, 1]), rtol=1e-9)


def test_one_of_many_equilibria():
    """Two bodies that radiate to each other rest at any common temperature T, with the pole −4·sigma·T³·(1/C1 + 1/C2):
    a linear model that a search chose was that of 322 K for bodies that end at 375 K."""
    ev = EqnEnv()
    a, b = th.HeatCapacitor(ev, "a", 100.0, 300.0), th.HeatCapacitor(ev, "b", 300.0, 400.0)
    gap = th.Radiation(ev, "gap", eps=1.0)
    system = compiled(a, b, gap, connect=[(a.heat, gap.port_a), (b.heat, gap.port_b)])
    with pytest.raises(SteadyStateError, match=r"one of many: .*a common change of a\.T, b\.T.*drifting=\['a\.T'\]"):
        linearize(system, [], ["gap.Q_flow"])
    at = steady_state(system.with_parameters({"a.initial_temperature": 375.0}), drifting=["a.T"])
    poles = linearize(system, [], ["gap.Q_flow"], at=at).poles()
    expected = [0.0, -4 * th.STEFAN_BOLTZMANN * 375.0**3 * (1 / 100 + 1 / 300)]
    np.testing.assert_allclose(poles, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_to_control():
    space = linearize(motor(), {"source.u": 0.0}, ["motor.rotor.w"])
    theirs = space.to_control()
    assert theirs.input_labels == ["source_u"] and theirs.output_labels == ["motor_rotor_w"]
    omega = np.array([0.5, 20.0])
    np.testing.assert_allclose(
        control.frequency_response(theirs, omega).complex,
        space.frequency_response(omega).values[:, 0, 0],
        rtol=ROUNDING,
    )
    with pytest.raises(ModelError, match=r"needs inputs and outputs: name inputs in linearize"):
        spring().to_control()


# --- sweeps ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_grid_of_simulations():
    """v = V·(1 − exp(−t/(R·C))) for every pair of R and C."""
    r, c, ts = np.array([1.0, 2.0, 4.0]), np.array([0.5, 1.5]), np.array([0.0, 0.7, 2.0])
    found = sweep(rc_circuit(), {"r.R": r, "c.C": c}, t1=2.0, ts=ts, rtol=1e-9, atol=1e-11)
    assert found.shape == (3, 2) and found["c.v"].shape == (3, 2, 3)
    expected = 3.0 * (1 - np.exp(-ts / (r[:, None, None] * c[:, None])))
    np.testing.assert_allclose(found["c.v"], expected, rtol=0, atol=1e-7)  # a hundred times the tolerance
    data = found.to_xarray()
    assert data["c.v"].dims == ("r.R", "c.C", "time") and data["c.v"].attrs == {"units": "V"}
    np.testing.assert_array_equal(data["c.v"].sel({"r.R": 2.0, "c.C": 1.5}), found["c.v"][1, 1])
    assert repr(found) == "Sweep(r.R: 3 values from 1 to 4 × c.C: 2 values from 0.5 to 1.5)"
    assert "(3, 2)" in found._repr_html_()


@pytest.mark.slow
def test_zipped_steady_states():
    eps, area = jnp.array([0.2, 0.5, 0.9]), jnp.array([1.0, 2.0, 0.5])

    def both(system):
        point = steady_state(system, inputs={"heater.Q_flow": 100.0}, throw=False)
        return {"T": point["body.T"], "x": point.x}

    found = sweep(radiator(), {"skin.eps": eps, "skin.A": area}, both, zipped=True)
    assert found.shape == (3,) and found["x"].shape == (3, 1)
    np.testing.assert_allclose(found["T"], radiating(100.0, eps, area), rtol=ROUNDING)
    data = found.to_xarray()
    assert data["T"].dims == ("case",) and data["x"].dims == ("case", "x_0")
    np.testing.assert_array_equal(data.coords["skin.A"], area)


@pytest.mark.slow
def test_a_sweep_is_differentiated():
    eps = jnp.array([0.2, 0.5, 0.9])

    def hot(system):
        return steady_state(system, inputs={"heater.Q_flow": 100.0}, throw=False)["body.T"]

    def total(eps):
        return jnp.sum(sweep(radiator(), {"skin.eps": eps}, hot).values)

    slope = jax.jit(jax.grad(total))(eps)
    np.testing.assert_allclose(slope, jax.grad(lambda e: jnp.sum(radiating(100.0, e)))(eps), rtol=1e-10)


class Noted(list):
    """A list that does not count as content: a function that fills it stays the same."""

    def __content__(self):
        return "noted", ()


def test_a_sweep_compiles_once():
    traced = Noted()

    def function(system):
        traced.append(1)
        return system.parameters["r.R"] * 2

    for first in (1.0, 5.0):
        found = sweep(rc_circuit(), {"r.R": jnp.array([first, 2.0])}, function)
        np.testing.assert_array_equal(found.values, [2 * first, 4.0])
    assert len(traced) == 1


def test_arguments_of_a_sweep():
    system, values = rc_circuit(), [1.0, 2.0]
    for given, options, message in [
        ({"r.Q": values}, {}, r"'r\.Q' is not a parameter"),
        ({"c.C": [1.0, -2.0]}, {"t1": 1.0, "ts": [1.0]}, r"parameter 'c\.C' must lie in .*; got -2"),
        ({"r.R": 1.0}, {}, r"need shape \(k,\)"),
        ({"r.R": values}, {"t1": 1.0}, r"needs t1=\.\.\., and ts="),
        ({"r.R": values, "c.C": [1.0]}, {"zipped": True, "t1": 1.0, "ts": [1.0]}, r"2 for 'r\.R', 1 for 'c\.C'"),
        ({}, {}, "by parameters' names"),
        ({"r.R": values}, {"function": abs, "t1": 1.0}, "t1: options of simulate"),
    ]:
        with pytest.raises(ModelError, match=message):
            sweep(system, given, **options)


# --- tables of other libraries -----------------------------------------------------------------------------------


def test_solutions_as_tables():
    solution = run()
    ts = solution.ts
    frame = solution.to_pandas("mass.s", "spring.f")
    assert list(frame.columns) == ["mass.s", "spring.f"] and frame.index.name == "time"
    np.testing.assert_array_equal(frame.index, ts)
    np.testing.assert_array_equal(frame["spring.f"], solution["spring.f"])
    assert list(solution.to_pandas().columns) == solution.system.variables
    data = solution.to_xarray()
    assert data["mass.v"].dims == ("time",) and data["mass.v"].attrs == {"units": "m/s"}
    np.testing.assert_array_equal(data["mass.v"], solution["mass.v"])
    batch = eqx.filter_vmap(lambda x: solution_of(oscillator(), ts, x))(jnp.ones((2, 3, 2)))
    assert batch.to_xarray("mass.s")["mass.s"].dims == ("batch_0", "time")
    with pytest.raises(ModelError, match="this is a batch of shape"):
        batch.to_pandas()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pandas", "xarray", "control"])
def test_missing_packages_name_the_extra(monkeypatch, name):
    solution, space = run(), spring()
    monkeypatch.setitem(sys.modules, name, None)  # so that importing it raises
    call = {"pandas": solution.to_pandas, "xarray": solution.to_xarray, "control": space.to_control}[name]
    with pytest.raises(ImportError, match=rf"needs .*: pip install 'jaxonomy_dae\[{name}\]'"):
        call()
