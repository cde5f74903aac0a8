"""Accounts of energy: what components declare, read from solutions, and whether it balances."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component, damped_oscillation, oscillator
from sympy import Eq, Symbol
from trajectories import balanced, solution_of

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.friction as fr
import jaxonomy_dae.library.hydraulic as hy
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.thermal as th
import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import Component, EqnEnv, ModelError, Translational, der, simulate
from jaxonomy_dae.testing import assert_energy_balance

TIGHT = {"rtol": 1e-9, "atol": 1e-11}
BALANCED = 1e-7  # a hundred times the tolerance of these runs
ROUNDING = 1e-13  # of a few operations


@functools.cache
def rlc():
    """A step of 5 V on a resistor, a coil and a capacitor in series."""
    ev = EqnEnv()
    source, r = el.VoltageSource(ev, "source", 5.0), el.Resistor(ev, "r", 1.5)
    coil, c = el.Inductor(ev, "l", 0.2, initial_current=0.0), el.Capacitor(ev, "c", 0.1, initial_voltage=0.0)
    ground = el.Ground(ev, "ground")
    return compiled(
        source, r, coil, c, ground,
        connect=[(source.p, r.p), (r.n, coil.p), (coil.n, c.p), (c.n, source.n, ground.p)],
    )  # fmt: skip


def test_terms_of_an_oscillator():
    """½·M·v² + ½·K·x², lost at D·v², nothing supplied."""
    system, ts = oscillator(), np.linspace(0.0, 3.0, 7)
    x, v = damped_oscillation(ts)
    assert system.states == ["mass.s", "mass.v"]
    solution = solution_of(system, ts, np.stack([x, v], axis=1))
    np.testing.assert_allclose(solution.energy("mass"), v**2, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(solution.energy("spring"), 2.5 * x**2, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(solution.energy(), v**2 + 2.5 * x**2, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(solution.dissipation(), 0.6 * v**2, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_array_equal(solution.supply(), 0.0)
    np.testing.assert_array_equal(solution.dissipation("mass"), 0.0)


@pytest.mark.slow
def test_a_loose_run_is_off_by_its_own_error():
    """What the saved states lose of ½·M·v² + ½·K·x² against the closed form is what the balance finds."""
    ts = np.linspace(0.0, 6.0, 7)
    solution = simulate(oscillator(), 6.0, ts=ts, rtol=1e-4, atol=1e-6)
    x, v = damped_oscillation(ts)
    lost = np.asarray(solution.energy()) - (v**2 + 2.5 * x**2)
    error = np.asarray(solution.energy_balance_error())
    scale = np.max(np.abs(lost)) / np.max(np.abs(error))  # the size that errors are relative to
    energy = float(solution.energy()[0])
    assert 0.5 * energy < scale < 5 * energy
    np.testing.assert_allclose(error * scale, lost, rtol=0, atol=BALANCED * energy)
    tight = simulate(oscillator(), 6.0, ts=ts, **TIGHT)
    assert np.max(np.abs(tight.energy_balance_error())) < BALANCED
    assert_energy_balance(tight, rtol=BALANCED)


def test_rlc():
    """The source gives 5 V·q, the capacitor takes half of it in the end, the resistor the rest."""
    solution = balanced(rlc(), 4.0)
    i, v = np.asarray(solution["l.i"]), np.asarray(solution["c.v"])
    np.testing.assert_allclose(solution.energy(), 0.1 * i**2 + 0.05 * v**2, rtol=1e-12)
    np.testing.assert_allclose(solution.supply("source"), 5.0 * i, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(solution.dissipation("r"), 1.5 * i**2, rtol=1e-12, atol=1e-15)
    worst = float(np.max(np.abs(solution.energy_balance_error())))
    assert 0.0 < worst < BALANCED
    with pytest.raises(AssertionError, match=f"rtol={0.9 * worst:g}"):
        assert_energy_balance(solution, rtol=0.9 * worst)


def test_a_dc_motor_in_its_parts():
    """Electrical power becomes mechanical; a load takes it, and the name of a composite adds up its parts."""
    ev = EqnEnv()
    machine, source = el.DCMotor(ev, "motor", R=1.2, L=1e-2, k=0.1, J=1e-3, d=2e-3), el.SignalVoltage(ev, "source")
    ground, load = el.Ground(ev, "ground"), rot.Torque(ev, "load")
    system = compiled(
        machine, source, ground, load,
        connect=[(source.p, machine.p), (source.n, machine.n, ground.p), (machine.flange, load.flange)],
    )  # fmt: skip
    solution = balanced(system, 1.0, {"source.u": lambda t: 12.0 * jnp.sin(20.0 * t), "load.tau": -0.05})
    i, w = np.asarray(solution["motor.inductor.i"]), np.asarray(solution["motor.rotor.w"])
    np.testing.assert_allclose(solution.dissipation("motor"), 1.2 * i**2 + 2e-3 * w**2, rtol=1e-12)
    np.testing.assert_allclose(solution.supply("load"), -0.05 * w, rtol=1e-12, atol=1e-15)


def test_heat_goes_to_the_heat_port():
    """The power of a heated resistor is stored in a body and leaves to the surroundings: nothing is lost."""
    ev = EqnEnv()
    source, r, ground = el.VoltageSource(ev, "source", 10.0), el.HeatedResistor(ev, "r", 4.0), el.Ground(ev, "ground")
    body, skin = th.HeatCapacitor(ev, "body", C=30.0, initial_temperature=300.0), th.Convection(ev, "skin", h=8.0)
    room = th.FixedTemperature(ev, "room", T=290.0)
    system = compiled(
        source, r, ground, body, skin, room,
        connect=[
            (source.p, r.p), (source.n, r.n, ground.p), (r.heat, body.heat, skin.port_a), (skin.port_b, room.heat),
        ],
    )  # fmt: skip
    solution = balanced(system, 20.0)
    np.testing.assert_array_equal(solution.dissipation(), 0.0)
    np.testing.assert_allclose(solution.supply("source"), 25.0, rtol=1e-12)
    np.testing.assert_allclose(
        solution.supply("room"), -8.0 * (np.asarray(solution["body.T"]) - 290.0), rtol=1e-9
    )  # fmt: skip


@pytest.mark.slow
def test_mechanics_that_is_not_linear():
    """A mass on a hardening spring with friction, driven against a stop with play by a moving end."""
    ev = EqnEnv()
    mass = tr.Mass(ev, "mass", 0.5, initial_position=0.02, initial_velocity=0.0)
    spring, friction = tr.NonlinearSpring(ev, "spring", c=40.0, c3=2e4), tr.Friction(ev, "friction", sliding=0.1)
    stop, wall = tr.Backlash(ev, "stop", gap=0.02, c=500.0, d=1.0, smooth=1e-3), tr.FixedPosition(ev, "wall")
    soft, shaker = tr.SpringDamper(ev, "soft", c=20.0, d=0.3), tr.PositionSource(ev, "shaker")
    system = compiled(
        mass, spring, friction, stop, wall, soft, shaker,
        connect=[
            (wall.flange, spring.flange_a, friction.flange_a, stop.flange_a),
            (mass.flange, spring.flange_b, friction.flange_b, stop.flange_b, soft.flange_b),
            (soft.flange_a, shaker.flange),
        ],
    )  # fmt: skip
    inputs = {"shaker.u": lambda t: 0.03 * jnp.sin(9.0 * t)}
    solution = simulate(system, 1.0, ts=jnp.linspace(0.0, 1.0, 6), inputs=inputs, **TIGHT)
    assert_energy_balance(solution, rtol=10 * BALANCED)  # creeping friction: |f'| is 250 times the sliding force
    speed = 0.27 * np.cos(9.0 * np.asarray(solution.ts))
    np.testing.assert_allclose(
        solution.supply(), -np.asarray(solution["shaker.flange.f"]) * speed, rtol=1e-9, atol=1e-12
    )  # fmt: skip


def test_what_no_term_reads_may_have_no_value():
    """x² + z² where z is identically zero and 1/x, which nobody declares, infinite: the energy was not a number."""

    def write(self, ev):
        a, x, z = self.variable("a"), self.variable("x", start=0.0, fixed=True), self.variable("z")
        self.add_equations(Eq(a, 1 / x), Eq(der(x), 1), Eq(z, 0))
        self.declare_energy(x**2 + z**2)

    solution = solution_of(compiled(component(write)), np.array([0.0, 0.5]), np.array([[0.0], [0.5]]))
    np.testing.assert_allclose(solution.energy(), [0.0, 0.25], rtol=ROUNDING)


def test_a_speed_that_the_model_does_not_have():
    """A force on the end of a massless spring: its speed is that of the force's change, f'/K, and of the mass."""
    ev = EqnEnv()
    force, spring = tr.Force(ev, "force"), tr.Spring(ev, "spring", c=3.0)
    mass = tr.Mass(ev, "mass", 2.0, initial_position=0.0, initial_velocity=0.0)
    system = compiled(force, spring, mass, connect=[(force.flange, spring.flange_b), (spring.flange_a, mass.flange)])
    inputs = {"force.f": lambda t: 1.5 * jnp.sin(2.0 * t)}
    solution = balanced(system, 2.0, inputs)
    t = np.asarray(solution.ts)
    with pytest.raises(ModelError, match="occurs nowhere"):
        solution["der(force.flange.s)"]
    speed = np.asarray(solution["mass.v"]) + 3.0 * np.cos(2.0 * t) / 3.0
    np.testing.assert_allclose(solution.supply(), 1.5 * np.sin(2.0 * t) * speed, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_hydraulics():
    """A pump's shaft drives fluid from a tank through an orifice into an accumulator, with inertia and compliance."""
    ev = EqnEnv()
    tank, pump = hy.Tank(ev, "tank", A=0.01, initial_level=1.0), hy.Pump(ev, "pump", D=1e-6)
    speed, duct = rot.SpeedSource(ev, "speed"), hy.Inertance(ev, "duct", L=2.0, A=1e-4, initial_m_flow=0.0)
    volume, orifice = (
        hy.HydraulicCapacity(ev, "volume", C=1e-10, initial_pressure=2e5),
        hy.Orifice(ev, "orifice", A=5e-6),
    )
    store = hy.Accumulator(ev, "store", V0=1e-3, p0=1.5e5, n=1.4, initial_volume=1e-5)
    leak, outside = hy.LaminarPipe(ev, "leak", D=1e-3, L=0.5), hy.PressureSource(ev, "outside")
    system = compiled(
        tank, pump, speed, duct, volume, orifice, store, leak, outside,
        connect=[
            (tank.fluid, pump.port_b), (pump.port_a, volume.fluid, duct.port_a), (speed.flange, pump.flange),
            (duct.port_b, orifice.port_a), (orifice.port_b, store.fluid, leak.port_a), (leak.port_b, outside.fluid),
        ],
    )  # fmt: skip
    solution = simulate(system, 0.5, ts=jnp.linspace(0.0, 0.5, 4), inputs={"speed.u": -20.0}, **TIGHT)
    assert_energy_balance(solution, rtol=BALANCED)


