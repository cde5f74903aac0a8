"""Large blocks that are singular at a point, examined by a sparse factorization."""

import numpy as np
import scipy.sparse as sp

from ..judgement.sparse_rank import sparse_rank_of
from ..lowering.plan import SystemPlan
from ..lowering.schedule import SparseStep
from ..tolerances import ILL_CONDITIONED, NO_PART, SLIGHT
from .block_values import BlockValues
from .condition import DENSE_LIMIT, BlockFinding


def sparse_finding(plan: SystemPlan, values: BlockValues, step: SparseStep) -> BlockFinding | None:
    """Examines a sparse block: returns its fault, or None. If it is linear, its unknowns are solved for on the way."""
    n = step.n
    column = np.full(len(values.quantities), -1)  # ZERO is −1: the last entry
    column[step.unknown[0]] = np.arange(n)
    texts = np.concatenate([equation.equation for equation in step.equations])
    rows, columns, entries, bounds = [], [], [], []
    if not step.carried:
        values.quantities[step.unknown[0]] = 0.0
    first = 0
    for equation in step.equations:
        partials, of_partials = values.partials(equation), values.partial_errors(equation)
        instance, slot = np.nonzero(column[equation.quantity] >= 0)
        rows.append(first + instance)
        columns.append(column[equation.quantity[instance, slot]])
        entries.append(partials[instance, slot])
        bounds.append(of_partials[instance, slot])
        first += len(equation.equation)
    place = np.concatenate(rows), np.concatenate(columns)
    matrix = sp.csc_array((np.concatenate(entries), place), shape=(n, n))
    errors = sp.csc_array((np.concatenate(bounds), place), shape=(n, n))
    if not np.isfinite(matrix.data).all():
        return None  # what is not finite has another cause than rank
    rank = sparse_rank_of(matrix, errors)
    if rank.factors is not None and not step.carried:
        residual = np.concatenate([values.residual(e) for e in step.equations])
        values.quantities[step.unknown[0]] = rank.c * rank.factors.solve(-rank.r * residual)
    if rank.is_regular and rank.condition < ILL_CONDITIONED:
        return None
    left, right = rank.null_vectors()
    chosen = np.flatnonzero(np.abs(right) > SLIGHT * np.abs(right).max())
    dependent = np.flatnonzero(np.abs(left) > SLIGHT * np.abs(left).max())
    left, right = rank.r * left, rank.c * right
    names = tuple(plan.quantity_name[int(step.unknown[0][k])] for k in chosen)
    equations = tuple(dict.fromkeys(plan.locate(int(texts[k])) for k in dependent))
    singular = not rank.is_regular
    causes = _causes(plan, values, step, column, left, right) if singular else ()
    return BlockFinding(rank.condition, singular, n, names, equations, causes, bool(causes))


def _causes(
    plan: SystemPlan, values: BlockValues, step: SparseStep, column: np.ndarray, left: np.ndarray, right: np.ndarray
) -> tuple[tuple[str, float], ...]:
    """The parameters p a change of which makes the block regular: uᵀ·∂J/∂p·v ≠ 0 for the null vectors u and v."""
    effect = np.zeros(len(values.parameters))
    first = 0
    for equation in step.equations:
        u = left[first : first + len(equation.equation)]
        first += len(u)
        places = column[equation.quantity]
        v = np.where(places >= 0, right[places], 0.0)
        before = values.partials(equation)
        for j in range(equation.parameter.shape[1]):
            p = equation.parameter[:, j]
            moved = values.parameters.copy()
            moved[p] += 1e-3 * np.where(moved[p] == 0, 1.0, np.abs(moved[p]))
            change = values.partials(equation, moved) - before
            np.add.at(effect, p, u * (change * v).sum(axis=1))
    size = np.abs(np.where(np.isfinite(effect), effect, np.inf))
    found = np.flatnonzero(size > NO_PART * size.max(initial=0.0))[:DENSE_LIMIT]
    return tuple((plan.flat.parameters.names[p], float(values.parameters[p])) for p in found)
