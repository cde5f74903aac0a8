"""What a test problem is, and how far a result is from its reference."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, Component, EqnEnv

from .index_one import IndexOne

DATA = Path(__file__).parents[2] / "tests" / "data" / "testset"


def load(name: str) -> dict[str, Any]:
    """The facts of a problem: sources, parameters, starts, published references."""
    return json.loads((DATA / f"{name}.json").read_text())


@dataclass(frozen=True)
class Table:
    """A published trajectory: `values[name]` has the shape of `ts`; `digits` (relative to `scale`) are right."""

    ts: np.ndarray
    values: Mapping[str, np.ndarray]
    digits: float


@dataclass(frozen=True)
class Problem:
    """A DAE with a known end value.

    - `build`: the model, as an environment and a diagram.
    - `reference`: variables of the model and their values at `t1`, right to `digits` significant digits (relative to
        `scale`); `origin` says where from. For values worse than that in their publication, `published` keeps those,
        right to `published_digits`.
    - `scale`: the size below which a component's error counts as absolute. The error of a result is
        |found − reference| / max(|reference|, scale).
    - `atol`, `least_atol`: solve with an absolute tolerance of max(rtol·atol, least_atol); see `tolerances`.
    - `t0`: where integration starts, `t1` where it ends. `breaks`: times in between where the equations jump.
    - `index_one`: index-1 equations M·dy/dt = F(t, y); `given` says whether these are the published equations, so that
        a solver may be measured on them, or a reduction by hand.
    - `stiff`: whether an explicit solver is hopeless.
    """

    name: str
    build: Callable[[], tuple[EqnEnv, AcausalDiagram]]
    reference: Mapping[str, float]
    scale: Mapping[str, float]
    digits: float
    origin: str
    t1: float
    index_one: Callable[[], IndexOne]
    given: bool
    atol: float = 1.0
    least_atol: float = 0.0
    t0: float = 0.0
    breaks: tuple[float, ...] = ()
    stiff: bool = False
    published: Mapping[str, float] = field(default_factory=dict)
    published_digits: float = math.inf
    table: Table | None = None

    def compile(self) -> AcausalSystem:
        ev, diagram = self.build()
        return AcausalCompiler(ev, diagram)()

    def tolerances(self, rtol: float) -> dict[str, float]:
        """`rtol=` and `atol=` for a solver."""
        return {"rtol": rtol, "atol": max(rtol * self.atol, self.least_atol)}

    def errors(self, found: Mapping[str, Any]) -> dict[str, float]:
        """|found − reference| / max(|reference|, scale) for every reference; `found` are values at `t1`."""
        return {
            name: float(abs(np.asarray(found[name], float) - value)) / max(abs(value), self.scale[name])
            for name, value in self.reference.items()
        }

    def correct_digits(self, found: Mapping[str, Any]) -> float:
        """The least number of correct digits of any component: −log₁₀ of the largest error."""
        worst = max(self.errors(found).values())
        return -math.log10(max(worst, 1e-17)) if math.isfinite(worst) else -math.inf


def alone(component: Callable[[EqnEnv], Component]) -> Callable[[], tuple[EqnEnv, AcausalDiagram]]:
    """A model of one component."""

    def build():
        ev = EqnEnv()
        return ev, AcausalDiagram().add(component(ev))

    return build


def named(prefix: str, names: Any, values: Any) -> dict[str, float]:
    """`{"prefix.name": value}`, without values that are not known."""
    pairs = zip(names, values, strict=True)
    return {f"{prefix}.{name}": float(value) for name, value in pairs if value is not None}
