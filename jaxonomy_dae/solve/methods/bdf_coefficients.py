"""The coefficients of a variable-step BDF formula with fixed leading coefficient.

Brenan, Campbell & Petzold (1996), Numerical Solution of Initial-Value Problems in Differential-Algebraic Equations,
section 5.2. All arrays have one entry for each difference, orders 0 to 5; those above the order in use are masked.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Coefficients(NamedTuple):
    """The factors by which a step of size h and order k multiplies divided differences."""

    psi: Float[Array, " rows"]  # ψ_i(n+1): sums of the last i + 1 step sizes
    beta: Float[Array, " rows"]  # φ*_i = β_i φ_i
    sigma: Float[Array, " rows"]  # of the error estimates
    gamma: Float[Array, " rows"]  # y'_predicted = Σ γ_i φ*_i
    upto: Float[Array, " rows"]  # 1 for i ≤ k
    leading: Float[Array, ""]  # c_j: dy/dt = y'_predicted + c_j (y − y_predicted)
    test: Float[Array, ""]  # the error test is test·|y − y_predicted| ≤ 1


def coefficients(h: Float[Array, ""], psi: Float[Array, " rows"], order: Int[Array, ""]) -> Coefficients:
    """The coefficients for a step of size h after steps with the sums `psi`."""
    rows = psi.shape[0]
    index = jnp.arange(rows, dtype=order.dtype)
    inside = index <= order
    one = jnp.ones((1,), psi.dtype)
    new = jnp.concatenate([h[None], psi[:-1] + h])
    beta = jnp.concatenate([one, jnp.cumprod(new[:-1] / psi[:-1])])
    alpha = jnp.concatenate([one, h / new[1:]])
    sigma = jnp.cumprod(jnp.concatenate([one, jnp.asarray(np.arange(1, rows), psi.dtype) * alpha[1:]]))
    gamma = jnp.concatenate([jnp.zeros((1,), psi.dtype), jnp.cumsum(alpha[:-1]) / h])
    harmonic = jnp.asarray(np.concatenate([[0.0], np.cumsum(1 / np.arange(1, rows))]), psi.dtype)
    alpha_s = -harmonic[order]
    alpha_0 = -jnp.sum(jnp.where(index < order, alpha, 0))
    test = jnp.maximum(jnp.abs(alpha[order] + alpha_s - alpha_0), alpha[order])
    mask = inside.astype(psi.dtype)
    return Coefficients(new, jnp.where(inside, beta, 1), sigma, gamma * mask, mask, -alpha_s / h, test)


def interpolate(
    after: Float[Array, ""], psi: Float[Array, " rows"], order: Int[Array, ""] | Float[Array, ""]
) -> Float[Array, " rows"]:
    """The weights of the differences in the solution at t_n + `after`."""
    rows = psi.shape[0]
    shifted = jnp.concatenate([jnp.zeros((1,), psi.dtype), psi[: rows - 2]])
    factors = (after + shifted) / psi[: rows - 1]
    weight = jnp.concatenate([jnp.ones((1,), psi.dtype), jnp.cumprod(factors)])
    return jnp.where(jnp.arange(rows, dtype=order.dtype) <= order, weight, 0)
