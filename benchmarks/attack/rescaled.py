"""The random models in other units."""

import dataclasses
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from jaxonomy_dae.compile.passes.flatten import flatten

from .case import Case, Expected

sys.path.insert(0, str(Path(__file__).parents[1]))  # imported by its own name, as the tests do

from rescaling import new_name  # noqa: E402
from rescaling import rescaled as in_other_units


def rescaled(case: Case, seed: int, kind: str) -> Case:
    """The case in other units, its equations and variables in random order."""
    flat = flatten(case.diagram)
    ev, diagram, factors = in_other_units(np.random.default_rng([seed, 9]), flat, kind)
    factor = dict(zip(flat.variables.names, factors.variable.tolist(), strict=True))

    def values(table: Mapping[str, Expected]) -> dict[str, Expected]:
        return {new_name(n): Expected(true.value / factor[n], true.allowed / factor[n]) for n, true in table.items()}

    return dataclasses.replace(
        case,
        ev=ev,
        diagram=diagram,
        initial={new_name(n): v / factor[n] for n, v in case.initial.items()},
        expected=values(case.expected),
        rates=values(case.rates),
        motion=None,
        note=f"{case.note}; {kind} rescaled",
    )


def family(make: Callable[[int], Case], kind: str) -> Callable[[int], Case]:
    """A family in other units."""
    return lambda seed: rescaled(make(seed), seed, kind)
