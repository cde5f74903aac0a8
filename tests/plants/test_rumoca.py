"""Models in Modelica that rumoca has flattened, run and compared with closed forms and with SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from modelica_sources import stored
from modelica_twins import TWINS

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate
from jaxonomy_dae.modelica import FlatComponent, load, read_rumoca


def compiled(model, **options):
    ev, diagram = EqnEnv(), AcausalDiagram()
    flat = read_rumoca(stored(model), model)
    diagram.add(FlatComponent(ev, "m", flat, **options))
    return AcausalCompiler(ev, diagram)()


def run(system, ts):
    return simulate(system, float(ts[-1]), ts=jnp.asarray(ts), rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_a_circuit_by_connections_and_its_gradient_by_a_parameter_of_others():
    """`scale` is the parameter that R = scale / 2 depends on; C v' = (V - v) / R from t = 0.5 s on."""
    system = compiled("Circuits.RC")
    assert dict(system.parameters.items()) == {"m.scale": 2.0, "m.r.R": 1.0, "m.c.C": 0.3, "m.s.V": 5.0, "m.s.T": 0.5}

    def voltage(scale):
        return run(system.with_parameters({"m.scale": scale}), np.array([0.0, 1.0, 2.0]))["m.c.v"]

    def closed(scale):
        tau = 0.5 * scale * 0.3
        at_step = 0.1 * jnp.exp(-0.5 / tau)
        return 5.0 + (at_step - 5.0) * jnp.exp(-(jnp.array([1.0, 2.0]) - 0.5) / tau)

    value, slope = jax.jit(jax.value_and_grad(lambda s: voltage(s)[1]))(2.0)
    assert value == pytest.approx(float(closed(2.0)[0]), abs=1e-8)
    assert slope == pytest.approx(float(jax.jacfwd(closed)(2.0)[0]), rel=1e-6)


@pytest.mark.slow
def test_a_motor_of_connected_parts():
    """L i' = V - R i - k w, J w' = k i."""
    R, L, k, J, V = 0.5, 0.1, 0.2, 0.02, 10.0
    A = np.array([[-R / L, -k / L, V / L], [k / J, 0.0, 0.0], [0.0, 0.0, 0.0]])
    ts = np.array([0.0, 0.3, 1.0])
    solution = run(compiled("Circuits.Motor"), ts)
    closed = np.array([scipy.linalg.expm(A * t) @ [0.0, 0.0, 1.0] for t in ts])
    np.testing.assert_allclose(solution["m.l.i"], closed[:, 0], atol=1e-7)
    np.testing.assert_allclose(solution["m.j.w"], closed[:, 1], atol=1e-7)


@pytest.mark.slow
def test_a_pendulum_in_cartesian_coordinates():
    ts = np.linspace(0.0, 2.0, 5)
    solution = run(compiled("Pendulum"), ts)
    start = [np.arctan2(0.72, 0.96), 0.0]
    angle = scipy.integrate.solve_ivp(
        lambda t, s: [s[1], -9.81 / 1.2 * np.sin(s[0])], (0.0, 2.0), start, t_eval=ts, rtol=1e-11, atol=1e-12
    ).y[0]
    np.testing.assert_allclose(solution["m.x"], 1.2 * np.sin(angle), atol=1e-7)
    np.testing.assert_allclose(solution["m.y"], -1.2 * np.cos(angle), atol=1e-7)


@pytest.mark.long("events in one program")
def test_a_ball_that_bounces():
    """Falls for t1 = sqrt(2 h / g), then flies for 2 e^n t1."""
    ts = np.array([0.3, 0.9, 1.5, 2.5])
    solution = run(compiled("Ball"), ts)
    first = np.sqrt(2.0 / 9.81)
    touch, speed, n = first, 0.8 * 9.81 * first, np.zeros(4, int)
    height = 1.0 - 9.81 * ts**2 / 2
    for _ in range(20):
        t = ts - touch
        height, n = np.where(t > 0, speed * t - 9.81 * t**2 / 2, height), n + (t > 0)
        touch, speed = touch + 2 * speed / 9.81, 0.8 * speed
    np.testing.assert_allclose(solution["m.h"], height, atol=1e-8)
    assert solution["m.n"].tolist() == n.tolist()


