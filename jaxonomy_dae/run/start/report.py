"""What initialization did, in user names: for `system.initialization_report()`, and for the text of its errors."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.sparse as sp

from ...base.tolerances import DIGIT, HALF_OF_THE_DIGITS, ILL_CONDITIONED, KNOWN, TINY, ridge, solved
from ...compile.diagnosis.lost_cancellation import lost_cancellation
from ...compile.diagnosis.redundant_constraints import DependentConstraints, ModelAt, dependent_constraints, no_freedom
from ...compile.diagnosis.wording import listed, quoted
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.remembered import remembered
from ...compile.model.tables import ZERO
from ...graph.judgement.sparse_rank import sparse_rank_of
from ..system.input_values import input_values
from ..system.sections import SHOWN, Sections, some
from .constraints_at import constraints_at
from .initialize import InitialPoint, is_consistent, slopes_at_guess
from .integrated import integrated
from .ladder import FAILED, METHODS, NEAREST
from .rows import InitialRows, StartRow, initial_rows, supports
from .singular_blocks import BlockFinding, examine_blocks
from .sparse_newton import sparse_rows

WORST = 5  # rows that do not hold, in a text
# A point is known to half of the digits, so that constraints which depend on each other may show no more than this
# condition number. From here on they are asked whether they are redundant.
SUSPICIOUS = 1 / HALF_OF_THE_DIGITS


class Guess(NamedTuple):
    """A state that nothing fixes: where the search began, and the value found."""

    name: str
    guess: float
    value: float

    @property
    def moved(self) -> float:
        return self.value - self.guess


class Redundant(NamedTuple):
    """A start that the equations and other starts determine: pairs of name and value. `arguments` are the parameters
    of components that fix these starts, where there is one for each."""

    name: str
    value: float
    follows_from: tuple[tuple[str, float], ...]
    agrees: bool
    arguments: tuple[str, ...] = ()


class Residual(NamedTuple):
    """An equation or a start that does not hold, the variables in it, and by how much."""

    text: str
    variables: tuple[str, ...]
    value: float
    is_start: bool = False


class InitializationReport(Sections):
    """A report of initialization; `print(report)` shows it.

    - `consistent`: whether a point was found at which everything holds.
    - `method`: the rung of the ladder that found it, `evaluations` how many residuals it took.
    - `fixed`: starts that hold, as pairs of name and value: values given come first, then declared ones.
    - `guesses`: states that nothing fixes, and how far each moved.
    - `redundant`: starts that follow from others, and whether they agree.
    - `outranked`: names of fixed starts that gave way to values of the caller's.
    - `solved`: parameters solved for, as pairs of name and value.
    - `residuals`: what does not hold, worst first; empty if the point is consistent.
    - `blocks`: blocks of equations that are singular at the point, or ill-conditioned.
    - `notes`.
    """

    def __init__(
        self, system: Any, found: InitialPoint, t0: Any, inputs: Any, initial: Any, solve_for: tuple[str, ...] = ()
    ):
        self._system, self._found, self._inputs = system, found, inputs
        self._t0, self._initial, self._solve_for = t0, initial, solve_for
        self._plan: SystemPlan = system.plan
        table = system.parameters.table
        self._key = (self._plan, tuple(sorted(initial or ())), tuple(table.index(n) for n in solve_for))
        self._rows = initial_rows(*self._key)
        self.time = float(t0)
        self.method = METHODS[int(found.method)]
        self.evaluations = int(found.evaluations)
        self.outranked = [row.name for row in self._rows.dropped]
        self.solved = [(n, float(v)) for n, v in zip(solve_for, np.asarray(found.solved), strict=True)]
        self._residual = np.asarray(found.residual, float)
        self._target = np.asarray(found.target, float)[len(self._residual) - len(self._rows.kept) :]
        self._x = np.asarray(found.x, float)
        self._limit = np.asarray(found.limit, float)
        self._relative = solved(found.x.dtype)
        self.consistent = bool(is_consistent(found))

    # --- starts ------------------------------------------------------------------------------------------------

    @property
    def _promoted(self) -> int:
        """The number of guesses among the rows kept; they are the last ones."""
        return self._rows.n_soft

    @functools.cached_property
    def fixed(self) -> list[tuple[str, float]]:
        kept = self._rows.kept[: len(self._rows.kept) - self._promoted]
        redundant = set(self._rows.redundant)
        return [(r.name, float(self._target[k])) for k, r in enumerate(kept) if k not in redundant]

    @functools.cached_property
    def guesses(self) -> list[Guess]:
        plan, rows = self._plan, self._rows
        n = len(rows.kept) - self._promoted
        held = {r.quantity for r in rows.kept[:n]}
        parameters = np.asarray(self._system.numbers, float)
        out = []
        entries = [int(q) for q in (*plan.states, *plan.carried)]
        moved = self._residual[len(self._residual) - len(rows.kept) :]
        for k in range(n, len(rows.kept)):
            if rows.kept[k].quantity not in entries:
                guess = float(self._target[k])
                out.append(Guess(rows.kept[k].name, guess, guess + float(moved[k])))
        others = [row for row in rows.hints if row.quantity not in entries]
        if others:
            names = [row.name for row in others]
            values = np.asarray(self._system.observe(names, self.time, self._found.x, self._inputs), float)
            given = [0.0 if row.start is None else row.start.value(parameters) for row in others]
            out += [Guess(*guess) for guess in zip(names, given, values.tolist(), strict=True)]
        for k, q in enumerate(entries):
            if q in held:
                continue
            row = rows.guess[k]
            guess = 0.0
            if row is not None and row.given < 0 and row.start is not None:
                guess = row.start.value(parameters) / row.factor
            name = plan.quantity_name[q]
            # A sum with zero turns −0 into 0, as it is printed.
            out.append(Guess(name, guess + 0.0, float(self._x[k]) + 0.0))
        return out

    @functools.cached_property
    def redundant(self) -> list[Redundant]:
        rows = self._rows
        if not rows.redundant:
            return []
        position = {(r.name, r.given): k for k, r in enumerate(rows.kept)}

        def value(row: StartRow) -> tuple[str, float]:
            return row.name, float(self._target[position[row.name, row.given]])

        out = []
        first = len(self._residual) - len(rows.kept)
        for k, others in supports(*self._key).items():
            involved = [k, *(position[o.name, o.given] for o in others)]
            chosen = [first + j for j in involved]
            agrees = bool((np.abs(self._residual[chosen]) <= self._limit[chosen]).all())
            name, number = value(rows.kept[k])
            arguments = self._arguments([rows.kept[k], *others])
            out.append(Redundant(name, number, tuple(value(o) for o in others), agrees, arguments))
        return out

    def _arguments(self, starts: Sequence[StartRow]) -> tuple[str, ...]:
        """The parameters that are the declared starts of these rows; none if one of them has another kind of start."""
        flat = self._plan.flat
        found = []
        for row in starts:
            names = [flat.parameters.names[p] for p in (row.start.parameters if row.start else ())]
            # A component's own parameter, which is the start of nothing else that it fixes.
            if len(names) != 1 or names[0].rpartition(".")[0] != row.name.rpartition(".")[0]:
                return ()
            found += names
        return tuple(dict.fromkeys(found))

    # --- starts that do not hold -------------------------------------------------------------------------------

    @functools.cached_property
    def warnings(self) -> list[str]:
        """Texts about starts that a component declares and that do not hold: fixed ones that gave way to values given,
        and guesses of what the model integrates that told no more than no guess would have, as they lie as far from the
        value found as zero does."""
        return [*self._warning_of_outranked(), *self._warning_of_guesses()]

    def _warning_of_outranked(self) -> list[str]:
        rows = self._rows.dropped
        if not rows:
            return []
        parameters = np.asarray(self._system.numbers, float)
        values = np.asarray(self._system.observe(self.outranked, self.time, self._found.x, self._inputs), float)
        declared = [row.start.value(parameters) for row in rows if row.start is not None]
        starts = [Guess(*one) for one in zip(self.outranked, declared, values.tolist(), strict=True)]
        left = [
            f"'{g.name}' = {g.value:.6g}, declared {g.guess:.6g}"
            for g, row in zip(starts, rows, strict=True)
            if not (self._is_kept(g) or abs(g.moved) <= self._rounding(row.quantity))
        ]
        return [outranked(self._rows, left)] if left else []

    def _warning_of_guesses(self) -> list[str]:
        place, quantity, variable, factor = _guessed(*self._key)
        if not len(place):
            return []
        guess = self._plan.flat.variables.start.values(np.asarray(self._system.numbers, float))[variable] / factor
        value, rounding = self._x[place], KNOWN * np.asarray(self._system.typical_sizes)[quantity]
        left = (np.abs(guess) > rounding) & (np.abs(value - guess) >= (1 - self._relative) * np.abs(guess))
        if not left.any() or self._is_the_only_solution:
            return []
        names = self._plan.quantity_name
        said = [f"'{names[int(quantity[k])]}' = {value[k]:.6g}, guessed {guess[k]:.6g}" for k in np.flatnonzero(left)]
        return [
            f"the start is far from what is guessed: {', '.join(said)}. If this is another solution than the one that "
            "is meant, give better guesses, or fix one of them"
        ]

    @property
    def _is_the_only_solution(self) -> bool:
        """True if the slopes of the equations are the same at the guesses and at the solution, as those of linear
        equations are: then guesses choose nothing. Of large models this is not looked at, and nothing is said."""
        there = self._found.jacobian
        if there is None or np.ndim(there) != 2:
            return True
        there = np.asarray(there, float)
        begun = slopes_at_guess(self._system, self._t0, self._inputs, self._initial, self._solve_for)[: len(there)]
        size = np.abs(there).max(axis=1, keepdims=True, initial=0.0)
        return bool((np.abs(begun - there) <= HALF_OF_THE_DIGITS * size).all())

    def _rounding(self, quantity: int) -> float:
        """The size at which a number of this quantity is rounding beside others of the model."""
        return KNOWN * float(self._system.typical_sizes[quantity]) if quantity != ZERO else 0.0

    def _is_kept(self, g: Guess) -> bool:
        return abs(g.moved) <= self._relative * max(abs(g.value), abs(g.guess))

    # --- residuals ---------------------------------------------------------------------------------------------

    @functools.cached_property
    def residuals(self) -> list[Residual]:
        if self.consistent:
            return []
        size = np.abs(self._residual)
        ratio = size / np.maximum(self._limit, np.finfo(float).tiny)
        order = np.argsort(np.where(np.isfinite(ratio), -ratio, -np.inf), kind="stable")
        described = self._described()
        chosen = [int(k) for k in order if not size[k] <= self._limit[k]]
        equations = len(self._residual) - len(self._rows.kept)
        return [Residual(*described[k], float(self._residual[k]), is_start=k >= equations) for k in chosen]

    def _described(self) -> list[tuple[str, tuple[str, ...]]]:
        """The text and the variables of every row, as `initialize` orders them."""
        plan = self._plan
        starts = [
            (f"start of {r.name}, {v:.6g}", (r.name,)) for r, v in zip(self._rows.kept, self._target, strict=True)
        ]
        if self._rows.direct:
            return starts
        out = []
        for planned in plan.constraints:
            for e, q in zip(planned.equation.equation, planned.equation.quantity, strict=True):
                out.append((plan.locate(int(e)), self._names(q)))
        for step in plan.steps:
            if step.carried:
                for equation in step.left:
                    for b in range(len(equation.equation)):
                        names = self._names(equation.quantity[b])
                        out.append((plan.locate(int(equation.equation[b])), names))
        return out + starts

    def _names(self, quantities: np.ndarray) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self._plan.quantity_name[int(q)] for q in quantities if q != ZERO))

    # --- blocks ------------------------------------------------------------------------------------------------

    @functools.cached_property
    def blocks(self) -> list[BlockFinding]:
        return [b for b in self._suspected if not b.condition < ILL_CONDITIONED]

    @functools.cached_property
    def _suspected(self) -> list[BlockFinding]:
        """Blocks that are singular, ill-conditioned, or so far from well-conditioned that redundancy may be why."""
        return list(self._examine()) if self.consistent else []

    def _examine(self):
        with jax.ensure_compile_time_eval():
            # If parameters were solved for, the system's typical sizes belong to the values before, and are found anew.
            sizes = None if self.solved else np.asarray(self._system.typical_sizes, float)
            yield from examine_blocks(self._plan, *self._numbers(), self.time, self._x, self._read, sizes, SUSPICIOUS)

    def _numbers(self) -> tuple[np.ndarray, tuple]:
        """All parameters, those solved for included, and the networks' weights."""
        system = self._system
        parameters = system.numbers
        if self.solved:
            table = system.parameters.table
            index = np.array([table.index(n) for n, _ in self.solved])
            parameters = table.complete(parameters.at[index].set(self._found.solved))
        return np.asarray(parameters, float), tuple(system.neural[n] for n in self._plan.network_names)

    def _read(self) -> np.ndarray:
        """The values of the inputs' quantities."""
        dtype = self._system.numbers.dtype
        return np.array(input_values(self._plan, self._inputs, self.time, dtype), float)

    @functools.cached_property
    def _constraints(self) -> ModelAt | None:
        """The model at the point, for questions about its constraints; None if it has none, or too many."""
        with jax.ensure_compile_time_eval():
            return constraints_at(self._plan, *self._numbers(), self.time, self._x, self._read)

    @functools.cached_property
    def _dependent(self) -> list[DependentConstraints]:
        return dependent_constraints(self._constraints) if self._constraints is not None else []

    @functools.cached_property
    def _condition(self) -> float | None:
        """The condition number of the initial equations, rows and columns scaled."""
        jacobian = self._found.jacobian
        if jacobian is None or not self.consistent or not jacobian.size:
            return None
        matrix = np.asarray(jacobian, float)
        if matrix.ndim == 1:
            sparse = sparse_rows(self._plan, self._rows)
            assert sparse is not None
            places = sparse.square.rows, sparse.square.cols
            square = sp.csr_array((matrix[sparse.inside], places), shape=sparse.square.shape)
            return sparse_rank_of(square, abs(square) * 0.0).condition
        for axis in (1, 0, 1):
            matrix = matrix / np.maximum(np.abs(matrix).max(axis=axis, keepdims=True), TINY)
        s = np.linalg.svd(matrix, compute_uv=False)
        return float(s[0] / s[-1]) if s[-1] > 0 else np.inf

    @functools.cached_property
    def notes(self) -> list[str]:
        out = []
        for block in self.blocks:
            if not block.singular:
                out.append(
                    f"the block of {some(block.variables)} is ill-conditioned, {block.condition:.1e}: about "
                    f"{int(np.log10(block.condition))} digits of its solution are lost"
                )
        if self._suspected and not any(block.singular for block in self._suspected):
            out += [str(found) for found in self._dependent]
        if self._condition is not None and self._condition > ILL_CONDITIONED:
            out.append(
                f"the initial equations are ill-conditioned, {self._condition:.1e}: the starts hardly determine the "
                "point, and its gradients are not reliable"
            )
        elif self._condition is not None and self._condition * ridge(self._found.x.dtype) > DIGIT:
            # Measured on x + y = a, x + (1 + e)·y = b: gradients are off by 1.4e-6 where it is 0.07, by 1.4 % at 0.7
            # and by 35 % at 2.4.
            out.append(
                f"the initial equations are ill-conditioned, {self._condition:.1e}: gradients with respect to the "
                "starts lose digits"
            )
        if self._rows.unshared:
            out.append(
                f"there are more guesses than they can choose, and too many unknowns for the point nearest to all: "
                f"{listed(self._rows.unshared, SHOWN)} gave way to those before"
            )
        return out

    # --- text --------------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str | None:
        """The text of the `InitializationError` this amounts to, or None if the model can start here."""
        if not self.consistent:
            return self._inconsistent()
        for block in self._suspected:
            if block.singular:
                return self._singular(block)
        # Redundant constraints are singular only as far as the point fulfils them.
        if self._suspected and any(found.is_redundant for found in self._dependent):
            return self._singular(self._suspected[0])
        return None

    def _inconsistent(self) -> str:
        if not np.isfinite(self._residual).all() or not np.isfinite(self._x).all():
            plan, numbers = self._plan, np.asarray(self._system.numbers, float)
            lost = lost_cancellation(plan.model.groups, numbers, plan.flat.parameters.names, self.time)
            if lost is not None:
                return f"no consistent initial point: {lost}."
            wrong = [r.text for r in self.residuals if not np.isfinite(r.value)][:4]
            return (
                "no consistent initial point: the equations are not finite at the start values"
                + (f" ({'; '.join(wrong)})" if wrong else "")
                + ". Give start values at a regular point with `initial={...}` or in the components."
            )
        lines = ["no consistent initial point was found; conditions that could not be met, largest error first:"]
        for r in self.residuals[:WORST]:
            variables = "" if r.is_start else f", in {some(r.variables)}"
            lines.append(f"  {r.text}{variables}: off by {abs(r.value):.3g}")
        if len(self.residuals) > WORST:
            lines.append(f"  … and {len(self.residuals) - WORST} more")
        contradictions = [r for r in self.redundant if not r.agrees]
        lines += [_contradiction(r) for r in contradictions[:4]]
        if self._constraints is not None:
            lines += [
                f"the constraints of {listed(names, 12)} leave no degree of freedom: there are as many of them as "
                "variables. If the mechanism should move, one of them repeats others: remove it, or replace it by a "
                "compliant part such as a spring."
                for names in no_freedom(self._constraints)
            ]
        if not contradictions:
            lines.append(
                f"Newton's method, Levenberg–Marquardt and homotopy did not find a solution in {self.evaluations} "
                "evaluations. Check the starts named above, or give better guesses with `initial={...}`."
            )
        return "\n".join(lines)

    def _singular(self, block: BlockFinding) -> str:
        dependent = self._dependent
        what = f"they do not determine {some(block.variables)}"
        if any(found.is_redundant or len(found.components) > 1 for found in dependent):
            lines = [f"the equations are singular at the initial point: {what}"]
            return "\n".join([*lines, *(str(found) for found in dependent[:SHOWN])])
        causes = ", ".join(f"{n} = {v:.6g}" for n, v in block.causes[:6])
        at = f" with {causes}" if causes else ""
        if block.causes_are_parameters:
            names = [n for n, _ in block.causes]
            mend = f"Give {names[0]} another value" if len(names) == 1 else f"Give one of {some(names)} another value"
        else:
            mend = "Start elsewhere, with `initial={...}` or other parameters"
        lines = [
            f"the equations are singular at the initial point{at}: {what}",
            *(f"  {text}" for text in block.equations[:SHOWN]),
        ]
        if len(block.equations) > SHOWN:
            lines.append(f"  … and {len(block.equations) - SHOWN} more")
        if block.undecided:
            lines.append(
                "Numbers cannot decide it: the coefficients are not zero, but smaller than the rounding errors of what "
                "they are computed from. Either the point is singular, or it is nearer to a singular one than this "
                "precision resolves."
            )
        lines.append(f"{mend}, or remove from the model what has become superfluous.")
        return "\n".join(lines)

    def _guess(self, g: Guess) -> str:
        kept = "kept" if self._is_kept(g) else f"moved by {g.moved:.3g} from {g.guess:.6g}"
        return f"{g.name} = {g.value:.6g}, {kept}"

    def _contents(self) -> tuple[list[str], list[tuple[str, list[str]]]]:
        singular = [b for b in self.blocks if b.singular]
        state = "a consistent" if self.consistent else "no consistent"
        head = [f"{state} initial point at t = {self.time:g}" + (", singular" if singular else "")]
        if self._rows.direct:
            head.append("the starts are the states; nothing had to be solved")
        elif self.method == METHODS[0]:
            head.append("the starts fulfil all equations; nothing had to be solved")
        elif self.method == METHODS[FAILED]:
            head.append(f"no method succeeded ({self.evaluations} evaluations)")
        elif self.method == METHODS[NEAREST]:
            head.append(f"the nearest point to guesses that cannot all hold, {self.evaluations} evaluations")
        else:
            head.append(f"found by {self.method}, {self.evaluations} evaluations")
        sections = [
            ("solved for", [f"{n} = {v:.6g}" for n, v in self.solved]),
            ("fixed", [f"{n} = {v:.6g}" for n, v in self.fixed]),
            ("redundant, as they follow from others", [_redundancy(r) for r in self.redundant if r.agrees]),
            ("contradicting", [_contradiction(r) for r in self.redundant if not r.agrees]),
            ("fixed in the model, but outranked by values given", self.outranked),
            ("guesses", [self._guess(g) for g in self.guesses]),
            ("does not hold, worst first", [f"{r.text}: off by {abs(r.value):.3g}" for r in self.residuals]),
            ("singular", [self._singular(b).replace("\n", " ") for b in singular]),
            ("notes", self.notes),
        ]
        return head, [(title, list(entries)) for title, entries in sections if entries]


