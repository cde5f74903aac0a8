"""Which starts determine the initial point.

Given the plan, the values a caller names and the parameters to be solved for, returns the rows that are kept beside the
equations: values given and fixed starts, which must hold, and guesses, which need not, as many as it takes to determine
the rest. The choice is a question of rank, asked at a generic point: it reads the structure alone, never the values of
parameters or weights, so that it is right for all of them. A row is independent if it closes a direction that the
equations and the rows before it leave open.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp

from ...base.errors import InitializationError
from ...base.tolerances import HALF_OF_THE_DIGITS, ILL_CONDITIONED, KNOWN, NO_PART, TINY
from ...compile.diagnosis.wording import quoted
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.remembered import remembered
from ...compile.model.declared import declared_scale
from ...compile.model.jacobian import generic_jacobian
from ...compile.model.natural_sizes import natural_sizes
from ...compile.model.opaque import Networks
from ...compile.model.quantities import ABSENT
from ...compile.model.starts import Start
from ...compile.model.tables import ZERO, complete
from ...graph.judgement.rank import DECOMPOSED_UPTO, above_errors
from ...graph.judgement.scaling import balanced, equilibrated
from ...graph.judgement.sparse_rank import sparse_rank_of
from ...graph.structure.dulmage_mendelsohn import left_open
from ...graph.structure.matching import match_in_order
from ...solve.linear.choice import DENSE_UPTO
from .integrated import integrated


@dataclasses.dataclass(frozen=True)
class StartRow:
    """One start: factor·quantity equals a start expression or the caller's value `given`."""

    name: str
    quantity: int
    factor: float
    start: Start | None
    given: int = -1


@dataclasses.dataclass(frozen=True)
class InitialRows:
    """The rows that determine the initial point."""

    guess: tuple[StartRow | None, ...]  # for each entry of the state array, where its first value comes from
    kept: tuple[StartRow, ...]  # rows that must hold, then the guesses
    n_soft: int  # how many of the rows kept, the last ones, are guesses
    independent: tuple[bool, ...]  # of the rows kept, those that no row before determines
    direct: bool  # every kept row is a state and nothing else constrains the states
    redundant: tuple[int, ...]  # rows that must hold, though they follow from others
    settled: tuple[int, ...]  # of these, rows that follow from equations alone: no unknown moves them
    dropped: tuple[StartRow, ...]  # fixed starts that values given by the caller outrank
    unshared: tuple[
        str, ...
    ] = ()  # guesses that gave way to others, where there are too many unknowns for a compromise
    hints: tuple[StartRow, ...] = ()  # declared guesses that others determine: they choose among solutions


@dataclasses.dataclass(frozen=True)
class _Generic:
    """The extended system at a generic point, equilibrated; columns are quantities and then parameters solved for."""

    jacobian: Any  # sparse
    columns: np.ndarray  # by which the columns were multiplied
    values: np.ndarray  # of parameters
    solve_for: tuple[int, ...]
    noise: float  # how far, in the Frobenius norm, the equilibrated Jacobian may be off

    @property
    def n(self) -> int:
        """The number of columns that are quantities."""
        return self.jacobian.shape[1] - len(self.solve_for)

    def row(self, row: StartRow) -> np.ndarray:
        """The gradient of a start row, scaled."""
        out = np.zeros(self.jacobian.shape[1])
        for place, value in self.entries(row):
            out[place] = value
        return out

    def rows(self, rows: Sequence[StartRow]) -> Any:
        """The gradients of start rows, sparse."""
        entries = [(k, place, value) for k, row in enumerate(rows) for place, value in self.entries(row)]
        k, place, value = zip(*entries, strict=True) if entries else ((), (), ())
        return sp.csr_array((value, (k, place)), shape=(len(rows), self.jacobian.shape[1]))

    def entries(self, row: StartRow) -> list[tuple[int, float]]:
        """The columns on which a start row depends, and its gradient there, scaled."""
        # Quantities after the unknown ones are given from outside, as inputs are.
        found = [(row.quantity, 1.0)] if ZERO != row.quantity < self.n else []
        for parameter, slope in self._slopes(row):
            found.append((self.n + self.solve_for.index(parameter), -slope / (row.factor or 1.0)))
        scaled = [(place, value * float(self.columns[place])) for place, value in found]
        largest = max((abs(value) for _, value in scaled), default=TINY)
        return [(place, value / max(largest, TINY)) for place, value in scaled]

    def _slopes(self, row: StartRow) -> list[tuple[int, float]]:
        start = row.start
        if start is None or row.given >= 0 or not set(start.parameters) & set(self.solve_for):
            return []
        with jax.ensure_compile_time_eval():
            values = [jnp.asarray(self.values[k]) for k in start.parameters]
            slopes = jax.grad(lambda v: jnp.asarray(start.template.residual([], v, [], jnp.zeros(()), None)))(values)
            numbers = [float(s) for s in slopes]
        pairs = zip(start.parameters, numbers, strict=True)
        return [(k, slope if np.isfinite(slope) else 1.0) for k, slope in pairs if k in self.solve_for]


