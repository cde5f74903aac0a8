"""Sizes of quantities of which nothing is declared, by what their equations say."""

import numpy as np
from jaxtyping import Float

from ..tolerances import KNOWN
from .declared import declared_scale
from .extended import Extended
from .jacobian import generic
from .natural_sizes import are_told, natural_sizes
from .reduced import ReducedModel

MOVED = 1e-6  # of parameters: a difference from which a slope is told to six digits
DECADES = 30  # that they may span: single precision has 38


def typical_sizes(
    model: ReducedModel, parameters: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, " quantities"]:
    """The typical sizes of all quantities, at the parameter values the model was compiled with; powers of two, by which
    numbers are multiplied without rounding."""
    return _rounded(_unrounded(model, parameters))


def _rounded(sizes: Float[np.ndarray, " quantities"]) -> Float[np.ndarray, " quantities"]:
    return 2.0 ** np.round(np.log2(sizes))


def unrounded_sizes(
    model: ReducedModel, parameters: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, " quantities"]:
    """As `typical_sizes` before rounding to powers of two. State selection compares sizes, and rounding could turn a
    small difference into a factor of two."""
    return _unrounded(model, parameters)


def _unrounded(model: ReducedModel, parameters: np.ndarray) -> np.ndarray:
    return _balanced(model.extended, parameters, _declared_or_started(model, parameters))


def error_sizes(model: ReducedModel, parameters: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " quantities"]:
    """The sizes to whose rounding quantities are known, where they are near zero, at these values of the parameters:
    the typical ones, except that a start which is rounding itself, as L·sin(π) is, says nothing. Zero where nothing is
    known."""
    extended, declared = model.extended, declared_scale(model)
    started = _declared_or_started(model, parameters)
    typical = _balanced(extended, parameters, started)
    if (np.abs(started) > KNOWN * typical.max(initial=0.0))[started != 0.0].all():
        return _rounded(typical)
    without = _balanced(extended, parameters, declared)
    is_rounding = (np.abs(started) <= KNOWN * without) & (started != 0.0)
    is_rounding &= are_told(extended.groups, extended.quantities.n, parameters)
    if not is_rounding.any():
        return _rounded(typical)
    return _balanced(extended, parameters, np.where(is_rounding, declared, started))


def _declared_or_started(model: ReducedModel, parameters: np.ndarray) -> np.ndarray:
    """Nominal values, and else first starts; zero where there is none."""
    size, starts = declared_scale(model), model.flat.variables.start
    values = starts.values(parameters)
    # A start that is computed may be rounding alone, as L·sin(π) is; a number that is given is what it is.
    moved = starts.values(parameters * (1 + MOVED * generic(np.random.default_rng(1), parameters.shape)))
    values = np.where(np.abs(values) <= KNOWN * np.abs(moved - values) / MOVED, 0.0, values)
    for v in np.flatnonzero(starts.is_given).tolist():
        quantity, factor = model.variables[v]
        if quantity >= 0 and size[quantity] == 0.0:
            value = values[v] / factor
            size[quantity] = value if np.isfinite(value) else 0.0
    return size


def _balanced(extended: Extended, parameters: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Sizes that make terms alike, where `size` is zero."""
    start = np.where(size == 0.0, 1.0, size)
    q = extended.quantities
    lower = np.flatnonzero((q.owner[:-1] == q.owner[1:]) & (q.order[1:] == q.order[:-1] + 1))
    found, _ = natural_sizes(
        extended.groups, extended.n_equations, start, parameters, rates=(lower, lower + 1) if len(lower) else None
    )
    return 10.0 ** np.clip(np.log10(np.abs(found)), -DECADES, DECADES)
