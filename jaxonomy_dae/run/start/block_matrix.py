"""The Jacobian of a block at a point, in NumPy, and what makes it singular there."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ...base.tolerances import KNOWN, RANK
from ...compile.lowering.schedule import AnyStep, SparseStep
from ...compile.model.group import Point, QuantityGroup
from ...graph.judgement.rank import DECOMPOSED_UPTO, Rank, are_evident, rank_of
from ...graph.judgement.sparse_rank import SparseRank, sparse_rank_of

MOVED = 1e-3  # of what a Jacobian depends on, relative, to see whether it makes the Jacobian regular


class Known:
    """The quantities that are known so far, not-a-number for others, and bounds of their errors: they are found by
    Newton's method, so to rounding of themselves and of their typical sizes."""

    def __init__(self, at: Point, typical: np.ndarray):
        self.at = at
        self._typical = np.append(typical, 0.0)
        self.errors = KNOWN * (np.abs(at.values) + self._typical)

    def put(self, quantity: np.ndarray, values: Any):
        """Adds what has become known."""
        self.at.values[quantity] = values
        self.errors[quantity] = KNOWN * (np.abs(values) + self._typical[quantity])


class Effects(NamedTuple):
    """For each of the parameters, or quantities: whether a change of it makes the Jacobian regular, and whether it
    changes the Jacobian at all."""

    matters: np.ndarray
    touches: np.ndarray


