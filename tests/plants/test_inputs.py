"""Inputs: read when they are given, seen by the steps, differentiable, and refused by name where they cannot be."""

import functools
import math

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import sympy
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, ModelError, assign, der, simulate
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.solvers import BDF, Rodas5P

END = jnp.array([10.0])


class Lag(Component):
    """x' = −0.1·x + 3·u, from 0; y = u."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, x = self.input("u"), self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), -0.1 * x + 3 * u))
        self.output("y", u)


class Rate(Component):
    """x = ∫u' + u dt: the model differentiates its input."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, x, y = self.input("u"), self.variable("x", start=0.0, fixed=True), self.variable("y")
        self.add_equations(Eq(y, u), Eq(der(x), der(y) + u))


@pytest.fixture(scope="module")
def lag():
    return compiled(Lag(EqnEnv(), "m"))


@pytest.fixture(scope="module")
def rate():
    return compiled(Rate(EqnEnv(), "m"))


def convolved(u, end=10.0, breaks=()):
    """x(end) of `Lag` for an input u(t), by quadrature between its breaks."""
    ends = [0.0, *breaks, end]
    return sum(
        scipy.integrate.quad(lambda s: 3 * np.exp(-0.1 * (end - s)) * float(u(s)), a, b, epsabs=1e-13, epsrel=1e-13)[0]
        for a, b in zip(ends, ends[1:], strict=False)
    )


def constant(value):
    return 30 * value * (1 - np.exp(-1.0))


# --- what a function reads -----------------------------------------------------------------------------------------


GAIN = 1.0


def from_global(t):
    return GAIN * jnp.ones_like(t)


class Owner:
    def __init__(self, gain):
        self.gain = gain

    def __call__(self, t):
        return self.gain * jnp.ones_like(t)

    def method(self, t):
        return self.gain * jnp.ones_like(t)


TIGHT = {"rtol": 1e-8, "atol": 1e-10, "adjoint": diffrax.ForwardMode()}
FAST = {"adjoint": diffrax.ForwardMode()}  # whose programs compile fastest, where nothing is differentiated
READERS = {
    "function": lambda owner, data: from_global,
    "object": lambda owner, data: owner,
    "method": lambda owner, data: owner.method,
    "partial": lambda owner, data: functools.partial(Owner.method, owner),
    "array": lambda owner, data: lambda t: jnp.interp(t, jnp.linspace(0.0, 10.0, 5), data),
}


@pytest.fixture(scope="module")
def lags():
    """Lags that are named after what drives them."""
    ev = EqnEnv()
    return compiled(*(Lag(ev, name) for name in READERS))


@pytest.mark.slow
@pytest.mark.long("what is read again must be read in each way alone")
def test_what_changed_is_read_again(lags, monkeypatch):
    """Globals, attributes and arrays: each changes by itself, so that no other makes the program be traced again."""
    owners = {name: Owner(1.0) for name in READERS}
    data, values = np.ones(5), dict.fromkeys(READERS, 1.0)
    monkeypatch.setitem(globals(), "GAIN", 1.0)

    def agree():
        inputs = {f"{name}.u": read(owners[name], data) for name, read in READERS.items()}
        solution = simulate(lags, 10.0, ts=END, inputs=inputs, **FAST)
        for name, value in values.items():
            np.testing.assert_allclose(solution[f"{name}.x"], constant(value), rtol=1e-5)
            np.testing.assert_allclose(solution[f"{name}.y"], value, rtol=1e-12)
        observed = lags.observe([f"{name}.y" for name in READERS], 0.0, jnp.ones(len(READERS)), inputs)
        np.testing.assert_allclose(observed, list(values.values()), rtol=1e-12)
        return solution

    first = agree()
    for k, name in enumerate(READERS):
        values[name] = 2.0 - 3 * k
        if name == "function":
            monkeypatch.setitem(globals(), "GAIN", values[name])
        elif name == "array":
            data[:] = values[name]
        else:
            owners[name].gain = values[name]
        agree()
    np.testing.assert_allclose(first["array.y"], 1.0)  # a solution keeps what was simulated