@remembered
def initial_rows(plan: SystemPlan, names: tuple[str, ...], solve_for: tuple[int, ...] = ()) -> InitialRows:
    """Chooses the rows for values given of `names`.

    **Raises:**

    - `InitializationError` if parameters are solved for and the values given do not determine them, or do so twice.
    """
    overrides, fixed, declared = _declared(plan, names)
    started = declared | {r.quantity: r for r in overrides}
    entries = [int(q) for q in (*plan.states, *plan.carried)]
    guess = tuple(started.get(q) for q in entries)
    inside = set(plan.states.tolist())
    rows = [*overrides, *fixed]
    others = [started[q] for q in sorted(started.keys() - {*entries, ZERO})]
    # Questions of rank cost a decomposition. Where states are free and starts are states, there is nothing to ask.
    free = not plan.n_constraints and not len(plan.carried) and not solve_for
    ranks = _ranks(plan, guess, others) if others or not free else None
    if free and all(r.quantity in inside for r in rows) and (ranks is None or _are_states(ranks, inside)):
        held: set[int] = set()
        again = []  # starts of variables that equal one with a start of its own
        for k, r in enumerate(rows):
            if r.quantity in held:
                again.append(k)
            held.add(r.quantity)
        independent = tuple(k not in again for k in range(len(rows)))
        return InitialRows(
            guess=guess, kept=tuple(rows), n_soft=0, independent=independent, direct=True, redundant=tuple(again),
            settled=(), dropped=(),
        )  # fmt: skip
    generic = _generic(plan, solve_for)
    judge = _by_rank if generic.jacobian.shape[1] <= DECOMPOSED_UPTO else _by_matching
    closes, follows, soft, unshared, hints = judge(plan, generic, rows, ranks or _ranks(plan, guess, others))
    # What the caller gave outranks other starts, unless these follow whatever is given.
    is_dropped = [
        bool(overrides) and r.given < 0 and not c and not f for r, c, f in zip(rows, closes, follows, strict=True)
    ]
    kept = [k for k, gone in enumerate(is_dropped) if not gone]
    return InitialRows(
        guess=guess,
        kept=(*(rows[k] for k in kept), *(row for row, _ in soft)),
        n_soft=len(soft),
        independent=(*(closes[k] for k in kept), *(alone for _, alone in soft)),
        direct=False,
        redundant=tuple(place for place, k in enumerate(kept) if not closes[k]),
        settled=tuple(place for place, k in enumerate(kept) if follows[k]),
        dropped=tuple(row for row, gone in zip(rows, is_dropped, strict=True) if gone),
        unshared=unshared,
        hints=hints,
    )


