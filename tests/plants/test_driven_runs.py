"""Runs that waves in time drive, by default arguments: what happens while nothing else moves is not passed over.

References: SciPy's DOP853 with steps of at most 1/500 of a period, which pass over nothing.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, component
from scipy.integrate import solve_ivp
from scipy.special import lambertw
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, der, simulate
from jaxonomy_dae.library import electrical as el

VT, IS = 1.380649e-23 / 1.602176634e-19 * 300.15, 1e-3
TS = np.linspace(0.0, 10.0, 201)


def rectifier():
    """10 V at 1 Hz through a diode and 1 Ω into 1 F."""
    ev, d = EqnEnv(), AcausalDiagram()
    v, q = el.SineVoltage(ev, "v", 10.0, 1.0), el.Diode(ev, "q", IS, VT, 1e12)
    r, c, g = el.Resistor(ev, "r"), el.Capacitor(ev, "c", 1.0, 0.0), el.Ground(ev, "g")
    d.connect(v.p, q.p).connect(q.n, r.p).connect(r.n, c.p).connect(c.n, v.n, g.p)
    return AcausalCompiler(ev, d)()


def current(u):
    """Of the diode and 1 Ω in series at a voltage u: the Lambert function of its law."""
    x = (u + IS) / VT + np.log(IS / VT)
    w = np.real(lambertw(np.exp(x))) if x < 500 else x - np.log(x) + np.log(x) / x
    return w * VT - IS


@functools.cache
def exact(amplitude=10.0):
    def slope(t, y):
        return [current(amplitude * np.sin(2 * np.pi * t) - y[0])]

    return solve_ivp(slope, (0, 10), [0.0], "DOP853", TS, rtol=1e-10, atol=1e-12, max_step=0.002).y[0]


@functools.cache
def system():
    return rectifier()


@pytest.mark.slow
@pytest.mark.long("a stiff run of ten periods, and SciPy's with 5,000 steps")
def test_a_rectifier():
    found = simulate(system(), 10.0, ts=TS)
    np.testing.assert_allclose(found["c.v"], exact(), rtol=0, atol=1e-5)  # of 10 V


@pytest.mark.slow
def test_its_derivative():
    def last(amplitude):
        changed = system().with_parameters({"v.amplitude": amplitude})
        return simulate(changed, 10.0, ts=jnp.asarray(TS[-1:])).states[-1, 0]

    by_amplitude = jax.jit(jax.grad(last))(10.0)
    differences = (exact(10.01)[-1] - exact(9.99)[-1]) / 0.02
    assert float(by_amplitude) == pytest.approx(differences, rel=1e-4)


@pytest.mark.slow
def test_steps_without_what_drives_them():
    """What the bound is for: without it the run ends far off, and says nothing."""
    found = simulate(system(), 10.0, ts=TS, dtmax=jnp.inf)
    assert abs(float(found["c.v"][-1]) - exact()[-1]) > 1


@pytest.mark.slow
def test_a_source_that_is_switched_off_limits_no_step():
    """Kind: what has no effect costs the run. A source of amplitude zero and 1e6 rad/s limited steps to a quarter of
    its period: max_steps at t = 0.026."""

    def write(self, ev):
        x, a = self.variable("x", start=1.0, fixed=True), self.parameter("a", 0.0)
        self.add_equations(Eq(der(x), -x + a * sympy.sin(1e6 * ev.t)))

    system = compiled(component(write))
    solution = simulate(system, 1.0, ts=jnp.array([1.0]))
    np.testing.assert_allclose(solution["c.x"], np.exp(-1.0), rtol=1e-5)
    assert solution.counts["num_steps"] < 50
    on = simulate(system.with_parameters({"c.a": 1.0}), 1e-4, ts=jnp.array([1e-4]))
    assert on.counts["num_steps"] > 50


@pytest.mark.slow
def test_kinks_and_jumps_at_the_same_times():
    """A step that ended just before a jump was followed by one of a rounding, to the kink there: 4,096 steps were not
    enough for a week of ten-minute samples."""

    def write(self, ev):
        x, u, v = self.variable("x", start=0.0, fixed=True), self.input("u"), self.input("v")
        self.add_equations(Eq(der(x), -x + u + v))

    n, h = 200, 0.1
    t = h * np.arange(n + 1)
    u, v = np.random.default_rng(0).standard_normal((2, n + 1))
    inputs = {"c.u": (t, u, "held"), "c.v": (t, v)}
    run = simulate(compiled(component(write)), t[-1], ts=t[1:], inputs=inputs, rtol=1e-9, atol=1e-11)
    assert run.stats["num_steps"] < 5 * n
    x, exact = 0.0, []
    for k in range(n):
        slope = (v[k + 1] - v[k]) / h
        level = u[k] + v[k]
        x = (x - level + slope) * np.exp(-h) + level + slope * h - slope
        exact.append(x)
    np.testing.assert_allclose(run["c.x"], exact, atol=1e-9)
