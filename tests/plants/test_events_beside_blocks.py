"""Events beside nonlinear blocks: the point after the event is searched for from the one before.

References: SciPy's solution of each mode, with the block solved by bracketing.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from problems import compiled

from jaxonomy_dae import Component, Eq, EqnEnv, Hydraulic, assign, simulate
from jaxonomy_dae.library import hydraulic, signal

TIGHT = dict(rtol=1e-10, atol=1e-10)
RHO, G = 998.2, 9.80665
D, LENGTH, SMALL, AREA = 0.04, 20.0, 100.0, 0.5
PIPE = np.pi * D**2 / 4 * np.sqrt(2 * RHO * D / (0.02 * LENGTH))


class Switched(Component):
    """A pump whose pressure is on·curve(m_flow), switched off at a time that is a parameter."""

    def __init__(self, ev, name, off=50.0):
        super().__init__(ev, name)
        a, b = self.port("a", Hydraulic), self.port("b", Hydraulic)
        m, on = self.variable("m_flow"), self.discrete("on", start=1)
        (curve,) = self.function("curve", lambda m: 2e5 - 2e4 * m, [m])
        self.add_equations(Eq(a.m_flow, m), Eq(b.m_flow, -m), Eq(b.p - a.p, on * curve))
        self.when(ev.t >= self.parameter("off", off), assign(on, 0))


def pumped():
    """A pump, a check valve and a turbulent pipe that fill a tank."""
    ev = EqnEnv()
    source, pump, check = hydraulic.PressureSource(ev, "s"), Switched(ev, "pump"), hydraulic.CheckValve(ev, "check")
    pipe = hydraulic.TurbulentPipe(ev, "pipe", D=D, L=LENGTH)
    tank = hydraulic.Tank(ev, "tank", A=AREA, initial_level=1.0)
    ends = (source.fluid, pump.a), (pump.b, check.port_a), (check.port_b, pipe.port_a), (pipe.port_b, tank.fluid)
    return compiled(source, pump, check, pipe, tank, connect=ends)


def flow(level):
    """While the pump is on."""

    def missing(m):
        dp = 2e5 - 2e4 * m - RHO * G * level
        return PIPE * dp / (dp**2 + SMALL**2) ** 0.25 - m

    return scipy.optimize.brentq(missing, 0.0, 10.0, xtol=1e-14)


def test_a_pump_that_is_switched_off_in_a_nonlinear_block():
    """dp = on·curve(m_flow) cannot be solved for the curve once on = 0; then the valve shuts, and the level stays."""
    system = pumped()

    def level(off):
        return simulate(system.with_parameters({"pump.off": off}), 100.0, **TIGHT)["tank.level"][-1]

    value, slope = jax.value_and_grad(level)(50.0)
    known = scipy.integrate.solve_ivp(
        lambda t, y: [flow(y[0]) / (RHO * AREA)], (0, 50.0), [1.0], rtol=1e-11, atol=1e-12
    ).y[0, -1]
    np.testing.assert_allclose(value, known, rtol=1e-8)
    np.testing.assert_allclose(slope, flow(known) / (RHO * AREA), rtol=1e-7)


Q = np.array([-1e-3, 0.0, 1e-3, 2e-3, 3e-3, 4e-3, 5e-3])  # m3/s
HEAD = np.array([20.5, 20.0, 19.4, 17.8, 15.0, 10.6, 4.0])  # m
FALL, UPPER, LOWER, OUT, CD = 8.0, 1.6, 0.6, 2.5e-4, 0.6


class CurvePump(Component):
    """Head over flow from a table while `on` is 1; no head while it is 0."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b, on = self.port("a", Hydraulic), self.port("b", Hydraulic), self.input("on")
        m, q = self.variable("m_flow", start=1.0), self.variable("q", start=1e-3)
        (head,) = self.function("head", lambda q: jnp.interp(q, Q, HEAD), [q])
        self.add_equations(Eq(q, m / RHO), Eq(a.m_flow, m), Eq(b.m_flow, -m), Eq(b.p - a.p, on * RHO * G * head))


class Riser(Component):
    """The static head of a vertical pipe from a up to b."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.port("a", Hydraulic), self.port("b", Hydraulic)
        self.add_equations(Eq(a.p - b.p, RHO * G * FALL), Eq(a.m_flow + b.m_flow, 0))


def two_tanks():
    ev = EqnEnv()
    low, high = (
        hydraulic.Tank(ev, "low", A=4.0, initial_level=2.0),
        hydraulic.Tank(ev, "high", A=AREA, initial_level=0.9),
    )
    pump, riser, check = CurvePump(ev, "pump"), Riser(ev, "riser"), hydraulic.CheckValve(ev, "check")
    pipe = hydraulic.TurbulentPipe(ev, "pipe", D=D, L=LENGTH, f=0.02)
    out, drain = hydraulic.Orifice(ev, "out", A=OUT, Cd=CD), hydraulic.PressureSource(ev, "drain")
    switch = signal.Hysteresis(ev, "switch", lower=LOWER, upper=UPPER, low=1.0, high=0.0)
    ends = (
        (low.fluid, pump.a), (pump.b, check.port_a), (check.port_b, riser.a), (riser.b, pipe.port_a),
        (pipe.port_b, high.fluid, out.port_a), (out.port_b, drain.fluid), (high.level, switch.u), (switch.y, pump.on),
    )  # fmt: skip
    return compiled(low, high, pump, riser, check, pipe, out, drain, switch, connect=ends)


def refilled(upper, lower):
    """The time from the pump's start at `lower` to its stop at `upper`, in the second cycle."""

    def inflow(low, high):
        def missing(m):
            dp = RHO * G * (low + np.interp(m / RHO, Q, HEAD) - FALL - high)
            return PIPE * dp / (dp**2 + SMALL**2) ** 0.25 - m

        return scipy.optimize.brentq(missing, 0.0, 10.0, xtol=1e-14)

    def slopes(t, y, on):
        m = inflow(*y) if on else 0.0
        dp = RHO * G * y[1]
        leaves = CD * OUT * np.sqrt(2 * RHO) * dp / (dp**2 + SMALL**2) ** 0.25
        return [-m / (RHO * 4.0), (m - leaves) / (RHO * AREA)]

    y, times, t = [2.0, 0.9], [], 0.0
    for on, level in ((True, upper), (False, lower), (True, upper)):

        def meets(t, y, on, level=level):
            return y[1] - level

        meets.terminal = True
        run = scipy.integrate.solve_ivp(slopes, (t, 3000.0), y, args=(on,), events=meets, rtol=1e-11, atol=1e-11)
        t, y = run.t[-1], run.y[:, -1]
        times.append(t)
    return times[2] - times[1]


@pytest.mark.slow
def test_two_tanks_a_pump_with_a_curve_a_check_valve_and_a_float_switch():
    system = two_tanks()

    def refill(p):
        of = system.with_parameters({"switch.upper": p[0], "switch.lower": p[1]})
        events = simulate(of, 1500.0, **TIGHT).events
        return events.ts[4] - events.ts[2]

    value, slopes = jax.value_and_grad(refill)(jnp.array([UPPER, LOWER]))
    h = 1e-3
    known = [
        (refilled(UPPER + h, LOWER) - refilled(UPPER - h, LOWER)) / (2 * h),
        (refilled(UPPER, LOWER + h) - refilled(UPPER, LOWER - h)) / (2 * h),
    ]
    np.testing.assert_allclose(value, refilled(UPPER, LOWER), rtol=1e-6)
    np.testing.assert_allclose(slopes, known, rtol=1e-5)
