"""Rotational components together, against a closed form."""

import numpy as np
from component_references import checks, measured
from problems import compiled
from trajectories import trajectory

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library.rotational import Damper, FixedAngle, IdealGear, Inertia, Spring, Torque

OSCILLATION = "closed form of a damped oscillation about a turned wall"


@checks(
    {
        Inertia: (OSCILLATION, "load.phi", "load.w", "load.a"),
        Spring: (OSCILLATION, "load.phi", "spring.tau"),
        Damper: (OSCILLATION, "load.phi", "damper.tau"),
        FixedAngle: (OSCILLATION, "load.phi"),
        Torque: (OSCILLATION, "load.phi"),
        IdealGear: (f"{OSCILLATION}, reflected by ratio²", "motor.phi", "gear.flange_b.tau"),
    },
    origin="rtol 1e-9 for each of fewer than 100 steps",
)
def test_torque_through_a_gear_onto_a_damped_spring():
    """The gear reflects J1 as ratio²·J1 and the torque as ratio·τ: J·φ'' = ratio·τ − d·φ' − c·(φ − turned + slack) from
    rest at φ = 0, underdamped."""
    j1, j2, ratio, c, d, tau, turned, slack = 0.1, 2.0, 3.0, 50.0, 4.0, 5.0, 0.4, 0.15
    ev = EqnEnv()
    motor, load = Inertia(ev, "motor", j1), Inertia(ev, "load", j2, initial_angle=0.0, initial_speed=0.0)
    torque, gear, wall = Torque(ev, "torque"), IdealGear(ev, "gear", ratio), FixedAngle(ev, "wall", turned)
    spring, damper = Spring(ev, "spring", c, slack), Damper(ev, "damper", d)
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
    inertia = j2 + ratio**2 * j1
    a = d / (2 * inertia)
    w = np.sqrt(c / inertia - a * a)
    rest, decay = turned - slack + ratio * tau / c, np.exp(-a * ts)
    phi = rest * (1 - decay * (np.cos(w * ts) + a / w * np.sin(w * ts)))
    speed = rest * decay * c / inertia / w * np.sin(w * ts)
    acceleration = rest * decay * c / inertia * (np.cos(w * ts) - a / w * np.sin(w * ts))
    expected = {
        "load.phi": phi, "load.w": speed, "load.a": acceleration, "motor.phi": ratio * phi,
        "spring.tau": c * (turned - slack - phi), "damper.tau": -d * speed,
        "gear.flange_b.tau": -ratio * (tau - j1 * ratio * acceleration),
    }  # fmt: skip
    solution = trajectory(system, ts, list(expected), {"torque.tau": tau})
    for name, true in expected.items():
        measured(name, solution[name], true, 1e-7 * np.abs(true).max())
