"""Blocks that are numerically singular at a point, though their structure is regular.

Given a system, its parameters and a state, each block that could be singular there is examined in NumPy: its Jacobian
is equilibrated, so that units do not matter, and its singular values are compared with rounding. Only the quantities
that some Jacobian depends on are computed.
"""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from ..judgement.rank import is_undecided, rank_of
from ..lowering.plan import SystemPlan
from ..lowering.remembered import remembered
from ..lowering.schedule import SparseStep, Step, StepEquation
from ..model.tables import ZERO
from ..tolerances import ILL_CONDITIONED, KNOWN, RANK, SLIGHT
from .block_values import BlockValues, slots_of_partials
from .condition import DENSE_LIMIT, BlockFinding, conditions, left_null
from .sparse_blocks import sparse_finding


@dataclasses.dataclass(frozen=True)
class _Check:
    """The static part of a check: the steps to examine, and the steps to solve before."""

    examined: frozenset[int]
    solved: frozenset[int]


@remembered
def _plan_check(plan: SystemPlan) -> _Check:
    examined, wanted = set(), np.zeros(plan.extended.quantities.n, bool)
    solved: set[int] = set()
    for k, step in enumerate(plan.steps):
        if isinstance(step, SparseStep):
            examined.add(k)
            wanted[step.needs()[step.needs() != ZERO]] = True
            continue
        if len(step.unknown) == 1 and all(_never_vanishes(e) for e in step.equations):
            continue
        examined.add(k)
        for equation in step.equations:
            for slot in slots_of_partials(equation):
                source = equation.quantity[:, slot]
                wanted[source[source != ZERO]] = True
    settled = plan.selection.settled
    for planned in plan.constraints:
        wanted[settled[np.isin(settled, planned.group.quantity)]] = True
    for k in reversed(range(len(plan.steps))):
        step = plan.steps[k]
        if any(wanted[q].any() for q in step.unknown):
            solved.add(k)
            needs = step.needs()
            wanted[needs[needs != ZERO]] = True
    return _Check(frozenset(examined), frozenset(solved))


def _never_vanishes(equation: StepEquation) -> bool:
    """True if the equation's only local unknown has a coefficient that is a nonzero number."""
    positions = equation.inside
    return len(positions) == 1 and equation.template.coefficient_is_number(positions[0])


def examine_blocks(
    plan: SystemPlan,
    parameters,
    networks: tuple,
    t: float,
    x,
    inputs: Callable[[], np.ndarray],
    limit: float = ILL_CONDITIONED,
) -> Iterator[BlockFinding]:
    """The blocks that are singular at a state, or ill-conditioned, in the order they are solved; the first singular
    one ends the search, as nothing after it can be computed.

    **Arguments:**

    - `parameters`, `x`: flat arrays.
    - `inputs`: a function that gives the values of the inputs' quantities; called only if they are needed.
    - `limit`: the condition number from which on a block that is written out is reported.
    """
    check = _plan_check(plan)
    if not check.examined and not plan.n_constraints:
        return
    values = BlockValues(plan, parameters, networks, t, x, inputs)
    for k, step in enumerate(plan.steps):
        if isinstance(step, SparseStep):
            finding = sparse_finding(plan, values, step)
            if finding is not None:
                yield finding
                if finding.singular:
                    return
            continue
        if step.carried and (k in check.solved or k in check.examined):
            values.follow(step)
        if k in check.examined:
            condition, left, right = conditions(values.jacobian(step), values.jacobian_errors(step))
            for b in np.flatnonzero(~(condition < limit)):
                singular = not np.isfinite(condition[b])
                yield _finding(plan, values, step, int(b), float(condition[b]), singular, left(int(b)), right(int(b)))
                if singular:
                    return
        if k in check.solved and not step.carried:
            values.solve(step)
    yield from _constraints(plan, values)


def _finding(
    plan: SystemPlan, values: BlockValues, step: Step, b: int, condition, singular, left, right
) -> BlockFinding:
    names = [plan.quantity_name[int(u[b])] for u in step.unknown]
    texts = [plan.locate(int(e.equation[b])) for e in step.equations]
    chosen = np.flatnonzero(np.abs(right).max(axis=1, initial=0.0) > SLIGHT)
    dependent = np.flatnonzero(np.abs(left).max(axis=1, initial=0.0) > SLIGHT)
    variables = tuple(names[u] for u in chosen) or tuple(names)
    equations = tuple(dict.fromkeys(texts[e] for e in dependent)) or tuple(dict.fromkeys(texts))
    causes = _causes(plan, values, step, b, left, right) if singular or left.shape[1] else ()
    parameters = bool(causes) and causes[0][0] in plan.flat.parameters.names
    undecided = singular and len(names) <= DENSE_LIMIT and is_undecided(values.jacobian(step)[b])
    return BlockFinding(condition, singular, len(names), variables, equations, causes, parameters, undecided)


