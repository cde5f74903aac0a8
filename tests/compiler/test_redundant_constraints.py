"""Loops that are closed twice are reported by the joints and bodies in them."""

import pytest
from linkages import LOOP, REDUNDANT, Linkage
from problems import compiled, component

import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
from jaxonomy_dae import EqnEnv, StructuralError
from jaxonomy_dae.compile.diagnosis import redundant_constraints
from jaxonomy_dae.compile.model import consistent_point
from jaxonomy_dae.write import Eq, der


@pytest.fixture(params=["whole", "sampled", "many"], autouse=True)
def size(request, monkeypatch):
    """Kind: a verdict that hangs on the size of the model. Parts of more than 600 constraints were not examined; those
    that depend on each other are sought first there, and here in small parts, too. Where more than 600 of them did,
    nothing was said: their combinations are found without singular values."""
    if request.param != "whole":
        monkeypatch.setattr(redundant_constraints, "WHOLE", 0)
        if request.param == "many":
            monkeypatch.setattr(redundant_constraints, "DECOMPOSED_UPTO", 0)
        monkeypatch.setattr(consistent_point, "DECOMPOSED_UPTO", 0)


# --- joints side by side -------------------------------------------------------------------------------------------


def test_a_door_on_two_hinges():
    """Regression: the fault was reported twice, for x and for y."""
    b = Linkage()
    wall, door = b(pl.World, "wall"), b(pl.MassiveLink, "door")
    b.pin("top", wall.frame, door.frame_a, initial_angle=0.3, initial_speed=0.0)
    b.pin("bottom", wall.frame, door.frame_a)
    expected = (
        "'top' and 'bottom' form a loop, and each of them fixes a difference of 'x' and 'y': one too many. Remove one "
        "of them, or put a joint into the loop."
    )
    assert b.refusal("auto") == expected


def test_a_slider_on_two_parallel_guides():
    b = Linkage()
    bed, sled = b(pl.World, "bed"), b(pl.Body, "sled")
    left, right = b(pl.Prismatic, "left", initial_position=0.2, initial_velocity=0.0), b(pl.Prismatic, "right")
    aside, across = b(pl.Link, "aside", 0.0, 0.5), b(pl.Link, "across", 0.0, 0.5)
    b.join(bed.frame, left.frame_a, aside.frame_a)
    b.join(left.frame_b, sled.frame, across.frame_a)
    b.chain(aside.frame_b, right.frame_a, right.frame_b, across.frame_b)
    text = b.refusal("auto")
    assert text.startswith("'left', 'right', 'aside' and 'across' form a loop, and each of them fixes a difference of ")
    assert text.endswith("Remove one of them, or put a joint into the loop.")


def test_a_four_bar_linkage_that_is_closed_twice():
    b = Linkage()
    coupler = b.parallelogram()
    b.pin("again", coupler.frame_b, b.parts[3].frame_b)
    assert b.parts[3].name == "rocker"
    assert b.refusal("auto").startswith(
        "'pin4' and 'again' form a loop, and each of them fixes a difference of 'x' and"
    )


def test_two_drives_of_one_shaft():
    ev = EqnEnv()
    one, other, load = rot.AngleSource(ev, "one"), rot.AngleSource(ev, "other"), rot.Inertia(ev, "load")
    with pytest.raises(StructuralError, match="^'one' and 'other' both fix the angle of one node. Keep one of them"):
        compiled(one, other, load, connect=[(one.flange, other.flange, load.flange_a)])


# --- loops whose constraints depend on each other ------------------------------------------------------------------


@pytest.mark.slow
def test_a_parallelogram_with_a_third_bar():
    """The message listed equations, and told to change the parameters `ry` of links."""
    b = Linkage()
    b.bar(b.parallelogram())
    assert b.refusal("dummy_derivatives").splitlines()[-1] == REDUNDANT.format(LOOP, "one of them follows")


def test_two_pins_between_two_bodies():
    """The force along the line between the pins is not determined."""
    b = Linkage()
    one, other = b(pl.MassiveLink, "one"), b(pl.MassiveLink, "other")
    b.pin("hinge", b(pl.World, "world").frame, one.frame_a)
    b.pin("near", one.frame_a, other.frame_a)
    b.pin("far", one.frame_b, other.frame_b)
    expected = REDUNDANT.format("'one', 'other', 'near' and 'far'", "one of them follows")
    assert b.refusal("dummy_derivatives").splitlines()[-1] == expected


@pytest.mark.slow
def test_what_hangs_on_the_loop_is_not_named():
    """A pendulum on the coupler moves as it likes."""
    b = Linkage()
    coupler = b.parallelogram()
    b.bar(coupler)
    b.pin("hook", coupler.frame_b, b(pl.MassiveLink, "pendulum", 0.5, initial_angle=-1.0, initial_speed=0.0).frame_a)
    assert b.refusal("dummy_derivatives").splitlines()[-1] == REDUNDANT.format(LOOP, "one of them follows")


def test_two_bars_too_many():
    """Now constraints outnumber positions, which was said of 32 equations, and once more of unknown forces."""
    b = Linkage()
    coupler = b.parallelogram()
    b.bar(coupler)
    b.bar(coupler, prefix="second_")
    text = b.refusal("dummy_derivatives")
    assert text.startswith("the constraints of 'crank', 'rocker', 'coupler', ")
    assert "determine the same positions more than once: they repeat each other, so that" in text
    assert "\n" not in text and "'bar'" in text and "3 more" in text


@pytest.mark.slow
def test_two_loops_are_two_faults():
    b = Linkage()
    b.bar(b.parallelogram("a_"), prefix="a_")
    b.bar(b.parallelogram("b_", 0.7), prefix="b_", start=0.7)
    lines = b.refusal("dummy_derivatives").splitlines()
    assert len(lines) == 2
    for letter, line in zip("ab", lines, strict=True):
        assert line.startswith(f"the constraints of '{letter}_crank', '{letter}_rocker', ")
        assert "one of them follows" in line


def circle(name):
    """A point on a circle, in one's own component."""

    def write(self, ev):
        x, y = self.variable("x", start=0.6), self.variable("y", start=0.8)
        u, v = self.variable("u"), self.variable("v")
        f, g = self.variable("f"), self.variable("g")
        self.add_equations(Eq(der(x), u), Eq(der(y), v), Eq(der(u), -2 * f * x - 4 * g * x), Eq(der(v), -2 * f * y - 9))
        self.add_equations(Eq(x**2 + y**2, 1), Eq((x**2 + y**2) ** 2, 1))

    return component(write, name)


def test_constraints_of_one_component():
    """Two of them are listed as they are."""
    with pytest.raises(StructuralError, match=r"depend on each other .*\n  ring: 0 = x\*\*2 .*\n  ring: 0 = \(x\*\*2"):
        compiled(circle("ring"), state_selection="dummy_derivatives")
