"""Machines, batteries and converters of the Modelica Standard Library 4.1.0 in plants with our own parts.

Each stands beside its equations in SciPy; slopes are those of central differences. `MODELICA_LIBRARY` names the folder
of the library; without it the tests are skipped.
"""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from device_library import standard_library
from diode_bridges import GOFF, RON, bridge_by_brute_force
from open_classes import by_differences, opened, run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate
from jaxonomy_dae.library import electrical, rotational, thermal
from jaxonomy_dae.library.signal import Ramp
from jaxonomy_dae.modelica import Library
from jaxonomy_dae.solvers import Rodas5P

pytestmark = pytest.mark.slow
MACHINES = "Electrical.Machines.BasicMachines"


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def solved(slope, start, ts, **options):
    given = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12} | options
    run = scipy.integrate.solve_ivp(slope, (0.0, ts[-1]), start, t_eval=ts, **given)
    assert run.success
    return run.y


def test_motors_of_a_watt_and_of_a_megawatt(library):
    """Two motors of one class: a small one with losses of brushes, core, stray fields and friction, whose winding heats
    our body and loses conductance, and a large one without losses. Both turn our loads."""
    ev, d = EqnEnv(), AcausalDiagram()
    name = f"Modelica.{MACHINES}.DCMachines.DC_PermanentMagnet"
    losses = {"coreParameters": {"PRef": 0.3}, "strayLoadParameters": {"PRef": 0.1}}
    losses |= {"frictionParameters": {"PRef": 0.2}, "brushParameters": {"V": 0.4}}
    Small = library.component(name, useThermalPort=True, **losses)
    reference = {"TaNominal": 293.15, "TaRef": 293.15}
    small = Small(
        ev, "small", VaNominal=12.0, IaNominal=0.5, wNominal=300.0, Ra=3.0, La=2e-3, Jr=1e-5, alpha20a=3.93e-3,
        TaOperational=293.15, start={"la.i": 0.0}, **reference,
    )  # fmt: skip
    large = opened(library, f"{MACHINES}.DCMachines.DC_PermanentMagnet")(
        ev, "large", VaNominal=1000.0, IaNominal=1000.0, wNominal=150.0, Ra=0.02, La=5e-4, Jr=40.0, alpha20a=0.0,
        TaOperational=293.15, start={"la.i": 0.0}, **reference,
    )  # fmt: skip
    weak, strong, g = (
        electrical.VoltageSource(ev, "weak", V=12.0),
        electrical.VoltageSource(ev, "strong", V=900.0),
        electrical.Ground(ev, "g"),
    )
    fan = rotational.Inertia(ev, "fan", J=2e-5, initial_angle=0.0, initial_speed=0.0)
    mill = rotational.Inertia(ev, "mill", J=200.0, initial_angle=0.0, initial_speed=0.0)
    air, rock, wall = (
        rotational.Damper(ev, "air", d=1e-5),
        rotational.Damper(ev, "rock", d=30.0),
        rotational.FixedAngle(ev, "wall"),
    )
    winding, rest = thermal.HeatCapacitor(ev, "winding", 0.5, 293.15), thermal.FixedTemperature(ev, "rest", 293.15)
    case = thermal.ThermalConductor(ev, "case", G=0.02)
    d.add(small, large, weak, strong, g, fan, mill, air, rock, wall, winding, rest, case)
    d.connect(weak.p, small.pin_ap)
    d.connect(strong.p, large.pin_ap)
    d.connect(g.p, weak.n, strong.n, small.pin_an, large.pin_an)
    d.connect(small.flange, fan.flange_a, air.flange_a)
    d.connect(large.flange, mill.flange_a, rock.flange_a)
    d.connect(wall.flange, air.flange_b, rock.flange_b)
    ports = {p.name.rpartition(".")[2]: p for p in small.thermalPort}
    d.connect(ports.pop("heatPortArmature"), winding.heat, case.port_a)
    d.connect(rest.heat, case.port_b, *ports.values())
    system = AcausalCompiler(ev, d)()
    values = {
        "small.Ra": 3.0, "small.brushParameters.V": 0.4, "small.coreParameters.PRef": 0.3, "case.G": 0.02,
        "fan.J": 2e-5, "large.La": 5e-4, "large.Jr": 40.0, "rock.d": 30.0,
    }  # fmt: skip
    ts = np.array([0.02, 0.1, 0.4])
    names = ["fan.w", "winding.T", "small.pin_ap.i", "mill.w", "large.pin_ap.i"]
    given = system.with_parameters(values)
    found = simulate(given, 0.4, ts=jnp.asarray(ts), rtol=1e-9, atol=1e-11, solver=Rodas5P())[names].T

    def motors(Ra, brush, core, G, J, La, Jr, rock):
        induced = 12.0 - Ra * 0.5 - brush
        k, Gc, linear = induced / 300.0, core / induced**2, 0.005

        def current(T, i):
            """Of the pin, with that of the winding's inductance; and the voltage behind the resistance and brushes."""
            R = Ra * (1 + 3.93e-3 * (T - 293.15))
            high = (i + Gc * (12.0 - brush)) / (1 + Gc * R)
            low = (i + Gc * 12.0) / (1 + Gc * (R + brush / linear))
            now, drop = (high, brush) if high > linear else (low, brush * low / linear)
            return R, now, 12.0 - R * now - drop

        def slope(t, x):
            i, w, T = x
            R, now, across = current(T, i)
            friction = 0.2 / 300.0 * ((w / 300.0) ** 2 if w > 0.3 else 1e-6 * w / 0.3)
            stray = 0.1 / 300.0 * (now / 0.5) ** 2 * abs(w) / 300.0 * np.sign(w)
            torque = k * i - friction - stray - 1e-5 * w
            return [(across - k * w) / 2e-3, torque / (1e-5 + J), (R * now**2 - G * (T - 293.15)) / 0.5]

        x = solved(slope, [0.0, 0.0, 293.15], ts, method="Radau", rtol=1e-10, atol=1e-12, max_step=1e-3)
        pin = [current(T, i)[1] for i, _, T in x.T]
        k = 980.0 / 150.0
        y = solved(lambda t, y: [(900.0 - 0.02 * y[0] - k * y[1]) / La, (k * y[0] - rock * y[1]) / (Jr + 200.0)],
                   [0.0, 0.0], ts)  # fmt: skip
        return np.array([x[1], x[2], pin, y[1], y[0]])

    np.testing.assert_allclose(found, motors(*values.values()), rtol=1e-6)


