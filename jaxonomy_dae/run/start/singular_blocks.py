"""Blocks that are numerically singular at a point, though their structure is regular.

Given a system, its parameters and a state, each block that could be singular there is examined in NumPy: its Jacobian
is equilibrated, so that units do not matter, and its singular values are compared with rounding. Only the quantities
that some Jacobian depends on are computed.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ...base.tolerances import ILL_CONDITIONED, SLIGHT
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.remembered import remembered
from ...compile.lowering.schedule import SparseStep, Step, StepEquation
from ...compile.model.group import Point
from ...compile.model.opaque import Networks
from ...compile.model.tables import ZERO
from ...compile.model.typical_sizes import typical_sizes
from ...graph.judgement.rank import DECOMPOSED_UPTO, Rank, are_evident, is_undecided
from ...graph.judgement.sparse_rank import SparseRank
from .block_matrix import Block, Known, blocks_of


@dataclasses.dataclass(frozen=True)
class BlockFinding:
    """A block that is singular, or nearly so: the variables it leaves open, the equations that depend on each other,
    and the parameters and variables that make it so, with their values.

    `undecided`: it is regular as its numbers stand, and singular within their errors, so that nobody can tell.
    """

    condition: float
    singular: bool
    size: int
    variables: tuple[str, ...]
    equations: tuple[str, ...]
    causes: tuple[tuple[str, float], ...]
    causes_are_parameters: bool
    undecided: bool = False


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
        # These are nearly all steps of a model, and nothing of them can be singular.
        if len(step.unknown) == 1 and all(_never_vanishes(e) for e in step.equations):
            continue
        examined.add(k)
        for equation in step.equations:
            inside = (equation.template.slots_of_partial(slot) for slot in equation.inside)
            source = equation.quantity[:, sorted(frozenset().union(*inside))]
            wanted[source[source != ZERO]] = True
    settled = plan.selection.settled
    for planned in plan.constraints:
        wanted[settled[np.isin(settled, planned.equation.quantity)]] = True
    # Backwards, since what a step needs is computed by those before it.
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
    sizes: np.ndarray | None = None,
    limit: float = ILL_CONDITIONED,
) -> Iterator[BlockFinding]:
    """The blocks that are singular at a state, or ill-conditioned, in the order they are solved; the first singular
    one ends the search, as nothing after it can be computed.

    **Arguments:**

    - `parameters`, `x`: flat arrays.
    - `inputs`: a function that gives the values of the inputs' quantities; called only if there are any.
    - `sizes`: the typical sizes of all quantities, where the caller has them.
    - `limit`: the condition number from which on a block is reported.
    """
    check = _plan_check(plan)
    if not check.examined and not plan.n_constraints:
        return
    quantities = plan.extended.quantities
    values = np.full(quantities.n, np.nan)
    values[[*plan.states, *plan.carried]] = x
    if quantities.n > quantities.n_unknown:
        values[quantities.n_unknown :] = inputs()
    parameters = np.asarray(parameters, float)
    sizes = typical_sizes(plan.model, parameters) if sizes is None else sizes
    known = Known(Point.of(values, parameters, t, Networks(networks)), sizes)
    for k, step in enumerate(plan.steps):
        if k not in check.examined | check.solved:
            continue
        if isinstance(step, SparseStep):
            blocks = blocks_of(step)
        else:
            if step.carried:
                _follow(step, known)
            elif k in check.solved:
                _solve(step, known)
            blocks = blocks_of(step, np.flatnonzero(_are_suspicious(step, known))) if k in check.examined else ()
        for block in blocks:
            if step.whole and not step.carried:
                # At zero the residual is the right-hand side, as in `_solve`.
                known.put(block.unknown, 0.0)
            rank = block.rank(known)
            if rank is None:
                continue
            condition = rank.condition if rank.is_regular else np.inf
            if not condition < limit:
                yield _finding(plan, known, block, rank)
                if not rank.is_regular:
                    return
            if step.whole and not step.carried:
                # Behind a block that is solved, others are judged at its solution, for their coefficients may depend on
                # it.
                known.put(block.unknown, rank.solve(-block.residual(known)))
    yield from _constraints(plan, known)


def _in_blocks(step: Step, numbers: Sequence[np.ndarray]) -> np.ndarray:
    """Numbers by slots, (n, slots) of each of a step's equations, as matrices of its n blocks, shape (n, k, k)."""
    k = len(step.unknown)
    out = np.zeros((step.n, k, k))
    for e, (equation, found) in enumerate(zip(step.equations, numbers, strict=True)):
        for slot in equation.inside:
            out[:, e, equation.local[slot]] += found[:, slot]
    return out


def _are_suspicious(step: Step, known: Known) -> np.ndarray:
    """True for blocks that are not evidently regular, shape (n,)."""
    found = [equation.partials_with_errors(known.at, known.errors) for equation in step.equations]
    return ~are_evident(*(_in_blocks(step, numbers) for numbers in zip(*found, strict=True)))


