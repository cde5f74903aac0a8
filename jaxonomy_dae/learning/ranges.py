"""Networks in the ranges of their inputs, so that units do not decide what a fit finds.

A raw `equinox.nn.MLP` is drawn for inputs and outputs of order one. Where an input goes from 2·10⁵ to 3·10⁵ (pascals),
all its hidden units are saturated; where it stays below 10⁻³ (metres), all are linear; and a prior on weights means
something else in each unit. So the search measures weights by what they do. With inputs of centre c and half range s,
as the model's runs explore them without the network, and outputs of size o, the coordinates are those of

    o·MLP((u − c)/s),

up to biases of the first layer, which take up c: weights of the first layer in units of 1/s, biases there in units of
√(1 + |c/s|²), and the last layer in units of o. The network itself stays what it is.

Modules of a user's own bring their scales along, and so do networks with a prior of a given precision.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from .objective import Objective
from .program import weights_of


def in_ranges(
    objective: Objective, quiet: Float[np.ndarray, " f"]
) -> tuple[Objective, Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
    """(the objective with weights measured by what they do; the start of its search; the same start, but with the
    numbers of the networks taken as numbers for inputs and outputs of order one). `quiet`: a point at which networks
    say nothing. Without raw networks, or where the model cannot be run there, nothing changes."""
    c = objective.coordinates
    start = c.z_start[objective.free]
    places = {name: _places(objective, name) for name in objective.blocks}
    chosen = {name: at for name, at in places.items() if at is not None}
    found = objective.evaluate(quiet) if chosen else None
    if found is None:
        return objective, start, start
    weights = objective.weights(quiet, found)
    rows = weights.row[:, None] * found.jacobian
    misfit = float(np.linalg.norm(weights.row * found.residual))
    seen = objective.seen(objective.full(quiet))
    size, fresh = np.array(c.size), np.array(c.start)
    for name, at in chosen.items():
        points = seen[name][np.isfinite(seen[name]).all(axis=1)]
        if not len(points):
            continue
        net = objective.system.neural[name]
        free = np.cumsum(objective.free)[at] - 1
        effect = _like(net, np.linalg.norm(rows[:, free], axis=0))
        low, high = points.min(axis=0), points.max(axis=0)
        size[at], fresh[at] = _measured(net, 0.5 * (low + high), 0.5 * (high - low), effect.layers[-1], misfit)
    measured = dataclasses.replace(c, size=size)
    begun = dataclasses.replace(measured, start=fresh)
    objective = dataclasses.replace(objective, coordinates=measured)
    return objective, measured.z_start[objective.free], begun.z_start[objective.free]


def _places(objective: Objective, name: str) -> Int[np.ndarray, " w"] | None:
    """The coordinates of a raw network whose prior the evidence chooses; None for all others."""
    net, c = objective.system.neural[name], objective.coordinates
    if type(net) is not eqx.nn.MLP or len(net.layers) < 2 or objective.penalties.get(name) != "evidence":
        return None
    at = np.flatnonzero(np.array([group == name for group in c.group]) & c.is_weight)
    return at if objective.free[at].all() else None


def _like(net: Any, numbers: Float[np.ndarray, " w"]) -> Any:
    """The network with these numbers in place of its trained ones, as NumPy arrays."""
    leaves, structure = jax.tree.flatten(eqx.filter(net, eqx.is_inexact_array))
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = [part.reshape(leaf.shape) for part, leaf in zip(np.split(numbers, ends), leaves, strict=True)]
    return jax.tree.unflatten(structure, parts)


def _measured(
    net: Any, centre: Float[np.ndarray, " inputs"], spread: Float[np.ndarray, " inputs"], effect: Any, misfit: float
) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " w"]]:
    """(the units of a network's numbers; its numbers, taken as those for inputs and outputs of order one).

    - `effect`: the last layer, with the norm of what one of its numbers changes residuals by; `misfit`: the norm of
        residuals without the network. Outputs are as large as would change as much as there is to explain.
    """
    spread = np.where(spread > 0, spread, np.where(centre != 0, np.abs(centre), 1.0))
    numbers = _like(net, _flat(weights_of(net)).astype(float))
    units = jax.tree.map(np.ones_like, numbers)
    first, unit = numbers.layers[0], units.layers[0]
    unit.weight[...] = 1 / spread
    first.weight[...] = first.weight / spread
    if first.bias is not None:
        unit.bias[...] = np.sqrt(1 + np.sum((centre / spread) ** 2))
        first.bias[...] = first.bias - first.weight @ centre
    squares = np.mean(effect.weight**2, axis=1)
    with np.errstate(divide="ignore"):
        out = np.where((squares > 0) & (misfit > 0), misfit / np.sqrt(squares), 1.0)
    for a in jax.tree.leaves((units.layers[-1], numbers.layers[-1])):
        a[...] = (a.T * out).T
    return _flat(units), _flat(numbers)


def _flat(tree: Any) -> Float[np.ndarray, " w"]:
    return np.concatenate([np.ravel(a) for a in jax.tree.leaves(tree)])
