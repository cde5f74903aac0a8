"""Every causal block against a closed form or an independent computation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
import scipy.signal
import scipy.special
from component_references import checks, measured
from problems import compiled
from scipy.linalg import expm
from sympy import Eq
from trajectories import trajectory

import jaxonomy_dae.library.signal as sig
from jaxonomy_dae import Component, EqnEnv, InitializationError, ModelError, der, simulate

ROUNDING = 1e-12  # of blocks without memory
X, VALUES = np.array([0.0, 1.0, 1.5, 3.0]), np.array([1.0, -1.0, 2.0, 0.5])
GRID = np.random.default_rng(0).normal(size=(4, 3))


class Reader(Component):
    """x' = y, what is read at place·t of a table."""

    def __init__(self, ev, name, pace):
        super().__init__(ev, name)
        pace = self.parameter("pace", pace)
        x, y = self.variable("x", start=0.0, fixed=True), self.input("y")
        self.output("u", pace * ev.t)
        self.add_equations(Eq(der(x), y))


@pytest.mark.slow
@pytest.mark.parametrize(
    "differentiated",
    [
        pytest.param(False, marks=pytest.mark.long("a program with events")),
        pytest.param(True, marks=pytest.mark.slow),
    ],
)
def test_a_table_whose_kinks_are_events(differentiated):
    """x(t) = (F(p·t) − F(0))/p with F the integral of the table, and dx/dp = (y(p·t)·t − x)/p: at the default
    tolerances to rounding, as steps see one line at a time."""
    ev, pace, end = EqnEnv(), 1.3, 2.5
    table, reader = sig.Table1D(ev, "table", X, VALUES, events=True), Reader(ev, "reader", pace)
    system = compiled(table, reader, connect=[(reader.u, table.u), (table.y, reader.y)])

    def reached(pace):
        return simulate(system.with_parameters({"reader.pace": pace}), end, ts=jnp.array([end]))["reader.x"][0]

    found = jax.value_and_grad(reached)(pace) if differentiated else [reached(pace)]
    line = scipy.interpolate.interp1d(X, VALUES, fill_value="extrapolate")
    places = np.unique(np.append(X[X < pace * end], pace * end))
    x = scipy.integrate.trapezoid(line(places), places) / pace
    np.testing.assert_allclose(found, [x, (line(pace * end) * end - x) / pace][: len(found)], rtol=1e-12)


@checks(
    {
        sig.Gain: ("arithmetic", "gain.y"),
        sig.Constant: ("arithmetic", "gain.y"),
        sig.Sum: ("arithmetic", "error.y"),
        sig.Product: ("arithmetic", "product.y"),
        sig.Saturation: ("NumPy's clip", "cut.y"),
        sig.DeadZone: ("arithmetic", "dead.y"),
        sig.Table1D: ("SciPy's interp1d and CubicHermiteSpline", "line.y", "curve.y"),
        sig.Table2D: ("SciPy's RegularGridInterpolator", "map.y"),
    },
    origin="rounding",
)
def test_blocks_without_memory():
    ev = EqnEnv()
    parts = [
        sig.Gain(ev, "gain", 3.0), sig.Sum(ev, "error", (1.0, -2.0, 0.5)), sig.Product(ev, "product", 3),
        sig.Saturation(ev, "cut", -0.5, 0.75), sig.DeadZone(ev, "dead", 0.4),
        sig.Table1D(ev, "line", X, VALUES), sig.Table1D(ev, "curve", X, VALUES, kind="cubic"),
        sig.Table2D(ev, "map", X, [0.0, 1.0, 4.0], GRID), sig.Constant(ev, "c", 2.0),
    ]  # fmt: skip
    system = compiled(*parts, connect=[(parts[-1].y, parts[0].u)])
    slopes = np.diff(VALUES) / np.diff(X)
    curve = scipy.interpolate.CubicHermiteSpline(X, VALUES, np.append(slopes[:1], slopes))
    line = scipy.interpolate.interp1d(X, VALUES, fill_value="extrapolate")
    surface = scipy.interpolate.RegularGridInterpolator((X, [0.0, 1.0, 4.0]), GRID, bounds_error=False, fill_value=None)
    names = ["gain.y", "error.y", "product.y", "cut.y", "dead.y", "line.y", "curve.y", "map.y"]
    observe = jax.jit(lambda inputs: system.observe(names, 0.0, system.initialize(inputs=inputs), inputs))
    for u in (-1.0, -0.3, 0.2, 0.7, 1.3, 2.9, 4.0):
        inputs = {"error.u1": u, "error.u2": 0.1, "error.u3": 0.2, "product.u1": u, "product.u2": 2.0}
        inputs |= {"product.u3": -1.5, "cut.u": u, "dead.u": u, "line.u": u, "curve.u": u, "map.u1": u, "map.u2": 1.7}
        expected = [
            6.0, u - 0.2 + 0.1, -3.0 * u, np.clip(u, -0.5, 0.75), np.sign(u) * max(abs(u) - 0.4, 0.0), float(line(u)),
            float(curve(u)), float(surface([u, 1.7])[0]),
        ]  # fmt: skip
        found = observe({k: jnp.asarray(v) for k, v in inputs.items()})
        for name, value, true in zip(names, np.asarray(found), expected, strict=True):
            measured(name, value, true, ROUNDING * (1.0 + abs(true)), scale=abs(true) or 1.0)


