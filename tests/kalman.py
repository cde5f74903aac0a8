"""A Kalman filter for linear models, in NumPy and SciPy alone: exact discretization by matrix exponentials, all outputs
of a time at once."""

import numpy as np
import scipy.linalg


def discretized(a, g, h):
    """(Φ, Q) over a time h, by Van Loan's exponential (1978, IEEE Trans. Autom. Control 23:395)."""
    n = len(a)
    big = scipy.linalg.expm(np.block([[-a, g], [np.zeros((n, n)), a.T]]) * h)
    phi = big[n:, n:].T
    return phi, phi @ big[:n, n:]


def held(a, b, h):
    """∫ exp(A s) b ds over a time h."""
    n = len(a)
    big = scipy.linalg.expm(np.block([[a, b[:, None]], [np.zeros((1, n + 1))]]) * h)
    return big[:n, n]


def negative_log_likelihood(a, b, g, c, d, sigma, x, p, times, u, y, t0=0.0):
    """½ Σ (eᵀS⁻¹e + ln det S) of x' = A x + b(u) + noise of intensity G, y = C x + d(u) + e.

    `b` and `d` are functions of the input held from a time on; `u` are its values from t0 and each time on; NaN in `y`
    is a missing sample.
    """
    cost, now = 0.0, t0
    for k, t in enumerate(times):
        if t > now:
            phi, q = discretized(a, g, t - now)
            x = phi @ x + held(a, b(u[k]), t - now)
            p = phi @ p @ phi.T + q
        now = t
        seen = np.isfinite(y[k])
        if not seen.any():
            continue
        h = c[seen]
        e = y[k, seen] - h @ x - d(u[k + 1])[seen]
        s = h @ p @ h.T + np.diag(sigma[seen] ** 2)
        cost += 0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(s)[1])
        gain = p @ h.T @ np.linalg.inv(s)
        x = x + gain @ e
        p = p - gain @ s @ gain.T
    return float(cost)