def test_the_energy_of_an_accumulator():
    """The work of the fluid against the gas, ∫ p0·(V0/(V0 − V))^n dV, by quadrature."""
    ev, exponents = EqnEnv(), {"isothermal": 1.0, "adiabatic": 1.4}
    stores = [hy.Accumulator(ev, k, V0=2.0, p0=3.0, n=n, initial_volume=0.0) for k, n in exponents.items()]
    supplies = [hy.MassFlowSource(ev, f"supply_{k}") for k in exponents]
    system = compiled(
        *stores, *supplies, connect=[(a.fluid, b.fluid) for a, b in zip(stores, supplies, strict=True)]
    )  # fmt: skip
    assert system.states == [f"{k}.V_fluid" for k in exponents]
    inputs = {f"supply_{k}.m_flow": 998.2 for k in exponents}
    solution = solution_of(system, [0.0, 1.0], [[0.0, 0.0], [1.0, 1.0]], inputs)
    places, weights = np.polynomial.legendre.leggauss(20)
    for k, n in exponents.items():
        work = np.sum(weights / 2 * 3.0 * (2.0 / (2.0 - (1 + places) / 2)) ** n)
        energy = solution.energy(k)
        np.testing.assert_allclose(energy[1] - energy[0], work, rtol=1e-12)


