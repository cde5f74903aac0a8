"""Rotational components together, against a closed form."""

import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.rotational import Damper, FixedAngle, IdealGear, Inertia, Spring, Torque


def test_torque_through_a_gear_onto_a_damped_spring():
    # The gear reflects J1 as ratio²·J1 and the torque as ratio·τ: J·φ'' = ratio·τ − d·φ' − c·φ from rest, underdamped.
    j1, j2, ratio, c, d, tau = 0.1, 2.0, 3.0, 50.0, 4.0, 5.0
    ev = EqnEnv()
    motor, load = Inertia(ev, "motor", j1), Inertia(ev, "load", j2, initial_angle=0.0, initial_speed=0.0)
    torque, gear, wall = Torque(ev, "torque"), IdealGear(ev, "gear", ratio), FixedAngle(ev, "wall")
    spring, damper = Spring(ev, "spring", c), Damper(ev, "damper", d)
    system = compiled(
        torque, motor, gear, load, spring, damper, wall,
        connect=[
            (torque.flange, motor.flange_a),
            (motor.flange_b, gear.flange_a),
            (gear.flange_b, load.flange_a),
            (load.flange_b, spring.flange_a, damper.flange_a),
            (wall.flange, spring.flange_b, damper.flange_b),
        ],
    )  # fmt: skip
    assert system.report.index == 3 and system.report.degrees_of_freedom == 2
    ts = np.linspace(0.0, 3.0, 13)
    solution = simulate(system, 3.0, ts=ts, rtol=1e-9, atol=1e-11, inputs={"torque.tau": tau})
    inertia = j2 + ratio**2 * j1
    a = d / (2 * inertia)
    w = np.sqrt(c / inertia - a * a)
    expected = ratio * tau / c * (1 - np.exp(-a * ts) * (np.cos(w * ts) + a / w * np.sin(w * ts)))
    # rtol 1e-9 per step over fewer than 100 steps.
    np.testing.assert_allclose(solution["load.phi"], expected, atol=1e-7 * abs(expected).max())
    np.testing.assert_allclose(solution["motor.phi"], ratio * solution["load.phi"], rtol=1e-12, atol=1e-15)
    assert solution["spring.tau"][-1] == pytest.approx(-c * float(solution["load.phi"][-1]))
    assert solution["damper.tau"][-1] == pytest.approx(-d * float(solution["load.w"][-1]), abs=1e-12)