@pytest.mark.slow
def test_what_a_branch_reads_is_read_again(lag):
    """Numbers inside control flow are part of the traced program, not of its operands."""
    for value in (1.0, 2.0):
        inputs = {"m.u": lambda t, k=value: jax.lax.cond(t > -1.0, lambda: k, lambda: 0.0)}
        solution = simulate(lag, 10.0, ts=END, inputs=inputs, **FAST)
        np.testing.assert_allclose(solution["m.x"], constant(value), rtol=1e-5)
        np.testing.assert_allclose(solution["m.y"], value, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Rodas5P(), BDF()])
def test_a_jump_at_the_end_is_not_seen(lag, solver):
    """Stages of the last step would read the values from after the jump."""
    plain = {"m.u": (np.array([0.0, 20.0]), np.array([1.0, 1.0]), "held")}
    jumping = {"m.u": (np.array([0.0, 10.0]), np.array([1.0, 1e3]), "held")}
    runs = [simulate(lag, 10.0, inputs=inputs, solver=solver, **FAST) for inputs in (plain, jumping)]
    np.testing.assert_allclose(runs[1]["m.x"][-1], constant(1.0), rtol=2e-5)
    assert runs[1].stats["num_steps"] < runs[0].stats["num_steps"] + 10 and runs[1].ts[-1] == 10.0
    assert runs[1]["m.y"][-1] == 1e3


@pytest.mark.slow
def test_new_functions_of_the_same_form_share_a_program(lag):
    def call(gain, knots):
        return simulate(
            lag, 10.0, ts=END, inputs={"m.u": lambda t: gain * jnp.interp(t, knots, knots) + gain**2}, **FAST
        )["m.x"]  # fmt: skip

    knots = np.array([0.0, 10.0])
    call(1.0, knots)
    before = len(PROGRAMS)
    for gain in (2.0, -0.5):
        np.testing.assert_allclose(
            call(gain, knots * 1.0), convolved(lambda t, k=gain: k * t + k * k), rtol=1e-5
        )  # fmt: skip
    assert len(PROGRAMS) == before


@pytest.mark.slow
def test_inputs_of_initialization_are_not_stale(rate):
    """der(u) is an unknown of the start: initialize with two functions of one form."""
    for gain in (1.0, 2.0):
        solution = simulate(rate, 1.0, ts=jnp.array([1.0]), inputs={"m.u": lambda t, k=gain: k * jnp.sin(t)}, **FAST)
        np.testing.assert_allclose(solution["m.x"], gain * (np.sin(1.0) + 1 - np.cos(1.0)), rtol=1e-5)


# --- samples -------------------------------------------------------------------------------------------------------

PULSE = (np.array([0.0, 5.0, 5.1, 10.0]), np.array([0.0, 1.0, 0.0, 0.0]), "held")
PULSED = 30 * (np.exp(-0.49) - np.exp(-0.5))


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Rodas5P(), BDF()])
def test_a_short_pulse_is_seen(lag, solver):
    solution = simulate(lag, 10.0, ts=jnp.array([4.9, 5.0, 5.05, 10.0]), inputs={"m.u": PULSE}, solver=solver)
    np.testing.assert_allclose(solution["m.x"][-1], PULSED, rtol=1e-5)
    np.testing.assert_array_equal(solution["m.y"], [0.0, 1.0, 1.0, 0.0])
    assert solution.stats["num_steps"] < 100


PEAK = np.array([-0.01, 0.0, 0.01])  # a triangle of width 0.02, each at a time of its own