def _declared(plan: SystemPlan, names: tuple[str, ...]) -> tuple[list[StartRow], list[StartRow], dict[int, StartRow]]:
    """Values given, fixed starts they leave, and the start of each quantity that counts."""
    variables = plan.flat.variables
    overrides = [
        StartRow(name, int(q), float(s), None, k)
        for k, (name, q, s) in enumerate(zip(names, *plan.resolve(names), strict=True))
    ]
    overridden = {r.quantity for r in overrides}
    is_zero, leading = variables.start.is_zero, set(plan.leading.tolist())
    started: dict[int, StartRow] = {}
    fixed: list[StartRow] = []
    quantity, factor = plan.variable_map.quantity, plan.variable_map.factor
    # A start of what is identically zero says nothing if it is zero, too; a fixed one must turn out to be so.
    tells = (quantity != ABSENT) & ((quantity != ZERO) | (variables.fixed & ~is_zero))
    chosen = np.flatnonzero(variables.start.is_given & tells)
    columns = (chosen, quantity[chosen], factor[chosen], variables.fixed[chosen])
    starts = variables.start.of(chosen)
    for v, q, s, is_fixed, start in zip(*(c.tolist() for c in columns), starts, strict=True):
        row = StartRow(variables.names[v], q, s, start)
        if is_fixed and q not in overridden:
            fixed.append(row)
        if v in leading:
            started[q] = row
    return overrides, fixed, started


@remembered
def _generic(plan: SystemPlan, solve_for: tuple[int, ...]) -> _Generic:
    """Reads no values of parameters and no starts, which equal plans need not share."""
    extended = plan.extended
    n = extended.quantities.n_unknown
    size = declared_scale(plan.model)
    n_parameters = len(plan.flat.parameters)
    # Rank is asked at a generic point: at the declared starts, a derivative that happens to vanish there, as of a
    # pendulum at its lowest point, would make a row look dependent.
    parameter_size = np.ones(n_parameters)
    if n <= DECOMPOSED_UPTO:  # parameters, as generic numbers, would make some equations stiff beside others
        none = np.zeros(n_parameters)
        size, parameter_size = natural_sizes(extended.groups, extended.n_equations, size, none, by_terms=True)
    else:
        size = np.where(size == 0.0, 1.0, size)
    jacobian, errors, point, values = generic_jacobian(extended, size, parameter_size)
    errors = errors[:, :n]
    jacobian = above_errors(jacobian[:, :n], errors)
    if solve_for:
        jacobian = sp.hstack([jacobian, sp.csr_array(_parameter_columns(plan, point, values, solve_for))], format="csr")
    # Directions that are open must not look closed because of units. Beyond the limit only the pattern is read.
    scales = balanced if n + len(solve_for) <= DECOMPOSED_UPTO else equilibrated
    scaled, rows, columns = scales(jacobian)
    known: Any = sp.csr_array(sp.diags_array(rows) @ errors @ sp.diags_array(columns[:n]))
    noise = np.hypot(np.linalg.norm(known.data), KNOWN * np.linalg.norm(scaled.data))
    return _Generic(scaled, columns, values, solve_for, float(noise))


def _pivoted(jacobian: np.ndarray, noise: float) -> tuple[np.ndarray, int, float]:
    """An orthogonal basis whose first `rank` columns span the rows, that rank, and the least pivot that counts: one
    that is not below what the matrix may be off by."""
    factors: Any = scipy.linalg.qr(jacobian.T, pivoting=True)
    q, r, _ = factors
    pivots = np.abs(np.diag(r))
    rank = int((pivots > noise).sum())
    return q, rank, float(pivots[:rank].min(initial=1.0))


def _parameter_columns(plan: SystemPlan, point, values, solve_for) -> np.ndarray:
    """∂(equations)/∂(parameters)."""
    extended = plan.extended
    out = np.zeros((extended.n_equations, len(solve_for)))
    everything = functools.partial(complete, plan.flat.parameters.dependents)
    with jax.ensure_compile_time_eval():
        array = jnp.asarray(values)
        units = [jnp.zeros_like(array).at[p].set(1.0) for p in solve_for]
        along = [np.asarray(jax.jvp(everything, (array,), (unit,))[1]) for unit in units]
        for group in extended.groups:
            for j in range(len(solve_for)):
                hit = along[j][group.parameter]
                if group.template.opaque is not None or not hit.any():
                    continue
                slots = [jnp.asarray(s) for s in group.slots(np.append(point, 0.0))]
                given = [jnp.asarray(p) for p in values[group.parameter].T]
                coefficients = [jnp.asarray(c) for c in group.coefficient.T]

                def residual(p, group=group, slots=slots, coefficients=coefficients):
                    time = jnp.zeros((), p[0].dtype)
                    value = group.template.residual(slots, p, coefficients, time, Networks(()))
                    return jnp.broadcast_to(value, (len(group),))

                tangent = [jnp.asarray(h, p.dtype) for h, p in zip(hit.T, given, strict=True)]
                out[group.equation, j] = np.asarray(jax.jvp(residual, (given,), (tangent,))[1])
    # What is not real at the generic point depends on the parameter all the same.
    return np.where(np.isfinite(out), out, 1.0)


