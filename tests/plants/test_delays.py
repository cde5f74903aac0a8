"""Delayed quantities: against the method of steps, travelling waves and SciPy; derivatives through the past."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from hybrid_models import compiled
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from sympy import Piecewise

from jaxonomy_dae import Component, ModelError, SimulationError, der, linearize, reinit, simulate, steady_state
from jaxonomy_dae.solvers import Rodas5P
from jaxonomy_dae.write import Eq

TIGHT: Any = dict(rtol=1e-9, atol=1e-11)


class Decay(Component):
    """dx/dt = a·x(t − T), x = 1 until t = 0; `rate` is the derivative of what is delayed."""

    def __init__(self, ev, name, a=-1.0, T=1.0):
        super().__init__(ev, name)
        a, T = self.parameter("a", a), self.parameter("T", T)
        x, rate = self.variable("x", start=1.0, fixed=True), self.variable("rate")
        late = self.delayed("late", x, T)
        self.add_equations(Eq(der(x), a * late), Eq(rate, der(late)))


class Plain(Component):
    """As `Decay`, without the derivative."""

    def __init__(self, ev, name, a=-1.0, T=1.0):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        late = self.delayed("late", x, self.parameter("T", T))
        self.add_equations(Eq(der(x), self.parameter("a", a) * late))


def decayed(t, a=-1.0, T=1.0):
    """x by the method of steps: a polynomial in each interval of length T."""
    return sum(a**k * jnp.maximum(t - (k - 1) * T, 0.0) ** k / float(math.factorial(k)) for k in range(25))


class Line(Component):
    """A lossless line between a source of a step and a load: the two waves on it are delayed, and follow each other
    without an integration between. `q` is the integral of the voltage at the load."""

    def __init__(self, ev, name, Z=50.0, TD=0.25, Rs=20.0, RL=200.0, begin=0.3):
        super().__init__(ev, name)
        Z, TD, Rs, RL, begin = (
            self.parameter(n, v) for n, v in (("Z", Z), ("TD", TD), ("Rs", Rs), ("RL", RL), ("begin", begin))
        )
        v1, v2, i1, i2, es, er = (self.variable(n) for n in ("v1", "v2", "i1", "i2", "es", "er"))
        q = self.variable("q", start=0.0, fixed=True)
        late = {n: self.delayed(f"{n}_late", e, TD) for n, e in (("v1", v1), ("v2", v2), ("es", es), ("er", er))}
        self.add_equations(
            Eq(i1, (v1 - es) / Z), Eq(i2, (v2 - er) / Z), Eq(es, 2 * late["v2"] - late["er"]),
            Eq(er, 2 * late["v1"] - late["es"]), Eq(v1, Piecewise((0, ev.t < begin), (1, True)) - Rs * i1),
            Eq(v2, -RL * i2), Eq(der(q), v2),
        )  # fmt: skip


LINE = {"m.Z": 50.0, "m.TD": 0.25, "m.Rs": 20.0, "m.RL": 200.0, "m.begin": 0.3}


def waves(t, Z, TD, Rs, RL, begin):
    """(voltage at the load, its integral) by the diagram of bounces."""
    source, load = (Rs - Z) / (Rs + Z), (RL - Z) / (RL + Z)
    k = jnp.arange(20.0)
    size = Z / (Rs + Z) * (1 + load) * (source * load) ** k
    since = t - begin - (2 * k + 1) * TD
    return jnp.sum(jnp.where(since > 0, size, 0.0)), jnp.sum(size * jnp.maximum(since, 0.0))


class Stretched(Component):
    """A pulse of speed, delayed by a time that changes: y follows what a source that jumps at t = 1 and 2 was."""

    def __init__(self, ev, name, wide=0.4, quick=1.3, delay=1.0):
        super().__init__(ev, name)
        wide, quick, delay = (
            self.parameter("wide", wide),
            self.parameter("quick", quick),
            self.parameter("delay", delay),
        )
        x, y = self.variable("x", start=0.0, fixed=True), self.variable("y", start=0.0, fixed=True)
        pulse = Piecewise((0, ev.t < 1), (1 + x, ev.t < 2), (0, True))
        late = self.delayed("late", pulse, delay + wide * sympy.sin(quick * ev.t), longest=2 * delay)
        self.add_equations(Eq(der(x), sympy.cos(ev.t)), Eq(der(y), late))


class Blood(Component):
    """Mackey & Glass (1977): dx/dt = b·x(t − T)/(1 + x(t − T)ⁿ) − c·x."""

    def __init__(self, ev, name, b=0.2, c=0.1, n=10, T=17.0, start=0.5):
        super().__init__(ev, name)
        b, c, T = self.parameter("b", b), self.parameter("c", c), self.parameter("T", T)
        x = self.variable("x", start=start, fixed=True)
        late = self.delayed("late", x, T)
        self.add_equations(Eq(der(x), b * late / (1 + late**n) - c * x))


def test_by_the_method_of_steps():
    ts = jnp.linspace(0.0, 5.0, 23)
    run = simulate(compiled(Decay, "m"), 5.0, ts=ts, **TIGHT)
    assert np.abs(run["m.x"] - decayed(ts)).max() < 1e-9
    late = jnp.where(ts > 1, decayed(ts - 1), 1.0)
    assert np.abs(run["m.late"] - late).max() < 1e-9
    rate = jnp.where(ts > 2, -decayed(ts - 2), jnp.where(ts > 1, -1.0, 0.0))
    assert np.abs(run["m.rate"] - rate).max() < 1e-7  # a polynomial's slope is less exact than its values


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Rodas5P()], ids=["Tsit5", "Rodas5P"])
def test_derivatives(solver):
    # Without der(late) for Rodas5P, whose steps take derivatives of the field themselves.
    system, end = compiled(Decay if solver is None else Plain, "m"), 4.3

    def last(p):
        at = system.with_parameters({"m.a": p[0], "m.T": p[1]})
        return simulate(at, end, ts=jnp.array([end]), solver=solver, **TIGHT)["m.x"][0]

    def exact(p):
        return decayed(end, *p)

    p = jnp.array([-1.2, 0.7])
    backwards, forwards = jax.grad(last)(p), jax.jacfwd(last)(p)
    close = 1e-8 if solver is None else 3e-6
    assert np.abs(last(p) - exact(p)) < close
    assert np.abs(backwards - jax.grad(exact)(p)).max() < 10 * close
    assert np.abs(backwards - forwards).max() < 1e-11 * np.abs(forwards).max()


@pytest.mark.slow
def test_a_batch_of_delays():
    system, delays = compiled(Decay, "m"), jnp.array([0.3, 0.7, 1.0, 2.0, 6.0])

    def last(T):
        return simulate(system.with_parameters({"m.T": T}), 4.3, ts=jnp.array([4.3]), **TIGHT)["m.x"][0]

    exact = jax.vmap(lambda T: decayed(4.3, T=T))
    assert np.abs(jax.vmap(last)(delays) - exact(delays)).max() < 1e-9
    slopes = jax.vmap(jax.grad(lambda T: decayed(4.3, T=T)))(delays)
    # Derivatives by a delay are slopes of the record, which are less exact than its values.
    assert np.abs(jax.jit(jax.vmap(jax.grad(last)))(delays) - slopes).max() < 5e-7


@pytest.mark.slow
def test_waves_on_a_line():
    """Jumps come back again and again, and are as sharp as ever."""
    system = compiled(Line, "m")
    ts = jnp.linspace(0.013, 2.9, 41)
    run = simulate(system, 2.9, ts=ts)
    voltage, charge = jax.vmap(lambda t: jnp.stack(waves(t, *LINE.values())))(ts).T
    assert np.abs(run["m.v2"] - voltage).max() < 1e-13
    assert np.abs(run["m.q"] - charge).max() < 1e-13

    def last(p):
        at = system.with_parameters(dict(zip(LINE, p, strict=True)))
        return simulate(at, 2.9, ts=jnp.array([2.9]))["m.q"][0]

    p = jnp.array([*LINE.values()])
    exact = jax.grad(lambda p: waves(2.9, *p)[1])(p)
    assert np.abs(jax.grad(last)(p) - exact).max() < 1e-12


@pytest.mark.slow
def test_a_delay_that_changes():
    system, end = compiled(Stretched, "m"), 5.0

    def reference(wide, quick, delay):
        """The integral of the pulse as it comes out, between the times at which its jumps do."""

        def instant(t):
            return t - delay - wide * np.sin(quick * t)

        assert (np.diff(instant(np.linspace(0, end, 20_001))) > 0).all()  # the past is read forwards
        begin, stop = (brentq(lambda t, jump=jump: instant(t) - jump, 0, 20) for jump in (1.0, 2.0))
        return quad(lambda t: 1 + np.sin(instant(t)), begin, min(stop, end), epsabs=1e-13)[0]

    def last(p):
        at = system.with_parameters({"m.wide": p[0], "m.quick": p[1], "m.delay": p[2]})
        return simulate(at, end, ts=jnp.array([end]), **TIGHT)["m.y"][0]

    p = np.array([0.4, 1.3, 1.0])
    assert abs(last(p) - reference(*p)) < 1e-9
    h = 1e-5
    slopes = [(reference(*(p + h * e)) - reference(*(p - h * e))) / (2 * h) for e in np.eye(3)]
    assert np.abs(jax.grad(last)(jnp.asarray(p)) - np.array(slopes)).max() < 1e-7


@pytest.mark.slow
def test_mackey_and_glass():
    """Beside the method of steps by SciPy: each interval of one delay reads the dense output of the one before."""
    b, c, n, T, start, end = 0.2, 0.1, 10, 17.0, 0.5, 170.0
    before, x, ends = [lambda t: start], start, []
    for k in range(10):
        past = before[-1]

        def slope(t, x, past=past):
            late = past(t - T)
            return b * late / (1 + late**n) - c * x

        found = solve_ivp(slope, (k * T, (k + 1) * T), [x], "DOP853", rtol=1e-11, atol=1e-12, dense_output=True)
        before.append(lambda t, found=found: found.sol(t)[0])
        x = found.y[0, -1]
        ends.append(x)
    run = simulate(compiled(Blood, "m"), end, ts=jnp.arange(1.0, 11.0) * T, rtol=1e-9, atol=1e-11)
    assert np.abs(run["m.x"] - np.array(ends)).max() < 1e-7


def test_what_is_refused():
    with pytest.raises(ModelError, match="the delay must be positive; got 0"):
        compiled(_late(0), "m")
    with pytest.raises(ModelError, match="changes in time: say how long it may be"):
        compiled(_late(sympy.Symbol), "m")
    system = compiled(Decay, "m")
    with pytest.raises(ModelError, match="'m.late' must be positive; it is -1 s"):
        simulate(system.with_parameters({"m.T": -1.0}), 1.0)
    with pytest.raises(ModelError, match="a delay has no state space of finite size"):
        linearize(system, [], ["m.x"])
    with pytest.raises(ModelError, match="equilibria of models with delays"):
        steady_state(system)


def _late(time):
    class Late(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), -self.delayed("late", x, x if time is sympy.Symbol else time)))

    return Late


class Vanishing(Component):
    """A delay that comes to its end at t = 1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -self.delayed("late", x, 1 - ev.t, longest=1)))


