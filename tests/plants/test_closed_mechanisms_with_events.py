"""Closed mechanisms that strike, stick and are switched. References: SciPy's solution in one coordinate, from event to
event."""

import numpy as np
import pytest
from from_event_to_event import compare, followed
from problems import compiled
from sympy import cos, sin, sqrt

import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import Component, Eq, EqnEnv, Rotational, Translational
from jaxonomy_dae.library.contacts import HardStop
from jaxonomy_dae.library.friction import Brake

ROD = 0.25


class Yoke(Component):
    """b.s = r·sin(a.phi): a scotch yoke."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b, r = self.port("a", Rotational), self.port("b", Translational), self.parameter("r", 0.1)
        self.add_equations(Eq(b.s, r * sin(a.phi)), Eq(a.tau + r * cos(a.phi) * b.f, 0))


@pytest.mark.slow
def test_a_scotch_yoke_on_a_stop():
    """A driven flywheel; the yoke's mass strikes a stop that gives back a part of its speed, and so of the wheel's."""
    ev = EqnEnv()
    wheel, yoke, mass = rot.Inertia(ev, "wheel", 0.05, 0.0, 6.0), Yoke(ev, "yoke"), line.Mass(ev, "mass", 2.0)
    stop, wall, drive = (
        HardStop(ev, "stop", restitution=0.5),
        line.FixedPosition(ev, "wall", 0.08),
        rot.Torque(ev, "drive"),
    )
    ends = (
        (drive.flange, wheel.flange_a), (wheel.flange_b, yoke.a), (yoke.b, mass.flange, stop.flange_a),
        (stop.flange_b, wall.flange),
    )  # fmt: skip
    system = compiled(wheel, yoke, mass, stop, wall, drive, connect=ends)

    def known(p):
        r, back, inertia = p

        def slopes(t, y):
            way, bend = r * np.cos(y[0]), -r * np.sin(y[0])
            return [y[1], (1.0 - 2.0 * way * bend * y[1] ** 2) / (inertia + 2.0 * way**2)]

        t, y = followed(slopes, [0.0, 6.0], 0.0, 0.5, lambda t, y: 0.08 - r * np.sin(y[0]))
        return followed(slopes, [y[0], -back * y[1]], t, 0.5)[1][0]

    names = ["yoke.r", "stop.restitution", "wheel.J"]
    compare(system, names, [0.1, 0.5, 0.05], "wheel.phi", known, 0.5, {"drive.tau": 1.0})


class Crank(Component):
    """A crank of radius r and a rod of length ROD that drive a slider at b."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b, r = self.port("a", Rotational), self.port("b", Translational), self.parameter("r", 0.1)
        way, along = self.variable("way"), sqrt(ROD**2 - r**2 * sin(a.phi) ** 2)
        self.add_equations(
            Eq(b.s, r * cos(a.phi) + along),
            Eq(way, -r * sin(a.phi) - r**2 * sin(a.phi) * cos(a.phi) / along),
            Eq(a.tau + way * b.f, 0),
        )


@pytest.mark.slow
def test_a_brake_that_holds_a_slider_crank_and_lets_it_go():
    """Between 0.2 s and 0.7 s a brake is pressed. The crank slips, sticks, and swings on when it is let go."""
    ev = EqnEnv()
    shaft, crank, mass = rot.Inertia(ev, "shaft", 0.02, 0.7, 8.0), Crank(ev, "crank"), line.Mass(ev, "mass", 1.0)
    spring, wall = line.Spring(ev, "spring", c=300.0, length=ROD), line.FixedPosition(ev, "wall")
    brake = Brake(ev, "brake", mu=0.5, fn_max=40.0, cgeo=0.1)
    press = sig.Pulse(ev, "press", period=10.0, width=0.05, start_time=0.2)
    ends = (
        (shaft.flange_a, brake.flange), (shaft.flange_b, crank.a), (crank.b, mass.flange, spring.flange_b),
        (spring.flange_a, wall.flange), (press.y, brake.u),
    )  # fmt: skip
    system = compiled(shaft, crank, mass, spring, wall, brake, press, connect=ends)

    def known(p):
        r, inertia, c = p

        def slopes(t, y, rubs=0.0):
            s, k = np.sin(y[0]), np.cos(y[0])
            along = np.sqrt(ROD**2 - r**2 * s**2)
            way = -r * s - r**2 * s * k / along
            bend = -r * k - r**2 * ((k * k - s * s) / along + (r * s * k) ** 2 / along**3)
            force = -c * (r * k + along - ROD)
            return [y[1], (force * way - rubs - bend * way * y[1] ** 2) / (inertia + way**2)]

        _, y = followed(slopes, [0.7, 8.0], 0.0, 0.2)
        turns = np.sign(y[1])
        _, y = followed(lambda t, y: slopes(t, y, 2.0 * turns), y, 0.2, 0.7, lambda t, y: turns * y[1])
        return followed(slopes, [y[0], 0.0], 0.7, 1.0)[1][0]

    compare(system, ["crank.r", "shaft.J", "spring.c"], [0.1, 0.02, 300.0], "shaft.phi", known, 1.0)