@pytest.fixture(scope="module")
def sampled():
    """Samples of every kind, whose breaks are at different times: the solution, and what each lag must have."""
    times = {name: np.array([0.0, *(at + PEAK), 10.0]) for name, at in (("linear", 1.0), ("cubic", 7.0), ("path", 9.0))}
    values = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    knots = {name: jnp.array(times[name]) for name in ("cubic", "path")}
    hermite = jax.jit(diffrax.backward_hermite_coefficients)
    paths = {n: diffrax.CubicInterpolation(t, hermite(t, values)) for n, t in knots.items()}
    straight = diffrax.LinearInterpolation(jnp.array([0.0, 3.0, 10.0]), jnp.array([1.0, -1.0, 2.0]))
    inputs = {
        "held": PULSE,
        "linear": (times["linear"], values),
        "cubic": (times["cubic"], values, "cubic"),
        "path": paths["path"],
        "interpolation": straight,
        "evaluate": straight.evaluate,
    }
    smooth = {n: jax.jit(lambda t, path=p: path.evaluate(t)) for n, p in paths.items()}
    expected = {
        "held": PULSED,
        "linear": convolved(lambda t: np.interp(t, times["linear"], values), breaks=times["linear"][1:-1]),
        "cubic": convolved(smooth["cubic"], breaks=times["cubic"][1:-1]),
        "path": convolved(smooth["path"], breaks=times["path"][1:-1]),
        "interpolation": convolved(lambda t: np.interp(t, [0.0, 3.0, 10.0], [1.0, -1.0, 2.0]), breaks=[3.0]),
    }
    ev = EqnEnv()
    system = compiled(*(Lag(ev, name) for name in inputs))
    ts = jnp.array([4.9, 5.0, 5.05, 10.0])
    solution = simulate(system, 10.0, ts=ts, inputs={f"{n}.u": u for n, u in inputs.items()}, **TIGHT)
    return solution, expected | {"evaluate": expected["interpolation"]}


@pytest.mark.slow
@pytest.mark.long("the program of all kinds of samples, and quadrature")
@pytest.mark.parametrize("name", ["held", "linear", "cubic", "path", "interpolation", "evaluate"])
def test_short_pulses_and_narrow_peaks_are_seen(sampled, name):
    solution, expected = sampled
    np.testing.assert_allclose(solution[f"{name}.x"][-1], expected[name], rtol=1e-7)
    if name == "held":
        np.testing.assert_array_equal(solution["held.y"], [0.0, 1.0, 1.0, 0.0])


class Sampler(Component):
    """x' = q, from 0, where q = u² and p = (1 for u > 0.25, else 0) are sampled every 0.1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, x = self.input("u"), self.variable("x", start=0.0, fixed=True)
        y, z = self.variable("y"), self.variable("z")
        q, p = self.discrete("q", start=-1.0), self.discrete("p", start=-1.0)
        self.add_equations(
            Eq(der(x), q), Eq(y, u**2), Eq(z, sympy.Piecewise((1.0, u > 0.25), (0.0, True), evaluate=False))
        )
        self.when(self.sampled(0.1), assign(q, y), assign(p, z))


@pytest.mark.slow
def test_a_sample_at_a_tick_is_the_new_one():
    """On whichever side of a tick its time is rounded, and in the branches that it chooses. Sums of squares."""
    system, k = compiled(Sampler(EqnEnv(), "m")), np.arange(8)
    even = 0.1 * k
    ts = np.array([0.05, 0.15, 0.25, 0.35, 0.75])

    def run(times, scale):
        given = {"m.u": (jnp.asarray(times), scale * jnp.asarray(even), "held")}
        return simulate(system, 0.75, ts=jnp.asarray(ts), inputs=given)

    before = np.where(k > 0, np.nextafter(even, -1.0), 0.0)
    for times in (even, np.nextafter(even, 9.0), before, np.cumsum(np.full(8, 0.1)) - 0.1):
        found = run(times, 1.0)
        np.testing.assert_allclose(found["m.q"], (0.1 * np.floor(10 * ts)) ** 2, rtol=1e-12)
        np.testing.assert_array_equal(found["m.p"], [0.0, 0.0, 0.0, 1.0, 1.0])
    slope = jax.grad(lambda scale: run(even, scale)["m.x"][-1])(1.0)
    np.testing.assert_allclose(slope, 2 * (0.1 * np.sum(even[:7] ** 2) + 0.05 * even[7] ** 2), rtol=1e-10)


@pytest.mark.slow
def test_two_sampled_inputs():
    ev = EqnEnv()
    system = compiled(Lag(ev, "a"), Lag(ev, "b"))
    held = (np.array([0.0, 5.0, 5.1]), np.array([0.0, 1.0, 0.0]), "held")
    solution = simulate(system, 10.0, ts=END, inputs={"a.u": PULSE, "b.u": held})
    np.testing.assert_allclose([solution["a.x"][0], solution["b.x"][0]], PULSED, rtol=1e-5)


@pytest.mark.slow
def test_sampled_values_and_times_are_differentiated(lag):
    """x(10) = 30·(e^(−0.49) − e^(−0.5))·v for a pulse of height v that begins at s: ∂/∂s = −3·e^(−0.1·(10 − s))·v."""

    def last(start, height):
        times, values = jnp.stack([0.0 * start, start, 5.1 + 0 * start]), jnp.stack([0 * height, height, 0 * height])
        return simulate(lag, 10.0, ts=END, inputs={"m.u": (times, values, "held")}, rtol=1e-9, atol=1e-11)["m.x"][0]

    value, slopes = jax.jit(jax.value_and_grad(last, argnums=(0, 1)))(5.0, 2.0)
    np.testing.assert_allclose(value, 2 * PULSED, rtol=1e-8)
    np.testing.assert_allclose(slopes[1], PULSED, rtol=1e-8)
    np.testing.assert_allclose(slopes[0], -6 * np.exp(-0.5), rtol=1e-6)


@pytest.mark.slow
def test_a_batch_of_samples(lag):
    heights = np.array([1.0, -2.0, 0.5])

    @jax.jit
    @jax.vmap
    def last(height):
        values = jnp.stack([0 * height, height, 0 * height, 0 * height])
        return simulate(lag, 10.0, ts=END, inputs={"m.u": (PULSE[0], values, "held")}, **FAST)["m.x"][0]

    np.testing.assert_allclose(last(heights), heights * PULSED, rtol=1e-5)


@pytest.mark.slow
def test_a_linear_input_that_is_differentiated_jumps(rate):
    """x = u(t) − u(0) + ∫u, u' is a step function."""
    times, values = np.array([0.0, 0.5, 0.52, 1.0]), np.array([0.0, 0.0, 1.0, 1.0])
    solution = simulate(rate, 1.0, ts=jnp.array([1.0]), inputs={"m.u": (times, values)}, **FAST)
    np.testing.assert_allclose(solution["m.x"], 1.0 + np.trapezoid(values, times), rtol=1e-6)


