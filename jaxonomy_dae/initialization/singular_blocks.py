"""Blocks that are numerically singular at a point, though their structure is regular.

Given a system, its parameters and a state, each block that could be singular there is examined in NumPy: its Jacobian
is equilibrated, so that units do not matter, and its singular values are compared with rounding. Only the quantities
that some Jacobian depends on are computed.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from ..lowering.plan import SystemPlan
from ..lowering.schedule import SparseStep, Step, StepEquation
from ..model.evaluate_numpy import Networks
from ..model.scaling import equilibrated, geometric_scales
from ..model.tables import ZERO

DENSE_LIMIT = 200  # unknowns up to which a block gets a singular value decomposition
ILL_CONDITIONED = 1e12
TINY = 1e-300
PASSES = 5


@dataclasses.dataclass(frozen=True)
class BlockFinding:
    """A block that is singular, or nearly so: the variables it leaves open, the equations that depend on each other,
    and the parameters and variables that make it so, with their values."""

    condition: float
    singular: bool
    size: int
    variables: tuple[str, ...]
    equations: tuple[str, ...]
    causes: tuple[tuple[str, float], ...]
    causes_are_parameters: bool


@dataclasses.dataclass(frozen=True)
class _Check:
    """What is static: the steps to examine, and the steps to solve so that they can be."""

    examined: frozenset[int]
    solved: frozenset[int]


@functools.lru_cache(maxsize=64)
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
            for slot in _slots_of_partials(equation):
                source = equation.slots[slot]
                wanted[source.quantity[source.quantity != ZERO]] = True
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


def _local(equation: StepEquation) -> list[int]:
    return [k for k, s in enumerate(equation.slots) if s.local >= 0]


def _never_vanishes(equation: StepEquation) -> bool:
    """Whether the equation's only local unknown has a coefficient that is a nonzero number."""
    positions = _local(equation)
    return len(positions) == 1 and equation.template.coefficient_is_number(positions[0])


def _slots_of_partials(equation: StepEquation) -> list[int]:
    """The slots on which the equation's local partial derivatives depend."""
    return sorted(frozenset().union(*(equation.template.slots_of_partial(p) for p in _local(equation))))


