"""Loops that are singular where they start, or contradict each other, and redundant ones that the start shows."""

import functools

import numpy as np
import pytest
from linkages import LOOP, REDUNDANT, Linkage
from rescaling import KINDS, rescaled

import jaxonomy_dae.library.planar as pl
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, InitializationError, StructuralError
from jaxonomy_dae.compile.passes.flatten import flatten

POSITION = "Start elsewhere, with `initial={...}` or other parameters."


# --- redundant loops -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_parallelogram_with_a_third_bar_that_is_projected():
    """The message listed equations, and told to change the parameters `ry` of links."""
    b = Linkage()
    b.bar(b.parallelogram())
    assert b.refusal("auto").splitlines()[-1] == REDUNDANT.format(LOOP, "one of them follows")


@pytest.mark.slow
def test_two_pins_between_two_bodies_that_are_projected():
    """The force along the line between the pins is not determined."""
    b = Linkage()
    one, other = b(pl.MassiveLink, "one"), b(pl.MassiveLink, "other")
    b.pin("hinge", b(pl.World, "world").frame, one.frame_a)
    b.pin("near", one.frame_a, other.frame_a)
    b.pin("far", one.frame_b, other.frame_b)
    expected = REDUNDANT.format("'one', 'other', 'near' and 'far'", "one of them follows")
    assert b.refusal("auto").splitlines()[-1] == expected


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


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True,
    reason="the model is refused, but the text names equations where it should name the redundant loop: the search "
    "that no position guides leaves the constraints to fewer digits than a redundancy shows in",
)
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


@pytest.mark.long("a search for a start at which the constraints are singular, and its diagnosis")
def test_two_bodies_in_line():
    """They cannot move, but shake: to first order the pin between them is free to go sideways."""
    text = in_line().refusal("dummy_derivatives")
    assert "at this point the constraints of 'one', 'two', 'first', 'second' and 'third' depend on each other" in text
    assert "though not nearby" in text and text.endswith(POSITION) and "every position" not in text


@pytest.mark.slow
@pytest.mark.xfail(
    reason="angles of 4e-9 that are found for zero look exact, and scaling makes the block regular: how well a root is "
    "known does not reach the verdict on rank",
    strict=False,
)
def test_a_note_of_two_bodies_in_line():
    """A root of second order is found to half of the digits: there a pin bears 1e9 N."""
    notes = in_line().compile().initialization_report().notes
    assert any("'first', 'second' and 'third' depend on each other, though not nearby" in note for note in notes)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_regular_loop_is_not_blamed():
    """Contradicting starts of a loop that can move have nothing to do with its joints."""
    b = Linkage()
    b.parallelogram()
    system = b.compile(state_selection="dummy_derivatives")
    with pytest.raises(InitializationError) as caught:
        system.initialize(initial={"crank.body.phi": 1.0, "rocker.body.phi": 0.5})
    assert "depend on each other" not in str(caught.value) and "degree of freedom" not in str(caught.value)