def loop(k, law=None):
    """y = k·(u − law(y)), without memory."""
    ev = EqnEnv()
    u, gain, error = sig.Constant(ev, "u", 3.0), sig.Gain(ev, "gain", k), sig.Sum(ev, "error", (1.0, -1.0))
    back = sig.Gain(ev, "back", 1.0) if law is None else law(ev, "back")
    pairs = [(u.y, error.u1), (back.y, error.u2), (error.y, gain.u), (gain.y, back.u)]
    return compiled(u, gain, error, back, connect=pairs)


@pytest.mark.slow
def test_the_values_of_tables_are_trained_and_not_their_points():
    ev = EqnEnv()
    system = compiled(sig.Table1D(ev, "line", X, VALUES), sig.Table2D(ev, "map", X, [0.0, 1.0, 2.0], GRID))
    trained = jax.tree.leaves(system.partition("line.table", "map.table")[0])
    assert sorted(leaf.shape for leaf in trained) == [VALUES.shape, GRID.shape]


def test_loops_without_memory_are_solved():
    linear = loop(4.0)

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def loudness(k):
        system = linear.with_parameters({"gain.k": k})
        return system.observe("gain.y", 0.0, system.initialize())

    k = np.array([4.0, -7.0, 1e6])
    found, slope = loudness(k)
    np.testing.assert_allclose(found, 3 * k / (1 + k), rtol=ROUNDING)
    np.testing.assert_allclose(slope[:2], 3 / (1 + k[:2]) ** 2, rtol=ROUNDING)
    limited = loop(4.0, lambda ev, name: sig.Saturation(ev, name, -0.5, 0.75))
    curved = loop(0.5, lambda ev, name: sig.Table1D(ev, name, [-9.0, 0.0, 9.0], [-81.0, 0.0, 81.0]))
    read = jax.jit(lambda: [s.observe("gain.y", 0.0, s.initialize()) for s in (limited, curved)])
    # 4·(3 − 0.75), beyond the limit
    np.testing.assert_allclose(read(), [9.0, 1.5 / 5.5], rtol=ROUNDING)


def test_a_loop_without_a_solution_is_named():
    with pytest.raises(InitializationError, match=r"gain"):
        system = loop(4.0).with_parameters({"gain.k": -1.0})
        system.initialize()


def test_an_input_that_nothing_drives_is_named():
    ev = EqnEnv()
    system = compiled(sig.Gain(ev, "gain", 2.0))
    with pytest.raises(ModelError, match=r"gain\.u"):
        simulate(system, 1.0)


W = 2.0  # rad/s of the input sin(W·t)
TS = np.linspace(0.0, 3.0, 7)


def response(numerator, denominator):
    """The response to sin(W·t) from rest, by the exponential of the matrix with the oscillator appended."""
    a, b, c, d = scipy.signal.tf2ss(numerator, denominator)
    n = len(a)
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n] = a, b[:, 0]
    whole[n, n + 1], whole[n + 1, n] = W, -W
    states = np.array([expm(whole * t) @ np.append(np.zeros(n + 1), 1.0) for t in TS])
    return states[:, :n] @ c[0] + d[0, 0] * states[:, n]


EDGES = [0.25, 0.5, 2.25]
LIMITED = {"windup": None, "quick": 0.25}  # PI controllers with the default time of back-calculation and another