@pytest.mark.slow
def test_what_switches_and_friction_lose():
    """A brake, a clutch and a sliding part of 6, 1 and 0.5 N·m or N; a switch of 1 Ω that closes at 0.5 s, a diode."""
    ev = EqnEnv()
    wheel, brake = rot.Inertia(ev, "wheel", 2.0, 0.0, 6.0), fr.Brake(ev, "brake", mu=0.4, fn_max=10.0, cgeo=1.5)
    first, second = rot.Inertia(ev, "first", 1.0, 0.0, 4.0), rot.Inertia(ev, "second", 1.0, 0.0, 0.0)
    clutch, ground = fr.Clutch(ev, "clutch", mu=0.5, fn_max=2.0), el.Ground(ev, "ground")
    sled, ice, floor = (
        tr.Mass(ev, "sled", 1.0, 0.0, 1.0),
        fr.StickingFriction(ev, "ice", 0.5),
        tr.FixedPosition(ev, "f"),
    )
    source, r = el.VoltageSource(ev, "source", 3.0), el.Resistor(ev, "r", 2.0)
    switch, rd = el.TimedSwitch(ev, "switch", time=0.5, Ron=1.0, Goff=0.01), el.Resistor(ev, "rd", 2.2)
    diode = el.IdealDiode(ev, "diode", Ron=0.1, Vknee=0.7)
    system = compiled(
        wheel, brake, first, second, clutch, ground, sled, ice, floor, source, r, switch, rd, diode,
        connect=[
            (wheel.flange_a, brake.flange), (first.flange_b, clutch.flange_a), (clutch.flange_b, second.flange_a),
            (floor.flange, ice.flange_a), (ice.flange_b, sled.flange), (source.p, r.p, rd.p), (r.n, switch.p),
            (rd.n, diode.p), (source.n, switch.n, diode.n, ground.p),
        ],
    )  # fmt: skip
    ts = np.array([0.25, 0.75, 1.5])
    solution = simulate(system, 1.75, ts=ts, inputs={"brake.u": 1.0, "clutch.u": 1.0}, **TIGHT)
    open_current = 3.0 / (2.0 + 100.0)
    for name, lost in {
        "brake": 6 * (6 - 3 * ts), "clutch": 4 - 2 * ts, "ice": 0.5 * (1 - 0.5 * ts), "diode": [0.8] * 3,
        "switch": [100.0 * open_current**2, 1.0, 1.0],
    }.items():  # fmt: skip
        np.testing.assert_allclose(solution.dissipation(name), lost, rtol=BALANCED, err_msg=name)


