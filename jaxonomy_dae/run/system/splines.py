"""The cubic spline through samples, with continuous second derivatives, as Diffrax evaluates cubic curves."""

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float


def natural_spline(ts: Float[Array, " n"], ys: Float[Array, " n *shape"]) -> diffrax.CubicInterpolation:
    """The natural spline of n ≥ 2 samples: cubic between them, C², without curvature at both ends (de Boor 1978, A
    Practical Guide to Splines, IV). Its second derivatives follow from a tridiagonal system, so that every sample
    moves the whole curve, the less the further away; derivatives by samples are exact."""
    h = jnp.diff(ts).reshape(-1, *[1] * (ys.ndim - 1))
    slope = jnp.diff(ys, axis=0) / h
    bend = jnp.zeros_like(ys)
    if len(ts) > 2:
        width = jnp.diff(ts)
        matrix = lx.TridiagonalLinearOperator(2 * (width[:-1] + width[1:]), width[1:-1], width[1:-1])
        right = (6 * jnp.diff(slope, axis=0)).reshape(len(ts) - 2, -1)
        inner = jax.vmap(lambda b: lx.linear_solve(matrix, b, lx.Tridiagonal()).value, 1, 1)(right)
        bend = bend.at[1:-1].set(inner.reshape(len(ts) - 2, *ys.shape[1:]))
    # By second derivatives y'': y + b·s + y''/2·s² + Δy''/(6h)·s³ from each sample on, with b such that the next sample
    # is met.
    b = slope - h * (2 * bend[:-1] + bend[1:]) / 6
    return diffrax.CubicInterpolation(ts, ((bend[1:] - bend[:-1]) / (6 * h), bend[:-1] / 2, b, ys[:-1]))
