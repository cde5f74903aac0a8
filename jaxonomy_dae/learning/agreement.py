"""How well an estimate agrees with its data: errors by name, and the likelihood."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from .likelihood import Likelihood

if TYPE_CHECKING:
    from .estimate import Estimate


def log_likelihood(estimate: "Estimate") -> float:
    """As `Estimate.log_likelihood`."""
    m, objective = estimate.minimum, estimate.objective
    count = objective.stacked.weight[objective.rows[0]]
    none = np.zeros_like(m.z)
    cost = dataclasses.replace(m.weights, precision=none, mean=none).cost(m.z, m.found.residual)
    in_cost = isinstance(m.weights, Likelihood)  # the logarithms of noise levels
    logs = 0.0 if in_cost else float(np.sum(count * np.log(m.weights.row / np.sqrt(count))))
    return logs - cost - 0.5 * float(np.sum(count) * np.log(2 * np.pi))


def rms_by_name(estimate: "Estimate") -> dict[str, dict[str, float]]:
    """As `Estimate.rms`."""
    s, rows = estimate.objective.stacked, estimate.objective.rows
    errors = np.full(s.values.shape, np.nan)
    errors[rows] = estimate.minimum.found.residual
    if not np.isin(np.arange(len(s.labels)), rows[0]).all():
        free_runs = estimate.objective.predicted(estimate.point).outputs - s.values
        errors = np.where(np.isnan(errors), free_runs, errors)
    found: dict[str, dict[str, float]] = {}
    for k, label in enumerate(s.labels):
        for j, name in enumerate(s.outputs):
            seen = s.observed[k, :, j]
            if seen.any():
                found.setdefault(label, {})[name] = float(np.sqrt(np.mean(errors[k, :, j][seen] ** 2)))
    return found