class _Values:
    """All quantities known so far, and the kernels in NumPy."""

    def __init__(self, plan: SystemPlan, parameters, networks: tuple, t: float, x, inputs: Callable[[], np.ndarray]):
        self.plan = plan
        self.parameters = parameters
        self.networks = Networks(networks)
        self.t = t
        self.quantities = np.append(np.full(plan.extended.quantities.n, np.nan), 0.0)  # ZERO is −1: the last entry
        self.quantities[plan.states] = x[: len(plan.states)]
        self.quantities[plan.carried] = x[len(plan.states) :]
        self._inputs = inputs
        self._have_inputs = False

    def slots(self, equation: StepEquation) -> list[np.ndarray]:
        first = self.plan.extended.quantities.n_unknown
        if not self._have_inputs and any((s.quantity >= first).any() for s in equation.slots):
            self.quantities[first:-1] = self._inputs()
            self._have_inputs = True
        return [s.sign * self.quantities[s.quantity] for s in equation.slots]

    def partials(self, equation: StepEquation, parameters: np.ndarray | None = None) -> np.ndarray:
        """∂(residual)/∂(slot), signs included, shape (n, slots)."""
        slots = self.slots(equation)
        n = equation.parameter.shape[0]
        signs = np.stack([s.sign for s in equation.slots], axis=-1)
        p = list((self.parameters if parameters is None else parameters)[equation.parameter].T)
        c = list(equation.coefficient.T)
        with np.errstate(all="ignore"):
            out = equation.template.partial_values(slots, p, c, self.t, self.networks, backend="numpy")
            return np.stack([np.broadcast_to(np.asarray(v, float), (n,)) for v in out], axis=-1) * signs

    def residual(self, equation: StepEquation) -> np.ndarray:
        slots = self.slots(equation)
        p, c = list(self.parameters[equation.parameter].T), list(equation.coefficient.T)
        with np.errstate(all="ignore"):
            out = equation.template.residual(slots, p, c, self.t, self.networks, backend="numpy")
        return np.broadcast_to(np.asarray(out, float), (equation.parameter.shape[0],))

    def jacobian(self, step: Step, parameters: np.ndarray | None = None) -> np.ndarray:
        """Of a step's n blocks, shape (n, k, k)."""
        k = len(step.unknown)
        out = np.zeros((step.n, k, k))
        for e, equation in enumerate(step.equations):
            values = self.partials(equation, parameters)
            for slot in _local(equation):
                out[:, e, equation.slots[slot].local] += values[:, slot]
        return out

    def follow(self, step: Step):
        """What the tearing variables in the state determine."""
        for e, u in step.tearing.sequence:
            equation = step.equations[e]
            (k,) = [k for k in _local(equation) if equation.slots[k].local == u]
            slots, n = self.slots(equation), step.n
            p, c = list(self.parameters[equation.parameter].T), list(equation.coefficient.T)
            out = equation.template.solve(k, slots, p, c, self.t, self.networks, backend="numpy")
            self.quantities[step.unknown[u]] = np.broadcast_to(np.asarray(out, float), (n,)) * equation.slots[k].sign

    def solve(self, step: Step):
        """The unknowns of a linear step."""
        for quantities in step.unknown:
            self.quantities[quantities] = 0.0
        residual = np.stack([self.residual(e) for e in step.equations], axis=-1)
        try:
            with np.errstate(all="ignore"):
                found = np.linalg.solve(self.jacobian(step), -residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            found = np.full(residual.shape, np.nan)
        for u, quantities in enumerate(step.unknown):
            self.quantities[quantities] = found[:, u]


def examine_blocks(
    plan: SystemPlan, parameters, networks: tuple, t: float, x, inputs: Callable[[], np.ndarray]
) -> Iterator[BlockFinding]:
    """The blocks that are singular at a state, or ill-conditioned, in the order they are solved; the first singular
    one ends the search, as nothing after it can be computed.

    **Arguments:**

    - `parameters`, `x`: flat arrays.
    - `inputs`: a function that gives the values of the inputs' quantities; called only if they are needed.
    """
    check = _plan_check(plan)
    if not check.examined and not plan.n_constraints:
        return
    values = _Values(plan, parameters, networks, t, x, inputs)
    eps = np.finfo(float).eps
    for k, step in enumerate(plan.steps):
        if isinstance(step, SparseStep):
            finding = _sparse_finding(plan, values, step)
            if finding is not None:
                yield finding
                if finding.singular:
                    return
            continue
        if step.carried and (k in check.solved or k in check.examined):
            values.follow(step)
        if k in check.examined:
            matrices = values.jacobian(step)
            condition, left, right = _conditions(matrices)
            size = len(step.unknown)
            for b in np.flatnonzero(~(condition < ILL_CONDITIONED)):
                singular = not condition[b] < 1 / (4 * size * eps)
                yield _finding(plan, values, step, int(b), float(condition[b]), singular, left(int(b)), right(int(b)))
                if singular:
                    return
        if k in check.solved and not step.carried:
            values.solve(step)
    yield from _constraints(plan, values)


def _equilibrated(matrix: np.ndarray, passes: int) -> np.ndarray:
    """Matrices (n, rows, columns) with rows and columns scaled to a largest entry near 1 (Ruiz 2001)."""
    matrix = matrix / (np.abs(matrix).max(axis=2, keepdims=True, initial=0.0) + TINY)
    matrix = matrix / (np.abs(matrix).max(axis=1, keepdims=True, initial=0.0) + TINY)
    for _ in range(passes):
        rows, columns = np.abs(matrix).max(axis=2, initial=0.0), np.abs(matrix).max(axis=1, initial=0.0)
        rows, columns = np.sqrt(np.where(rows > 0, rows, 1.0)), np.sqrt(np.where(columns > 0, columns, 1.0))
        matrix = matrix / rows[:, :, None] / columns[:, None, :]
    return matrix


def _conditions(matrices: np.ndarray):
    """The condition number of each matrix, and functions that give the null vectors of one, left and right."""
    n, k, _ = matrices.shape
    if k == 1:
        # A single coefficient has no scale but zero.
        return np.where(matrices[:, 0, 0] == 0, np.inf, 1.0), lambda b: np.ones((1, 1)), lambda b: np.ones((1, 1))
    finite = np.atleast_1d(np.isfinite(matrices).all(axis=(1, 2)))
    # What is not finite has another cause than rank, and is reported as such.
    matrices = np.where(finite[:, None, None], matrices, np.eye(k))
    if k > DENSE_LIMIT:
        condition = np.array([_estimate(a) for a in _equilibrated(matrices, PASSES)])
        return condition, lambda b: np.zeros((k, 0)), lambda b: np.zeros((k, 0))
    scaled = _equilibrated(matrices, 0)
    condition = _ratio(np.linalg.svd(scaled, compute_uv=False))
    if not (condition < ILL_CONDITIONED).all():  # perhaps for want of better scaling
        scaled = _equilibrated(matrices, PASSES)
        condition = _ratio(np.linalg.svd(scaled, compute_uv=False))
    for b in np.flatnonzero(~(condition < ILL_CONDITIONED)):
        r, c = geometric_scales(matrices[b])
        better = _equilibrated((r[:, None] * matrices[b] * c)[None], PASSES)
        least = _ratio(np.linalg.svd(better, compute_uv=False))[0]
        if least < condition[b]:
            scaled[b], condition[b] = better[0], least

    def null(b: int, transposed: bool) -> np.ndarray:
        u, s, vt = np.linalg.svd(scaled[b])
        small = s <= max(s[0], 1e-300) / ILL_CONDITIONED
        return u[:, small] if transposed else vt[small].T

    return condition, lambda b: null(b, True), lambda b: null(b, False)


def _ratio(singular: np.ndarray) -> np.ndarray:
    """Condition numbers from singular values, shape (n, k)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(singular[:, -1] > 0, singular[:, 0] / singular[:, -1], np.inf)


def _estimate(matrix: np.ndarray) -> float:
    """A lower bound of a large block's condition number, by a sparse factorization (Hager 1984)."""
    return _factored(sp.csc_array(matrix))[1]


def _sparse_finding(plan: SystemPlan, values: _Values, step: SparseStep) -> BlockFinding | None:
    """What is wrong with a sparse block, whose unknowns are solved for on the way if it is linear."""
    n = step.n
    column = np.full(len(values.quantities), -1)  # ZERO is −1: the last entry
    column[step.unknown[0]] = np.arange(n)
    texts = np.concatenate([equation.equation for equation in step.equations])
    rows, columns, entries = [], [], []
    if not step.carried:
        values.quantities[step.unknown[0]] = 0.0
    first = 0
    for equation in step.equations:
        partials = values.partials(equation)
        for k, slot in enumerate(equation.slots):
            inside = np.flatnonzero(column[slot.quantity] >= 0)
            rows.append(first + inside)
            columns.append(column[slot.quantity[inside]])
            entries.append(partials[inside, k])
        first += len(equation.equation)
    matrix = sp.csc_array((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))
    if not np.isfinite(matrix.data).all():
        return None  # what is not finite has another cause than rank
    scaled, left_scale, right_scale = equilibrated(matrix)
    factors, condition = _factored(sp.csc_array(scaled))
    if not condition < ILL_CONDITIONED:  # perhaps for want of better scaling
        r, c = geometric_scales(matrix)
        better, more_left, more_right = equilibrated(sp.diags_array(r) @ matrix @ sp.diags_array(c))
        found, least = _factored(sp.csc_array(better))
        if least < condition:
            scaled, factors, condition = better, found, least
            left_scale, right_scale = r * more_left, c * more_right
    scaled = sp.csc_array(scaled)
    if factors is not None and not step.carried:
        residual = np.concatenate([values.residual(e) for e in step.equations])
        values.quantities[step.unknown[0]] = right_scale * factors.solve(-left_scale * residual)
    if condition < ILL_CONDITIONED:
        return None
    left, right = _null_vectors(scaled)
    chosen = np.flatnonzero(np.abs(right) > 1e-3 * np.abs(right).max())
    dependent = np.flatnonzero(np.abs(left) > 1e-3 * np.abs(left).max())
    left, right = left_scale * left, right_scale * right
    names = tuple(plan.quantity_name[int(step.unknown[0][k])] for k in chosen)
    equations = tuple(dict.fromkeys(plan.describe(int(texts[k])) for k in dependent))
    singular = not condition < 1 / (4 * n * np.finfo(float).eps)
    causes = _sparse_causes(plan, values, step, column, left, right) if singular else ()
    return BlockFinding(condition, singular, n, names, equations, causes, bool(causes))


def _factored(matrix: Any) -> tuple[Any, float]:
    """The factors of a sparse matrix, None if it is exactly singular, and an estimate of its condition number."""
    linalg: Any = scipy.sparse.linalg
    try:
        factors = linalg.splu(matrix)
    except RuntimeError:
        return None, np.inf
    inverse = linalg.LinearOperator(matrix.shape, matvec=factors.solve, rmatvec=lambda v: factors.solve(v, trans="T"))
    return factors, float(linalg.onenormest(matrix) * linalg.onenormest(inverse, t=1))


def _null_vectors(matrix: Any) -> tuple[np.ndarray, np.ndarray]:
    """Left and right null vectors of a sparse matrix that is singular, or nearly so, by inverse iteration."""
    n = matrix.shape[0]
    linalg: Any = scipy.sparse.linalg
    shift = 1e-10 * sp.diags_array(1 + np.arange(n) / n)  # regular, whatever the kernel
    factors = linalg.splu(sp.csc_array(matrix + shift))
    left = right = np.ones(n) + np.arange(n) / n
    for _ in range(4):
        right = factors.solve(right)
        left = factors.solve(left, trans="T")
        right, left = right / np.abs(right).max(), left / np.abs(left).max()
    return left, right


def _sparse_causes(
    plan: SystemPlan, values: _Values, step: SparseStep, column: np.ndarray, left: np.ndarray, right: np.ndarray
) -> tuple[tuple[str, float], ...]:
    """The parameters p a change of which makes the block regular: uᵀ·∂J/∂p·v ≠ 0 for the null vectors u and v."""
    effect = np.zeros(len(values.parameters))
    first = 0
    for equation in step.equations:
        u = left[first : first + len(equation.equation)]
        first += len(u)
        columns = [column[slot.quantity] for slot in equation.slots]
        v = np.stack([np.where(c >= 0, right[c], 0.0) for c in columns], axis=-1)
        before = values.partials(equation)
        for j in range(equation.parameter.shape[1]):
            p = equation.parameter[:, j]
            moved = values.parameters.copy()
            moved[p] += 1e-3 * np.where(moved[p] == 0, 1.0, np.abs(moved[p]))
            change = values.partials(equation, moved) - before
            np.add.at(effect, p, u * (change * v).sum(axis=1))
    size = np.abs(np.where(np.isfinite(effect), effect, np.inf))
    found = np.flatnonzero(size > 1e-6 * size.max(initial=0.0))[:DENSE_LIMIT]
    return tuple((plan.flat.parameters.names[p], float(values.parameters[p])) for p in found)


def _finding(plan: SystemPlan, values: _Values, step: Step, b: int, condition, singular, left, right) -> BlockFinding:
    names = [plan.quantity_name[int(u[b])] for u in step.unknown]
    texts = [plan.describe(int(e.equation[b])) for e in step.equations]
    chosen = np.flatnonzero(np.abs(right).max(axis=1, initial=0.0) > 1e-3)
    dependent = np.flatnonzero(np.abs(left).max(axis=1, initial=0.0) > 1e-3)
    variables = tuple(names[u] for u in chosen) or tuple(names)
    equations = tuple(dict.fromkeys(texts[e] for e in dependent)) or tuple(dict.fromkeys(texts))
    causes = _causes(plan, values, step, b, left, right) if singular else ()
    parameters = bool(causes) and causes[0][0] in plan.flat.parameters.names
    return BlockFinding(condition, singular, len(names), variables, equations, causes, parameters)


def _causes(plan: SystemPlan, values: _Values, step: Step, b: int, left, right) -> tuple[tuple[str, float], ...]:
    """The parameters, or else the variables, a change of which makes the block regular: those for which uᵀ·∂J·v ≠ 0 for
    null vectors u and v."""
    before = values.jacobian(step)[b]

    def matters(after: np.ndarray, anyhow: bool = False) -> bool:
        change = after - before
        if not np.isfinite(change).all():
            return True
        scale = np.abs(change).max(initial=0.0)
        if scale == 0.0:
            return False
        return anyhow or not left.shape[1] or bool(np.abs(left.T @ (change / scale) @ right).max() > 1e-9)

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
    sources = {int(e.slots[s].quantity[b]) for e in step.equations for s in _slots_of_partials(e)} - {ZERO}
    for q in sorted(sources):
        kept = values.quantities[q]
        values.quantities[q] = kept + 1e-3 * (abs(kept) or 1.0)
        after = values.jacobian(step)[b]
        values.quantities[q] = kept
        name = plan.quantity_name[q]
        named = (name, float(kept) + 0.0)
        if matters(after):
            moved.append(named)
        elif kept == 0.0 and matters(after, anyhow=True):
            touched.append(named)
    return tuple([c for c in moved if c[1] == 0.0] or found or moved or touched)


def _constraints(plan: SystemPlan, values: _Values) -> Iterator[BlockFinding]:
    """Hidden constraints that depend on each other at the state: the projection could not tell them apart."""
    m = plan.n_constraints
    if not m or plan.constraint_pattern is None or m > DENSE_LIMIT:
        return
    place = np.full(len(values.quantities), -1)
    place[plan.states] = np.arange(len(plan.states))
    matrix, texts = np.zeros((m, len(plan.states))), []
    row = 0
    for planned in plan.constraints:
        group = planned.group
        padded = np.append(values.quantities[:-1], 0.0)
        slots = list((group.sign * padded[group.quantity]).T)
        if np.isnan(slots).any() or group.template.opaque is not None:
            return
        p, c = list(values.parameters[group.parameter].T), list(group.coefficient.T)
        with np.errstate(all="ignore"):
            out = group.template.partial_values(slots, p, c, values.t, values.networks, backend="numpy")
        for k, partial in enumerate(out):
            partial = np.broadcast_to(np.asarray(partial, float), (len(group),)) * group.sign[:, k]
            where = place[group.quantity[:, k]]
            inside = np.flatnonzero(where >= 0)
            matrix[row + inside, where[inside]] += partial[inside]
        texts += group.equation.tolist()
        row += len(group)
    if not np.isfinite(matrix).all():
        return
    u, s, condition = _spectrum(matrix)
    if not condition < ILL_CONDITIONED:  # perhaps for want of better scaling
        r, c = geometric_scales(matrix)
        better = _spectrum(r[:, None] * matrix * c)
        if better[2] < condition:
            u, s, condition = better
    if condition < ILL_CONDITIONED:
        return
    dependent = np.flatnonzero(np.abs(u[:, s <= max(s[0], 1e-300) / ILL_CONDITIONED]).max(axis=1, initial=0.0) > 1e-3)
    states = np.flatnonzero(np.abs(matrix[dependent]).max(axis=0, initial=0.0) > 0)
    if not len(states):
        states = np.array(sorted({k for r in dependent for k in plan.constraint_pattern[r]}), np.int64)
    names = tuple(plan.quantity_name[int(plan.states[k])] for k in states)
    singular = condition >= 1 / (4 * m * np.finfo(float).eps)
    at = tuple((name, float(values.quantities[plan.states[k]])) for name, k in zip(names, states, strict=True))
    yield BlockFinding(
        float(condition), singular, m, names, tuple(plan.describe(texts[e]) for e in dependent), at, False
    )


def _spectrum(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Left singular vectors and singular values of the equilibrated matrix, one for each row, and its condition."""
    m = len(matrix)
    u, s, _ = np.linalg.svd(_equilibrated(matrix[None], PASSES if m > 1 else 0)[0])
    s = np.append(s, np.zeros(max(0, m - len(s))))[:m]
    return u, s, np.inf if s[-1] == 0 else float(s[0] / s[-1])
