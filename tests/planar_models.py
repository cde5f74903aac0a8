"""Planar mechanisms of bodies and pins that several test files share."""

import functools
from types import SimpleNamespace

from bench import Bench

import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot


@functools.cache
def double_pendulum(mode):
    """Two uniform rods; in the minimal form the states are the angles, which are good everywhere."""
    b = Bench()
    world, first = b(pl.World, "world"), b(pl.Revolute, "j1", initial_angle=0.3, initial_speed=0.0)
    second = b(pl.Revolute, "j2", initial_angle=0.5, initial_speed=0.0)
    upper, lower = b(pl.MassiveLink, "a", 1.0), b(pl.MassiveLink, "b", 0.8, m=0.5)
    b.chain(world.frame, first.frame_a, first.frame_b, upper.frame_a, upper.frame_b, second.frame_a, second.frame_b,
            lower.frame_a)  # fmt: skip
    angles = [f"{rod}.body.{angle}" for angle in ("phi", "omega") for rod in "ab"]
    return b.compile(state_selection=mode, prefer_states=angles if mode == "dummy_derivatives" else ())


@functools.cache
def four_bar(coupler_at=0.3, rocker_at=1.7):
    """A crank that turns fully, its coupler and a rocker, all uniform rods; guesses choose the open position."""
    b = Bench()
    west, east = b(pl.World, "west"), b(pl.World, "east", 2.0)
    crank, coupler = b(pl.MassiveLink, "crank", 0.8), b(pl.MassiveLink, "coupler", 1.9, m=0.6, guess_angle=coupler_at)
    rocker = b(pl.MassiveLink, "rocker", 1.5, m=1.5, guess_angle=rocker_at)
    pins = [b(pl.Revolute, "j1", initial_angle=1.0, initial_speed=5.0), *(b(pl.Revolute, f"j{k}") for k in (2, 3, 4))]
    b.chain(west.frame, pins[0].frame_a, pins[0].frame_b, crank.frame_a, crank.frame_b, pins[1].frame_a,
            pins[1].frame_b, coupler.frame_a, coupler.frame_b, pins[2].frame_a, pins[2].frame_b, rocker.frame_b,
            east.frame, pins[3].frame_a, pins[3].frame_b, rocker.frame_a)  # fmt: skip
    return b.compile()


def squeezing_mechanism(facts):
    """Seven bodies, ten pins, a spring (Schiehlen 1990; Mazzia & Magherini 2008, II-13, figures 1 and 2)."""
    b, p = Bench(), SimpleNamespace(**facts["parameters"])
    beta, theta, gamma, phi, delta, omega, epsilon = facts["initial"]["y0"][:7]
    at_o, at_a, at_b, at_c = (
        b(pl.World, n, x, y) for n, x, y in (("O", 0.0, 0.0), ("A", p.xa, p.ya), ("B", p.xb, p.yb), ("C", p.xc, p.yc))
    )
    k1, k2, k3, k4, k5, k6, k7 = (
        b(pl.MassiveLink, f"K{k + 1}", *geometry, g_y=0.0, guess_angle=angle)
        for k, (geometry, angle) in enumerate([
            ((p.rr, 0.0, p.m1, p.I1, p.ra, 0.0), beta),
            ((-p.d, 0.0, p.m2, p.I2, -p.da, 0.0), beta + theta),
            ((0.0, -p.ss, p.m3, p.I3, p.sb, p.sa), gamma),
            ((0.0, -p.e, p.m4, p.I4, 0.0, p.ea - p.e), phi + delta),
            ((p.zt, 0.0, p.m5, p.I5, p.tb, p.ta), delta),
            ((p.zf, 0.0, p.m6, p.I6, p.zf - p.fa, 0.0), omega + epsilon),
            ((0.0, -p.u, p.m7, p.I7, p.ub, p.ua), epsilon),
        ])
    )  # fmt: skip
    pins = {}
    for name, one, other in (
        ("beta", at_o.frame, k1.frame_a), ("Theta", k1.frame_b, k2.frame_a), ("gamma", at_b.frame, k3.frame_a),
        ("Phi", k5.frame_b, k4.frame_a), ("delta", at_a.frame, k5.frame_a), ("Omega", k7.frame_b, k6.frame_a),
        ("epsilon", at_a.frame, k7.frame_a), ("P3", k2.frame_b, k3.frame_b), ("P4", k2.frame_b, k4.frame_b),
        ("P6", k2.frame_b, k6.frame_b),
    ):  # fmt: skip
        # One degree of freedom: an angle and its speed are given; the guesses choose among the positions.
        given = dict(initial_angle=theta, initial_speed=0.0) if name == "Theta" else {}
        pins[name] = b(pl.Revolute, name, **given)
        b.chain(one, pins[name].frame_a, pins[name].frame_b, other)
    hook, spring = b(pl.Link, "D", p.sd, -p.sc), b(pl.SpringDamper, "spring", p.c0, 0.0, p.l0)
    torque = b(rot.Torque, "torque")
    b.chain(k3.frame_a, hook.frame_a, hook.frame_b, spring.frame_b, at_c.frame, spring.frame_a)
    b.join(torque.flange, pins["beta"].flange)
    return b.compile()
