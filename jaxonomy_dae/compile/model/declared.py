"""What is declared of quantities: nominal values, bounds and starts of the variables that equal them."""

import numpy as np
from jaxtyping import Int

from .quantities import ReducedModel


def declared_scale(model: ReducedModel) -> np.ndarray:
    """The nominal value of every quantity: the largest that a variable which equals it declares, else 0."""
    flat, variables = model.flat, model.variables
    scale = np.zeros(model.extended.quantities.n)
    v = np.flatnonzero(variables.quantity >= 0)
    np.maximum.at(scale, variables.quantity[v], flat.variables.nominal[v] / np.abs(variables.factor[v]))
    return scale


def quantity_scale(model: ReducedModel) -> np.ndarray:
    """The nominal value of every quantity, 1 where none is declared."""
    scale = declared_scale(model)
    return np.where(scale == 0, 1.0, scale)


def quantity_bounds(model: ReducedModel) -> np.ndarray:
    """The bounds of every quantity, shape (quantities, 2): those of all variables that equal it."""
    flat, variables, n = model.flat, model.variables, model.extended.quantities.n
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    v = np.flatnonzero(variables.quantity >= 0)
    (a, b), q = (flat.variables.bounds[v] / variables.factor[v, None]).T, variables.quantity[v]
    # A negative factor exchanges the bounds.
    np.maximum.at(low, q, np.minimum(a, b))
    np.minimum.at(high, q, np.maximum(a, b))
    return np.stack([low, high], axis=-1)


def leading_starts(model: ReducedModel, parameters: np.ndarray) -> Int[np.ndarray, " variables"]:
    """The variables whose starts count, one for each quantity that has any.

    A fixed start goes before a guess. Of guesses it is the one that is larger at these values of the parameters, and
    the positive one of two that differ in sign: zero is what is written where nothing is known, and a rule by place or
    by name would let these decide which branch a model starts on.
    """
    flat, variables = model.flat, model.variables
    v = np.flatnonzero(flat.variables.start.is_given & (variables.quantity >= 0))
    value = flat.variables.start.values(parameters)[v] / variables.factor[v]
    # The last entry of a quantity wins below, so the keys ascend.
    order = np.lexsort((-v, value, np.abs(value), flat.variables.fixed[v]))
    last = np.full(int(variables.quantity.max(initial=-1)) + 1, -1)
    last[variables.quantity[v[order]]] = v[order]
    return last[last >= 0]


def start_guess(
    model: ReducedModel, parameters: np.ndarray, leading: np.ndarray | None = None
) -> tuple[np.ndarray, dict[int, float]]:
    """The declared starts of all quantities (zero where there is none), and those that are fixed, at these values of
    the parameters; of the variables in `leading`, if it is given."""
    flat, variables = model.flat, model.variables
    guess = np.zeros(model.extended.quantities.n)
    chosen = leading_starts(model, parameters) if leading is None else leading
    q, fixed = variables.quantity[chosen], flat.variables.fixed[chosen]
    value = flat.variables.start.values(parameters)[chosen] / variables.factor[chosen]
    guess[q] = value
    return guess, dict(zip(q[fixed].tolist(), value[fixed].tolist(), strict=True))
