"""Loops that are closed twice are reported by the joints and bodies in them; loops that are only singular are not."""

import functools

import numpy as np
import planar_models as planar
import pytest
from problems import compiled, component
from rescaling import KINDS, rescaled

import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, InitializationError, StructuralError
from jaxonomy_dae.compiler.flatten import flatten
from jaxonomy_dae.modeling import Eq, der

MODES = ["dummy_derivatives", pytest.param("auto", marks=pytest.mark.slow)]


class Linkage(planar.Bench):
    """A bench on which bodies are joined by pins."""

    def pin(self, name, one, other, **given):
        joint = self(pl.Revolute, name, **given)
        self.chain(one, joint.frame_a, joint.frame_b, other)
        return joint

    def parallelogram(self, prefix="", start=1.0):
        """Two cranks of 0.8 and a coupler of 2, the first crank at the angle `start`; the coupler."""
        west, east = self(pl.World, f"{prefix}west"), self(pl.World, f"{prefix}east", 2.0)
        crank = self(pl.MassiveLink, f"{prefix}crank", 0.8, initial_phi=start, initial_omega=1.0)
        rocker = self(pl.MassiveLink, f"{prefix}rocker", 0.8, guess_phi=start)
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
        bar = self(pl.MassiveLink, f"{prefix}bar", length, guess_phi=start)
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
POSITION = "Start elsewhere, with `initial={...}` or other parameters."


# --- joints side by side -------------------------------------------------------------------------------------------


def test_a_door_on_two_hinges():
    """It was said once for x and once for y."""
    b = Linkage()
    wall, door = b(pl.World, "wall"), b(pl.MassiveLink, "door")
    b.pin("top", wall.frame, door.frame_a, initial_phi=0.3, initial_omega=0.0)
    b.pin("bottom", wall.frame, door.frame_a)
    expected = (
        "'top' and 'bottom' form a loop, and each of them fixes a difference of 'x' and 'y': one too many. Remove one "
        "of them, or put a joint into the loop."
    )
    assert b.refusal("auto") == expected


def test_a_slider_on_two_parallel_guides():
    b = Linkage()
    bed, sled = b(pl.World, "bed"), b(pl.Body, "sled")
    left, right = b(pl.Prismatic, "left", initial_s=0.2, initial_v=0.0), b(pl.Prismatic, "right")
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


@pytest.mark.parametrize("mode", MODES)
def test_a_parallelogram_with_a_third_bar(mode):
    """The message listed equations, and told to change the parameters `ry` of links."""
    b = Linkage()
    b.bar(b.parallelogram())
    assert b.refusal(mode).splitlines()[-1] == REDUNDANT.format(LOOP, "one of them follows")


