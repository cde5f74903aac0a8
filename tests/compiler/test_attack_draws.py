"""What `make attack` is asked for, which models it draws, and the reference of models with events."""

import itertools
import os
import subprocess

import numpy as np
import pytest
from attack.__main__ import arguments
from attack.draws import FAMILIES, NETWORKS, UNITS, draws
from attack.hybrid import Delicate, HybridSystem, Reference, Rule
from attack.outcome import Outcome, row
from problems import ROOT
from sympy import Float, Symbol


@pytest.mark.parametrize(
    "given, said",
    [
        (["--minutes", "ten"], "how many minutes? a positive number, such as 10; got 'ten'"),
        (["--minutes", ""], "how many minutes?"),
        (["--minutes", "-1"], "how many minutes?"),
        (["--minutes", "1", "--seed", "x"], "a natural number is needed; got 'x'"),
        (["--minutes", "1", "--family", "pumps"], "there is no family 'pumps'; there are resistors, circuits,"),
        (["--family", "events", "--units", "all"], "the family 'events' cannot be rescaled"),
        (["--family", "published"], "needs --units"),
        (["--minutes", "1", "--processes", "0"], "at least 1 process is needed"),
    ],
)
def test_what_cannot_be_meant(capsys, given, said):
    with pytest.raises(SystemExit):
        arguments(given)
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("given", [[], ["MINUTES="]])
@pytest.mark.parametrize("goal, minutes", [("attack", 10), ("test-slow", 25)])
def test_no_time_is_given(goal, minutes, given):
    outside = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    run = subprocess.run(["make", "-n", goal, *given], cwd=ROOT, env=outside, capture_output=True, text=True)
    assert run.returncode and f"how many minutes? make {goal} MINUTES={minutes}" in run.stderr and not run.stdout


def test_all_families_take_turns():
    """One model of each, as it is and rescaled; the kinds of units change; a seed repeats a run; what a command shows
    again is the same model."""
    turn = len(FAMILIES) + len(NETWORKS)
    first = list(itertools.islice(draws(FAMILIES, 3), 4 * turn))
    assert {d.family for d in first[:turn] if not d.units} == set(FAMILIES)
    assert {d.family for d in first[:turn] if d.units} == set(NETWORKS)
    assert all({d.units for d in first if d.family == f and d.units} == set(UNITS) for f in NETWORKS)
    assert all(any(d.moving for d in first if d.family == f) for f in NETWORKS)
    assert first == list(itertools.islice(draws(FAMILIES, 3), 4 * turn))
    assert not set(first) & set(itertools.islice(draws(FAMILIES, 4), 4 * turn))
    for draw in first[:turn]:
        again = arguments(draw.command.split()[3:])
        assert (again.family, again.seed, again.units, again.count) == ((draw.family,), draw.seed, draw.units, 1)


def test_a_row_of_the_table():
    kinds = [("right", 0.25, 1.0), ("wrong", 9.0, 3.0), ("right", 0.5, 2.0)]
    pairs = [(5 + k, Outcome(kind, error, "", seconds)) for k, (kind, error, seconds) in enumerate(kinds)]
    assert row("events", pairs).split() == "events 2 0 0 0 0 1 5.0e-01 2.0 3.0 s: seed 6".split()


def ball(e: float) -> HybridSystem:
    h, v, n = Symbol("h"), Symbol("v"), Symbol("n")
    bounce = Rule(h, {v: -e * v, h: Float(0), n: n + 1})
    return HybridSystem({h: 1.0, v: 0.0}, {n: 0.0}, {}, {h: v, v: Float(-9.81)}, {}, [bounce], [])


def test_the_reference_of_a_bouncing_ball():
    """Between bounces at t₁ = √(2h/g) and tₖ₊₁ = tₖ + 2·√(2h/g)·eᵏ, a parabola."""
    reference, e, fall = Reference(ball(0.8)), 0.8, np.sqrt(2 / 9.81)
    run = reference.run(3.0)
    times = fall * (1 + 2 * np.concatenate([[0], np.cumsum(e ** np.arange(1, 6))]))
    np.testing.assert_allclose(run.instants[1:], times, rtol=1e-9)
    found = reference.read(run, np.array([3.0]))
    s, up = 3.0 - times[-1], e**6 * 9.81 * fall
    np.testing.assert_allclose(found[Symbol("h")], up * s - 9.81 * s**2 / 2, atol=1e-9)
    np.testing.assert_array_equal(found[Symbol("n")], 6)


def test_what_two_methods_need_not_agree_about():
    """Bounces that accumulate at √(2h/g)·(1 + e)/(1 − e) = 1.35 s."""
    with pytest.raises(Delicate, match="instants"):
        Reference(ball(0.5)).run(3.0)
