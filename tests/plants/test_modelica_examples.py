"""Examples of the Modelica Standard Library (version 4) with diodes, clutches, brakes, stops and a heating control.

The trajectories in tests/data/modelica_events are those that Dymola published for them (repository
modelica/MAP-LIB_ReferenceResults), thinned to about 300 rows; both rows of every event are kept. They were computed at
tolerances between 1e-4 and 1e-6, which is what values and times of events may differ by; the gradients of ours are
compared with central differences of ours.
"""

import csv
import functools
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from component_references import checks, measured
from problems import compiled

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.thermal as th
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import AcausalSystem, EqnEnv, simulate
from jaxonomy_dae.library.friction import Brake, Clutch, OneWayClutch

FOLDER = pathlib.Path(__file__).parents[1] / "data" / "modelica_events"
TIGHT = dict(rtol=1e-9, atol=1e-10)
TOGETHER = 2e-5  # seconds: what is closer is one event; a change of modes may take several


class Published(NamedTuple):
    """A trajectory: times and values where nothing happens, and the times of events."""

    ts: np.ndarray
    values: dict[str, np.ndarray]
    events: np.ndarray


@functools.cache
def published(name):
    with (FOLDER / f"{name}.csv").open() as file:
        head, *rows = csv.reader(file)
    table = np.array(rows, float)
    ts = table[:, 0]
    same = np.flatnonzero(np.diff(ts) == 0)
    kept = np.ones(len(ts), bool)
    for k in same:
        kept[np.abs(ts - ts[k]) <= TOGETHER] = False
    changed = [k for k in same if ts[k] < ts[-1]]
    values = {name: table[kept, k] for k, name in enumerate(head) if k}
    return Published(ts[kept], values, apart(ts[changed]))


def apart(times):
    """The times of events without those that belong to the one before."""
    times = np.sort(times)
    return times[np.concatenate([[True], np.diff(times) > TOGETHER])] if len(times) else times


# --- models ----------------------------------------------------------------------------------------------------------


@functools.cache
def diodes():
    """Three diodes behind 1 mΩ at 10·sin(2πt), the second with an offset of −9 V."""
    ev = EqnEnv()
    kinds = {"Ideal": {}, "With_Ron_Goff": dict(Ron=0.1, Goff=0.1), "Knee": dict(Ron=0.2, Goff=0.2, Vknee=5.0)}
    parts, joined, node = [el.Ground(ev, "ground")], [], []
    for name, options in kinds.items():
        source = el.SineVoltage(ev, f"{name}_s", 10.0, 1.0, offset=-9.0 if name == "With_Ron_Goff" else 0.0)
        diode, series = el.IdealDiode(ev, name, **options), el.Resistor(ev, f"{name}_r", 1e-3)
        parts += [source, diode, series]
        joined += [(source.p, diode.p), (diode.n, series.p)]
        node += [source.n, series.n]
    return compiled(*parts, connect=[*joined, (*node, parts[0].p)])


@functools.cache
def heating():
    """A resistor, 10·(1 + (T − 293.15)/255) Ω, at 10 V heats 1 J/K; a relay holds it at what rises from 25 to 50 °C."""
    ev = EqnEnv()
    source, ground, switch = el.VoltageSource(ev, "source", 10.0), el.Ground(ev, "ground"), el.Switch(ev, "switch")
    heater = el.HeatedResistor(ev, "heater", 10.0, 1 / 255, 293.15)
    mass, loss = th.HeatCapacitor(ev, "mass", 1.0, 293.15), th.ThermalConductor(ev, "loss", 0.1)
    around, sensor = th.FixedTemperature(ev, "around", 293.15), th.TemperatureSensor(ev, "sensor")
    wanted = sig.Ramp(ev, "wanted", height=25.0, duration=6.0, offset=25.0 + 273.15, start_time=2.0)
    low = sig.Sum(ev, "low", [1.0, -1.0])
    relay = sig.Hysteresis(ev, "relay", -1.0, 1.0, initially_on=False)
    return compiled(
        source, ground, switch, heater, mass, loss, around, sensor, wanted, low, relay,
        connect=[
            (source.p, switch.p), (switch.n, heater.p), (heater.n, source.n, ground.p),
            (heater.heat, mass.heat, loss.port_a, sensor.heat), (loss.port_b, around.heat),
            (wanted.y, low.u1), (sensor.T, low.u2), (low.y, relay.u), (relay.y, switch.u),
        ],
    )  # fmt: skip