@pytest.mark.slow
def test_more_samples_than_steps_allowed(lag):
    times = np.linspace(0.0, 10.0, 400)
    solution = simulate(lag, 10.0, ts=END, inputs={"m.u": (times, np.cos(times))}, max_steps=100, **FAST)
    np.testing.assert_allclose(
        solution["m.x"], convolved(lambda t: np.interp(t, times, np.cos(times)), breaks=times[1:-1]), rtol=1e-6
    )  # fmt: skip


@pytest.mark.slow
def test_the_longest_step(lag):
    """A pulse in a function, whose steps nobody knows."""

    def pulse(t):
        return jnp.where((t >= 5.0) & (t < 5.1), 1.0, 0.0)

    for options in (dict(dtmax=0.02), dict(jump_ts=jnp.array([5.0, 5.1])), dict(dtmax=0.05, jump_ts=5.0)):
        solution = simulate(lag, 10.0, ts=END, inputs={"m.u": pulse}, **options)
        np.testing.assert_allclose(solution["m.x"], PULSED, rtol=1e-3)
    assert solution.stats["num_steps"] >= 200


# --- refused -------------------------------------------------------------------------------------------------------


class Wide(eqx.Module):
    def __call__(self, t):
        return jnp.ones(3)


@pytest.mark.parametrize(
    "given, message",
    [
        (np.sin, r"'m\.u' computes with NumPy or math.*jax\.numpy"),
        (math.sin, r"'m\.u' computes with NumPy or math.*jnp\.sin"),
        (lambda t: np.interp(t, [0.0, 1.0], [0.0, 1.0]), r"'m\.u' computes with NumPy.*jnp\.interp for np\.interp"),
        (lambda t: 1.0 if t > 1 else 0.0, r"'m\.u' decides by the time with a Python `if`.*jnp\.where"),
        (lambda t, x: t, r"'m\.u' failed when called with the time: TypeError"),
        (lambda t: None, r"'m\.u' must return one number for a time; it returned nothing"),
        (lambda t: jnp.ones(1), r"'m\.u' must return one number for a time; it returned shape \(1,\)"),
        (Wide(), r"'m\.u' must return one number for a time; it returned shape \(3,\)"),
        (lambda t: jnp.exp(jnp.complex128(1j) * t.astype(complex)), r"'m\.u' must be real; it returned complex128"),
        (1j, r"'m\.u' must be real; got complex128"),
        ("2", r"'m\.u' must be a number, samples or a function of time; got the text '2'"),
        (jnp.ones(3), r"'m\.u' must be a number, samples.*got shape \(3,\)"),
        ({"t": 1.0}, r"'m\.u' must be a number, samples or a function of time; got dict"),
        (([0.0, 1.0, 0.5, 10.0], np.ones(4)), r"'m\.u': times must increase; times\[1\]=1\.0 is followed by"),
        (([0.0, 5.0, 5.0, 10.0], np.ones(4)), r"times must increase.*'held'"),
        (([0.0, 10.0], np.ones(3)), r"needs a value for every time; got 2 times and 3 values"),
        (([0.0, 10.0], [0.0, np.nan]), r"'m\.u': values\[1\] is nan"),
        (([0.0, np.inf], [0.0, 1.0]), r"'m\.u': times\[1\] is inf"),
        (([0.0, 10.0], np.ones((2, 2))), r"'m\.u': values must be real numbers of shape \(n,\)"),
        (([0.0, 10.0], np.ones(2) * 1j), r"'m\.u': values must be real numbers of shape \(n,\); got complex128"),
        (([0.0, 10.0], np.ones(2), "quadratic"), r"samples are 'linear', 'spline', 'cubic' or 'held'; got 'quadratic'"),
        (([0.0, 9.0], np.ones(2)), r"samples of input 'm\.u' reach from 0 to 9, the run from 0 to 10"),
        (([1.0, 10.0], np.ones(2), "held"), r"reach from 1 to 10, the run from 0 to 10"),
        (
            diffrax.LinearInterpolation(jnp.array([0.0, 10.0]), jnp.ones((2, 2))),
            r"'m\.u' needs an interpolation of values of shape \(n,\); it returns \[\(2,\)\]",
        ),
        (
            diffrax.LinearInterpolation(jnp.array([0.0, 10.0]), jnp.array([0.0, jnp.nan])),
            r"'m\.u': a value of LinearInterpolation is not finite",
        ),
    ],
)  # fmt: skip
def test_inputs_that_cannot_be_read(lag, given, message):
    with pytest.raises(ModelError, match=message):
        simulate(lag, 10.0, inputs={"m.u": given})