@dataclasses.dataclass(frozen=True)
class _Rank:
    """Guesses that count equally: all that are open share what is open, or each takes what is left, in order."""

    rows: tuple[StartRow, ...]
    shares: bool


def _ranks(plan: SystemPlan, guess: Sequence[StartRow | None], others: Sequence[StartRow]) -> list[_Rank]:
    """Guesses in the order in which they count: what is declared before the zeros of states and of algebraic unknowns
    without a start, and quantities that the model integrates before all others. `others` are declared starts of what is
    neither state nor unknown."""
    entries = [int(q) for q in (*plan.states, *plan.carried)]
    inside = integrated(plan)
    declared = [*(row for row in guess if row is not None), *others]
    zeros = [
        StartRow(plan.quantity_name[q], q, 1.0, None) for q, row in zip(entries, guess, strict=True) if row is None
    ]
    states = set(plan.states.tolist())
    return [
        # Guesses of what the model integrates count first whichever of them became states: that depends on the order of
        # declaration and on what else is asked of the model.
        _Rank(tuple(row for row in declared if inside[row.quantity]), True),
        _Rank(tuple(row for row in declared if not inside[row.quantity]), True),
        _Rank(tuple(row for row in zeros if row.quantity in states), False),
        _Rank(tuple(row for row in zeros if row.quantity not in states), False),
    ]


def _are_states(ranks: Sequence[_Rank], states: set[int]) -> bool:
    """True if the guesses that determine the point are those of the states, and of nothing else."""
    left = set(states)
    for rank in ranks:
        quantities = {row.quantity for row in rank.rows}
        if left and not quantities <= states:
            return False
        left -= quantities
    return True


class _Judged(NamedTuple):
    """Of rows that must hold, those that close a direction, and those that follow from equations alone; guesses, and
    whether each closes a direction; guesses that gave way, though they should share; declared guesses that rows before
    theirs determine."""

    closes: list[bool]
    follows: list[bool]
    soft: list[tuple[StartRow, bool]]
    unshared: tuple[str, ...] = ()
    hints: tuple[StartRow, ...] = ()


class _Directions:
    """The directions that equations leave open, shape (columns, freedom), closed one by one.

    A basis of them is off by what the equations are off by, over the least pivot so far (a perturbation bound of null
    spaces; Golub & Van Loan 2013, section 8.6): a row that has less along them than that says nothing about them.
    """

    def __init__(self, generic: _Generic):
        q, rank, self._pivot = _pivoted(generic.jacobian.toarray(), generic.noise)
        self.free = q[:, rank:]
        self._noise = generic.noise

    @property
    def error(self) -> float:
        """How far the open directions may be off."""
        return self._noise / self._pivot

    def open(self, gradient: np.ndarray) -> bool:
        """True if a row of this gradient is not determined yet."""
        return bool(np.linalg.norm(gradient @ self.free) > self.error)

    def close(self, gradient: np.ndarray) -> bool:
        """Closes a direction by a row of this gradient; False if it closes none."""
        along = gradient @ self.free
        size = float(np.linalg.norm(along))
        if not size > self.error:
            return False
        self._pivot = min(self._pivot, size)
        # A Householder reflection turns the direction into the first column, which is left out.
        along = along / size
        reflector = along.copy()
        reflector[0] += np.copysign(1.0, along[0])
        reflector /= np.linalg.norm(reflector)
        self.free = (self.free - 2 * np.outer(self.free @ reflector, reflector))[:, 1:]
        return True


