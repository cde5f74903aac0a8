"""How a search begins and goes on where nothing is said: from coarse to fine, as the residuals ask for.

A network that was drawn at random says something at random, and runs with it may lead anywhere. One whose last layer is
zero says nothing: runs are those of the model without it, the first steps are linear least squares on what its inner
layers make of its inputs, and the misfit cannot be worse than having no network. Which of the two a search begins from
is for the residuals to say, so that weights that mean something stay.

Over a short time, a run depends on its numbers almost linearly. Where a run over the whole time is far from the data,
horizons grow.
"""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .evaluation import Evaluation
from .objective import Objective

GROWING = (0.1, 0.25, 0.5, 1.0)  # shares of the time, each two to two and a half times the one before
FAR = 10.0  # root mean square residual, in units of the noise, beyond which a network is fitted from coarse to fine
# The same in units of an output's standard deviation, where its noise is not known.
SPREAD = 0.1


def silent(objective: Objective, point: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """The point with the last layers of all trained networks at zero; the same point where none has one."""
    c, out = objective.coordinates, objective.full(point)
    for name in objective.layout.modules:
        network = objective.system.neural.get(name)
        marks = None if network is None else _last_layer(network)
        if marks is not None:
            places = np.flatnonzero(np.array([g == name for g in c.group]) & c.is_weight)
            out[places[marks]] = 0.0
    return out[objective.free]


def _last_layer(network: Any) -> np.ndarray | None:
    """True for those of its trained numbers that are the last linear layer's; None if it has none."""

    def is_linear(node: object) -> bool:
        return isinstance(node, eqx.nn.Linear)

    nodes, structure = jax.tree.flatten(network, is_leaf=is_linear)
    linear = [k for k, node in enumerate(nodes) if is_linear(node)]
    if not linear:
        return None
    marks = []
    for k, node in enumerate(nodes):
        leaves = jax.tree.leaves(eqx.filter(node, eqx.is_inexact_array))
        marks.extend(np.full(leaf.size, k == linear[-1]) for leaf in leaves)
    return np.concatenate(marks)


def misfit(objective: Objective, point: Float[np.ndarray, " f"]) -> tuple[float, bool]:
    """(−ln likelihood at a point, less a constant; whether it is far from the data)."""
    residual = objective.residual(point)
    if residual is None:
        return np.inf, True
    weights = objective.weights(point, Evaluation(residual, np.zeros((len(residual), len(point)))))
    bare = weights.cost(point, residual) - weights.prior_cost(point)
    s, (experiment, index, output) = objective.stacked, objective.rows
    known = objective.evidence.noise < 0
    far = [np.abs(residual * weights.scale)[known] / FAR]
    for j in np.unique(output[~known]):
        chosen = ~known & (output == j)
        values = s.values[experiment, index, output][chosen]
        far.append(np.abs(residual[chosen]) / (SPREAD * values.std() or np.inf))
    return bare - weights.log_rows, bool(np.mean(np.concatenate(far) ** 2) > 1)


def beginning(
    objective: Objective, point: Float[np.ndarray, " f"], fresh: Float[np.ndarray, " f"]
) -> tuple[Float[np.ndarray, " f"], tuple[float, ...]]:
    """(where a search for networks begins, and the shares of time over which it goes). It is the `point`, or `fresh`
    without the last layers of networks."""
    quiet = silent(objective, fresh)
    if np.array_equal(quiet, point):
        return point, (1.0,)
    (own, far), (none, far_without) = misfit(objective, point), misfit(objective, quiet)
    chosen, is_far = (quiet, far_without) if not own < none else (point, far)
    return chosen, GROWING if is_far else (1.0,)
