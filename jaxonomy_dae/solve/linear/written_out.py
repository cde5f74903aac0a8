"""Dense linear solves of the sizes that occur inside vector fields."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

# Unknowns up to which an elimination is written out rather than left to LAPACK. With four, a solve takes 1.0 µs and
# LAPACK's 0.9, in batches 0.06 and 0.23; it compiles in 0.22 s for 0.09. With six it is 2.7 and 1.1 µs, and 0.7 s for
# 0.1: half of the 72 s that an inverter with four ideal switches took.
UNROLLED = 4
# The same without pivoting: with six 1.0 and 0.9 µs, in batches 0.07 and 0.33; 0.22 s for 0.09.
UNROLLED_POSITIVE = 6
# By how much a pivot must be larger than the one above it. XLA computes a comparison anew in every fused loop that
# reads it, with other roundings: were equal pivots compared as they are, some loops would exchange rows, others not.
LARGER = 1.0873


def solve(matrix: Sequence[Sequence[Any]], right: Sequence[Any], *, positive: bool = False) -> list[Any]:
    """Solves A·x = b where the entries of A and b are scalars or arrays of one shape (a batch).

    The elimination is written out, with scaled partial pivoting by selection: no call of LAPACK, no branch, and every
    entry may be batched. It pays up to `UNROLLED` unknowns. A symmetric positive definite matrix (`positive`) needs no
    pivoting, so that it pays up to `UNROLLED_POSITIVE`.
    """
    return [row[0] for row in solve_many(matrix, [[b] for b in right], positive=positive)]


def inverse(matrix: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """A⁻¹, by elimination written out, as in `solve`."""
    n = len(matrix)
    one = jnp.ones_like(matrix[0][0])
    return solve_many(matrix, [[one if r == c else 0.0 * one for c in range(n)] for r in range(n)])


def solve_many(
    matrix: Sequence[Sequence[Any]], right: Sequence[Sequence[Any]], *, positive: bool = False
) -> list[list[Any]]:
    """Solves A·X = B."""
    n = len(right)
    a = [list(row) for row in matrix]
    b = [list(row) for row in right]
    # Pivots are compared in units of their rows' largest entries: the scale of an equation must not decide.
    unit = [] if positive or n == 1 else [1 / _largest(row) for row in a]
    for k in range(n):
        for r in range(k + 1, n if not positive else 0):
            # Bubble the largest pivot up to row k.
            swap = jnp.abs(a[r][k]) * unit[r] > LARGER * jnp.abs(a[k][k]) * unit[k]
            for c in range(k, n):
                a[k][c], a[r][c] = jnp.where(swap, a[r][c], a[k][c]), jnp.where(swap, a[k][c], a[r][c])
            for c in range(len(b[k])):
                b[k][c], b[r][c] = jnp.where(swap, b[r][c], b[k][c]), jnp.where(swap, b[k][c], b[r][c])
            if r < n - 1 or k < n - 2:
                unit[k], unit[r] = jnp.where(swap, unit[r], unit[k]), jnp.where(swap, unit[k], unit[r])
        for r in range(k + 1, n):
            factor = a[r][k] / a[k][k]
            for c in range(k + 1, n):
                a[r][c] = a[r][c] - factor * a[k][c]
            for c in range(len(b[k])):
                b[r][c] = b[r][c] - factor * b[k][c]
    x: list[list[Any]] = [[] for _ in range(n)]
    for k in reversed(range(n)):
        total = list(b[k])
        for c in range(k + 1, n):
            total = [t - a[k][c] * v for t, v in zip(total, x[c], strict=True)]
        x[k] = [t / a[k][k] for t in total]
    return x


def _largest(row: Sequence[Any]) -> Any:
    sizes = [jnp.abs(jax.lax.stop_gradient(entry)) for entry in row]
    return functools.reduce(jnp.maximum, sizes)
