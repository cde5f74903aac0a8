"""Matrices that dissipate, from numbers that may be anything.

An n × n matrix W of any numbers is read as

    R = L D Lᵀ,   L = I + (what stands below W's diagonal),   D = diag(softplus(W's diagonal)) ≥ 0,
    J = U − Uᵀ,   U = what stands above W's diagonal.

For all vectors e, eᵀ R e = Σ D (Lᵀe)² ≥ 0 and eᵀ J e = 0. All positive definite R and all skew J are reached, each by
one W (the LDLᵀ factorization is unique).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def dissipation(w: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """R, symmetric and positive semidefinite."""
    lower = _unit_lower(w)
    product = (lower * _diagonal(w)) @ lower.T
    return (product + product.T) / 2  # also symmetric in the last place


def interconnection(w: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """J, skew-symmetric."""
    upper = jnp.triu(w, 1)
    return upper - upper.T


def response(w: Float[Array, "n n"], e: Float[Array, " n"]) -> Float[Array, " n"]:
    """(J − R) e. In order: R is applied by its factors, so that eᵀ R e is a sum of squares in rounded numbers too."""
    lower = _unit_lower(w)
    return interconnection(w) @ e - lower @ (_diagonal(w) * (lower.T @ e))


def _unit_lower(w: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return jnp.tril(w, -1) + jnp.eye(w.shape[0], dtype=w.dtype)


def _diagonal(w: Float[Array, "n n"]) -> Float[Array, " n"]:
    return jax.nn.softplus(jnp.diagonal(w))