def _by_rank(plan: SystemPlan, generic: _Generic, hard: Sequence[StartRow], ranks: Sequence[_Rank]) -> _Judged:
    """The choice of rows for few quantities: each closes a direction that those before it leave open, or none."""
    directions = _Directions(generic)
    # Asked before any row closes a direction: these follow from the equations alone, and not from other starts.
    follows = [not directions.open(generic.row(row)) for row in hard]
    closes = [directions.close(generic.row(row)) for row in hard]
    soft: list[tuple[StartRow, bool]] = []
    hints: list[StartRow] = []
    held, order = {row.quantity for row in hard}, plan.extended.quantities.order
    for rank in ranks:
        gradients = [generic.row(dataclasses.replace(row, start=None)) for row in rank.rows]
        # All guesses of a rank are asked before one of them closes a direction. Otherwise the first of two that share a
        # freedom would hold, and the other would not count: the order of declaration would decide.
        undecided = [directions.open(gradient) for gradient in gradients]
        for row, gradient, is_open in zip(rank.rows, gradients, undecided, strict=True):
            alone = is_open and directions.close(gradient)
            if alone or (is_open and rank.shares):
                soft.append((row, alone))
            # Derivatives of constraints are linear in what has the highest order: there is nothing to choose.
            elif (
                rank.shares and not is_open and gradient.any() and row.quantity not in held and not order[row.quantity]
            ):
                hints.append(row)
    if generic.solve_for:
        redundant = [row for row, alone in zip(hard, closes, strict=True) if not alone]
        _check_count(plan, generic, directions, redundant, [*hard, *(row for row, _ in soft)])
    return _Judged(closes, follows, soft, hints=tuple(hints))


def _by_matching(plan: SystemPlan, generic: _Generic, hard: Sequence[StartRow], ranks: Sequence[_Rank]) -> _Judged:
    """The choice of rows for many quantities: a row is independent if it can be matched with a quantity beside the
    equations and the rows before it, and if numbers do not say otherwise."""
    guesses, n = [row for rank in ranks for row in rank.rows], len(hard)
    n_equations, n_columns = generic.jacobian.shape
    gradients = generic.rows([*hard, *(dataclasses.replace(row, start=None) for row in guesses)])
    pointer = np.concatenate([generic.jacobian.indptr, generic.jacobian.nnz + gradients.indptr[1:]])
    columns = np.concatenate([generic.jacobian.indices, gradients.indices]).astype(np.int64)
    # Matching tells which rows are independent for almost all numbers, in a time near the size of the model. What the
    # numbers at hand say otherwise is found by `_exchanged`.
    column = match_in_order(pointer, columns, n_columns, n_equations)
    shares = _sharing(pointer, columns, column, n_equations + n, ranks, n_columns)
    matched, settled, unshared = column[n_equations:] >= 0, np.zeros(0, np.int64), np.zeros(len(guesses), bool)
    # The point nearest to all guesses is found by dense algebra: with many unknowns each takes what is left, in order.
    if plan.n_state > DENSE_UPTO:
        shares, unshared = unshared, shares & ~matched[n:]
    missing = n_columns - n_equations - int(matched.sum())
    if not missing:
        matched, settled = _exchanged(generic, gradients, matched, n)
    closes = matched.tolist()
    if generic.solve_for and (missing or any(row.given >= 0 and not c for row, c in zip(hard, closes, strict=False))):
        unknown = quoted([plan.flat.parameters.names[p] for p in generic.solve_for])
        what = "too few" if missing else "too many"
        raise InitializationError(f"solve_for: {what} values in initial={{...}} to determine {unknown}")
    return _Judged(
        closes[:n],
        np.isin(np.arange(n), settled).tolist(),
        [(row, c) for row, c, shared in zip(guesses, closes[n:], shares.tolist(), strict=True) if c or shared],
        tuple(row.name for row, gone in zip(guesses, unshared.tolist(), strict=True) if gone),
    )


