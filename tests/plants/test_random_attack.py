"""Random models against independent solutions: a sample of what `make attack` draws.

`benchmarks/attack` makes and judges them.
"""

import subprocess
import sys

import pytest
from attack import invariance
from attack.draws import FAMILIES, NETWORKS, Draw
from attack.invariance import planted
from attack.outcome import GOOD
from problems import ROOT, slow

# Seeds of the quick run; those named were wrong or refused once.
QUICK = {
    "resistors": (103, 464),
    "circuits": (4, 8),
    "rods": (3, 13),
    "gears": (2, 29),
    "thermal": (3, 38),
    "pipes": (11, 84),
    "mechanisms": (7, 34),
    "descriptors": (27,),
    "events": (12, 6),
}


@pytest.mark.parametrize(
    "family, seed",
    [
        *((f, seeds[0]) for f, seeds in QUICK.items() if f != "events"),
        *(pytest.param(f, s, marks=pytest.mark.slow) for f, seeds in QUICK.items() for s in seeds[f != "events" :]),
    ],
)
def test_a_random_model(family, seed):
    note, (outcome,) = Draw(family, seed).judged()
    assert outcome.kind in GOOD, f"({note}): {outcome.kind}: {outcome.text[:1000]}"


OWN = {"rings": 1, "switches": 1, "blocks": 11, "pairs": 0, "singular": 3, "idle": 3}


@pytest.mark.parametrize(
    "family", ["rings", *(pytest.param(name, marks=pytest.mark.slow) for name in OWN if name != "rings")]
)
def test_families_that_judge_themselves(family):
    note, outcomes = Draw(family, OWN[family]).judged()
    for outcome in outcomes:
        assert outcome.kind in GOOD, f"({note}): {outcome.kind}: {outcome.text[:1000]}"


def judge_apart(*arguments: str) -> list[list[int]]:
    """The counts, one row a family, in a process of its own, whose XLA optimizes nothing: every program runs once."""
    command = [sys.executable, "-m", "benchmarks.attack", *arguments]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, f"{run.stdout}\n{run.stderr[-2000:]}"
    return [[int(n) for n in line[22:76].split()] for line in run.stdout.splitlines()[1:]]


@pytest.mark.slow
def test_some_of_each_family():
    families = [name for name in FAMILIES if name not in OWN and name != "invariance"]  # that has a row for each letter
    counts = judge_apart("--family", ",".join(families), "--count", "3", "--seed", "400", "--moving", "3")
    assert len(counts) == len(families)
    assert all(right + refused == 3 and not any(others) for right, refused, *others in counts)
    assert sum(row[0] for row in counts) >= 15  # most models are well posed


@pytest.mark.slow
def test_variants_of_a_model_are_run_by_its_program():
    counts = judge_apart("--family", "drives", "--seed", "2001", "--count", "1", "--variants", "5")
    assert counts == [[1, 0, 0, 0, 0, 0], [5, 0, 0, 0, 0, 0]]


@pytest.mark.slow
@pytest.mark.parametrize("units, seed", [("units", 410), ("all", 411)])
def test_one_of_each_family_in_other_units(units, seed):
    counts = judge_apart("--count", "1", "--seed", str(seed), "--units", units)
    assert len(counts) == len(NETWORKS) and all(right + refused == 1 for right, refused, *_ in counts)


@pytest.mark.slow
def test_right_sides_that_are_zero_but_for_rounding():
    # Computed once in a solution and once more in its check, by fused multiply-adds only once, they differ by all of
    # what they are, and the check fails.
    assert judge_apart("--family", "descriptors", "--seed", "281", "--count", "1") == [[1, 0, 0, 0, 0, 0]]


# Numbers of cheap models, by letter: what must not matter, and does not. `make attack FAMILY=invariance` draws others.
CHEAPEST = {("c", 22), ("e", 2), ("h", 1)}
INVARIANT = {"b": (100,), "c": (1, 19, 22), "d": (0, 9), "e": (2, 22), "h": (1, 30), "i": (100,)}


@pytest.mark.parametrize(
    "letter, number",
    [
        pytest.param(letter, n, marks=() if (letter, n) in CHEAPEST else pytest.mark.slow)
        for letter, ns in INVARIANT.items()
        for n in ns
    ],
)
def test_what_must_not_matter(letter, number):
    pairs = invariance.LETTERS[letter](number)
    assert len(pairs.outcomes) > 2
    for outcome in pairs.outcomes:
        assert outcome.kind == "right" or (letter == "b" and outcome.kind == "refused"), f"({pairs.note}): {outcome}"


@pytest.mark.slow
def test_a_twin_before_it_does_not_matter():
    pairs = invariance.LETTERS["a"](1)
    assert [o.kind for o in pairs.outcomes] == ["right"] * 10, pairs.outcomes


# One deliberate fault of each letter that compares points; `python -m benchmarks.attack.invariance.planted` plants all.
PLANTED = [
    k for k, fault in enumerate(planted.FAULTS) if (fault.letter, fault.number) in (("c", 2), ("e", 22), ("h", 2))
]


@pytest.mark.parametrize("k", slow(PLANTED, *PLANTED[1:]))
def test_a_planted_fault_is_noticed(k):
    assert planted.apart(k)
