"""A consistent point in NumPy, for passes that need numbers before the model runs."""

from typing import Any

import numpy as np
import scipy.sparse as sp

from .evaluate_numpy import Networks, residual_and_jacobian
from .extended import Extended


@np.errstate(all="ignore")  # numbers that overflow end the search
def consistent_point(
    extended: Extended,
    guess: np.ndarray,
    fixed: list[tuple[int, float]],
    parameters: np.ndarray,
    t: float,
    networks: Networks,
    iterations: int = 60,
) -> tuple[np.ndarray, float]:
    """A point near `guess` where the equations and the fixed starts hold: damped Gauss–Newton steps of least norm.

    Returns the values of all quantities and the largest residual left; inputs stay as in `guess`.
    """
    n = extended.quantities.n_unknown
    pins = np.array([q for q, _ in fixed], np.int64)
    targets = np.array([x for _, x in fixed])
    pin_rows = sp.coo_array(
        (np.ones(len(pins)), (np.arange(len(pins)), pins)), shape=(len(pins), extended.quantities.n)
    )
    values = guess.copy()

    def evaluate(values):
        r, jacobian = residual_and_jacobian(extended, values, parameters, t, networks)
        return np.concatenate([r, values[pins] - targets]), jacobian

    r, jacobian = evaluate(values)
    for _ in range(iterations):
        size = np.linalg.norm(r)
        if not np.isfinite(size) or size <= 1e-13 * (1 + np.abs(values).max(initial=0.0)):
            break
        full = sp.vstack([jacobian, pin_rows]).tocsr()[:, :n]
        if not np.isfinite(full.data).all():
            break
        try:
            step = _least_norm(full, -r)
        except np.linalg.LinAlgError:
            break
        scale, accepted = 1.0, False
        while scale > 1e-4:
            trial = values.copy()
            trial[:n] += scale * step
            r_trial, jacobian_trial = evaluate(trial)
            if np.isfinite(r_trial).all() and np.linalg.norm(r_trial) < (1 - 1e-4 * scale) * size:
                accepted = True
                break
            scale *= 0.5
        if not accepted:
            break
        values, r, jacobian = trial, r_trial, jacobian_trial
    return values, float(np.abs(r).max(initial=0.0))


def _least_norm(matrix: Any, right: np.ndarray) -> np.ndarray:
    if matrix.shape[1] <= 1500:
        return np.linalg.lstsq(matrix.toarray(), right, rcond=1e-12)[0]
    return sp.linalg.lsmr(matrix, right, atol=1e-12, btol=1e-12, maxiter=10 * matrix.shape[1])[0]