@functools.cache
def dynamic():
    """Blocks behind a sine and their responses; two controlled lags, and two behind limited PI controllers. What was
    found, and what is true of the first."""
    ev = EqnEnv()
    source = sig.Sine(ev, "source", 1.0, W / (2 * np.pi))
    delay = scipy.interpolate.pade([(-0.5) ** k / float(scipy.special.factorial(k)) for k in range(9)], 4)
    blocks = {
        sig.Integrator(ev, "sum", 2.0): response([2.0], [1.0, 0.0]),
        sig.FirstOrder(ev, "lag", 3.0, 0.5): response([3.0], [0.5, 1.0]),
        sig.SecondOrder(ev, "swing", 2.0, 4.0, 0.3): response([32.0], [1.0, 2.4, 16.0]),
        sig.DerivativeFilter(ev, "slope", 2.0, 0.1): response([2.0, 0.0], [0.1, 1.0]),
        sig.TransferFunction(ev, "tf", [2.0, 1.0, 3.0], [0.5, 1.0, 2.0]): response([2.0, 1.0, 3.0], [0.5, 1.0, 2.0]),
        sig.StateSpace(ev, "ss", [[0, 1], [-2, -0.5]], [[0], [1]], [[1, 0.2]], [[0.3]]): response(
            *(v.ravel() for v in scipy.signal.ss2tf([[0, 1], [-2, -0.5]], [[0], [1]], [[1, 0.2]], [[0.3]]))
        ),
        sig.PadeDelay(ev, "late", 0.5, 4): response(delay[0].coeffs, delay[1].coeffs),
    }
    joined = [(source.y, block.u) for block in blocks]
    step, ramp = sig.Step(ev, "step", 2.0, 0.5), sig.Ramp(ev, "ramp", 1.0, 2.0, 0.25)
    pid = sig.PID(ev, "pid", 3.0, 0.8, 0.1, 0.5, 8.0, 0.7, low=-1.0, high=2.5)
    pi = sig.PI(ev, "pi", 2.0, 0.6)
    first, second = sig.FirstOrder(ev, "first", 1.0, 0.4), sig.FirstOrder(ev, "second", 1.5, 0.3)
    joined += [
        (step.y, pid.setpoint), (first.y, pid.measured), (pid.y, first.u),
        (ramp.y, pi.setpoint), (second.y, pi.measured), (pi.y, second.u),
    ]  # fmt: skip
    expected = {f"{block.name}.y": true for block, true in blocks.items()}
    parts = [source, step, ramp, *blocks, pid, pi, first, second]
    names = [*expected, "first.y", "second.y", "pid.v"]
    for name, Tt in LIMITED.items():
        limited = sig.PI(ev, name, 4.0, 0.5, low=-0.2, high=1.2, Tt=Tt)
        lag = sig.FirstOrder(ev, f"{name}_lag", 1.0, 0.8)
        parts += [limited, lag]
        joined += [(lag.y, limited.measured), (limited.y, lag.u)]
        names += [f"{name}.v", f"{name}.x", f"{name}_lag.y"]
    system = compiled(*parts, connect=joined)
    inputs = {f"{name}.setpoint": 1.0 for name in LIMITED}
    return trajectory(system, TS, names, inputs, edges=EDGES), expected


RESPONSE = "matrix exponential of SciPy's tf2ss"


@checks(
    {
        sig.Sine: (RESPONSE, "sum.y"),
        sig.Integrator: (RESPONSE, "sum.y"),
        sig.FirstOrder: (RESPONSE, "lag.y"),
        sig.SecondOrder: (RESPONSE, "swing.y"),
        sig.DerivativeFilter: (RESPONSE, "slope.y"),
        sig.TransferFunction: (RESPONSE, "tf.y"),
        sig.StateSpace: ("matrix exponential of SciPy's ss2tf", "ss.y"),
        sig.PadeDelay: ("matrix exponential of SciPy's pade", "late.y"),
    },
    origin="rtol 1e-9 for each of fewer than 200 steps",
)
def test_blocks_with_memory():
    solution, expected = dynamic()
    for name, true in expected.items():
        measured(name, solution[name], true, 2e-7 * np.abs(true).max())
    late = np.where(TS < 0.5, 0.0, np.sin(W * (TS - 0.5)))
    assert np.abs(np.asarray(solution["late.y"]) - late)[2:].max() < 1e-2  # what order 4 leaves


LOOP = "SciPy's Radau of the loop's equations, from kink to kink"