@pytest.mark.slow
def test_a_clutch_that_locks():
    """w1 = 10 - t and w2 = 2 t until t = 10 / 3; then both grow by 1 per second."""
    ts = np.array([0.0, 2.0, 3.0, 5.0, 8.0])
    solution = run(compiled("Clutch"), ts)
    lock = 10.0 / 3.0
    after = 2 * lock + np.maximum(ts - lock, 0.0)
    np.testing.assert_allclose(solution["m.w1"], np.where(ts < lock, 10.0 - ts, after), atol=1e-8)
    np.testing.assert_allclose(solution["m.w2"], np.where(ts < lock, 2.0 * ts, after), atol=1e-8)
    assert solution["m.locked"].tolist() == [0, 0, 0, 1, 1]


@pytest.mark.slow
def test_a_thermostat_with_hysteresis():
    ts = np.linspace(0.0, 10.0, 41)
    solution = run(compiled("Thermostat"), ts)
    T, t, on, n, expected = 20.0, 0.0, True, 0, []
    for at in ts:
        while True:
            rest, level = (30.0, 21.0) if on else (5.0, 19.0)
            turn = t - np.log((level - rest) / (T - rest)) / 0.1
            if turn > at:
                break
            T, t, on, n = level, turn, not on, n + 1
        expected.append((rest + (T - rest) * np.exp(-0.1 * (at - t)), n))
    np.testing.assert_allclose(solution["m.T"], [e[0] for e in expected], atol=1e-8)
    assert solution["m.switches"].tolist() == [e[1] for e in expected]


@pytest.mark.slow
def test_a_tank_that_stops_when_it_is_nearly_empty():
    """sqrt(h) falls linearly; h = 0.5 after (sqrt(2) - sqrt(0.5)) sqrt(2 / g) A / hole. No value is saved after it."""
    slope = 0.05 * np.sqrt(9.81 / 2.0)
    end = (np.sqrt(2.0) - np.sqrt(0.5)) / slope
    ts = np.array([0.0, 2.0, end - 1e-6, end + 1e-6, 30.0])
    h = np.asarray(run(compiled("Tank"), ts)["m.h"])
    np.testing.assert_allclose(h[:3], (np.sqrt(2.0) - slope * ts[:3]) ** 2, atol=1e-7)
    assert np.isnan(h[3:]).all()


@pytest.mark.slow
def test_arrays_and_equations_in_a_for():
    system = compiled("Rod")
    assert {f"m.k[{i}]" for i in (1, 2, 3)} | {"m.M[2,1]"} <= set(system.parameters.names)
    k = [1.0, 2.0, 3.0]
    A = np.zeros((5, 5))
    for i in range(3):
        A[i, i] -= k[i]
        A[i, i + 1] += k[i]
        A[i + 1, i] += k[i]
        A[i + 1, i + 1] -= k[i]
    A[0, 0] -= 1.0
    A[0, 4] = 3.0
    solution = run(system, np.array([0.0, 1.0]))
    closed = scipy.linalg.expm(A) @ [3.0, 0.0, 0.0, 1.0, 1.0]
    np.testing.assert_allclose([solution[f"m.T[{i}]"][-1] for i in range(1, 5)], closed[:4], atol=1e-8)
    np.testing.assert_allclose(solution["m.total"][-1], closed[:4].sum(), atol=1e-8)
    z = scipy.linalg.expm(np.array([[0.0, 1.0], [-4.0, -0.5]])) @ [1.0, 0.0]
    np.testing.assert_allclose([solution["m.z[1]"][-1], solution["m.z[2]"][-1]], z, atol=1e-8)