@functools.cache
def braked():
    """A motor with 200·sin(100t) N·m until 0.5 s, a clutch, a shaft on a spring, and a brake from then on."""
    ev = EqnEnv()
    motor = rot.Torque(ev, "motor")
    inertias = [
        rot.Inertia(ev, f"inertia{k}", J, 0.0, w) for k, J, w in ((1, 1.0, 90.0), (2, 0.05, 90.0), (3, 1.0, 100.0))
    ]
    first, shaft, driven = inertias
    clutch, brake = Clutch(ev, "clutch", fn_max=160.0), Brake(ev, "brake", fn_max=1600.0)
    spring = rot.SpringDamper(ev, "spring", 160.0, 1.0)
    pressed, on, off = (
        sig.Constant(ev, "pressed", 1.0),
        sig.Step(ev, "on", start_time=0.5),
        sig.Step(ev, "off", -1.0, 0.5, 1.0),
    )
    sine, product = sig.Sine(ev, "sine", 200.0, 50 / np.pi), sig.Product(ev, "product")
    return compiled(
        motor, *inertias, clutch, brake, spring, pressed, on, off, sine, product,
        connect=[
            (motor.flange, driven.flange_a), (driven.flange_b, clutch.flange_a), (clutch.flange_b, shaft.flange_a),
            (shaft.flange_b, spring.flange_a), (spring.flange_b, brake.flange, first.flange_a),
            (sine.y, product.u1), (off.y, product.u2), (product.y, motor.tau), (pressed.y, clutch.u), (on.y, brake.u),
        ],
    )  # fmt: skip


@functools.cache
def coupled():
    """Four shafts and three clutches: the first pressed by a sine, the others from 0.4 and from 0.9 s on."""
    ev = EqnEnv()
    J = [rot.Inertia(ev, f"J{k}", 1.0, 0.0, 10.0 * (k == 1)) for k in range(1, 5)]
    clutch = [Clutch(ev, f"clutch{k}", mu=0.5, fn_max=20.0, peak=1.1) for k in range(1, 4)]
    motor, sine = rot.Torque(ev, "motor"), sig.Sine(ev, "sine", 10.0, 5.0)
    pressed = [
        sig.Sine(ev, "first", 1.0, 0.2, phase=np.pi / 2), sig.Step(ev, "second", start_time=0.4),
        sig.Step(ev, "third", start_time=0.9),
    ]  # fmt: skip
    joined = [(sine.y, motor.tau), (motor.flange, J[0].flange_a)]
    for k in range(3):
        joined += [(J[k].flange_b, clutch[k].flange_a), (clutch[k].flange_b, J[k + 1].flange_a)]
        joined += [(pressed[k].y, clutch[k].u)]
    return compiled(motor, sine, *J, *clutch, *pressed, connect=joined)


@functools.cache
def freewheel():
    """A shaft driven by 10·sin(6πt) N·m and another behind a freewheel, whose clutch is pressed by pulses."""
    ev = EqnEnv()
    driving, driven = rot.Inertia(ev, "inertiaIn", 1.0, 0.0, -0.5), rot.Inertia(ev, "inertiaOut", 1.0, 0.0, 0.0)
    wheel, motor = OneWayClutch(ev, "oneWayClutch", fn_max=3.0, peak=25.0), rot.Torque(ev, "motor")
    sine, pulses = sig.Sine(ev, "sine", 10.0, 3.0), sig.Pulse(ev, "pulses", 1.0, 1.3, 0.5, start_time=0.3)
    return compiled(
        driving, driven, wheel, motor, sine, pulses,
        connect=[
            (motor.flange, driving.flange_a), (driving.flange_b, wheel.flange_a), (wheel.flange_b, driven.flange_a),
            (sine.y, motor.tau), (pulses.y, wheel.u),
        ],
    )  # fmt: skip