def _sharing(
    pointer: np.ndarray, columns: np.ndarray, matched: np.ndarray, first: int, ranks: Sequence[_Rank], n: int
) -> np.ndarray:
    """True for guesses that share what rows before their rank leave open, shape (guesses,); `matched` is the column of
    every row, `first` the number of the first guess."""
    shares, row = [np.zeros(0, bool)], np.repeat(np.arange(len(matched)), np.diff(pointer))
    for rank in ranks:
        last, inside = first + len(rank.rows), slice(None, pointer[first])
        is_open = left_open(row[inside], columns[inside], matched[:first], n)
        shares.append(is_open[[r.quantity for r in rank.rows]] if rank.shares else np.zeros(len(rank.rows), bool))
        first = last
    return np.concatenate(shares)


def _exchanged(generic: _Generic, gradients: Any, chosen: np.ndarray, hard: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that numbers do not make dependent. Given are the gradients of all rows, and those `chosen` so that the
    equations and they can be matched with all quantities. Returns the rows to be chosen, and of the
    first `hard` those that follow from the equations alone.

    While the matrix of equations and chosen rows is singular, the last row of a combination that vanishes gives way to
    the first one that closes the direction that is left open: so each is independent of those before it, as if they had
    been taken one after the other.
    """
    chosen, n_equations = chosen.copy(), generic.jacobian.shape[0]
    for _ in range(len(chosen)):
        inside = np.flatnonzero(chosen)
        matrix = sp.csr_array(sp.vstack([generic.jacobian, gradients[inside]]))
        rank = sparse_rank_of(matrix, KNOWN * abs(matrix))
        if rank.is_regular:
            outside = np.flatnonzero(~chosen[:hard])
            weights = _weights_of(rank, gradients[outside], n_equations)
            return chosen, outside[~weights.any(axis=1)] if len(outside) else outside
        left, right = (vectors[:, 0] for vectors in rank.null_vectors())
        if np.abs(left @ rank.scaled).max() > HALF_OF_THE_DIGITS or np.abs(rank.scaled @ right).max() > (
            HALF_OF_THE_DIGITS
        ):
            break  # ill-conditioned, which makes no row follow from others
        weight, open_ = np.abs(left[n_equations:]), np.abs(gradients @ (rank.c * right))
        part = inside[weight > NO_PART * np.abs(left).max()]
        closes = np.flatnonzero(~chosen & (open_ > NO_PART * open_.max(initial=0.0)))
        if not len(part) or not len(closes):
            break
        chosen[part[-1]] = False
        chosen[next((k for k in closes.tolist() if k != part[-1]), part[-1])] = True
    return chosen, np.zeros(0, np.int64)


def _weights_of(rank: Any, gradients: Any, n_equations: int) -> np.ndarray:
    """True where a chosen row has a part in another row, as a combination of chosen rows and equations; shape (rows,
    chosen)."""
    out = np.zeros((gradients.shape[0], len(rank.r) - n_equations), bool)
    for k in range(gradients.shape[0]):
        weight = np.abs(rank.factors.solve(gradients[[k]].toarray()[0] * rank.c, trans="T"))
        out[k] = weight[n_equations:] > NO_PART * max(weight.max(initial=0.0), TINY)
    return out


# --- what follows from what ----------------------------------------------------------------------------------------


def supports(
    plan: SystemPlan, names: tuple[str, ...], solve_for: tuple[int, ...] = ()
) -> dict[int, tuple[StartRow, ...]]:
    """For each redundant row, by its place among the rows kept, the other rows it follows from together with the
    equations."""
    rows = initial_rows(plan, names, solve_for)
    if rows.direct:
        return {k: (next(r for r in rows.kept if r.quantity == rows.kept[k].quantity),) for k in rows.redundant}
    if not rows.redundant:
        return {}
    generic = _generic(plan, solve_for)
    hard = len(rows.kept) - rows.n_soft
    base = [r for r, alone in zip(rows.kept[:hard], rows.independent[:hard], strict=True) if alone]
    if generic.jacobian.shape[1] <= DECOMPOSED_UPTO:
        return {k: _support(generic, rows.kept[k], base)[0] for k in rows.redundant}
    alone = [r for r, alone in zip(rows.kept, rows.independent, strict=True) if alone]
    matrix: Any = sp.csr_array(sp.vstack([generic.jacobian, generic.rows(alone)]))
    rank = sparse_rank_of(matrix, KNOWN * abs(matrix)) if matrix.shape[0] == matrix.shape[1] else None
    if rank is None or not rank.is_regular:
        return {k: () for k in rows.redundant}
    gradients = generic.rows([rows.kept[k] for k in rows.redundant])
    used = _weights_of(rank, gradients, generic.jacobian.shape[0])
    return {
        k: tuple(r for r, u in zip(alone, row, strict=True) if u and r in base)
        for k, row in zip(rows.redundant, used, strict=True)
    }


def _support(generic: _Generic, row: StartRow, base: list[StartRow]) -> tuple[tuple[StartRow, ...], np.ndarray]:
    """The rows of `base`, and the equations, of which a row is a combination."""
    matrix = np.concatenate([generic.jacobian.toarray(), *(generic.row(r)[None, :] for r in base)])
    weight = np.abs(np.linalg.lstsq(matrix.T, generic.row(row), rcond=1 / ILL_CONDITIONED)[0])
    used = weight > NO_PART * max(weight.max(initial=0.0), TINY)
    n = generic.jacobian.shape[0]
    return tuple(r for r, u in zip(base, used[n:], strict=True) if u), np.flatnonzero(used[:n])


def _check_count(
    plan: SystemPlan, generic: _Generic, directions: _Directions, redundant: list[StartRow], kept: list[StartRow]
):
    """Raises if the values given do not determine the parameters that are solved for, or determine one twice."""
    table = plan.flat.parameters
    wanted = [table.names[p] for p in generic.solve_for]
    given = [r for r in redundant if r.given >= 0]
    if given:
        base = [r for r in kept if r not in redundant]
        equations: set[int] = set()
        for row in given:
            equations |= set(_support(generic, row, base)[1].tolist())
        found = _parameters_of(plan, sorted(equations), set(generic.solve_for))
        others = f", or solve for one more parameter ({quoted(found)})" if found else ""
        more = "a value" if len(given) == 1 else f"{len(given)} values"
        raise InitializationError(
            f"solve_for: {more} too many for {len(wanted)} unknown parameter{'s' * (len(wanted) > 1)} "
            f"({quoted(wanted)}): {quoted([r.name for r in given])} follow{'s' * (len(given) == 1)} from the others. "
            f"Leave {'it' if len(given) == 1 else 'them'} out{others}."
        )
    left = np.linalg.norm(directions.free[generic.n :], axis=1)
    undetermined = [w for w, size in zip(wanted, left, strict=True) if size > directions.error]
    if undetermined:
        missing = directions.free.shape[1]
        moving = np.linalg.norm(directions.free[: generic.n], axis=1)
        pinned = {r.quantity for r in kept}
        free = [q for q in np.flatnonzero(moving > directions.error).tolist() if q not in pinned]
        candidates = [plan.quantity_name[q] for q in free if plan.is_visible(q)]
        if candidates:
            hint = f"Give {'one' if missing == 1 else missing} of: {quoted(candidates)}"
        else:
            hint = "No variable depends on it at the initial point: leave it out of solve_for"
        raise InitializationError(
            f"solve_for: {missing} value{'s' * (missing > 1)} too few: nothing determines {quoted(undetermined)}. "
            f"{hint}, in initial={{...}} or as a fixed start."
            if candidates
            else f"solve_for: nothing determines {quoted(undetermined)}. {hint}."
        )


def _parameters_of(plan: SystemPlan, equations: list[int], without: set[int]) -> list[str]:
    """The parameters in some extended equations, by name, in the order of declaration."""
    found: set[int] = set()
    chosen = np.zeros(plan.extended.n_equations, bool)
    chosen[equations] = True
    for group in plan.extended.groups:
        found |= set(group.parameter[chosen[group.equation]].ravel().tolist())
    table = plan.flat.parameters
    return [table.names[p] for p in sorted(found - without) if p not in table.expressions]
