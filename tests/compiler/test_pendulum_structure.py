"""The constrained pendulum: index, states, and references that agree with each other."""

import numpy as np
import pytest
from problems import DRAG, HORIZONS, RELEASE, angle_solution, elliptic_angle, pendulum


def test_structure():
    report = pendulum().report
    # Pantelides (1988); J. Cash's driver: structural index 3, two degrees of freedom.
    assert (report.index, report.degrees_of_freedom) == (3, 2)
    assert sorted(n for _, n in report.differentiated) == [1, 1, 2]
    assert len(report.constraints) == 2


def minimal(theta, *prefer):
    """The states and the notes of a pendulum with two states, released at an angle."""
    options = {"state_selection": "dummy_derivatives", "prefer_states": prefer}
    report = pendulum(initial_theta=theta, compiler=options).report
    return {name.removeprefix("pend.") for name in report.states}, " ".join(report.notes)


def test_preferred_states_are_taken_where_they_are_regular():
    assert minimal(RELEASE, "pend.x", "pend.vx") == ({"x", "vx"}, "")
    assert minimal(RELEASE, "pend.y", "pend.vy") == ({"y", "vy"}, "")


@pytest.mark.parametrize("theta, good, bad", [(-np.pi / 2, "x", "y"), (0.0, "y", "x")])
def test_a_singular_choice_of_states_is_vetoed(theta, good, bad):
    """At its lowest point a pendulum's height is not a state: numbers decide, not structure alone."""
    assert minimal(theta) == ({good, f"v{good}"}, "")
    states, notes = minimal(theta, f"pend.{bad}", f"pend.v{bad}")
    assert states == {good, f"v{good}"}
    assert f"pend.v{bad} was preferred" in notes and "nearly singular" in notes


def test_what_is_preferred_and_no_state_is_said():
    """Coordinates of which the constraint leaves one, and what no equation differentiates."""
    states, notes = minimal(RELEASE, "pend.x", "pend.vx", "pend.y", "pend.lam")
    assert states == {"x", "vx"}
    assert notes == "prefer_states: 'pend.y' and 'pend.lam' are no states: the states and inputs determine them"


def test_the_references_agree():
    ts = np.linspace(0.1, 20.0, 50)
    angle = elliptic_angle(np.pi / 6, ts)
    numeric = angle_solution(np.pi / 6, 0.0, ts)
    # A closed form against DOP853 at 1e-13 over 20 s.
    np.testing.assert_allclose(np.stack([numeric.x, numeric.y]), np.stack([np.cos(angle), np.sin(angle)]), atol=1e-9)


def test_the_tension_would_notice_a_missing_drag():
    with_drag = angle_solution(RELEASE, 0.0, HORIZONS, force=lambda vx, vy: (-DRAG * vx * abs(vx), 0.0))
    n = -DRAG * with_drag.vx * np.abs(with_drag.vx)
    assert np.min(np.abs(with_drag.x * n / 2)) > 1e-4  # what `lam` lacks in row injection
