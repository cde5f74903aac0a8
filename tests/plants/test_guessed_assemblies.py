"""Mechanisms that can be assembled in two ways: the one that is guessed is found."""

import numpy as np
import pytest
from bench import Bench

import jaxonomy_dae.library.planar as pl


def arm(reach, direction, elbow):
    """Two links of 1 m and 0.8 m whose end is held, their joints guessed; the angles of the joints."""
    b = Bench()
    x, y = reach * np.cos(direction), reach * np.sin(direction)
    inside = np.arccos((1.0 + reach**2 - 0.64) / (2 * reach))
    first = direction + elbow * inside
    second = np.arctan2(y - np.sin(first), x - np.cos(first))
    angles = first, second - first, -second
    world, held = b(pl.World, "world"), b(pl.World, "held", x, y)
    near, far = b(pl.MassiveLink, "near", 1.0), b(pl.MassiveLink, "far", 0.8)
    pins = [b(pl.Revolute, f"j{k}", guess_angle=angle) for k, angle in enumerate(angles, 1)]
    grip = b(pl.Prismatic, "grip", initial_position=0.0, initial_velocity=0.0)
    b.chain(world.frame, pins[0].frame_a, pins[0].frame_b, near.frame_a, near.frame_b, pins[1].frame_a)
    b.chain(pins[1].frame_b, far.frame_a, far.frame_b, pins[2].frame_a, pins[2].frame_b, grip.frame_b)
    b.join(grip.frame_a, held.frame)
    return b.compile(), np.array(angles)


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.0, 0.2])
@pytest.mark.parametrize("elbow", [1, -1])
def test_joints_that_are_guessed_choose_the_side_of_an_elbow(elbow, off):
    """The grip leaves nothing open, so that guesses can only choose among the two positions."""
    system, angles = arm(1.2, 0.25, elbow)
    guesses = angles * (1 + off * np.array([1, -1, 1]))
    system = system.with_parameters({f"j{k}.initial_angle": guess for k, guess in enumerate(guesses, 1)})
    found = system.observe(["j1.phi", "j2.phi", "j3.phi"], 0.0, system.initialize())
    np.testing.assert_allclose(found, angles, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("coupler", [0.0, -1.1e-16])
def test_a_guess_that_is_rounding_has_no_size(coupler):
    """Beside other angles an angle of 1e-16 is zero, and is measured as they are."""
    b = Bench()
    west, east = b(pl.World, "west"), b(pl.World, "east", 2.0)
    crank = b(pl.MassiveLink, "crank", 0.8)
    rod, rocker = b(pl.MassiveLink, "rod", 2.0, guess_angle=coupler), b(pl.MassiveLink, "rocker", 0.8, guess_angle=0.9)
    j1 = b(pl.Revolute, "j1", initial_angle=1.0, initial_speed=0.0)
    j2, j3, j4 = (b(pl.Revolute, f"j{k}") for k in (2, 3, 4))
    for joint, one, other in (
        (j1, west.frame, crank.frame_a), (j2, crank.frame_b, rod.frame_a), (j3, east.frame, rocker.frame_a),
        (j4, rod.frame_b, rocker.frame_b),
    ):  # fmt: skip
        b.chain(one, joint.frame_a, joint.frame_b, other)
    system = b.compile()
    found = system.observe(["rod.body.phi", "rocker.body.phi"], 0.0, system.initialize())
    np.testing.assert_allclose(found, [0.0, 1.0], rtol=0, atol=1e-12)