@functools.cache
def gaps():
    """Two masses between walls at ±2 m: one held by springs and dampers, one between elastic stops."""
    ev = EqnEnv()
    west, east = line.FixedPosition(ev, "west", -2.0), line.FixedPosition(ev, "east", 2.0)
    held, free = line.Mass(ev, "mass1", 1.0, 2.0, 0.0), line.Mass(ev, "mass2", 1.0, 2.0, 0.0)
    springs = [line.SpringDamper(ev, f"springDamper{k}", 10.0, 1.5, 1.0) for k in (1, 2)]
    stops = [line.ElasticStop(ev, f"elastoGap{k}", 10.0, 1.5, 1.5) for k in (1, 2)]
    joined = []
    for mass, (left, right) in ((held, springs), (free, stops)):
        joined += [
            (west.flange, left.flange_a),
            (left.flange_b, mass.flange, right.flange_a),
            (right.flange_b, east.flange),
        ]
    return compiled(west, east, held, free, *springs, *stops, connect=joined)


# --- against what was published --------------------------------------------------------------------------------------


class Example(NamedTuple):
    """A model, and the names of ours by those of the published trajectory.

    `tolerance` is what values may differ by, in parts of the largest of each variable, `times` what the times of events
    may, in seconds. `unseen` are published events that are none of ours. The derivative of `output`, at the end, by
    `parameter` is compared with differences.
    """

    make: Callable[[], AcausalSystem]
    names: dict[str, str]
    tolerance: float
    times: float
    parameter: str
    output: str
    unseen: tuple[float, ...] = ()


def same(*names):
    return {n: n for n in names}


EXAMPLES = {
    "CharacteristicIdealDiodes": Example(
        diodes,
        {"Ideal.v": "Ideal.v", "With_Ron_Goff.v": "With_Ron_Goff.v", "With_Ron_Goff_Vknee.v": "Knee.v"},
        1e-12,  # there are no states
        1e-8,
        "Knee.Ron",
        "Knee.i",
    ),
    # The tool's first event is 6e-5 s early by the quadrature below; the relay hands errors on, and times them by up to
    # 6 where the temperature falls hardly faster than what is wanted rises.
    "ControlledTemperature": Example(
        heating,
        {"heatCapacitor.T": "mass.T", "onOffController.y": "relay.y"},
        1e-4,
        2e-3,
        "loss.G",
        "mass.T",
    ),
    "CoupledClutches": Example(
        coupled,
        same(*(f"clutch{k}.{v}" for k in (1, 2, 3) for v in ("phi_rel", "w_rel", "mode")), "J1.phi", "J1.w"),
        3e-5,
        1e-5,
        "clutch1.mu",
        "J1.phi",
    ),
    "ElastoGap": Example(
        gaps,
        same("elastoGap1.v_rel", "elastoGap2.s_rel", "springDamper1.v_rel", "springDamper2.s_rel"),
        3e-5,
        1e-5,
        "elastoGap2.c",
        "mass2.s",
    ),
    "Friction": Example(
        braked,
        same(
            "clutch.phi_rel", "clutch.w_rel", "spring.phi_rel", "spring.w_rel", "inertia3.phi", "inertia3.w",
            "brake.mode", "clutch.mode",
        ),
        3e-5,
        1e-5,
        "clutch.mu",
        "spring.phi_rel",
    ),
    # Pulses that begin while the clutch is locked or slides change no mode of ours. At 1.5 s, after a whole period of
    # the torque, the speeds touch: the tool's error makes it lock for 0.3 ms, and an angle of 8e-5 remains.
    "OneWayClutch": Example(
        freewheel,
        same("oneWayClutch.w_rel", "inertiaIn.phi", "inertiaIn.w"),
        1e-4,
        1e-5,
        "oneWayClutch.mu",
        "inertiaIn.phi",
        unseen=(0.3, 1.4997028, 1.5000016, 1.6),
    ),
}  # fmt: skip


@functools.cache
def run(name):
    """An example at the published times."""
    known = published(name)
    return simulate(EXAMPLES[name].make(), known.ts[-1], ts=jnp.asarray(known.ts), **TIGHT)


