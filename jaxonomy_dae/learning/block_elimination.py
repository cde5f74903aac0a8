"""Least squares with the structure of multiple shooting, solved block by block.

Unknowns of an experiment are π, common to its segments, and the moves δ of the states at its nodes. Rows are those of
data, r + J δₖ + P π for segment k, and those of continuity between neighbours, c + L δₖ − E δₖ₊₁ + B π. The first node
is no unknown of its own: δ₀ = G π, because a start follows from parameters and starts.

Nodes are eliminated one after the other by orthogonal transformations, as in a square-root filter (Bierman 1977,
"Factorization Methods for Discrete Sequential Estimation"; for shooting, Bock 1981): the cost is linear in their
number, no product of many propagations is formed, and normal equations are not either. What is left of all
experiments is a triangle of rows in π.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..host.threads import one_thread


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Rows of e experiments with N = M + 1 segments of m samples, states of g entries, nodes of d degrees of freedom,
    and q numbers common to the segments of an experiment."""

    residual: Float[np.ndarray, "e N m"]  # r
    by_node: Float[np.ndarray, "e N m d"]  # J
    by_common: Float[np.ndarray, "e N m q"]  # P
    gap: Float[np.ndarray, "e M g"]  # c
    leave: Float[np.ndarray, "e M g d"]  # L
    arrive: Float[np.ndarray, "e M g d"]  # E
    gap_by_common: Float[np.ndarray, "e M g q"]  # B
    first: Float[np.ndarray, "e d q"]  # G

    def weighted(self, row: Float[np.ndarray, "e N m"], continuity: float, shift: Float[np.ndarray, "e M g"]):
        """Rows of data times their weights, and of continuity times one weight, with its residuals shifted."""
        return Blocks(
            residual=row * self.residual, by_node=row[..., None] * self.by_node,
            by_common=row[..., None] * self.by_common, gap=continuity * self.gap + shift,
            leave=continuity * self.leave, arrive=continuity * self.arrive,
            gap_by_common=continuity * self.gap_by_common, first=self.first,
        )  # fmt: skip

    @property
    def local(self) -> Float[np.ndarray, "e r q"]:
        """The derivatives of each segment's rows by the common numbers, with nodes held."""
        data = np.array(self.by_common)
        data[:, 0] += self.by_node[:, 0] @ self.first
        e, q = len(data), data.shape[-1]
        return np.concatenate([data.reshape(e, -1, q), self.gap_by_common.reshape(e, -1, q)], axis=1)

    @property
    def sizes(self) -> Float[np.ndarray, "e N d"]:
        """The norm of each node's columns."""
        square = np.sum(self.by_node**2, axis=2)
        square[:, :-1] += np.sum(self.leave**2, axis=2)
        square[:, 1:] += np.sum(self.arrive**2, axis=2)
        return np.sqrt(square)


class Eliminated(NamedTuple):
    """The rows that are left when all nodes are eliminated, and the rows from which the nodes follow."""

    rows: Float[np.ndarray, "e r q"]
    residual: Float[np.ndarray, "e r"]
    kept: list[Float[np.ndarray, "e d _"]]  # rows [δₖ | δₖ₊₁ | π | residual] for nodes 1, 2, …

    def nodes(self, common: Float[np.ndarray, "e q"]) -> Float[np.ndarray, "e M d"]:
        """The moves of all nodes but the first that follow from moves `common` of the numbers π, shape (e, q)."""
        experiments, q = common.shape
        moves: list[np.ndarray] = []
        for rows in reversed(self.kept):
            d = rows.shape[1]
            right = rows[:, :, -1] + np.einsum("edq,eq->ed", rows[:, :, -1 - q : -1], common)
            if moves:
                right = right + np.einsum("edf,ef->ed", rows[:, :, d : 2 * d], moves[-1])
            moves.append(-np.linalg.solve(rows[:, :, :d], right[..., None])[..., 0])
        if not moves:
            return np.zeros((experiments, 0, 0))
        return np.stack(moves[::-1], axis=1)