def test_unknown_inputs_and_wrong_tables(lag, rate):
    with pytest.raises(ModelError, match=r"'m\.v' is not an input of this system: did you mean 'm\.u'"):
        simulate(lag, 10.0, inputs={"m.v": 1.0})
    with pytest.raises(ModelError, match=r"differentiates input 'm\.u' once: held samples.*Give 'spline'"):
        simulate(rate, 1.0, inputs={"m.u": PULSE})
    for jumps, message in ((jnp.ones((2, 2)), r"shape \(2, 2\)"), (math.nan, "must be finite")):
        with pytest.raises(ModelError, match="jump_ts " + message if "finite" in message else message):
            simulate(lag, 10.0, inputs={"m.u": 1.0}, jump_ts=jumps)
    with pytest.raises(ModelError, match="jump_ts and StepTo both say where steps end"):
        steps = diffrax.StepTo(ts=jnp.linspace(0.0, 10.0, 11))
        simulate(lag, 10.0, inputs={"m.u": 1.0}, jump_ts=5.0, stepsize_controller=steps)
    for initial, message in (({"m.x": 1j}, "must be real; got complex128"), ({"m.x": "1"}, "needs a scalar; got '1'")):
        with pytest.raises(ModelError, match=r"initial: 'm\.x' " + message):
            simulate(lag, 10.0, inputs={"m.u": 1.0}, initial=initial)