def _causes(plan: SystemPlan, values: BlockValues, step: Step, b: int, left, right) -> tuple[tuple[str, float], ...]:
    """The parameters, or else the variables, a change of which makes the block regular: those for which uᵀ·∂J·v ≠ 0 for
    null vectors u and v, beyond the errors of J: a multiple of what is zero but for rounding is no cause."""
    before = values.jacobian(step)[b]
    errors = np.abs(left).T @ values.jacobian_errors(step)[b] @ np.abs(right)

    def matters(after: np.ndarray, anyhow: bool = False) -> bool:
        change = after - before
        if not np.isfinite(change).all():
            return True
        scale = np.abs(change).max(initial=0.0)
        if scale == 0.0:
            return False
        if anyhow or not left.shape[1]:
            return True
        along = np.abs(left.T @ (change / scale) @ right)
        return bool(((along > RANK) & (along * scale > errors)).any())

    found: list[tuple[str, float]] = []
    for p in sorted({int(p) for e in step.equations for p in e.parameter[b]}):
        parameters = values.parameters.copy()
        parameters[p] += 1e-3 * (abs(parameters[p]) or 1.0)
        if matters(values.jacobian(step, parameters)[b]):
            found.append((plan.flat.parameters.names[p], float(values.parameters[p])))
    # A parameter that is not zero only scales what is: the cause is what is zero.
    zero = [c for c in found if c[1] == 0.0]
    if zero:
        return tuple(zero)
    moved: list[tuple[str, float]] = []
    touched: list[tuple[str, float]] = []  # where it is of the second order
    sizes = values.errors / KNOWN  # a step along 1e-16 rad alone would show nothing
    sources = {int(e.quantity[b, s]) for e in step.equations for s in slots_of_partials(e)} - {ZERO}
    for q in sorted(sources):
        kept = values.quantities[q]
        values.quantities[q] = kept + 1e-3 * (sizes[q] or 1.0)
        after = values.jacobian(step)[b]
        values.quantities[q] = kept
        name = plan.quantity_name[q]
        named = (name, float(kept) + 0.0)
        if matters(after):
            moved.append(named)
        elif kept == 0.0 and matters(after, anyhow=True):
            touched.append(named)
    return tuple([c for c in moved if c[1] == 0.0] or found or moved or touched)


def _constraints(plan: SystemPlan, values: BlockValues) -> Iterator[BlockFinding]:
    """Hidden constraints that depend on each other at the state: the projection could not tell them apart."""
    m = plan.n_constraints
    if not m or plan.constraint_pattern is None or m > DENSE_LIMIT:
        return
    place = np.full(len(values.quantities), -1)  # ZERO is −1: the last entry
    place[plan.states] = np.arange(len(plan.states))
    matrix, errors = np.zeros((2, m, len(plan.states)))
    texts = []
    row = 0
    for planned in plan.constraints:
        group = planned.group
        if np.isnan(values.quantities[group.quantity]).any() or group.template.opaque is not None:
            return
        instance, slot = np.nonzero(place[group.quantity] >= 0)
        entries = row + instance, place[group.quantity[instance, slot]]
        np.add.at(matrix, entries, group.partials(values.point)[instance, slot])
        np.add.at(errors, entries, group.partial_errors(values.point, values.errors)[instance, slot])
        texts += group.equation.tolist()
        row += len(group)
    if not np.isfinite(matrix).all():
        return
    rank = rank_of(matrix, errors)
    condition = rank.condition if rank.is_regular else np.inf
    if condition < ILL_CONDITIONED:
        return
    dependent = np.flatnonzero(np.abs(left_null(rank)).max(axis=1, initial=0.0) > SLIGHT)
    states = np.flatnonzero(np.abs(matrix[dependent]).max(axis=0, initial=0.0) > 0)
    if not len(states):
        states = np.array(sorted({k for r in dependent for k in plan.constraint_pattern[r]}), np.int64)
    names = tuple(plan.quantity_name[int(plan.states[k])] for k in states)
    singular = not rank.is_regular
    at = tuple((name, float(values.quantities[plan.states[k]])) for name, k in zip(names, states, strict=True))
    yield BlockFinding(
        float(condition), singular, m, names, tuple(plan.locate(texts[e]) for e in dependent), at, False,
        undecided=singular and is_undecided(matrix),
    )  # fmt: skip
