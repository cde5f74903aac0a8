"""Planar linkages, and what is said of those that are closed twice."""

import pytest
from bench import Bench

import jaxonomy_dae.library.planar as pl
from jaxonomy_dae import InitializationError, StructuralError


class Linkage(Bench):
    """A bench on which bodies are joined by pins."""

    def pin(self, name, one, other, **given):
        joint = self(pl.Revolute, name, **given)
        self.chain(one, joint.frame_a, joint.frame_b, other)
        return joint

    def parallelogram(self, prefix="", start=1.0):
        """Two cranks of 0.8 and a coupler of 2, the first crank at the angle `start`; the coupler."""
        west, east = self(pl.World, f"{prefix}west"), self(pl.World, f"{prefix}east", 2.0)
        crank = self(pl.MassiveLink, f"{prefix}crank", 0.8, initial_angle=start, initial_speed=1.0)
        rocker = self(pl.MassiveLink, f"{prefix}rocker", 0.8, guess_angle=start)
        coupler = self(pl.MassiveLink, f"{prefix}coupler", 2.0)
        for k, ends in enumerate(
            [
                (west.frame, crank.frame_a), (crank.frame_b, coupler.frame_a), (east.frame, rocker.frame_a),
                (coupler.frame_b, rocker.frame_b),
            ], 1,
        ):  # fmt: skip
            self.pin(f"{prefix}pin{k}", *ends)
        return coupler

    def bar(self, coupler, length=0.8, prefix="", start=1.0):
        """A third bar, from the ground to the middle of the coupler."""
        middle, half = self(pl.World, f"{prefix}middle", 1.0), self(pl.Link, f"{prefix}half", 1.0)
        bar = self(pl.MassiveLink, f"{prefix}bar", length, guess_angle=start)
        self.join(half.frame_a, coupler.frame_a)
        self.pin(f"{prefix}pin5", middle.frame, bar.frame_a)
        self.pin(f"{prefix}pin6", bar.frame_b, half.frame_b)

    def refusal(self, mode):
        """What compiler or initialization say."""
        with pytest.raises((StructuralError, InitializationError)) as caught:
            self.compile(state_selection=mode).initialize()
        return str(caught.value)


REDUNDANT = (
    "the constraints of {} depend on each other: {} from the others in every position, so nothing determines how they "
    "share their forces. Take one of these components out, or replace one by a part that yields, such as a spring."
)
LOOP = "'crank', 'rocker', 'coupler', 'pin1', 'pin2', 'pin3', 'pin4', 'half', 'bar', 'pin5' and 'pin6'"