# --- declarations ------------------------------------------------------------------------------------------------


class Block(Component):
    """A mass on a spring and a damper, with its declarations given from outside."""

    def __init__(self, ev, name, declare=lambda c, m, k, d, x, v: None):
        super().__init__(ev, name)
        m, k, d = self.parameter("m", 2.0), self.parameter("k", 5.0), self.parameter("d", 0.6)
        x, v = self.variable("x", start=0.7, fixed=True), self.variable("v", start=-0.4, fixed=True)
        self.add_equations(Eq(der(x), v), Eq(m * der(v), -k * x - d * v))
        self.output("lost", d * v**2)
        declare(self, m, k, d, x, v)


def right(c, m, k, d, x, v):
    c.declare_energy(m * v**2 / 2, k * x**2 / 2)
    c.declare_dissipation("lost")


def shares(c, m, k, d, x, v):
    """Declarations that are right for shares of 1, 1 and 0: one program for several ones that are not."""
    spring, lost, gained = (c.parameter(n, 1.0) for n in ("spring", "lost_share", "gained"))
    c.declare_energy(m * v**2 / 2, spring * k * x**2 / 2)
    c.declare_dissipation(lost * d * v**2)
    c.declare_supply(gained * d * v**2)


def test_a_declaration_by_name():
    v = np.array([0.5, -2.0])
    found = solution_of(compiled(Block(EqnEnv(), "b", right)), [0.0, 1.0], np.stack([0 * v, v], axis=1))
    np.testing.assert_allclose(found.dissipation("b"), 0.6 * v**2, rtol=ROUNDING)
    np.testing.assert_allclose(found.energy("b"), v**2, rtol=ROUNDING)


@pytest.fixture(scope="module")
def block():
    return compiled(Block(EqnEnv(), "b", shares))


@pytest.mark.slow
@pytest.mark.parametrize(
    "spring, lost, gained",
    [
        pytest.param(1.0, 1.0, 0.0, id="right"),
        pytest.param(0.5, 1.0, 0.0, id="half of the spring"),
        pytest.param(1.0, 0.0, 0.0, id="no damper"),
        pytest.param(1.0, 0.0, 1.0, id="wrong sign"),
    ],
)
def test_a_wrong_declaration_is_detected(block, spring, lost, gained):
    system = block.with_parameters({"b.spring": spring, "b.lost_share": lost, "b.gained": gained})
    solution = simulate(system, 2.0, ts=jnp.array([0.0, 1.0, 2.0]), **TIGHT)
    if (spring, lost, gained) == (1.0, 1.0, 0.0):
        assert np.max(np.abs(solution.energy_balance_error())) < BALANCED
        assert assert_energy_balance(solution, rtol=BALANCED).holds
        return
    message = r"the account of energy is off by .* of .* J at t=.*: stored .* J, supplied .* J, lost .* J since t=0"
    with pytest.raises(AssertionError, match=message):
        assert_energy_balance(solution)


