"""A compiled model and how it is run: drawn as a sketch, or by another family."""

import dataclasses
import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalSystem

from .rewrite import numbers, varied
from .said import inputs_of, variables_of
from .sketch import Sketch, diagram_of
from .stranger import drawn

# Whose models the package is asked for a run of, too; by how many of theirs one can afford.
OTHERS = ("circuits", "thermal", "mechanisms", "relations", "events", "drives", "pipes", "gears", "rods", "shafts")
EVERY = 4  # so many-th number is a model of another family
MOST = 60  # variables: larger models are drawn again


@dataclasses.dataclass(frozen=True)
class Subject:
    """A system, the full names of what is read of it, and how it is run.

    - `values`: other values of its parameters, one mapping a member. `bounds`: of parameters, where they are bounded.
    - `delicate`: whether small errors may grow.
    """

    system: AcausalSystem
    names: Mapping[str, str]
    initial: Mapping[str, float]
    inputs: Mapping[str, Any]
    end: float
    note: str
    values: tuple[Mapping[str, float], ...]
    bounds: Mapping[str, tuple[float, float]]
    sizes: Mapping[str, float]
    sketch: Sketch | None = None


def of_sketch(sketch: Sketch, rng: np.random.Generator, members: int = 3) -> Subject:
    """Compiles a sketch, and draws other values."""
    full = sketch.names()
    system = AcausalCompiler(*diagram_of(sketch))()
    values = [numbers(sketch), *(varied(sketch, rng) for _ in range(members - 1))]
    return Subject(
        system,
        variables_of(sketch),
        {},
        inputs_of(sketch),
        sketch.end,
        sketch.note,
        tuple({full[n]: v for n, v in one.items()} for one in values),
        {full[d.name]: d.args["bounds"] for d in sketch.declared("parameter") if "bounds" in d.args},
        sketch.sizes,
        sketch,
    )


def of_family(number: int, rng: np.random.Generator) -> Subject:
    """A model of another family; parameters keep their values, and starts vary."""
    family = OTHERS[number // EVERY % len(OTHERS)]
    module = importlib.import_module(f"..{family}", __package__)
    for seed in range(number, number + 1000):
        case = module.make(seed)
        system = AcausalCompiler(case.ev, case.diagram)() if case.refusal is None else None
        if system is not None and len(system.variables) <= MOST:
            break
    else:
        raise AssertionError(f"no small model of {family}")
    known = [n for n in system.variables if n not in system.inputs]
    chosen = sorted(rng.choice(len(known), min(12, len(known)), replace=False).tolist())
    end = float(case.motion.ts[-1]) if case.motion is not None else 1.0
    names = {known[k]: known[k] for k in chosen}
    return Subject(
        system, names, dict(case.initial), {}, min(end, 2.0), f"{family} {seed}", ({}, {}, {}), {}, {}
    )  # fmt: skip


def subject(number: int) -> tuple[Subject, np.random.Generator]:
    """The model of a number."""
    rng = np.random.default_rng([number, 21])
    if number % EVERY == EVERY - 1:
        return of_family(number, rng), rng
    sketch = drawn(number, rng)
    return of_sketch(sketch, rng), rng