def _follow(step: Step, known: Known):
    """Computes the unknowns that follow from the tearing variables in the state."""
    for e, u in step.tearing.sequence:
        equation = step.equations[e]
        (slot,) = [k for k in equation.inside if equation.local[k] == u]
        known.put(step.unknown[u], equation.solved(slot, known.at))


def _solve(step: Step, known: Known):
    """Computes the unknowns of a linear step."""
    for quantities in step.unknown:
        # At zero the residual of a linear step is its right-hand side.
        known.put(quantities, 0.0)
    residual = np.stack([equation.residual(known.at) for equation in step.equations], axis=-1)
    try:
        with np.errstate(all="ignore"):
            matrices = _in_blocks(step, [equation.partials(known.at) for equation in step.equations])
            found = np.linalg.solve(matrices, -residual[..., None])[..., 0]
    except np.linalg.LinAlgError:
        found = np.full(residual.shape, np.nan)
    for u, quantities in enumerate(step.unknown):
        known.put(quantities, found[:, u])


def _finding(plan: SystemPlan, known: Known, block: Block, rank: Rank | SparseRank) -> BlockFinding:
    left, right = (np.abs(vectors).max(axis=1, initial=0.0) for vectors in rank.null_vectors())
    names = [plan.quantity_name[q] for q in block.unknown.tolist()]
    texts = [plan.locate(e) for group in block.equations for e in group.equation.tolist()]
    variables = [name for name, size in zip(names, right, strict=True) if size > SLIGHT * right.max()]
    equations = [text for text, size in zip(texts, left, strict=True) if size > SLIGHT * left.max()]
    causes = _causes(plan, known, block, rank) if left.any() else ()
    singular, n = not rank.is_regular, len(names)
    undecided = singular and n <= DECOMPOSED_UPTO and is_undecided(block.jacobian(known).toarray())
    return BlockFinding(
        condition=rank.condition if rank.is_regular else np.inf, singular=singular, size=n,
        variables=tuple(variables) or tuple(names), equations=tuple(dict.fromkeys(equations or texts)),
        causes=causes, causes_are_parameters=bool(causes) and causes[0][0] in plan.flat.parameters.names,
        undecided=undecided,
    )  # fmt: skip


def _causes(plan: SystemPlan, known: Known, block: Block, rank: Rank | SparseRank) -> tuple[tuple[str, float], ...]:
    """The parameters, or else the variables, a change of which makes the block regular."""
    parameters, names = known.at.parameters, plan.flat.parameters.names
    changing = np.flatnonzero(block.effects(known, rank, of_parameters=True).matters).tolist()
    found = [(names[p], float(parameters[p])) for p in changing[:DECOMPOSED_UPTO]]
    # A parameter that is not zero only scales what is: the cause is what is zero.
    zero = [c for c in found if c[1] == 0.0]
    if zero:
        return tuple(zero)
    values, effects = known.at.values, block.effects(known, rank, of_parameters=False)
    named = [(name, float(value) + 0.0) for name, value in zip(plan.quantity_name, values, strict=False)]
    moved = [named[q] for q in np.flatnonzero(effects.matters[:-1]).tolist()]
    touched = [named[q] for q in np.flatnonzero(effects.touches[:-1] & (values[:-1] == 0.0)).tolist()]
    return tuple([c for c in moved if c[1] == 0.0] or found or moved or touched)


@remembered
def _constraint_block(plan: SystemPlan) -> Block:
    """The hidden constraints, whose unknowns are the states."""
    return Block(tuple(planned.equation for planned in plan.constraints), plan.states)


def _constraints(plan: SystemPlan, known: Known) -> Iterator[BlockFinding]:
    """Hidden constraints that depend on each other at the state: the projection could not tell them apart."""
    m, values, groups = plan.n_constraints, known.at.values, tuple(planned.equation for planned in plan.constraints)
    if not m or plan.constraint_pattern is None or m > DECOMPOSED_UPTO:
        return
    if any(np.isnan(values[group.quantity]).any() or group.template.opaque is not None for group in groups):
        return
    block = _constraint_block(plan)
    if block.is_evident(known):
        return
    rank, matrix = block.rank(known), block.jacobian(known).toarray()
    if rank is None or (rank.is_regular and rank.condition < ILL_CONDITIONED):
        return
    texts = np.concatenate([group.equation for group in groups])
    dependent = np.flatnonzero(np.abs(rank.null_vectors()[0]).max(axis=1, initial=0.0) > SLIGHT)
    states = np.flatnonzero(np.abs(matrix[dependent]).max(axis=0, initial=0.0) > 0)
    if not len(states):
        states = np.array(sorted({k for r in dependent for k in plan.constraint_pattern[r]}), np.int64)
    at = [(plan.quantity_name[q], float(values[q])) for q in plan.states[states].tolist()]
    names, singular = tuple(name for name, _ in at), not rank.is_regular
    yield BlockFinding(
        condition=rank.condition if rank.is_regular else np.inf,
        singular=singular,
        size=m,
        variables=names,
        equations=tuple(plan.locate(int(texts[e])) for e in dependent),
        causes=tuple(at),
        causes_are_parameters=False,
        undecided=singular and is_undecided(matrix),
    )
