"""Left null vectors of matrices that are known at sample points.

A square block of the system Jacobian is singular wherever the model is if some w(p) ≠ 0 has wᵀJ(x, p) = 0 for all
states x. Given the block's entries as graphs and as numbers at several states, w is found from the matrices of all
states side by side; whether it depends on the parameters p, from their values at other parameters. What counts as zero
is decided by size relative to the terms that cancel, so no unit and no rounding of coefficients matters.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np

from ..expressions.node import ONE, ZERO, Node, Number, constant, divide, linear, multiply, scale
from ..judgement.rank import above_errors, rank_of

DEFICIENT = 1e-11  # singular values below, of a matrix with rows and columns scaled, are examined
CANCELLED = 1e-11  # of the terms: a sum this small is zero
NOTHING = (1e-8, 1e-13)  # weights below are left out, the larger ones if columns cancel without them
REFINEMENTS = 2
LARGEST_DENOMINATOR = 1000  # of a fraction that a computed weight is taken for
SIMPLE = 1_000_000  # numerator times denominator: beyond, fractions come as near to any number by chance


def cancels(weights: np.ndarray, matrix: np.ndarray) -> bool:
    """True if wᵀA = 0, to rounding of the terms of every column."""
    terms = weights[:, None] * matrix
    return bool((np.abs(terms.sum(axis=0)) <= CANCELLED * np.abs(terms).sum(axis=0)).all())


def left_null_vectors(matrix: np.ndarray, errors: np.ndarray) -> list[np.ndarray]:
    """Vectors w with wᵀA = 0, each with an entry 1 where the others have none; fewest entries first.

    `errors` are bounds of the errors of A's entries.
    """
    rank = rank_of(matrix, errors)
    null = rank.u[:, rank.s <= DEFICIENT * max(rank.s[0], 1e-300)].T
    found = _verified(null, rank.r, above_errors(matrix, rank.errors))
    return sorted(found, key=lambda w: (np.count_nonzero(w), *np.flatnonzero(w).tolist()))


def _verified(null: np.ndarray, rows: np.ndarray, matrix: np.ndarray) -> list[np.ndarray]:
    """Sparse combinations of the null vectors of diag(rows)·A, as those of A; without those with which columns of A
    do not cancel."""
    null = null.copy()
    chosen: list[int] = []
    for k in range(len(null)):  # Gauss–Jordan elimination with complete pivoting
        r, c = np.unravel_index(np.argmax(np.abs(null[k:])), null[k:].shape)
        null[[k, k + int(r)]] = null[[k + int(r), k]]
        null[k] /= null[k, c]
        others = np.arange(len(null)) != k
        null[others] -= np.outer(null[others, c], null[k])
        chosen.append(int(c))
    found = []
    for w, c in zip(null, chosen, strict=True):
        candidates = (np.where(np.abs(w) < least, 0.0, w) * rows / rows[c] for least in NOTHING)
        found.append(next((w for w in candidates if cancels(w, matrix)), None))
    return [_refined(w, matrix) for w in found if w is not None]


def _refined(w: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Refines w to working precision. Combined equations are combined again, and each time the error left in w is
    amplified."""
    used = np.flatnonzero(w)
    better = w.copy()
    for _ in range(REFINEMENTS):
        terms = better[used, None] * matrix[used]
        size = np.abs(terms).max(axis=0, initial=0.0)
        terms = terms[:, size > 0] / size[size > 0]
        left = terms.astype(np.longdouble).sum(axis=0).astype(float)
        others = better[used] != 1.0
        better[used[others]] *= 1 + np.linalg.lstsq(terms[others].T, -left, rcond=None)[0]
    return better if cancels(better, matrix) else w


def rational(value: float) -> Number:
    """The simple fraction that a number rounds, if there is one."""
    found = Fraction(value).limit_denominator(LARGEST_DENOMINATOR)
    is_simple = abs(found.numerator) * found.denominator <= SIMPLE
    return found if is_simple and abs(float(found) - value) <= 1e-11 * abs(value) else value


def weights_in_parameters(
    graphs: Sequence[Sequence[Node]],
    values: Callable[[Sequence[Node]], tuple[np.ndarray, np.ndarray]],
    unit: int,
) -> list[Node] | None:
    """w(p) with w[unit] = 1 and wᵀA(p) = 0, in graphs; None if there is none.

    **Arguments:**

    - `graphs`: the entries of A, by rows; their leaves are parameters.
    - `values`: of graphs, at sample parameters, and bounds of their errors: both of shape (graphs, samples).
    """
    m, n = len(graphs), len(graphs[0])
    numbers, errors = (found.reshape(m, n, -1) for found in values([g for row in graphs for g in row]))
    if not np.isfinite(numbers).all():
        return None
    samples = [left_null_vectors(numbers[:, :, k], errors[:, :, k]) for k in range(numbers.shape[2])]
    if any(len(found) != 1 or found[0][unit] == 0 for found in samples):
        return None
    weights = np.array([found[0] / found[0][unit] for found in samples])
    if (np.abs(weights - weights[0]) <= 1e-10 * np.abs(weights[0])).all():
        return [constant(rational(float(w))) for w in weights[0]]
    return _solved(graphs, numbers, values, unit)


def _solved(graphs, numbers: np.ndarray, values, unit: int) -> list[Node] | None:
    """By elimination: Σ_{i ≠ unit} wᵢ Aᵢⱼ = −A_unit,j, the pivots chosen by size at the first sample."""
    others = [k for k in range(len(graphs)) if k != unit]
    # Rows are the equations of this system, one for each column j of A; the last entry is the right-hand side.
    table = [[graphs[i][j] for i in others] + [scale(-1, graphs[unit][j])] for j in range(len(graphs[0]))]
    size = np.array([[np.abs(numbers[i, j]) for i in others] + [np.abs(numbers[unit, j])] for j in range(len(table))])
    order: list[tuple[int, int]] = []
    free_rows, free_columns = set(range(len(table))), set(range(len(others)))
    while free_columns:
        current = values([g for row in table for g in row])[0].reshape(len(table), len(others) + 1, -1)
        candidates = [
            (abs(current[r, c, 0]) / max(size[r, :, 0].max(), 1e-300), -r, -c)
            for r in free_rows
            for c in free_columns
            if (np.abs(current[r, c]) > CANCELLED * size[r, c]).all()
        ]
        if not candidates:
            return None
        _, r, c = max(candidates)
        r, c = -r, -c
        order.append((r, c))
        free_rows.discard(r)
        free_columns.discard(c)
        for k in range(len(table)):
            if k == r or table[k][c] is ZERO:
                continue
            factor = divide(table[k][c], table[r][c])
            ratio = np.abs(current[k, c] / current[r, c])
            size[k] = size[k] + ratio * size[r]
            row = [linear([(1, a), (-1, multiply(factor, b))]) for a, b in zip(table[k], table[r], strict=True)]
            updated, _ = values(row)
            small = (np.abs(updated) <= CANCELLED * size[k]).all(axis=1)
            table[k] = [ZERO if s or j == c else g for j, (g, s) in enumerate(zip(row, small, strict=True))]
    weights: list[Node] = [ZERO] * len(graphs)
    weights[unit] = ONE
    for r, c in order:
        weights[others[c]] = divide(table[r][-1], table[r][c])
    return weights
