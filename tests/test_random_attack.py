"""Random models of eight families against independent solutions; `benchmarks/attack` makes and judges them.

The long counts are `python -m benchmarks.attack`, too.
"""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from attack.judge import judged

ROOT = Path(__file__).parents[1]

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
}
# How many models of a family are judged by the slow tests, in runs of a hundred.
COUNTS = {
    "resistors": 1000,
    "circuits": 500,
    "rods": 500,
    "gears": 500,
    "thermal": 500,
    "pipes": 500,
    "descriptors": 500,
    "mechanisms": 200,
}


@pytest.mark.parametrize("family, seed", [(f, s) for f, seeds in QUICK.items() for s in seeds])
def test_a_random_model(family, seed):
    make = importlib.import_module(f"attack.{family}").make
    [(_, case, outcome)] = judged([(seed, make(seed))], lambda seed: False)
    assert outcome.kind in ("right", "refused"), f"({case.note}): {outcome.kind}: {outcome.text[:1000]}"


def hundreds(family: str) -> type:
    """The slow tests of a family, as a class: classes may run beside each other, on several workers."""

    class Hundreds:
        @pytest.mark.slow
        @pytest.mark.parametrize("first", range(0, COUNTS[family], 100))
        def test_a_hundred_random_models(self, first):
            judge_a_hundred(family, first)

    return Hundreds


def judge_a_hundred(family: str, first: int):
    assert judge_apart(family, first, 100) >= 50  # most models are well posed


def judge_apart(family: str, first: int, count: int) -> int:
    """How many are right, in a process of its own, whose XLA optimizes nothing: every program runs once."""
    command = [sys.executable, "-m", "benchmarks.attack", "--family", family, "--count", str(count)]
    command += ["--seed", str(first), "--moving", "50", "--show", "9"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    *failed, counts = run.stdout.splitlines()
    right, refused, *others = (int(n) for n in counts.split()[1:7])
    assert right + refused + sum(others) == count and not any(others), "\n".join(failed)
    return right


def test_right_sides_that_are_zero_but_for_rounding():
    # Computed once in a solution and once more in its check, by fused multiply-adds only once, they differ by all of
    # what they are, and the check fails.
    assert judge_apart("descriptors", 281, 1) == 1


TestResistors = hundreds("resistors")
TestCircuits = hundreds("circuits")
TestRods = hundreds("rods")
TestGears = hundreds("gears")
TestThermal = hundreds("thermal")
TestPipes = hundreds("pipes")
TestDescriptors = hundreds("descriptors")
TestMechanisms = hundreds("mechanisms")
