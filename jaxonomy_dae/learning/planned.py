"""Experiments that have not been made yet."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import ModelError
from ..lowering.plan import SystemPlan
from .experiment import Experiment


@dataclasses.dataclass(frozen=True, eq=False)
class Planned:
    """An experiment that could be made, for `learning.next_experiment`.

    - `times`: when it would be sampled, increasing, shape `(n,)`.
    - `measure`: what would be measured, the standard deviation of the noise by variables' names, in their units.
    - `inputs`, `initial`, `weight`, `t0`, `name`: as in `Experiment`. An unknown start is of no use by itself, and is
        allowed for: the samples must determine it too.
    """

    times: Any
    measure: Mapping[str, float]
    inputs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    initial: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    weight: float = 1.0
    t0: float = 0.0
    name: str = ""

    def __post_init__(self):
        if not isinstance(self.measure, Mapping) or not self.measure:
            raise ModelError(
                f"measure is a dictionary of noise levels by variables' names, {{'m.x': 1e-3}}; got {self.measure!r}"
            )
        for name, sigma in self.measure.items():
            number = isinstance(sigma, int | float | np.number) and not isinstance(sigma, bool)
            if not number or not (np.isfinite(sigma) and sigma > 0):
                raise ModelError(f"measure: '{name}' needs a standard deviation > 0; got {sigma!r}")

    def experiment(self, plan: SystemPlan) -> Experiment:
        """An experiment whose record is zero; only its times count."""
        count = len(np.atleast_1d(np.asarray(self.times)))
        data = {}
        for name in self.measure:
            entries = plan.entries(name)
            data[name] = np.zeros((count, *(() if entries is None else entries[1])))
        return Experiment(
            self.times, data, sigma=dict(self.measure), inputs=self.inputs, initial=self.initial, weight=self.weight,
            t0=self.t0, name=self.name,
        )  # fmt: skip