def compare(name):
    """The trajectory and the events of an example with what was published."""
    example, known, solution = EXAMPLES[name], published(name), run(name)
    values = solution[list(example.names.values())].T
    for (theirs, ours), found in zip(example.names.items(), np.asarray(values), strict=True):
        true = known.values[theirs]
        measured(ours, found, true, example.tolerance * np.abs(true).max())
    unseen = np.array(example.unseen).reshape(-1, 1)
    expected = known.events[~(np.abs(known.events - unseen) < TOGETHER).any(0)]
    found = apart(np.asarray(solution.events.ts)[: len(solution.events)])
    np.testing.assert_allclose(found, expected, rtol=0, atol=example.times)
    return solution


TOOL = "trajectory published for an example of the Modelica Standard Library"
ORIGIN = "the tolerance of the published run"


@pytest.mark.slow
@checks({el.IdealDiode: (TOOL, "Ideal.v", "With_Ron_Goff.v", "Knee.v")}, origin=ORIGIN)
def test_characteristics_of_diodes():
    compare("CharacteristicIdealDiodes")


@pytest.mark.slow
@checks(
    {
        line.ElasticStop: (TOOL, "elastoGap1.v_rel", "elastoGap2.s_rel"),
        line.SpringDamper: (TOOL, "springDamper1.v_rel"),
    },
    origin=ORIGIN,
)
def test_stops_and_gaps():
    compare("ElastoGap")


@pytest.mark.slow
@checks({OneWayClutch: (TOOL, "oneWayClutch.w_rel", "inertiaIn.phi")}, origin=ORIGIN)
def test_a_clutch_beside_a_freewheel():
    compare("OneWayClutch")


@pytest.mark.slow
@checks({Clutch: (TOOL, "clutch.w_rel", "spring.phi_rel"), Brake: (TOOL, "brake.mode", "inertia3.w")}, origin=ORIGIN)
def test_a_clutch_and_a_brake():
    compare("Friction")


@pytest.mark.slow
def test_coupled_clutches():
    compare("CoupledClutches")


@pytest.mark.slow
@checks({sig.Hysteresis: (TOOL, "relay.y", "mass.T"), el.HeatedResistor: (TOOL, "mass.T")}, origin=ORIGIN)
def test_a_heating_control():
    """The first time at which the relay opens, where the temperature has risen by 6 K, is an integral."""
    solution = compare("ControlledTemperature")
    first = scipy.integrate.quad(lambda rise: 1 / (10 / (1 + rise / 255) - 0.1 * rise), 0.0, 6.0, epsrel=1e-12)[0]
    assert float(solution.events.ts[0]) == pytest.approx(first, rel=1e-8)


@pytest.mark.slow
@checks(
    {line.ElasticStop: ("SciPy's DOP853 of the law written anew", "mass2.s", "mass2.v")}, origin="some tens of 1e-9"
)
def test_a_mass_between_stops():
    """The published example, to our tolerance."""

    def slope(t, state):
        s, v = state
        west, east = (max(1.5 - d, 0.0) * 10.0 for d in (s + 2.0, 2.0 - s))
        return [v, west - np.clip(1.5 * v, -west, west) - east + np.clip(-1.5 * v, -east, east)]

    solution = run("ElastoGap")
    ts = np.asarray(solution.ts)
    exact = scipy.integrate.solve_ivp(
        slope, (0.0, ts[-1]), [2.0, 0.0], "DOP853", ts, rtol=1e-12, atol=1e-13, max_step=2e-3
    )
    for name, true in zip(("mass2.s", "mass2.v"), exact.y, strict=True):
        measured(name, solution[name], true, 2e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ElastoGap"])
def test_gradients(name):
    """By central differences of our own runs at a relative step h = 1e-4: right to h² times third derivatives, which
    events make large, and to the runs' 1e-9/h = 1e-5."""
    example, end = EXAMPLES[name], float(published(name).ts[-1]) - 0.05
    system = example.make()
    at = float(system.parameters[example.parameter])
    simulate(system, end, ts=jnp.array([end]), **TIGHT)  # inside jit the solver is that of a run before

    def last(value):
        changed = system.with_parameters({example.parameter: value})
        return simulate(changed, end, ts=jnp.array([end]), **TIGHT)[example.output][0]

    reverse = float(jax.jit(jax.grad(last))(at)) * at
    differences = (float(last(at * (1 + 1e-4))) - float(last(at * (1 - 1e-4)))) / 2e-4
    assert reverse == pytest.approx(differences, rel=1e-4, abs=1e-5)