@pytest.mark.slow
def test_a_delay_that_vanishes():
    with pytest.raises(SimulationError, match="the delay of 'm.late' is .* s and becomes negative"):
        simulate(compiled(Vanishing, "m"), 2.0)


class Second(Component):
    """A point whose place is what another one's was."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, v, F, u = (self.variable(n) for n in ("x", "v", "F", "u"))
        late = self.delayed("late", u, 0.5)
        self.add_equations(Eq(u, sympy.sin(ev.t)), Eq(der(x), v), Eq(der(v), F), Eq(x, late))


def test_no_second_derivative():
    with pytest.raises(ModelError, match="'m.late': the equations need its second derivative"):
        compiled(Second, "m")


class Echo(Component):
    """A ball whose bounces are heard later: the delayed speed jumps, and lets an event happen."""

    def __init__(self, ev, name, T=0.3):
        super().__init__(ev, name)
        h, v = self.variable("h", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        heard = self.variable("heard", start=0.0, fixed=True)
        late = self.delayed("late", v, self.parameter("T", T))
        self.add_equations(Eq(der(h), v), Eq(der(v), -9.81), Eq(der(heard), 0.0))
        self.when(h <= 0, reinit(v, -0.8 * v), reinit(h, 0))
        self.when(late >= 1.0, reinit(heard, ev.t))


@pytest.mark.slow
def test_the_echo_of_an_event():
    """The guard of the second event jumps when the first one comes out of the delay."""
    system = compiled(Echo, "m")

    def heard(T):
        return simulate(system.with_parameters({"m.T": T}), 1.0, ts=jnp.array([1.0]))["m.heard"][0]

    assert abs(heard(0.3) - (math.sqrt(2 / 9.81) + 0.3)) < 1e-9
    assert abs(jax.grad(heard)(0.3) - 1.0) < 1e-9


class Two(Component):
    """Two delays that are equal by chance: what comes out of them at one instant moves with each of them."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.parameter("a", 0.5), self.parameter("b", 0.5)
        x = self.variable("x", start=0.0, fixed=True)
        pulse = Piecewise((0, ev.t < 1), (1, True))
        first, second = self.delayed("first", pulse, a), self.delayed("second", 3 * pulse, b)
        self.add_equations(Eq(der(x), first * (1 + second)))


