"""Elimination of nodes against one dense factorization by SciPy of the same rows, on random blocks."""

import numpy as np
import pytest
import scipy.linalg

from jaxonomy_dae.learning.block_elimination import Blocks, condensed, eliminate, linear


def random_blocks(rng, e, segments, m, g, d, q):
    draw = rng.standard_normal
    return Blocks(
        draw((e, segments, m)), draw((e, segments, m, d)), draw((e, segments, m, q)), draw((e, segments - 1, g)),
        draw((e, segments - 1, g, d)), draw((e, segments - 1, g, d)), draw((e, segments - 1, g, q)), draw((e, d, q)),
    )  # fmt: skip


def dense(b, damping, k):
    """All rows of experiment k, and their residuals, in [π | δ₁ | δ₂ | …]."""
    _, segments, m, d = b.by_node.shape
    g, q = b.gap.shape[-1], b.by_common.shape[-1]
    rows, residual = [], []
    for s in range(segments):
        row = np.zeros((m, q + (segments - 1) * d))
        row[:, :q] = b.by_common[k, s]
        onward = np.zeros((g, row.shape[1]))
        for target, matrix in ((row, b.by_node[k, s]), (onward, b.leave[k, s] if s < segments - 1 else None)):
            if matrix is None:
                continue
            if s == 0:
                target[:, :q] += matrix @ b.first[k]
            else:
                target[:, q + (s - 1) * d : q + s * d] += matrix
        rows.append(row)
        residual.append(b.residual[k, s])
        if s < segments - 1:
            onward[:, :q] += b.gap_by_common[k, s]
            onward[:, q + s * d : q + (s + 1) * d] -= b.arrive[k, s]
            rows.append(onward)
            residual.append(b.gap[k, s])
    held = np.zeros(((segments - 1) * d, q + (segments - 1) * d))
    held[:, q:] = np.diag(damping[k, 1:].ravel())
    return np.concatenate([*rows, held]), np.concatenate([*residual, np.zeros(len(held))])


@pytest.mark.parametrize(
    "e, segments, m, g, d, q", [(1, 2, 3, 2, 2, 3), (3, 7, 4, 5, 3, 6), (2, 5, 1, 4, 4, 9), (2, 1, 8, 2, 2, 3)]
)
def test_minimum_is_that_of_a_dense_solver(e, segments, m, g, d, q):
    rng = np.random.default_rng(segments)
    b = random_blocks(rng, e, segments, m, g, d, q)
    damping = rng.uniform(0.1, 1.0, (e, segments, d))
    left = eliminate(b, damping)
    for k in range(e):
        rows, residual = dense(b, damping, k)
        expected = scipy.linalg.lstsq(rows, -residual)[0]
        common = scipy.linalg.lstsq(left.rows[k], -left.residual[k])[0]
        np.testing.assert_allclose(common, expected[:q], rtol=1e-9, atol=1e-11)
        every = np.zeros((e, q))
        every[k] = common
        np.testing.assert_allclose(left.nodes(every)[k].ravel(), expected[q:], rtol=1e-9, atol=1e-11)
        # The rows after that move are the dense ones.
        data, gap = linear(b, every, left.nodes(every))
        moved = rows @ expected + residual
        held = moved[len(moved) - (segments - 1) * d :]
        np.testing.assert_allclose(
            np.sum(data[k] ** 2) + np.sum(gap[k] ** 2), np.sum(moved**2) - np.sum(held**2), rtol=1e-9
        )


def test_condensed_rows_are_those_of_least_squares_with_exact_continuity():
    """Constrained least squares by the null space of the continuity rows."""
    rng = np.random.default_rng(3)
    e, segments, m, d, q = 2, 6, 3, 3, 4
    b = random_blocks(rng, e, segments, m, d, d, q)
    for k in range(e):
        rows, _ = dense(b, np.zeros((e, segments, d)), k)
        rows = rows[: segments * m + (segments - 1) * d]
        is_gap = np.zeros(len(rows), bool)
        for s in range(segments - 1):
            first = s * (m + d) + m
            is_gap[first : first + d] = True
        free = scipy.linalg.null_space(rows[is_gap])  # (unknowns, q)
        expected = rows[~is_gap] @ free @ np.linalg.inv(free[:q])
        np.testing.assert_allclose(condensed(b)[k].reshape(-1, q), expected, rtol=1e-7, atol=1e-8)