def test_a_synchronous_machine_with_a_damper_cage(library):
    """Our three phases feed a machine with permanent magnets, whose cage swings it into step with our load; stator and
    cage by space phasors in the frame of the rotor, by SciPy."""
    ev, d = EqnEnv(), AcausalDiagram()
    Machine = library.component(f"Modelica.{MACHINES}.SynchronousMachines.SM_PermanentMagnet", p=2, useDamperCage=True)
    given = {"Rs": 0.3, "Lssigma": 2e-3, "Lmd": 0.02, "Lmq": 0.03, "Lrsigmad": 1.5e-3, "Rrd": 0.5, "Jr": 0.01}
    given |= {"VsOpenCircuit": 80.0, "fsNominal": 50.0, "TrOperational": 293.15, "TsOperational": 293.15}
    given |= {"TsRef": 293.15, "TrRef": 293.15, "alpha20s": 0.0, "alpha20r": 0.0}
    given |= {"statorCoreParameters.VRef": 100.0, "strayLoadParameters.IRef": 100.0}
    given |= {"permanentMagnetLossParameters.IRef": 100.0, "permanentMagnetLossParameters.wRef": 100.0}
    w0 = 50 * np.pi
    start = dict.fromkeys([f"{n}[{k}]" for n in ("airGap.i_sr", "damperCage.spacePhasor_r.i_") for k in (1, 2)], 0.0)
    machine = Machine(ev, "machine", start=start, **given)
    phases = [
        electrical.SineVoltage(ev, f"phase{k}", amplitude=120.0, frequency=50.0, phase=np.pi / 2 - 2 * np.pi * k / 3)
        for k in range(3)
    ]
    g, load = electrical.Ground(ev, "g"), rotational.Inertia(ev, "load", J=0.02, initial_angle=0.0, initial_speed=w0)
    damper, wall = rotational.Damper(ev, "damper", d=0.01), rotational.FixedAngle(ev, "wall")
    d.add(machine, *phases, g, load, damper, wall)
    for k in range(3):
        d.connect(phases[k].p, machine.plug_sp[k])
    d.connect(g.p, *(p.n for p in phases))
    d.connect(*machine.plug_sn)
    d.connect(machine.flange, load.flange_a, damper.flange_a)
    d.connect(damper.flange_b, wall.flange)
    system = AcausalCompiler(ev, d)()
    values = {"machine.Lmq": 0.03, "machine.Rrd": 0.5, "machine.VsOpenCircuit": 80.0, "load.J": 0.02}
    ts = np.array([0.01, 0.03, 0.05])
    names = ["load.w", "load.phi", "machine.plug_sp.pin[1].i"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(Lmq, Rr, Vo, J):
        main = np.diag([0.02, Lmq])
        # Flux linkages of stator and cage by their currents; the cage's current leaves it.
        L = np.block([[2e-3 * np.eye(2) + main, main], [main, 1.5e-3 * np.eye(2) + main]])
        magnet = np.array([np.sqrt(2) * Vo / (100 * np.pi), 0.0])
        turn = np.array([[0.0, -1.0], [1.0, 0.0]])

        def slope(t, x):
            currents, w, phi = x[:4], x[4], x[5]
            stator = currents[:2]
            flux = L[:2] @ currents + magnet
            angle = 100 * np.pi * t - 2 * phi  # of the voltage's phasor against the rotor
            volts = 120.0 * np.array([np.cos(angle), np.sin(angle)])
            change = [*(volts - 0.3 * stator - 2 * w * turn @ flux), *(-Rr * currents[2:])]
            torque = 3.0 * (stator[1] * flux[0] - stator[0] * flux[1])
            return [*np.linalg.solve(L, change), (torque - 0.01 * w) / (0.01 + J), w]

        x = solved(slope, [0.0, 0.0, 0.0, 0.0, w0, 0.0], ts)
        return np.array([x[4], x[5], x[0] * np.cos(2 * x[5]) - x[1] * np.sin(2 * x[5])])

    np.testing.assert_allclose([found[n] for n in names], reference(*values.values()), rtol=1e-6, atol=1e-6)
    for name, expected in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(expected, rel=1e-4), name


def test_a_chopper_with_its_pulse_width(library):
    """Pulses of the library, as wide as our ramp at the beginning of each, switch a chopper onto our coil and
    resistor. The current by exponentials from switch to switch."""
    ev, d, converters = EqnEnv(), AcausalDiagram(), "Electrical.PowerConverters.DCDC"
    chopper = opened(library, f"{converters}.ChopperStepDown")(
        ev, "chopper", RonTransistor=0.05, GoffTransistor=1e-4, RonDiode=0.1, GoffDiode=2e-4, VkneeDiode=0.7
    )
    pwm = library.component(f"Modelica.{converters}.Control.SignalPWM", useConstantDutyCycle=False, f=1000.0)(ev, "pwm")
    source, g = electrical.VoltageSource(ev, "source", V=24.0), electrical.Ground(ev, "g")
    coil, load = electrical.Inductor(ev, "coil", L=2e-3, initial_current=0.5), electrical.Resistor(ev, "load", R=3.0)
    duty = Ramp(ev, "duty", height=0.5, duration=5e-3, offset=0.25)
    d.add(chopper, pwm, source, g, coil, load, duty)
    d.connect(duty.y, pwm.dutyCycle)
    d.connect(pwm.fire, chopper.fire_p)
    d.connect(source.p, chopper.dc_p1)
    d.connect(source.n, chopper.dc_n1, g.p)
    d.connect(chopper.dc_p2, coil.p)
    d.connect(coil.n, load.p)
    d.connect(load.n, chopper.dc_n2)
    system = AcausalCompiler(ev, d)()
    values = {"duty.offset": 0.25, "source.V": 24.0, "chopper.RonTransistor": 0.05, "chopper.VkneeDiode": 0.7}
    values |= {"coil.L": 2e-3, "load.R": 3.0}
    ts = np.array([1.15e-3, 2.9e-3, 3.9e-3])
    found, slopes = run_with_slopes(system, values, ts, ["coil.i", "chopper.dc_p2.v"], ["coil.i"])

    def reference(offset, V, Ron, knee, L, R):
        def behind(on, i):
            """The voltage of the coil and its load: V - v, and v, drive currents into the node of the current i."""
            up = 1 / Ron if on else 1e-4
            down, lost = (2e-4, 0.0) if on else (1 / 0.1, knee / 0.1 - 2e-4 * knee)
            return (up * V - lost - i) / (up + down)

        def after(i, on, dt):
            a, b = behind(on, 1.0) - behind(on, 0.0) - R, behind(on, 0.0)
            return (i + b / a) * np.exp(a / L * dt) - b / a

        out = []
        for t in ts:
            i, k = 0.5, 0
            while True:
                width, inside = (offset + 0.5 * k * 1e-3 / 5e-3) * 1e-3, t - k * 1e-3
                i = after(i, True, min(width, inside))
                on = inside <= width
                if not on:
                    i = after(i, False, min(inside, 1e-3) - width)
                if inside <= 1e-3:
                    break
                k += 1
            out.append([i, behind(on, i)])
        return np.array(out).T

    expected = reference(*values.values())
    np.testing.assert_allclose([found["coil.i"], found["chopper.dc_p2.v"]], expected, rtol=1e-6)
    for name, by_hand in by_differences(lambda *p: reference(*p)[:1], values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-5), name


def test_a_rectifier_of_the_library_on_our_capacitor(library):
    """A bridge of diodes, by the only one of its sixteen modes that fits at each voltage of the capacitor."""
    ev, d = EqnEnv(), AcausalDiagram()
    bridge = opened(library, "Electrical.PowerConverters.ACDC.DiodeBridge2Pulse")(
        ev, "bridge", RonDiode=RON, GoffDiode=GOFF, VkneeDiode=0.6
    )
    source, series = electrical.SineVoltage(ev, "source", 10.0, 1.0), electrical.Resistor(ev, "series", R=1.0)
    tank, load = electrical.Capacitor(ev, "tank", 0.05, initial_voltage=1.0), electrical.Resistor(ev, "load", 20.0)
    g = electrical.Ground(ev, "g")
    d.add(bridge, source, series, tank, load, g)
    d.connect(source.p, series.p)
    d.connect(series.n, bridge.ac_p)
    d.connect(source.n, bridge.ac_n, g.p)
    d.connect(bridge.dc_p, tank.p, load.p)
    d.connect(bridge.dc_n, tank.n, load.n)
    system = AcausalCompiler(ev, d)()
    values, ts = {"source.amplitude": 10.0, "tank.C": 0.05, "load.R": 20.0}, np.array([0.1, 0.3, 0.6])
    found, slopes = run_with_slopes(system, values, ts, ["tank.v"], ["tank.v"])

    def reference(amplitude, C, R):
        def charging(t, v):
            current = bridge_by_brute_force(amplitude * np.sin(2 * np.pi * t), v[0], knee=0.6)[1]
            return (current - v / R) / C

        return solved(charging, [1.0], ts, method="RK45", rtol=1e-9, atol=1e-10, max_step=2e-3)

    np.testing.assert_allclose(found["tank.v"], reference(*values.values())[0], rtol=1e-6)
    for name, expected in by_differences(reference, values, 1e-3).items():
        assert slopes[name] == pytest.approx(expected, rel=1e-3), name


def test_three_phases_of_currents_and_of_phasors(library):
    """A source of three phases on unequal resistors and coils, with our resistor in the neutral line. Currents from
    zero, by SciPy; the same circuit of phasors, by the equations of nodes."""
    ev, d = EqnEnv(), AcausalDiagram()
    V, R, L = [100.0, 100.0, 100.0], [10.0, 20.0, 5.0], [0.02, 0.05, 0.04]

    def part(path, name, structure=None, **values):
        x = library.component(f"Modelica.Electrical.{path}", **(structure or {}))(ev, name, **values)
        d.add(x)
        return x

    three = {"m": 3}
    source = part("Polyphase.Sources.SineVoltage", "source", three, V=V, f=[50.0] * 3)
    r = part("Polyphase.Basic.Resistor", "r", three, R=R)
    coil = part("Polyphase.Basic.Inductor", "coil", three, L=L, start={f"inductor[{k}].i": 0.0 for k in (1, 2, 3)})
    ends = [part("Polyphase.Basic.Star", n, three) for n in ("one", "other")]
    neutral, g = electrical.Resistor(ev, "neutral", R=2.0), electrical.Ground(ev, "g")
    d.add(neutral, g)
    for k in range(3):
        d.connect(source.plug_p[k], r.plug_p[k])
        d.connect(r.plug_n[k], coil.plug_p[k])
        d.connect(coil.plug_n[k], ends[1].plug_p[k])
        d.connect(source.plug_n[k], ends[0].plug_p[k])
    d.connect(ends[1].pin_n, neutral.p)
    d.connect(ends[0].pin_n, neutral.n, g.p)

    phasors = "QuasiStatic.Polyphase"
    source_q = part(f"{phasors}.Sources.VoltageSource", "source_q", three, V=V, f=50.0)
    r_q = part(f"{phasors}.Basic.Resistor", "r_q", three, R_ref=R)
    coil_q = part(f"{phasors}.Basic.Inductor", "coil_q", three, L=L)
    ends_q = [part(f"{phasors}.Basic.Star", n, three) for n in ("one_q", "other_q")]
    neutral_q = part("QuasiStatic.SinglePhase.Basic.Resistor", "neutral_q", R_ref=2.0)
    g_q = part("QuasiStatic.SinglePhase.Basic.Ground", "g_q")
    d.connect(source_q.plug_p, r_q.plug_p)
    d.connect(r_q.plug_n, coil_q.plug_p)
    d.connect(coil_q.plug_n, ends_q[1].plug_p)
    d.connect(source_q.plug_n, ends_q[0].plug_p)
    d.connect(ends_q[1].pin_n, neutral_q.pin_p)
    d.connect(ends_q[0].pin_n, neutral_q.pin_n, g_q.pin)
    system = AcausalCompiler(ev, d)()
    values = {"source.V[2]": 100.0, "r.R[3]": 5.0, "coil.L[1]": 0.02, "neutral.R": 2.0}
    values |= {"source_q.V[2]": 100.0, "r_q.R_ref[3]": 5.0, "coil_q.L[1]": 0.02, "neutral_q.R_ref": 2.0}
    ts = np.array([0.003, 0.01, 0.025])
    names = [f"coil.inductor[{k}].i" for k in (1, 2, 3)] + ["neutral_q.i.re", "neutral_q.i.im"]
    found, slopes = run_with_slopes(system, values, ts, names, names)
    turns = np.exp(-2j * np.pi * np.arange(3) / 3)

    def reference(V2, R3, L1, Rn, V2q, R3q, L1q, Rnq):
        volts, ohms, henries = np.array([100.0, V2, 100.0]), np.array([10.0, 20.0, R3]), np.array([L1, 0.05, 0.04])

        def slope(t, i):
            u = volts * np.sin(100 * np.pi * t - 2 * np.pi * np.arange(3) / 3)
            return (u - ohms * i - Rn * i.sum()) / henries

        i = solved(slope, np.zeros(3), ts)
        y = 1 / (np.array([10.0, 20.0, R3q]) + 100j * np.pi * np.array([L1q, 0.05, 0.04]))
        current = (y * np.array([100.0, V2q, 100.0]) * turns).sum() / (1 + Rnq * y.sum())
        return np.array([*i, np.full(3, current.real), np.full(3, current.imag)])

    np.testing.assert_allclose([found[n] for n in names], reference(*values.values()), rtol=1e-6, atol=1e-6)
    for name, expected in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(expected, rel=1e-5), name