@pytest.mark.slow
def test_breaks_that_come_out_at_once():
    system = compiled(Two, "m")

    def last(p):
        return simulate(system.with_parameters({"m.a": p[0], "m.b": p[1]}), 2.0, ts=jnp.array([2.0]))["m.x"][0]

    # From 1 + max(a, b) on dx/dt is 4, from 1 + a on 1 if that is first. So ∂x/∂b is −3 for b > a, and 0 else.
    slopes = jax.grad(last)(jnp.array([0.5, 0.5]))
    later, sooner = jnp.array([-1.0, -3.0]), jnp.array([-4.0, 0.0])
    assert min(jnp.abs(slopes - one).max() for one in (later, sooner)) < 1e-12


class Closing(Component):
    """A delay that vanishes at t = π, and opens again."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=0.0, fixed=True), self.variable("y", start=0.0, fixed=True)
        late = self.delayed("late", x, 1 + sympy.cos(ev.t), longest=2)
        self.add_equations(Eq(der(x), sympy.cos(ev.t)), Eq(der(y), late))


@pytest.mark.slow
def test_a_delay_that_vanishes_for_an_instant():
    ts = jnp.linspace(0.0, 6.0, 25)
    run = simulate(compiled(Closing, "m"), 6.0, ts=ts, **TIGHT)
    assert np.abs(run["m.late"] - jnp.sin(jnp.maximum(ts - 1 - jnp.cos(ts), 0.0))).max() < 1e-8


class Slow(Component):
    """A delay that is short beside what happens."""

    def __init__(self, ev, name, T=1e-4):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -self.delayed("late", x, self.parameter("T", T))))


@pytest.mark.slow
def test_steps_longer_than_the_delay():
    """By the one slow mode, exp(−ωt)/(ω(1 − ωT)) with ω = exp(ωT); the others die out within a few delays."""
    T, omega = 1e-4, 1.0
    for _ in range(50):
        omega = math.exp(omega * T)
    run = simulate(compiled(Slow, "m"), 5.0, ts=jnp.array([5.0]))
    assert run.counts["num_steps"] < 2000  # of the length of the delay, they were 50,000
    assert abs(run["m.x"][0] - math.exp(-5 * omega) / (omega * (1 - omega * T))) < 1e-7
