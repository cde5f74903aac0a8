"""What a random model is: a diagram, the values that determine its point, and what must come out."""

import dataclasses
import itertools
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv

TRIED = 30  # other numbers for each variant, until the reference can decide what happens
TOLERANCE = 1e-8  # of a quantity's scale
ROUNDING = 100 * np.finfo(float).eps
UNCHANGED: Mapping[str, float] = types.MappingProxyType({})  # no part's value is multiplied


@dataclasses.dataclass(frozen=True)
class Expected:
    """The true value of a variable and the error that is allowed."""

    value: float
    allowed: float


@dataclasses.dataclass(frozen=True)
class Case:
    """A random model.

    - `initial`: what is given at the start: enough to determine the point.
    - `expected`: true values by variable. `rates`: true time derivatives, for those that are states.
    - `freedom`: how many states there must be; None if the family does not say (or keeps redundant ones).
    - `refusal`: if the model has no unique solution, what the error must say (one of these words); None if it has one.
    - `motion`: a true trajectory; integrated if asked for, or if the case `always_moves`. `slopes`: derivatives of a
        functional of it.
    - `may_refuse`: what an error may truly say of a model that has a solution, but asks for more than is promised.
    - `variants`: the same equations with other numbers, for `with_parameters`.
    """

    ev: EqnEnv
    diagram: AcausalDiagram
    initial: Mapping[str, float]
    expected: Mapping[str, Expected]
    rates: Mapping[str, Expected] = dataclasses.field(default_factory=dict)
    freedom: int | None = None
    refusal: Sequence[str] | None = None
    motion: "Motion | None" = None
    slopes: "Slopes | None" = None
    always_moves: bool = False
    t0: float = 0.0
    may_refuse: Sequence[str] = ()
    variants: "Sequence[Variant]" = ()
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Motion:
    """A true trajectory: `values[name]` at the times `ts`, with the errors allowed at rtol, atol. `follow` gives the
    values for other initial values and times, if the family can."""

    ts: np.ndarray
    values: Mapping[str, np.ndarray]
    allowed: Mapping[str, float]
    rtol: float
    atol: float
    follow: Callable[[Mapping[str, float], np.ndarray], Mapping[str, np.ndarray]] | None = None


@dataclasses.dataclass(frozen=True)
class Slopes:
    """The true derivatives of Σ weights[name]·values(name) over the motion's times: by `parameters` and by the values
    `initial` of the case, by name; by all weights of the networks in `learned`, by their number. Taken in reverse mode,
    and `forward` as well."""

    weights: Mapping[str, np.ndarray]
    value: Expected
    parameters: Mapping[str, Expected]
    initial: Mapping[str, Expected]
    learned: Mapping[str, Sequence[Expected]] = dataclasses.field(default_factory=dict)
    forward: bool = True


@dataclasses.dataclass(frozen=True)
class Variant:
    """Other numbers for the equations of a case: parameters by name, what is given at the start, and what comes out,
    with as many times and the same names as in the case."""

    parameters: Mapping[str, float]
    initial: Mapping[str, float]
    motion: Motion
    slopes: "Slopes | None" = None


def numbers_of(parts: Sequence[Component]) -> dict[str, float]:
    """The parameters of components by name, without starts of discrete variables and what follows from others."""
    return {
        f"{part.name}.{p.name}": float(p.value)
        for part in parts
        for p in part.parameters.values()
        if not p.is_discrete and isinstance(p.value, int | float)
    }


def varied(rng: np.random.Generator, value: float) -> float:
    """The value multiplied by 10 to the power of ±1/4 at most."""
    return value * log_uniform(rng, -0.25, 0.25)


def drawn(count: int, seed: Sequence[int], draw: Callable[[np.random.Generator], Variant | None]) -> list[Variant]:
    """So many variants of a case, or as many as a limited number of trials gives."""
    found = (draw(np.random.default_rng([*seed, k])) for k in range(TRIED * count))
    return list(itertools.islice((v for v in found if v is not None), count))


def diagram_of(rng: np.random.Generator, parts: Sequence[Component], nodes: Sequence[Sequence[Any]]) -> AcausalDiagram:
    """The diagram of components and of nodes, lists of ports, in random order and split at random.

    A node of k ports becomes one connection of all, or a chain of smaller ones.
    """
    diagram = AcausalDiagram()
    connections: list[list[Any]] = []
    for ports in nodes:
        ports = [ports[k] for k in rng.permutation(len(ports))]
        if len(ports) < 2:
            continue
        if len(ports) > 2 and rng.random() < 0.3:
            cut = int(rng.integers(1, len(ports)))
            connections += [ports[:cut], ports[cut:], [ports[0], ports[-1]]]
        else:
            connections.append(ports)
    diagram.add(*(parts[k] for k in rng.permutation(len(parts))))
    for k in rng.permutation(len(connections)):
        if len(connections[k]) > 1:
            diagram.connect(*connections[k])
    return diagram


def names(rng: np.random.Generator, count: int) -> list[str]:
    """Distinct names without an order that means anything."""
    numbers = rng.permutation(10 * count + 10)[:count]
    return [f"{'abkqxzRCt'[int(k) % 9]}{k}" for k in numbers]


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """10 to the power of a uniform number."""
    return float(10 ** rng.uniform(low, high))


def signed(rng: np.random.Generator, value: float) -> float:
    """The value with a random sign."""
    return value if rng.random() < 0.5 else -value
