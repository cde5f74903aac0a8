"""A consistent point in NumPy, for passes that need numbers before the model runs."""

from typing import Any

import numpy as np
import scipy.sparse as sp

from ...base.tolerances import ILL_CONDITIONED
from ...graph.judgement.rank import DECOMPOSED_UPTO
from ...graph.judgement.scaling import equilibrated
from ...solve.linear.newton import Tried, newton
from ...solve.linear.sparse_least_squares import SparseLeastSquares
from .declared import start_guess
from .extended import Extended
from .group import Point
from .jacobian import residual_and_jacobian
from .opaque import Networks
from .quantities import ReducedModel
from .tables import Declared

MOST = 240  # looks at a point, shortened steps included; Newton's method takes ten

_Seen = tuple[
    np.ndarray, np.floating
]  # units of the rows at the last accepted point, and the norm of the residuals there


def initial_point(model: ReducedModel, declared: Declared) -> Point:
    """All quantities near the declared starts, consistent where possible."""
    guess, pins = start_guess(model, declared.values)
    networks = Networks(tuple(declared.networks.values()))
    at = Point.of(guess, declared.values, 0.0, networks)
    return consistent_point(model.extended, at, list(pins.items()))


@np.errstate(all="ignore")  # numbers that overflow end the search
def consistent_point(extended: Extended, guess: Point, fixed: list[tuple[int, float]]) -> Point:
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

    def look(x: np.ndarray, part: np.ndarray, last: _Seen) -> Tried[np.ndarray, _Seen]:
        rows, least = last
        at = guess.at(np.concatenate([x, values[n:]]))
        r, jacobian = residual_and_jacobian(extended, at)
        r = np.concatenate([r, at.values[pins] - targets])
        full: sp.csr_array = sp.vstack([jacobian, pin_rows]).tocsr()[:, :n]
        # Residuals are compared in the units of the last accepted point: units of the trial point would change what is
        # measured along the way. The decrease that is asked for is that of Armijo (1966).
        falls = np.isfinite(r).all() & (np.linalg.norm(rows * r) < (1 - 1e-4 * part) * least)
        worse, nowhere = ~falls & (least < np.inf), np.full(n, np.nan)
        if worse or not np.isfinite(full.data).all():
            return Tried(falls, np.False_, nowhere, (rows, least))
        # The step of least norm depends on units. In equilibrated ones, no variable moves more than another for its
        # unit alone.
        scaled, rows, columns = equilibrated(full)
        size = np.linalg.norm(rows * r)
        holds = size <= 1e-15 * (1 + np.abs(x / columns).max(initial=0.0))
        try:
            step = columns * _least_norm(scaled, -rows * r)
        except np.linalg.LinAlgError:
            step = nowhere
        return Tried(falls, holds, step, (rows, size))

    found = newton(look, values[:n], (np.ones(()), np.float64(np.inf)), MOST, 1e-4)
    return guess.at(np.concatenate([found.x, values[n:]]))


def _least_norm(matrix: Any, right: np.ndarray) -> np.ndarray:
    # Beyond, one sparse factorization solves to five digits, which steps that are repeated until the equations hold do
    # not show.
    if matrix.shape[1] <= DECOMPOSED_UPTO:
        return np.linalg.lstsq(matrix.toarray(), right, rcond=1 / ILL_CONDITIONED)[0]
    return SparseLeastSquares(matrix).solve(right)