@pytest.mark.slow
def test_what_the_message_says_mends_it():
    """With a spring in place of the bar, the same parallelogram starts."""
    b = Linkage()
    coupler = b.parallelogram()
    middle, half = b(pl.World, "middle", 1.0), b(pl.Link, "half", 1.0)
    spring = b(pl.SpringDamper, "spring", 1e3, 10.0, 0.8)
    b.chain(coupler.frame_a, half.frame_a, middle.frame, spring.frame_a, spring.frame_b, half.frame_b)
    system = b.compile(state_selection="dummy_derivatives")
    # The spring lies along the third bar: relaxed, at the cranks' angle.
    found = system.observe(["spring.s", "rocker.body.phi", "coupler.body.phi"], 0.0, system.initialize())
    np.testing.assert_allclose(found, [0.8, 1.0, 0.0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", MODES)
def test_two_pins_between_two_bodies(mode):
    """The force along the line between the pins is not determined."""
    b = Linkage()
    one, other = b(pl.MassiveLink, "one"), b(pl.MassiveLink, "other")
    b.pin("hinge", b(pl.World, "world").frame, one.frame_a)
    b.pin("near", one.frame_a, other.frame_a)
    b.pin("far", one.frame_b, other.frame_b)
    expected = REDUNDANT.format("'one', 'other', 'near' and 'far'", "one of them follows")
    assert b.refusal(mode).splitlines()[-1] == expected


@pytest.mark.slow
def test_redundancy_is_found_in_other_units():
    """A point that fulfils the constraints to fewer digits leaves the Jacobian that much short of singular: this model,
    in units of 1e-12 to 1e9 of its own, was started."""
    b = Linkage()
    one, other = b(pl.MassiveLink, "one"), b(pl.MassiveLink, "other")
    b.pin("hinge", b(pl.World, "world").frame, one.frame_a)
    b.pin("near", one.frame_a, other.frame_a)
    b.pin("far", one.frame_b, other.frame_b)
    diagram = AcausalDiagram()
    diagram.add(*b.parts)
    for ends in b.joined:
        diagram.connect(*ends)
    ev, changed, _ = rescaled(np.random.default_rng([3, KINDS.index("all")]), flatten(diagram), "all", False)
    with pytest.raises((StructuralError, InitializationError), match="one of them follows from the others in every"):
        AcausalCompiler(ev, changed, state_selection="dummy_derivatives")().initialize()


def test_what_hangs_on_the_loop_is_not_named():
    """A pendulum on the coupler moves as it likes."""
    b = Linkage()
    coupler = b.parallelogram()
    b.bar(coupler)
    b.pin("hook", coupler.frame_b, b(pl.MassiveLink, "pendulum", 0.5, initial_phi=-1.0, initial_omega=0.0).frame_a)
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


# --- loops that are singular, or contradict each other -------------------------------------------------------------


@functools.cache
def in_line():
    """Two bodies of length 1 between pins at a distance of 2."""
    b = Linkage()
    one, two = b(pl.MassiveLink, "one", 1.0, guess_x=0.5), b(pl.MassiveLink, "two", 1.0, guess_x=1.5)
    b.pin("first", b(pl.World, "west").frame, one.frame_a)
    b.pin("second", one.frame_b, two.frame_a)
    b.pin("third", two.frame_b, b(pl.World, "east", 2.0).frame)
    return b


def test_two_bodies_in_line():
    """They cannot move, but shake: to first order the pin between them is free to go sideways."""
    text = in_line().refusal("dummy_derivatives")
    assert "at this point the constraints of 'one', 'two', 'first', 'second' and 'third' depend on each other" in text
    assert "though not nearby" in text and text.endswith(POSITION) and "every position" not in text


@pytest.mark.slow
def test_a_note_of_two_bodies_in_line():
    """A root of second order is found to half of the digits: there a pin bears 1e9 N."""
    notes = in_line().compile().initialization_report().notes
    assert any("'first', 'second' and 'third' depend on each other, though not nearby" in note for note in notes)


def test_a_parallelogram_in_line():
    """Where all bars lie on one line, it may go on as a parallelogram, or with its cranks in opposite senses."""
    b = Linkage()
    b.parallelogram(start=0.0)
    text = b.refusal("dummy_derivatives")
    assert "at this point the constraints of 'crank', 'rocker', 'coupler', 'pin1', 'pin2', 'pin3' and 'pin4'" in text
    assert text.endswith(POSITION) and "every position" not in text


@pytest.mark.slow
def test_a_third_bar_of_another_length():
    """It does not fit: nothing is redundant, but there is a constraint too many for a motion."""
    b = Linkage()
    b.bar(b.parallelogram(), 0.85)
    lines = b.refusal("dummy_derivatives").splitlines()
    assert lines[0].startswith("no consistent initial point was found")
    assert lines[-1].startswith(f"the constraints of {LOOP} leave no degree of freedom")
    assert "crank.body.phi is fixed at 1, but the equations alone determine it" in "\n".join(lines)


def test_a_regular_loop_is_not_blamed():
    """Contradicting starts of a loop that can move have nothing to do with its joints."""
    b = Linkage()
    b.parallelogram()
    system = b.compile(state_selection="dummy_derivatives")
    with pytest.raises(InitializationError) as caught:
        system.initialize(initial={"crank.body.phi": 1.0, "rocker.body.phi": 0.5})
    assert "depend on each other" not in str(caught.value) and "degree of freedom" not in str(caught.value)
