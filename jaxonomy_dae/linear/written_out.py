"""Dense linear solves of the sizes that occur inside vector fields."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

UNROLLED = 6


def solve(matrix: Sequence[Sequence[Any]], right: Sequence[Any], *, positive: bool = False) -> list[Any]:
    """Solves A·x = b where the entries of A and b are scalars or arrays of one shape (a batch).

    The elimination is written out, with partial pivoting by selection: no call of LAPACK, no branch, and every entry
    may be batched. It pays up to about `UNROLLED` unknowns. A symmetric positive definite matrix (`positive`) needs no
    pivoting.
    """
    n = len(right)
    a = [list(row) for row in matrix]
    b = list(right)
    for k in range(n):
        for r in range(k + 1, n if not positive else 0):
            # Bubble the largest pivot up to row k.
            swap = jnp.abs(a[r][k]) > jnp.abs(a[k][k])
            for c in range(k, n):
                a[k][c], a[r][c] = jnp.where(swap, a[r][c], a[k][c]), jnp.where(swap, a[k][c], a[r][c])
            b[k], b[r] = jnp.where(swap, b[r], b[k]), jnp.where(swap, b[k], b[r])
        for r in range(k + 1, n):
            factor = a[r][k] / a[k][k]
            for c in range(k + 1, n):
                a[r][c] = a[r][c] - factor * a[k][c]
            b[r] = b[r] - factor * b[k]
    x: list[Any] = [None] * n
    for k in reversed(range(n)):
        total = b[k]
        for c in range(k + 1, n):
            total = total - a[k][c] * x[c]
        x[k] = total / a[k][k]
    return x