@dataclasses.dataclass(frozen=True)
class Block:
    """Equations, some instances of templates, and as many unknown quantities that they determine."""

    equations: tuple[QuantityGroup, ...]
    unknown: np.ndarray

    @functools.cached_property
    def _places(self) -> tuple[list[tuple[np.ndarray, np.ndarray]], tuple[np.ndarray, np.ndarray]]:
        """For each group of equations, the instances and slots that hold unknowns; and the rows and columns of all of
        them."""
        rows, columns, inside = [], [], []
        for first, group in self._with_rows():
            place = self._columns(group)
            instance, slot = np.nonzero(place >= 0)
            inside.append((instance, slot))
            rows.append(first + instance)
            columns.append(place[instance, slot])
        return inside, (np.concatenate(rows), np.concatenate(columns))

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of equations and of unknowns."""
        return sum(map(len, self.equations)), len(self.unknown)

    def _entries(self, numbers: Sequence[np.ndarray]) -> np.ndarray:
        """Those of numbers by slots, (n, slots) of each group of equations, that belong to unknowns."""
        return np.concatenate([found[at] for found, at in zip(numbers, self._places[0], strict=True)])

    def _sparse(self, numbers: Sequence[np.ndarray]) -> Any:
        return sp.csr_array((self._entries(numbers), self._places[1]), shape=self.shape)

    def _with_errors(self, known: Known) -> Iterator[tuple[np.ndarray, ...]]:
        """The numbers by slots of the Jacobian, then bounds of their errors."""
        found = [group.partials_with_errors(known.at, known.errors) for group in self.equations]
        return zip(*found, strict=True)

    def jacobian(self, known: Known) -> Any:
        """∂(residuals)/∂(unknowns)."""
        return self._sparse([group.partials(known.at) for group in self.equations])

    def is_evident(self, known: Known) -> bool:
        """True if the equations are independent at a glance, as `are_evident`."""

        def dense(numbers: Sequence[np.ndarray]) -> np.ndarray:
            out = np.zeros((1, *self.shape))
            np.add.at(out[0], self._places[1], self._entries(numbers))
            return out

        return bool(are_evident(*map(dense, self._with_errors(known)))[0])

    def rank(self, known: Known) -> Rank | SparseRank | None:
        """The Jacobian's rank; None if it is not finite, which has another cause."""
        matrix, errors = map(self._sparse, self._with_errors(known))
        if not np.isfinite(matrix.data).all():
            return None
        if matrix.shape[0] > DECOMPOSED_UPTO:
            return sparse_rank_of(matrix, errors)
        return rank_of(matrix.toarray(), errors.toarray())

    def residual(self, known: Known) -> np.ndarray:
        """The residuals."""
        return np.concatenate([group.residual(known.at) for group in self.equations])

    def _with_rows(self) -> Iterator[tuple[int, QuantityGroup]]:
        """The groups of equations, each with the number of its first row."""
        first = 0
        for group in self.equations:
            yield first, group
            first += len(group)

    def _columns(self, group: QuantityGroup) -> np.ndarray:
        """The column of each slot, −1 for quantities from outside."""
        order = np.argsort(self.unknown)
        place = order[np.minimum(np.searchsorted(self.unknown, group.quantity, sorter=order), len(order) - 1)]
        return np.where(self.unknown[place] == group.quantity, place, -1)

    def effects(self, known: Known, rank: Rank | SparseRank, of_parameters: bool) -> Effects:
        """What a change of each parameter, or of each quantity, does: the block becomes regular if uᵀ·∂J·v ≠ 0 for
        null vectors u and v, beyond the errors of J: a multiple of what is zero but for rounding is no cause."""
        left, right = rank.null_vectors()
        at = known.at
        n = len(at.parameters) if of_parameters else len(at.values)
        size, along = np.zeros(n), np.zeros((n, left.shape[1], right.shape[1]))
        noise = np.zeros(along.shape[1:])
        for first, group in self._with_rows():
            rows, place = slice(first, first + len(group)), self._columns(group)
            inside = place >= 0
            u, v = left[rows], np.where(inside[..., None], right[place], 0.0)
            # Null vectors are those of the scaled matrix.
            scales = rank.r[rows, None] * rank.c[place]
            errors = np.where(inside, group.partials_with_errors(at, known.errors)[1] * scales, 0.0)
            noise += np.einsum("ia,is,isb->ab", np.abs(u), errors, np.abs(v))
            # An argument in one place of one equation is moved, and nothing that reads the same elsewhere.
            own = group.apart()
            arguments = [at.values[group.quantity], at.parameters[group.parameter]]
            ids, moving = (group.parameter, 1) if of_parameters else (group.quantity, 0)
            unit = np.abs(arguments[1]) if of_parameters else known.errors[group.quantity] / KNOWN
            before = _partials(own, arguments, at)
            for k in range(ids.shape[1]):
                moved = list(arguments)
                moved[moving] = arguments[moving].copy()
                # What is zero moves by one: a part of zero would be no change.
                moved[moving][:, k] += MOVED * np.where(unit[:, k] == 0.0, 1.0, unit[:, k])
                change = np.where(inside, (_partials(own, moved, at) - before) * scales, 0.0)
                # A slope that is no longer finite has changed without measure: what was moved counts as a cause.
                change = np.where(np.isfinite(change), change, np.inf)
                np.maximum.at(size, ids[:, k], np.abs(change).max(axis=1, initial=0.0))
                with np.errstate(invalid="ignore"):
                    np.add.at(along, ids[:, k], np.einsum("ia,is,isb->iab", u, change, v))
        known_size = size[:, None, None]
        matters = (np.abs(along) > RANK * known_size) & (np.abs(along) > noise)
        return Effects(matters.any(axis=(1, 2)) | ~np.isfinite(size), size > 0)


def _partials(own: QuantityGroup, arguments: list[np.ndarray], at: Point) -> np.ndarray:
    quantities, parameters = (a.ravel() for a in arguments)
    return own.partials(Point.of(quantities, parameters, at.t, at.networks))


def blocks_of(step: AnyStep, which: np.ndarray | None = None) -> Iterator[Block]:
    """The blocks of a step, those of numbers in `which` if it is given."""
    if isinstance(step, SparseStep):
        for block in range(int(step.block.max()) + 1):
            rows = [np.flatnonzero(of == block) for of in step.equation_block]
            chosen = [equation.take(r) for equation, r in zip(step.equations, rows, strict=True) if len(r)]
            yield Block(tuple(chosen), step.unknown[0][step.block == block])
        return
    for b in range(step.n) if which is None else which.tolist():
        yield Block(tuple(e.take([b]) for e in step.equations), np.array([u[b] for u in step.unknown]))
