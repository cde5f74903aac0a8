"""Networks in the ranges of their inputs, so that units do not decide what a fit finds.

A raw `equinox.nn.MLP` is drawn for inputs and outputs of order one. Where an input goes from 2·10⁵ to 3·10⁵ (pascals),
all its hidden units are saturated; where it stays below 10⁻³ (metres), all are linear; and a prior on weights means
something else in each unit. So the search measures weights by what they do. With inputs of centre c and half range s,
as the model's runs explore them without the network, and outputs of size o, the coordinates are those of

    o·MLP((u − c)/s):

weights of the first layer in units of 1/s, biases there as they act at u = c, and the last layer in units of o. The
network itself stays what it is.

Those with a property (`laws/properties.py`) are measured where they are evaluated. Modules of a user's own bring their
scales along, and so do networks with a prior of a given precision.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from .coordinates import Shifts
from .laws.properties import Property, is_raw, raw
from .objective import Objective
from .program import weights_of


def in_ranges(
    objective: Objective, quiet: Float[np.ndarray, " f"], is_centred: bool
) -> tuple[Objective, Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
    """(the objective with weights measured by what they do; the start of its search; the same start, but with the
    numbers of the networks taken as numbers for inputs and outputs of order one). `quiet`: a point at which networks
    say nothing. `is_centred`: whether biases are measured at the centre of inputs. Without raw networks, or where the
    model cannot be run there, nothing changes."""
    c = objective.coordinates
    start = c.z_start[objective.free]
    places = {name: _places(objective, name) for name in objective.blocks}
    chosen = {name: at for name, at in places.items() if at is not None}
    seen = objective.seen(objective.full(quiet)) if chosen else {}
    points = {name: seen[name][np.isfinite(seen[name]).all(axis=1)] for name in chosen}
    points = {name: _asked(objective.system.neural[name], at) for name, at in points.items()}
    if not any(map(len, points.values())):
        return objective, start, start
    size, fresh, shifts = np.array(c.size), np.array(c.start), []
    chosen = {name: at for name, at in chosen.items() if len(points[name])}
    ends = np.zeros(len(c), bool)  # weights of last layers
    for name, at in chosen.items():
        low, high = points[name].min(axis=0), points[name].max(axis=0)
        net, centre = raw(objective.system.neural[name]), 0.5 * (low + high)
        size[at], fresh[at] = _inner(net, centre, 0.5 * (high - low))
        ends[at] = _of_last_layer(net)
        if net.layers[0].bias is not None and is_centred:
            shifts.append(_shifts(net, at, centre))
    # What the last layers do is measured beside inner layers in their ranges: before, units of inputs decided it.
    silent = dataclasses.replace(c, start=np.where(ends, 0.0, fresh)).z_start[objective.free]
    found = objective.evaluate(silent)
    if found is None:
        return objective, start, start
    weights = objective.weights(silent, found)
    misfit = float(np.linalg.norm(weights.row * found.residual))
    effects = np.zeros(len(c))
    effects[objective.free] = np.linalg.norm(weights.row[:, None] * found.jacobian, axis=0)
    for name, at in chosen.items():
        net = raw(objective.system.neural[name])
        out = _outer(net, _like(net, effects[at]).layers[-1], misfit)
        size[at], fresh[at] = size[at] * out, fresh[at] * out
    joined = Shifts(*(np.concatenate(parts) for parts in zip(*shifts, strict=True))) if shifts else None
    measured = dataclasses.replace(c, size=size, shifts=joined)
    begun = dataclasses.replace(measured, start=fresh)
    objective = dataclasses.replace(objective, coordinates=measured)
    return objective, measured.z_start[objective.free], begun.z_start[objective.free]


def _places(objective: Objective, name: str) -> Int[np.ndarray, " w"] | None:
    """The coordinates of a raw network whose prior the evidence chooses; None for all others."""
    whole, c = objective.system.neural[name], objective.coordinates
    if not is_raw(whole) or len(raw(whole).layers) < 2 or objective.penalties.get(name) != "evidence":
        return None
    at = np.flatnonzero(np.array([group == name for group in c.group]) & c.is_weight)
    # Bounds are those of the numbers themselves, and not of what biases are at the centre.
    is_bounded = np.isfinite(c.low[at]).any() or np.isfinite(c.high[at]).any()
    return at if objective.free[at].all() and not is_bounded else None


def _asked(net: Any, points: Float[np.ndarray, "m inputs"]) -> Float[np.ndarray, "n inputs"]:
    """Where a raw network is evaluated for its law at these points."""
    return net.asked(points) if isinstance(net, Property) and len(points) else points


def _shifts(net: Any, at: Int[np.ndarray, " w"], centre: Float[np.ndarray, " inputs"]) -> Shifts:
    """The coordinates of the first layer's biases, which are values at the centre: b = b' − W c."""
    first = _like(net, at.astype(float)).layers[0]
    into = np.repeat(first.bias.astype(int), len(centre))
    return Shifts(into, first.weight.astype(int).ravel(), np.tile(-centre, len(first.bias)))


def _like(net: Any, numbers: Float[np.ndarray, " w"]) -> Any:
    """The network with these numbers in place of its trained ones, as NumPy arrays."""
    leaves, structure = jax.tree.flatten(eqx.filter(net, eqx.is_inexact_array))
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = [part.reshape(leaf.shape) for part, leaf in zip(np.split(numbers, ends), leaves, strict=True)]
    return jax.tree.unflatten(structure, parts)


def _inner(
    net: Any, centre: Float[np.ndarray, " inputs"], spread: Float[np.ndarray, " inputs"]
) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " w"]]:
    """(the units of a network's numbers; its numbers, with a first layer taken as one for inputs of order one)."""
    spread = np.where(spread > 0, spread, np.where(centre != 0, np.abs(centre), 1.0))
    numbers = _like(net, _flat(weights_of(net)).astype(float))
    units = jax.tree.map(np.ones_like, numbers)
    first = numbers.layers[0]
    units.layers[0].weight[...] = 1 / spread
    first.weight[...] = first.weight / spread
    if first.bias is not None:
        first.bias[...] = first.bias - first.weight @ centre
    return _flat(units), _flat(numbers)


def _outer(net: Any, effect: Any, misfit: float) -> Float[np.ndarray, " w"]:
    """The units of a network's last layer, and one for its other numbers. Outputs are as large as would change as much
    as there is to explain.

    - `effect`: the last layer, with the norm of what one of its numbers changes residuals by; `misfit`: the norm of
        residuals without the network.
    """
    squares = np.mean(effect.weight**2, axis=1)
    with np.errstate(divide="ignore"):
        out = np.where((squares > 0) & (misfit > 0), misfit / np.sqrt(squares), 1.0)
    units = _like(net, np.ones(len(_flat(weights_of(net)))))
    for a in jax.tree.leaves(units.layers[-1]):
        a[...] = (a.T * out).T
    return _flat(units)


def _of_last_layer(net: Any) -> np.ndarray:
    """True for the numbers of the last layer."""
    marks = _like(net, np.zeros(len(_flat(weights_of(net)))))
    for a in jax.tree.leaves(marks.layers[-1]):
        a[...] = 1.0
    return _flat(marks) > 0


def _flat(tree: Any) -> Float[np.ndarray, " w"]:
    return np.concatenate([np.ravel(a) for a in jax.tree.leaves(tree)])