def eliminate(b: Blocks, damping: Float[np.ndarray, "e N d"]) -> Eliminated:
    """Eliminates the nodes of Σ |rows|² + Σ |damping·δ|²."""
    experiments, segments, _, d = b.by_node.shape
    q = b.by_common.shape[-1]

    def substituted(by_node, by_common, residual):
        """Rows [π | residual] with δ₀ = G π."""
        return np.concatenate([by_node @ b.first + by_common, residual[..., None]], axis=-1)

    carry = substituted(b.by_node[:, 0], b.by_common[:, 0], b.residual[:, 0])
    if segments > 1:
        onward = substituted(b.leave[:, 0], b.gap_by_common[:, 0], b.gap[:, 0])
        nothing = np.zeros((*carry.shape[:2], d))
        carry = np.concatenate(
            [np.concatenate([nothing, carry], axis=-1), np.concatenate([-b.arrive[:, 0], onward], axis=-1)], axis=1
        )
    kept = []
    for k in range(1, segments):
        last = k == segments - 1
        between = 0 if last else d

        def padded(node, rest, between=between):
            """Rows of this node without those of the next."""
            return np.concatenate([node, np.zeros((*node.shape[:2], between)), rest], axis=-1)

        data = np.concatenate([b.by_common[:, k], b.residual[:, k, :, None]], axis=-1)
        held = np.eye(d) * damping[:, k, None, :]
        rows = [
            padded(carry[..., :d], carry[..., d:]),
            padded(b.by_node[:, k], data),
            padded(held, np.zeros((experiments, d, q + 1))),
        ]
        if not last:
            onward = np.concatenate([b.gap_by_common[:, k], b.gap[:, k, :, None]], axis=-1)
            rows.append(np.concatenate([b.leave[:, k], -b.arrive[:, k], onward], axis=-1))
        triangle = _triangle(np.concatenate(rows, axis=1))
        kept.append(triangle[:, :d])
        carry = triangle[:, d:, d:]
    triangle = _triangle(carry)
    return Eliminated(triangle[..., :-1], triangle[..., -1], kept)


def _triangle(rows: Float[np.ndarray, "e r c"]) -> Float[np.ndarray, "e s c"]:
    """R of Q R."""
    with one_thread(rows.size * rows.shape[-1]):
        return np.asarray(np.linalg.qr(rows, mode="r"))


def linear(
    b: Blocks, common: Float[np.ndarray, "e q"], nodes: Float[np.ndarray, "e M d"]
) -> tuple[Float[np.ndarray, "e N m"], Float[np.ndarray, "e M g"]]:
    """The rows of data and of continuity after a move."""
    first = np.einsum("edq,eq->ed", b.first, common)[:, None]
    moves = np.concatenate([first, nodes], axis=1) if nodes.shape[1] else first
    data = b.residual + np.einsum("ekmd,ekd->ekm", b.by_node, moves) + np.einsum("ekmq,eq->ekm", b.by_common, common)
    gap = b.gap + np.einsum("ekgq,eq->ekg", b.gap_by_common, common)
    gap = gap + np.einsum("ekgd,ekd->ekg", b.leave, moves[:, :-1]) - np.einsum("ekgd,ekd->ekg", b.arrive, moves[:, 1:])
    return data, gap


def condensed(b: Blocks) -> Float[np.ndarray, "e N m q"]:
    """The Jacobian of the data by π where continuity holds: that of single shooting, from the segments' own."""
    slope, out = b.first, []
    for k in range(b.by_node.shape[1]):
        out.append(b.by_node[:, k] @ slope + b.by_common[:, k])
        if k + 1 < b.by_node.shape[1]:
            # Gaps have an entry for each state, and nodes move along the constraints alone: the matrix is not square.
            slope = np.linalg.pinv(b.arrive[:, k]) @ (b.leave[:, k] @ slope + b.gap_by_common[:, k])
    return np.stack(out, axis=1)
