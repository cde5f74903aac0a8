"""Random models of eight families against independent solutions; `benchmarks/attack` makes and judges them.

The long counts are `python -m benchmarks.attack`, too.
"""

import importlib

import pytest
from attack.judge import judge

# Seeds of the quick run; those named were wrong or refused once.
QUICK = {
    "resistors": (103, 464),
    "circuits": (4, 8),
    "rods": (3, 13),
    "gears": (2, 29),
    "thermal": (3, 38),
    "pipes": (11, 84),
    "mechanisms": (7, 34),
}
# How many models of a family are judged by the slow tests, in runs of fifty.
COUNTS = {
    "circuits": 500,
    "rods": 500,
    "gears": 500,
    "thermal": 500,
    "mechanisms": 200,
}


def _judged(family: str, seed: int, moving: bool = False):
    case = importlib.import_module(f"attack.{family}").make(seed)
    outcome = judge(case, moving)
    return outcome, f"{family} {seed} ({case.note}): {outcome.kind}: {outcome.text[:1000]}"


@pytest.mark.parametrize("family, seed", [(f, s) for f, seeds in QUICK.items() for s in seeds])
def test_a_random_model(family, seed):
    outcome, text = _judged(family, seed)
    assert outcome.kind in ("right", "refused"), text


@pytest.mark.slow
@pytest.mark.parametrize("family, first", [(f, s) for f, count in COUNTS.items() for s in range(0, count, 50)])
def test_fifty_random_models(family, first):
    judged = [_judged(family, seed, moving=seed % 50 == 0) for seed in range(first, first + 50)]
    failed = [text for outcome, text in judged if outcome.kind not in ("right", "refused")]
    assert not failed, "\n".join(failed)
    assert sum(outcome.kind == "right" for outcome, _ in judged) >= 25  # most models are well posed