@pytest.mark.slow
def test_a_component_that_declares_nothing_is_named():
    class Brake(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            flange = self.port("flange", Translational)
            self.add_equations(Eq(flange.f, 3.0 * der(flange.s)))

    ev = EqnEnv()
    mass, brake = tr.Mass(ev, "mass", initial_position=0.0, initial_velocity=1.0), Brake(ev, "brake")
    system = compiled(mass, brake, connect=[(mass.flange, brake.flange)])
    with pytest.raises(AssertionError, match=r"These components declare nothing: brake\."):
        assert_energy_balance(simulate(system, 1.0))


def test_what_cannot_be_declared():
    for declare, message in [
        (lambda c, *_: c.declare_energy("speed"), r"component 'b' has no variable or parameter 'speed'"),
        (lambda c, *_: c.declare_supply(None), r"component 'b': supply is an expression.*got None"),
    ]:
        with pytest.raises(ModelError, match=message):
            Block(EqnEnv(), "b", declare)
    with pytest.raises(ModelError, match=r"component 'b' is complete: declare its energy inside __init__"):
        Block(EqnEnv(), "b").declare_energy(1.0)
    with pytest.raises(ModelError, match="symbol 'q' was declared by no component"):
        compiled(Block(EqnEnv(), "b", lambda c, *_: c.declare_energy(Symbol("q") ** 2)))
    silent = compiled(Block(EqnEnv(), "b"))
    with pytest.raises(ModelError, match="no component of this model declares energies"):
        solution_of(silent, [0.0], [[0.7, -0.4]]).energy()
    with pytest.raises(ModelError, match=r"'bb' is not a component: did you mean 'b'"):
        solution_of(compiled(Block(EqnEnv(), "b", right)), [0.0], [[0.7, -0.4]]).energy("bb")

    def jerk(c, m, k, d, x, v):
        c.declare_energy(m * der(der(der(v))))

    with pytest.raises(
        ModelError, match=r"'b' declares energy in der\(der\(der\(b\.v\)\)\), but the model has neither"
    ):
        solution_of(compiled(Block(EqnEnv(), "b", jerk)), [0.0], [[0.7, -0.4]]).energy()


def test_declarations_cost_a_simulation_nothing():
    """They are no equations, and what is compiled for a run is the same program."""
    plain, declared = compiled(Block(EqnEnv(), "b")), compiled(Block(EqnEnv(), "b", right))
    assert plain.variables == declared.variables and plain.report.n_equations == declared.report.n_equations
    assert plain.plan != declared.plan  # another plan, so that neither is taken for the other
    texts = [str(jax.make_jaxpr(s.vector_field)(0.0, jnp.ones(2))) for s in (plain, declared)]
    assert texts[0] == texts[1]


@pytest.mark.slow
def test_accounts_inside_jit_and_batches():
    system, ts = compiled(Block(EqnEnv(), "b", right)), jnp.array([0.0, 1.0])

    def lost(d):
        return simulate(system.with_parameters({"b.d": d}), 1.0, ts=ts, **TIGHT).energy()[-1]

    step = 1e-4  # central differences: their error is of the order of step², and of the tolerance by step
    slope = (lost(0.6 + step) - lost(0.6 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(lost))(0.6), slope, rtol=1e-4)
    run = eqx.filter_vmap(lambda d: simulate(system.with_parameters({"b.d": d}), 1.0, ts=ts))
    batch = eqx.filter_jit(run)(jnp.array([0.0, 0.6]))
    assert batch.energy().shape == (2, 2)
    np.testing.assert_allclose(batch.energy()[0, 1], batch.energy()[0, 0], rtol=1e-4)
    with pytest.raises(ModelError, match="this is a batch"):
        batch.energy_balance_error()
    with pytest.raises(ModelError, match="outside jit"):
        jax.jit(lambda d: simulate(system.with_parameters({"b.d": d}), 1.0, ts=ts).energy_balance_error())(0.6)


@pytest.mark.slow
def test_the_second_run_takes_the_options_of_the_first():
    """Kind: a run that is made again forgets what it was asked for. A pulse of 1 ms in 100 s, which `jump_ts` resolves,
    was stepped over in the run that integrates powers, and a right model did not balance."""

    class Pulsed(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            u, x = self.input("u", default=0.0), self.variable("x", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), u - x / 100))
            self.declare_energy(x**2 / 2)
            self.declare_supply(u * x)
            self.declare_dissipation(x**2 / 100)

    system = compiled(Pulsed(EqnEnv(), "c"))
    inputs = {"c.u": lambda t: jnp.where((t >= 50.0) & (t < 50.001), 1000.0, 0.0)}
    solution = simulate(system, 100.0, ts=np.linspace(0.0, 100.0, 5), inputs=inputs, jump_ts=[50.0, 50.001], **TIGHT)
    np.testing.assert_allclose(solution["c.x"][-1], 100 * (np.exp(-0.49999) - np.exp(-0.5)) * 1000, rtol=1e-6)
    assert np.abs(solution.energy_balance_error()).max() < BALANCED