@checks(
    {
        sig.PID: (LOOP, "first.y"),
        sig.Step: (LOOP, "first.y"),
        sig.PI: (LOOP, "second.y"),
        sig.Ramp: (LOOP, "second.y"),
    },
    origin="rtol 1e-9 here and 1e-10 there; the limit is left and reached between steps",
)
def test_a_controlled_plant_against_scipy():
    """A lag behind a PID controller with limits, and another behind a PI controller; the limit is reached."""
    solution, _ = dynamic()

    def slopes(t, s):
        y, i, smooth, x, z = s
        r, q = 2.0 * (t >= 0.5), min(max((t - 0.25) / 2.0, 0.0), 1.0)
        v = 3.0 * (0.7 * r - y) + i - 3.0 * 8.0 * (y - smooth)
        u = min(max(v, -1.0), 2.5)
        return [
            (u - y) / 0.4, 3.0 * (r - y) / 0.8 + (u - v) / 0.5, (y - smooth) * 8.0 / 0.1,
            (q - z) / 0.6, (1.5 * 2.0 * (q - z + x) - z) / 0.3,
        ]  # fmt: skip

    at = [np.zeros(5)]
    for a, b in zip([0.0, 0.25, 0.5, 2.25], [0.25, 0.5, 2.25, 3.0], strict=True):
        inside = TS[(TS > a) & (TS <= b)]
        run = scipy.integrate.solve_ivp(
            slopes, (a + 1e-14, b), at[-1], "Radau", rtol=1e-10, atol=1e-12, t_eval=np.union1d(inside, [b])
        )
        for t, column in zip(run.t, run.y.T, strict=True):
            if t in inside or t == b:
                at.append(column)
    table = {t: s for t, s in zip(np.union1d(TS, [0.25, 0.5, 2.25]), at, strict=True)}
    expected = np.array([table[t] for t in TS])
    assert np.max(solution["pid.v"]) > 2.5  # the limit matters
    measured("first.y", solution["first.y"], expected[:, 0], 1e-6)
    measured("second.y", solution["second.y"], expected[:, 4], 1e-6)


@checks(
    {sig.PI: ("SciPy's solution of a loop with a lag, limited", "lag.y", "pi.x")},
    origin="rtol 1e-9 here and 1e-11 there; the limit is left between steps",
)
def test_a_limited_pi_controller():
    """A lag behind it that can reach its setpoint of 1 only slowly; without back-calculation it would overshoot."""
    solution, _ = dynamic()
    for name, Tt in LIMITED.items():

        def slopes(t, s, Tt=Tt):
            y, i = s  # in the form of PID: i = k·x
            v = 4.0 * (1.0 - y) + i
            u = min(max(v, -0.2), 1.2)
            return [(u - y) / 0.8, 4.0 * (1.0 - y) / 0.5 + (u - v) / (Tt or 0.5)]

        run = scipy.integrate.solve_ivp(
            slopes, (0, 3), [0, 0], "Radau", t_eval=TS, rtol=1e-11, atol=1e-13, max_step=0.01
        )
        assert np.max(solution[f"{name}.v"]) > 1.2
        measured("lag.y", solution[f"{name}_lag.y"], run.y[0], 1e-6)
        measured("pi.x", 4.0 * solution[f"{name}.x"], run.y[1], 1e-6)


@pytest.mark.slow
@checks(
    {sig.Noise: ("mean, variance and correlation of independent normal values", "mean", "variance", "correlation")},
    origin="four standard deviations of 2,000 values",
)
def test_noise_belongs_to_its_key():
    ev = EqnEnv()
    system = compiled(sig.Noise(ev, "n", jax.random.key(3), 2.0, 0.1), sig.Noise(ev, "m", jax.random.key(4), 2.0, 0.1))
    read = jax.jit(jax.vmap(lambda t: system.observe(["n.y", "m.y"], t, system.initialize(t0=t))))
    values = np.asarray(read(jnp.arange(2000.0) * 0.1))
    # 2,000 independent values: the mean's deviation is 2/√2000, the variance's 4·√(2/2000); four of each.
    measured("mean", values.mean(axis=0), 0.0, 4 * 2 / np.sqrt(2000), scale=2.0)
    measured("variance", values.var(axis=0), 4.0, 4 * 4 * np.sqrt(2 / 2000))
    measured("correlation", np.corrcoef(values.T)[0, 1], 0.0, 4 / np.sqrt(2000), scale=1.0)
    between = np.asarray(read(jnp.array([0.7, 0.725, 0.8])))[:, 0]
    assert between[1] == pytest.approx(0.75 * between[0] + 0.25 * between[2], rel=1e-9)