@pytest.mark.slow
def test_functions_with_loops_branches_and_several_results():
    ts = np.array([0.2, 0.9, 1.5, 2.5, 3.5])
    solution = run(compiled("Polynomial"), ts)
    np.testing.assert_allclose(solution["m.y"], ts**2 + 2 * ts + 3, atol=1e-8)
    np.testing.assert_allclose(solution["m.dy"], 2 * ts + 2, atol=1e-8)
    t = np.mod(ts, 2.0)
    u = np.where(ts > 3, t + 1, 1.0)
    np.testing.assert_allclose(solution["m.s"], np.where(ts > 3, t + 1, np.where(ts > 1, 2 * t, t)) + 10 * u, atol=1e-8)


@pytest.mark.slow
def test_equations_in_an_if():
    """From s = 1: 0.5 + 0.5 cos(3 t) until the play, a line of slope -1.5 across it, and so on."""
    ts = np.linspace(0.0, 2.2, 12)
    solution = run(compiled("Spring"), ts)
    quarter, cross = np.pi / 6, 1.0 / 1.5
    expected = np.where(ts < quarter, 0.5 + 0.5 * np.cos(3 * ts), 0.5 - 1.5 * (ts - quarter))
    late = ts - quarter - cross
    expected = np.where(late > 0, -0.5 - 0.5 * np.sin(3 * late), expected)
    np.testing.assert_allclose(solution["m.s"], expected, atol=1e-7)


@pytest.mark.slow
def test_clocks_and_whens_with_further_branches():
    """A branch of a when was left out while the condition of an earlier branch held, and happened when that ended.
    Modelica asks which condition *becomes* true."""
    ts = np.linspace(0.03, 1.93, 20)
    solution = run(compiled("Sampled"), ts)
    x = u = peak = t = 0.0
    phase, ticks, seen, states = 1, 0, False, []
    marks = sorted([*np.arange(0.0, 2.0, 0.25), *ts, 0.7, 1.1, 0.1, 0.6, 1.1 + 1e-9, 1.6])
    for mark in marks:
        if not seen and x + u * (mark - t) > 0.3:
            seen, phase = True, 2
        x, t = x + u * (mark - t), mark
        if mark in (0.7, 1.1):
            phase += 10
        if np.isclose(mark % 0.25, 0.0) and mark not in ts:
            u += 0.5 * (1.0 - x)
            peak = max(peak, u)
        if mark in (0.1, 0.6, 1.1 + 1e-9, 1.6):
            ticks = 0 if ticks == 2 else ticks + 1
        if mark in ts:
            states.append((x, u, peak, phase, ticks))
    for name, expected in zip(("x", "u", "peak", "phase", "ticks"), zip(*states, strict=True), strict=True):
        np.testing.assert_allclose(solution[f"m.{name}"], expected, atol=1e-7, err_msg=name)


ENDS = {"Ball": 3.0, "Clutch": 8.0, "Thermostat": 10.0, "Tank": 10.0, "Polynomial": 4.0, "Spring": 3.0, "Sampled": 2.0}


@pytest.mark.slow
@pytest.mark.parametrize("model", TWINS)
def test_a_model_runs_as_its_twin_in_base_modelica(model):
    """The same model through the other reader: the same parameters, and a run that differs by the solver's tolerance.
    No time is that of an event; after a time at which the model ends itself, both are NaN."""
    end = ENDS.get(model, 1.0)
    ts = (np.arange(19) + 0.317) * end / 19.0
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(FlatComponent(ev, "m", load(TWINS[model])))
    twin, system = AcausalCompiler(ev, diagram)(), compiled(model)
    theirs, ours = run(twin, ts), run(system, ts)
    values, others = ({n: v for n, v in s.parameters.items() if ":" not in n} for s in (system, twin))
    assert values == others
    for name in (n for n in twin.variables if ":" not in n):  # those with a colon are the readers' own
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-7, atol=1e-7, err_msg=name)
