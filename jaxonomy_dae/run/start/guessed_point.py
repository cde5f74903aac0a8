"""The point that the equations and the declared guesses have in common, as far as they have one.

Equations may have several solutions where guesses leave nothing open, as a linkage can be assembled in several ways.
There guesses choose. So the search for a solution begins at a least-squares point of the equations, of the starts that
must hold and of all declared guesses, which count alike: a point that satisfies all of them is a solution, and the
search ends there. Unknowns that nobody declared weigh nothing.

First the starts alone, which most often are unknowns themselves, then all rows, by Levenberg's and Marquardt's method
with the damping of Nielsen (1999).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...base.tolerances import NOISE, ridge, spacing
from ...solve.linear.arrays import Numbers, loop, namespace, triangular, where
from .search import Look

ROUNDS = 3  # of steps onto the starts alone: these are linear in the unknowns, or nearly so
LIMIT = 100  # looks at the rows
FIRST_DAMPING = 1e-6  # of the largest slope squared: the starts have been met
SETTLED = 1e-8  # a step of this part of the point ends the search: what remains is the ladder's


class _Walk(NamedTuple):
    """Where the search stands: the point and the rows there, the damping and its growth, the trial point, how often
    rows were looked at, and whether it has settled."""

    at: Numbers
    value: Numbers
    jacobian: Numbers
    damping: Numbers
    growth: Numbers
    count: Numbers
    settled: Numbers


def guessed_point(
    look: Callable[[Numbers], Look],
    start: Float[Numbers, " n"],
    typical: Float[Numbers, " n"],
    starts: Bool[np.ndarray, " m"],
    counts: Bool[np.ndarray, " m"],
    limits: Float[np.ndarray, "n 2"],
) -> Numbers:
    """Returns a point from which the search for a solution begins, shape (n,): `start` itself where no better one is
    found, as where rows are not finite.

    **Arguments:**

    - `look`: the rows at a point; `start`: where the search begins.
    - `typical`: sizes of the unknowns, those of the model: a guess may be zero up to rounding.
    - `starts`: rows that are starts; `counts`: rows that count, all but guesses that nobody declared.
    - `limits`: of the unknowns; a step that would leave them ends on them.
    """
    xp, dtype = namespace(start), start.dtype
    at, unit = look(start), typical

    def weights(jacobian: Numbers, chosen: np.ndarray) -> Numbers:
        largest = xp.max(xp.abs(jacobian), axis=1, initial=0.0)
        usable = xp.asarray(chosen) & (largest > 0) & xp.isfinite(largest)
        return xp.where(usable, 1 / xp.where(usable, largest, 1), 0)

    def inside(x: Numbers) -> Numbers:
        return xp.clip(x, xp.asarray(limits[:, 0], dtype), xp.asarray(limits[:, 1], dtype))

    x = start
    for _ in range(ROUNDS):
        scaled = at.jacobian * unit
        weight = weights(scaled, starts & counts)
        x = inside(x - unit * _least_squares(xp, weight[:, None] * scaled, weight * at.value))
        at = look(x)
    # Rows are weighed where starts have been met. At the start of the search, slopes of a linkage that is not assembled
    # yet may be far from those at a solution.
    weight = weights(at.jacobian * unit, counts)

    def rows(x: Numbers) -> tuple[Numbers, Numbers]:
        here = look(x)
        return weight * here.value, weight[:, None] * here.jacobian * unit

    def going(walk: _Walk) -> Numbers:
        return (walk.count < LIMIT) & ~walk.settled

    def advanced(walk: _Walk) -> _Walk:
        root = xp.sqrt(walk.damping) * xp.eye(len(start), dtype=dtype)
        right = xp.append(walk.value, xp.zeros((len(start),), dtype))
        step = -_least_squares(xp, xp.concatenate([walk.jacobian, root]), right)
        trial = inside(walk.at + unit * step)
        value, jacobian = rows(trial)
        before, after = xp.sum(walk.value**2), xp.sum(value**2)
        expected = before - xp.sum((walk.value + walk.jacobian @ step) ** 2)
        ratio = (before - after) / xp.where(expected > 0, expected, 1)
        better = (ratio > 0) & xp.all(xp.isfinite(jacobian))
        small = xp.max(xp.abs(step)) <= SETTLED * xp.max(xp.maximum(xp.abs(walk.at / unit), 1))
        less = walk.damping * xp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
        return _Walk(
            at=where(better, trial, walk.at),
            value=where(better, value, walk.value),
            jacobian=where(better, jacobian, walk.jacobian),
            damping=where(better, less, walk.damping * walk.growth),
            growth=where(better, xp.asarray(2.0, dtype), 2 * walk.growth),
            count=walk.count + 1,
            settled=small | ~xp.isfinite(before),
        )

    value, jacobian = rows(x)
    damping, growth = (xp.asarray(v, dtype) for v in (FIRST_DAMPING, 2.0))
    begun = _Walk(x, value, jacobian, damping, growth, xp.asarray(0, np.int32), xp.asarray(False))
    found = loop(going, advanced, begun)
    # What only rounding has moved stays, as speeds of what rests: beside zeros rounding is all there is.
    stays = xp.abs(found.at - start) <= NOISE * spacing(dtype) * unit
    found = found._replace(at=xp.where(stays, start, found.at))
    good = xp.all(xp.isfinite(found.at)) & xp.all(xp.isfinite(found.value)) & xp.all(xp.isfinite(found.jacobian))
    return where(good, found.at, start)


def _least_squares(xp, matrix: Numbers, right: Numbers) -> Numbers:
    """A least-squares solution, next to the shortest one; zeros where the matrix is not finite. By QR: what is written
    in C has no decomposition by singular values."""
    finite = xp.all(xp.isfinite(matrix)) & xp.all(xp.isfinite(right))
    matrix, right = xp.where(finite, matrix, 0), xp.where(finite, right, 0)
    m, n = matrix.shape
    q, r = xp.linalg.qr(xp.concatenate([matrix, ridge(matrix.dtype) * xp.eye(n, dtype=matrix.dtype)]))
    return triangular(r, (q[:m].T @ right)[:, None])[:, 0]
