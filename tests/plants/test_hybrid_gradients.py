"""Digits of gradients through events, by reverse mode with the default solver and adjoint.

References are closed forms. A run is made at several tolerances by one program: a gradient is as good as the run.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hybrid_models import Ball, Bob, SampledPI, Thermostat, compiled
from hybrid_references import BY_V0, SLOPES
from problems import compiled as joined

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.rotational as rot
from jaxonomy_dae import AcausalSystem, EqnEnv, simulate
from jaxonomy_dae.library.contacts import DogClutch
from jaxonomy_dae.library.friction import Clutch


class Case(NamedTuple):
    """What is differentiated at which time, by which parameters and where, and what its derivatives are."""

    system: Callable[[], AcausalSystem]
    looked_at: str
    end: float
    parameters: dict[str, float]
    slopes: list[float]
    inputs: dict[str, float | Callable] = {}


def after(instant):
    """Rises from 0 to 1 through 0.5 at the instant."""
    return lambda t: 0.5 + 0.5 * jnp.tanh(5.0 * (t - instant))


def two_shafts() -> AcausalSystem:
    ev = EqnEnv()
    driven = rot.Inertia(ev, "J1", 1.0, initial_angle=0.0, initial_speed=10.0)
    load = rot.Inertia(ev, "J2", 2.0, initial_angle=0.0, initial_speed=0.0)
    clutch, torque = Clutch(ev, "c", mu=0.5, fn_max=16.0), rot.Torque(ev, "drive")
    at = [(torque.flange, driven.flange_a), (driven.flange_b, clutch.flange_a), (clutch.flange_b, load.flange_a)]
    return joined(driven, load, clutch, torque, connect=at)


INERTIAS, SPEEDS = [1.0, 2.0, 0.5, 3.0], [10.0, -1.0, 4.0, 0.5]
COMMON = float(np.dot(INERTIAS, SPEEDS)) / sum(INERTIAS)


def four_shafts() -> AcausalSystem:
    """Three dog clutches close at once."""
    ev = EqnEnv()
    shafts = [
        rot.Inertia(ev, f"J{k}", J, initial_angle=0.0, initial_speed=w)
        for k, (J, w) in enumerate(zip(INERTIAS, SPEEDS, strict=True))
    ]
    clutches = [DogClutch(ev, f"c{k}") for k in range(3)]
    at = []
    for k, clutch in enumerate(clutches):
        at += [(shafts[k].flange_b, clutch.flange_a), (clutch.flange_b, shafts[k + 1].flange_a)]
    return joined(*shafts, *clutches, connect=at)


def two_capacitors() -> AcausalSystem:
    ev = EqnEnv()
    first = el.Capacitor(ev, "first", 1e-3, initial_voltage=10.0)
    second = el.Capacitor(ev, "second", 3e-3, initial_voltage=2.0)
    switch, ground = el.JoiningSwitch(ev, "switch"), el.Ground(ev, "ground")
    at = [(first.p, switch.p), (switch.n, second.p), (first.n, second.n, ground.p)]
    return joined(first, second, switch, ground, connect=at)


CASES = {
    "a ball": Case(
        lambda: compiled(Ball, "ball"), "ball.h", 3.0, {"ball.e": 0.8, "ball.g": 9.81, "ball.h0": 1.0}, SLOPES
    ),
    "a thermostat": Case(lambda: compiled(Thermostat, "room"), "room.T", 20.0, {"room.P": 10.0}, [-3.51092853184108]),
    "a sampled controller": Case(
        lambda: compiled(SampledPI, "loop"), "loop.x", 3.0, {"loop.Kp": 2.0, "loop.Ki": 3.0},
        [-0.00718258236586836, -0.00910828614834083],
    ),
    "the period of a clock": Case(
        lambda: compiled(SampledPI, "loop"), "loop.x", 2.55, {"loop.T": 0.1}, [0.0155033203623]
    ),
    "a string": Case(lambda: compiled(Bob, "bob"), "bob.x", 1.5, {"bob.v0": 5.2}, [BY_V0[0]]),
    # dφ/dτ = −50/81 at a slip torque of τ = 16·μ.
    "a clutch that locks": Case(
        two_shafts, "J1.phi", 3.0, {"c.mu": 0.5}, [-16 * 50 / 81], {"c.u": 1.0, "drive.tau": 3.0}
    ),
    # One speed: the momentum over the sum of inertias.
    "dog clutches": Case(
        four_shafts, "J3.w", 1.0, {f"J{k}.J": J for k, J in enumerate(INERTIAS)},
        [(w - COMMON) / sum(INERTIAS) for w in SPEEDS], {f"c{k}.u": after(0.4) for k in range(3)},
    ),
    # One voltage: the charge over the sum of capacitances.
    "capacitors": Case(
        two_capacitors, "second.v", 1.0, {"first.C": 1e-3, "second.C": 3e-3}, [6 / 4e-3, -2 / 4e-3],
        {"switch.u": after(0.4)},
    ),
}  # fmt: skip


@functools.cache
def program(case: str):
    system, name, end, parameters, _, inputs = CASES[case]
    model = system()

    def run(p, tolerance):
        changed = model.with_parameters(dict(zip(parameters, p, strict=True)))
        ts = jnp.array([end])
        solution = simulate(
            changed, end, ts=ts, inputs=inputs, rtol=tolerance, atol=tolerance, throw=False, max_events=100
        )
        return solution[name][-1]

    return jax.jit(jax.grad(run))


# Digits at tolerances of 1e-6 and 1e-10. Where every piece is a polynomial, the method integrates it exactly; only
# rounding and event localization are left. Errors of the others add up over 35 switches of the thermostat and 25
# periods of the loop. The sensitivity to the period goes up to 0.4 and ends at 0.0155. Error control does not see it:
# at 1e-10, steps grow to whole periods once x has come to rest, and lose 4e-10 of it. At 1e-6, all steps are whole
# periods: the loop is then one whose lag is slightly off, throughout, and its sensitivity is off as little as x is.
DIGITS = {
    "a ball": (10, 10),
    "a thermostat": (7, 9),
    "a sampled controller": (8, 8),
    "the period of a clock": (7, 7),
    "a string": (5, 9),
    "a clutch that locks": (12, 12),
    "dog clutches": (12, 12),
    "capacitors": (12, 12),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_digits(case):
    true = np.array(CASES[case].slopes)
    at = jnp.array([*CASES[case].parameters.values()])
    for tolerance, digits in zip((1e-6, 1e-10), DIGITS[case], strict=True):
        found = program(case)(at, tolerance)
        worst = np.max(np.abs(found - true)) / np.max(np.abs(true))
        assert worst < 10.0**-digits, f"{-np.log10(worst):.1f} digits at a tolerance of {tolerance}"


@pytest.mark.slow
def test_the_period_of_a_clock_by_shorter_steps():
    """Where steps stay half a period long, the sensitivity has the digits of the tolerance."""
    case = CASES["the period of a clock"]
    system, ts = case.system(), jnp.array([case.end])

    def run(period):
        changed = system.with_parameters({"loop.T": period})
        return simulate(changed, case.end, ts=ts, rtol=1e-10, atol=1e-10, dtmax=0.05)[case.looked_at][-1]

    np.testing.assert_allclose(jax.grad(run)(0.1), case.slopes[0], rtol=1e-9)