@remembered
def _guessed(plan: SystemPlan, names: tuple[str, ...], unknown: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """The declared guesses of what the model integrates and nothing fixes: places in the state array, quantities,
    variables, and the variables' factors."""
    rows = initial_rows(plan, names, unknown)
    held = {row.quantity for row in rows.kept[: len(rows.kept) - rows.n_soft]}
    inside, order, index = integrated(plan), plan.extended.quantities.order, plan.variable_index
    found = [
        (k, row.quantity, index[row.name], row.factor)
        for k, row in enumerate(rows.guess)
        if row is not None and row.start is not None and row.name in index and row.quantity not in held
        and not order[row.quantity] and inside[row.quantity]
    ]  # fmt: skip
    place, quantity, variable, factor = zip(*found, strict=True) if found else ((),) * 4
    return np.array(place, int), np.array(quantity, int), np.array(variable, int), np.array(factor, float)


def outranked(rows: InitialRows, starts: Sequence[str]) -> str:
    """The text of a warning: values given take the place of fixed starts."""
    given = [row.name for row in rows.kept if row.given >= 0]
    return (
        f"initial={{...}}: {quoted(given)} determine{'s' * (len(given) == 1)} variables whose starts are fixed in the "
        f"model, and what is given counts: {', '.join(starts)}. Give these variables instead, or values that agree"
    )


def _redundancy(r: Redundant) -> str:
    others = ", ".join(f"{n} = {v:.6g}" for n, v in r.follows_from)
    return f"{r.name} = {r.value:.6g}" + (f", from {others}" if others else ", from the equations")


def _contradiction(r: Redundant) -> str:
    if not r.follows_from:
        return (
            f"{r.name} is fixed at {r.value:.6g}, but the equations alone determine it: free it (fixed=False), or give "
            "a value that agrees."
        )
    release = "release one start (fixed=False, or without the component's argument `initial_…`)"
    if r.arguments:
        arguments = [f"`{name.rpartition('.')[2]}` of {name.rpartition('.')[0]}" for name in r.arguments]
        release = f"leave out {' or '.join(arguments)} (in components of your own: fixed=False)"
    names = [r.name, *(n for n, _ in r.follows_from)]
    values = [r.value, *(v for _, v in r.follows_from)]
    return (
        f"{_joined(names)} are fixed at {_joined([f'{v:.6g}' for v in values])}, which contradict each other: "
        f"{release}, or give values that agree."
    )


def _joined(names: list[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1]
