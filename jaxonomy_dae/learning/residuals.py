"""Residuals of a model by experiment and name, for losses of one's own."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..errors import ModelError, nearest
from ..system.system import AcausalSystem
from .objective import Objective
from .program import predict


def residuals(
    objective: Objective, model: AcausalSystem, starts: dict[str, Any], observe: dict[str, Any], adjoint: Any
) -> dict[str, dict[str, Any]]:
    """As `Problem.residuals`: predictions of a model like the objective's less its data, in units of the noise."""
    layout, s = objective.layout, objective.stacked
    shared, own = objective.numbers(objective.coordinates.start)
    shared = shared[len(shared) - len(layout.shared) :]
    for name, value in starts.items():
        value = jnp.asarray(value, shared.dtype)
        if name in layout.shared:
            shared = shared.at[layout.shared.index(name)].set(value)
        elif name in layout.own:
            own = own.at[:, layout.own.index(name)].set(value)
        else:
            raise ModelError(f"the start of '{name}' is not unknown: " + nearest(name, layout.shared + layout.own))
    plain = dataclasses.replace(layout, parameters=(), modules=(), extra=())
    outputs = predict(model, objective.observers | observe, plain, adjoint, shared, own, objective.conditions)
    sigma = np.where(np.isnan(s.sigma), 1.0, s.sigma)
    scaled = jnp.where(s.observed, (outputs - s.values) / sigma[:, None, :], 0.0)
    return {
        label: {name: scaled[k, :count, j] for j, name in enumerate(s.outputs) if s.observed[k, :, j].any()}
        for k, (label, count) in enumerate(zip(s.labels, s.counts, strict=True))
    }
