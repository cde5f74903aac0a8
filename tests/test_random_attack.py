"""Random models of eight families against independent solutions; `benchmarks/attack` makes and judges them.

The long counts are `python -m benchmarks.attack`, too.
"""

import importlib
from collections.abc import Callable, Iterable

import pytest
from attack.judge import judged

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
# How many models of a family are judged by the slow tests, in runs of fifty.
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


def _judged(family: str, seeds: Iterable[int], moving: Callable[[int], bool] = lambda seed: False):
    make = importlib.import_module(f"attack.{family}").make
    for seed, case, outcome in judged(((seed, make(seed)) for seed in seeds), moving):
        yield outcome, f"{family} {seed} ({case.note}): {outcome.kind}: {outcome.text[:1000]}"


@pytest.mark.parametrize("family, seed", [(f, s) for f, seeds in QUICK.items() for s in seeds])
def test_a_random_model(family, seed):
    [(outcome, text)] = _judged(family, [seed])
    assert outcome.kind in ("right", "refused"), text


@pytest.mark.slow
@pytest.mark.parametrize("family, first", [(f, s) for f, count in COUNTS.items() for s in range(0, count, 50)])
def test_fifty_random_models(family, first):
    outcomes = list(_judged(family, range(first, first + 50), lambda seed: seed % 50 == 0))
    failed = [text for outcome, text in outcomes if outcome.kind not in ("right", "refused")]
    assert not failed, "\n".join(failed)
    assert sum(outcome.kind == "right" for outcome, _ in outcomes) >= 25  # most models are well posed
