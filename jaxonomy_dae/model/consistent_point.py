"""A consistent point in NumPy, for passes that need numbers before the model runs."""

from typing import Any

import numpy as np
import scipy.sparse as sp

from ..judgement.scaling import equilibrated
from ..linear.sparse_least_squares import SparseLeastSquares
from ..tolerances import ILL_CONDITIONED
from .declared import start_guess
from .extended import Extended
from .group import Point
from .jacobian import residual_and_jacobian
from .opaque import Networks
from .quantities import ReducedModel
from .tables import Declared

# Quantities up to which singular values are computed, in some 0.05 s at 300. Beyond, one sparse factorization solves to
# five digits, which steps that are repeated until the equations hold do not show.
FEW = 300


def initial_point(model: ReducedModel, declared: Declared) -> Point:
    """All quantities near the declared starts, consistent where possible."""
    guess, pins = start_guess(model, declared.values)
    networks = Networks(tuple(declared.networks.values()))
    at = Point.of(guess, declared.values, 0.0, networks)
    return consistent_point(model.extended, at, list(pins.items()))


@np.errstate(all="ignore")  # numbers that overflow end the search
def consistent_point(extended: Extended, guess: Point, fixed: list[tuple[int, float]], iterations: int = 60) -> Point:
    """A point near `guess` where the equations and the fixed starts hold: damped Gauss–Newton steps of least norm, in
    units in which all rows and columns of the Jacobian are alike.

    Inputs stay as in `guess`.
    """
    n = extended.quantities.n_unknown
    pins = np.array([q for q, _ in fixed], np.int64)
    targets = np.array([x for _, x in fixed])
    pin_rows = sp.coo_array(
        (np.ones(len(pins)), (np.arange(len(pins)), pins)), shape=(len(pins), extended.quantities.n)
    )
    values = guess.values[:-1].copy()

    def evaluate(values):
        r, jacobian = residual_and_jacobian(extended, guess.at(values))
        return np.concatenate([r, values[pins] - targets]), jacobian

    r, jacobian = evaluate(values)
    for _ in range(iterations):
        full: sp.csr_array = sp.vstack([jacobian, pin_rows]).tocsr()[:, :n]
        if not np.isfinite(full.data).all():
            break
        scaled, rows, columns = equilibrated(full)
        size = np.linalg.norm(rows * r)
        if not np.isfinite(size) or size <= 1e-15 * (1 + np.abs(values[:n] / columns).max(initial=0.0)):
            break
        try:
            step = columns * _least_norm(scaled, -rows * r)
        except np.linalg.LinAlgError:
            break
        scale, accepted = 1.0, False
        while scale > 1e-4:
            trial = values.copy()
            trial[:n] += scale * step
            r_trial, jacobian_trial = evaluate(trial)
            if np.isfinite(r_trial).all() and np.linalg.norm(rows * r_trial) < (1 - 1e-4 * scale) * size:
                accepted = True
                break
            scale *= 0.5
        if not accepted:
            break
        values, r, jacobian = trial, r_trial, jacobian_trial
    return guess.at(values)


def _least_norm(matrix: Any, right: np.ndarray) -> np.ndarray:
    if matrix.shape[1] <= FEW:
        return np.linalg.lstsq(matrix.toarray(), right, rcond=1 / ILL_CONDITIONED)[0]
    return SparseLeastSquares(matrix).solve(right)
