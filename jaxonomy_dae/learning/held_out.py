"""Whether experiments that were held out are met: by noise, and by what intervals leave open.

With u the residuals of a held-out experiment in units of the noise, and A Aᵀ the covariance of its predictions by that
of all estimates, a right model leaves |u|² = Σ (1 + s²)·χ²₁, with the singular values s of A. A scaled χ² of the same
mean and variance stands for this sum (Satterthwaite 1946, Biometrics Bulletin 2:110). Weighted by the inverse of the
covariance instead, small errors of A in its longest direction, where predictions are not linear in what was estimated,
doubt right models: 90 of 240 that were fitted to a tenth of a swing and held against ten of them. Starts that are
fitted to the experiment alone take their directions out of u, A and the degrees of freedom. Where the noise level was
estimated, Fisher's F takes the place of χ².
"""

import numpy as np
import scipy.stats
from jaxtyping import Float
from scipy.special import chdtrc

from ..host.threads import one_thread
from .colour import Colour
from .noise import Tails
from .objective import Objective

FAR = 3e-3  # the probability of a right model, so that it adds little to what else doubts one


def missed(
    objective: Objective, point: Float[np.ndarray, " p"], root: Float[np.ndarray, "p r"], sigma: dict[str, float],
    freedom: float,
) -> dict[str, tuple[float, float]]:  # fmt: skip
    """Held-out experiments that a right model would hardly miss by so much.

    **Arguments:**

    - `point`, `root`: all coordinates, and A of their covariance A Aᵀ.
    - `sigma`: noise levels that were estimated, with `freedom` degrees of freedom.

    **Returns:**

    By label, the root mean squares of residuals in units of the noise: found, and expected.
    """
    s, c = objective.stacked, objective.coordinates
    held = np.flatnonzero(s.holdout & (s.weight > 0) & s.observed.any(axis=(1, 2)))
    if not len(held):
        return {}
    predicted, found = objective.predicted(point), {}
    for k in held.tolist():
        only = np.arange(len(s.labels)) == k
        rows = np.nonzero(s.observed & only[:, None, None])
        u, level = objective.standardized(point, sigma, rows)
        by_all = c.pulled(point, predicted.jacobian(rows))
        if objective.rho.any():
            by_all = Colour.of(s, rows, objective.rho).whitened(by_all)
        by_all = by_all / level[:, None]
        if not (np.isfinite(u).all() and np.isfinite(by_all).all()):
            found[s.labels[k]] = np.inf, 1.0
            continue
        own = by_all[:, ~c.fixed & objective.owned(only)]
        taken = np.linalg.qr(own)[0] if own.shape[1] else own
        free = len(u) - own.shape[1]
        if free < 1:
            continue
        with one_thread(len(u) * root.shape[1] ** 2):
            spread = np.linalg.svd(left_by(taken, by_all @ root), compute_uv=False) ** 2
        u = left_by(taken, Tails(*s.tails[rows[2]].T).scores(u))
        mean, variance = free + np.sum(spread), 2 * (free + np.sum(2 * spread + spread**2))
        ratio, count = np.sum(u**2) / mean, 2 * mean**2 / variance
        is_estimated = bool(sigma) and not objective.has_variances
        beyond = scipy.stats.f.sf(ratio, count, max(freedom, 1.0)) if is_estimated else chdtrc(count, count * ratio)
        if beyond < FAR / len(held):
            found[s.labels[k]] = float(np.sqrt(np.sum(u**2) / free)), float(np.sqrt(mean / free))
    return found


def left_by(taken: Float[np.ndarray, "n k"], a: np.ndarray) -> np.ndarray:
    """The part of columns, shape (n,) or (n, r), that is orthogonal to others of length one."""
    return a - taken @ (taken.T @ a)
