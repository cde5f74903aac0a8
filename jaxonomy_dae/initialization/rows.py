"""Which starts determine the initial point.

Given the plan, the values a caller names and the parameters to be solved for, returns the rows that are kept beside the
equations: values given, fixed starts, and as many guesses as it takes to determine the rest. Which guesses are kept is
decided once, numerically, at the declared parameter values: a row is independent if it closes a direction that the
equations and the rows before it leave open.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InitializationError
from ..lowering.plan import SystemPlan
from ..model.consistent_point import consistent_point
from ..model.evaluate_numpy import Networks, residual_and_jacobian, slot_values, start_values
from ..model.tables import ZERO, Start

NUMERIC_LIMIT = 3000  # quantities up to which guesses are chosen by rank
OPEN = 1e-7  # a direction less than this along a quantity leaves it determined


@dataclasses.dataclass(frozen=True)
class Row:
    """One start that must hold: sign·quantity equals a start expression or the caller's value `given`."""

    name: str
    quantity: int
    sign: int
    start: Start | None
    given: int = -1


@dataclasses.dataclass(frozen=True)
class InitialRows:
    """What determines the initial point."""

    guess: tuple[Row | None, ...]  # for each entry of the state array, where its first value comes from
    kept: tuple[Row, ...]
    independent: tuple[bool, ...] | None  # of the rows kept, those that no other determines; None if not examined
    direct: bool  # every kept row is a state and nothing else constrains the states
    redundant: tuple[int, ...]  # rows kept that follow from others
    promoted: tuple[str, ...]  # states that start at their guess, as nothing else determines them
    dropped: tuple[str, ...]  # fixed starts that values given by the caller outrank


@dataclasses.dataclass(frozen=True)
class _Open:
    """The extended system near the initial point, columns being quantities and then parameters to be solved for."""

    jacobian: np.ndarray
    point: np.ndarray
    values: np.ndarray
    solve_for: tuple[int, ...]

    @property
    def n(self) -> int:
        return self.jacobian.shape[1] - len(self.solve_for)

    def row(self, row: Row) -> np.ndarray:
        """The gradient of a start row."""
        out = np.zeros(self.jacobian.shape[1])
        if row.quantity != ZERO:
            out[row.quantity] = 1.0
        if row.start is not None and row.given < 0 and set(row.start.parameters) & set(self.solve_for):
            start = row.start
            with jax.ensure_compile_time_eval():
                values = [jnp.asarray(self.values[k]) for k in start.parameters]
                slopes = jax.grad(lambda v: jnp.asarray(start.template.residual([], v, [], jnp.zeros(()), None)))
                slope = [float(s) for s in slopes(values)]
            for k, parameter in enumerate(start.parameters):
                if parameter in self.solve_for:
                    out[self.n + self.solve_for.index(parameter)] -= row.sign * slope[k]
        return out


@functools.lru_cache(maxsize=256)
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
    free = not plan.n_constraints and not len(plan.carried) and not solve_for
    if free and all(r.quantity in inside for r in rows):
        held: set[int] = set()
        again = []  # starts of variables that equal one with a start of its own
        for k, r in enumerate(rows):
            if r.quantity in held:
                again.append(k)
            held.add(r.quantity)
        promoted = tuple(plan.quantity_name[q] for q in entries if q not in held)
        independent = tuple(k not in again for k in range(len(rows)))
        return InitialRows(guess, tuple(rows), independent, True, tuple(again), promoted, ())
    opened = _opened(plan, fixed, declared, solve_for)
    if opened is None:
        if solve_for:
            raise InitializationError(
                "solve_for: cannot tell whether the values given determine the parameters: the model has more than "
                f"{NUMERIC_LIMIT} quantities, or its equations are not finite at the declared starts"
            )
        return InitialRows(guess, tuple(rows), None, False, (), (), ())
    return _by_rank(plan, opened, overrides, fixed, guess)


def _declared(plan: SystemPlan, names: tuple[str, ...]) -> tuple[list[Row], list[Row], dict[int, Row]]:
    """Values given, fixed starts they leave, and the first start of each quantity."""
    variables = plan.flat.variables
    values = plan.flat.parameters.values
    overrides = [
        Row(name, int(q), int(s), None, k)
        for k, (name, q, s) in enumerate(zip(names, *plan.resolve(names), strict=True))
        if q != ZERO
    ]
    overridden = {r.quantity for r in overrides}
    value_of = start_values(variables.start, values)
    started: dict[int, Row] = {}
    fixed: list[Row] = []
    for v, start in enumerate(variables.start):
        if start is None:
            continue
        quantity, sign = plan.quantity_of(v)
        if quantity == ZERO and not (variables.fixed[v] and value_of(v) != 0.0):
            continue  # zero as it should be; any other fixed start contradicts the equations, and is kept to say so
        row = Row(variables.names[v], quantity, sign, start)
        if variables.fixed[v] and quantity not in overridden:
            fixed.append(row)
        started.setdefault(quantity, row)
    started |= {r.quantity: r for r in reversed(fixed)}
    return overrides, fixed, started


def _opened(plan: SystemPlan, fixed, started, solve_for) -> _Open | None:
    """The equations' Jacobian, rows scaled, at a point near the initial one; None if it is too large, or not finite."""
    extended = plan.extended
    n = extended.quantities.n_unknown
    if n > NUMERIC_LIMIT:
        return None
    values = plan.flat.parameters.values
    value_of = start_values([r.start for r in started.values()], values)
    point = np.zeros(extended.quantities.n)
    for k, (q, row) in enumerate(started.items()):
        if row.start is not None and q != ZERO:
            point[q] = row.sign * value_of(k)
    one = start_values([r.start for r in fixed], values)
    pins = [(r.quantity, r.sign * one(k)) for k, r in enumerate(fixed) if r.quantity != ZERO]
    weights = Networks(tuple(plan.flat.networks.values()))
    point, _ = consistent_point(extended, point, pins, values, 0.0, weights)
    _, jacobian = residual_and_jacobian(extended, point, values, 0.0, weights)
    dense = jacobian.toarray()[:, :n]
    if solve_for:
        dense = np.concatenate([dense, _parameter_columns(plan, point, values, solve_for, weights)], axis=1)
    if not np.isfinite(dense).all():
        return None
    dense = dense / np.maximum(np.abs(dense).max(axis=1, keepdims=True), 1e-300)
    return _Open(dense, point, values, solve_for)


def _parameter_columns(plan: SystemPlan, point, values, solve_for, weights: Networks) -> np.ndarray:
    """∂(equations)/∂(parameters), columns scaled."""
    extended = plan.extended
    out = np.zeros((extended.n_equations, len(solve_for)))
    with jax.ensure_compile_time_eval():
        for group in extended.groups:
            for j, parameter in enumerate(solve_for):
                hit = group.parameter == parameter
                if group.template.opaque is not None or not hit.any():
                    continue
                slots = [jnp.asarray(s) for s in slot_values(group, point)]
                given = [jnp.asarray(p) for p in values[group.parameter].T]
                coefficients = [jnp.asarray(c) for c in group.coefficient.T]

                def residual(p, group=group, slots=slots, coefficients=coefficients):
                    time = jnp.zeros((), p[0].dtype)
                    value = group.template.residual(slots, p, coefficients, time, weights)
                    return jnp.broadcast_to(value, (len(group),))

                tangent = [jnp.asarray(h, p.dtype) for h, p in zip(hit.T, given, strict=True)]
                out[group.equation, j] = np.asarray(jax.jvp(residual, (given,), (tangent,))[1])
    return out / np.maximum(np.abs(out).max(axis=0, keepdims=True, initial=0.0), 1e-300)


class _Directions:
    """The directions that equations leave open, shape (columns, freedom), closed one by one."""

    def __init__(self, jacobian: np.ndarray):
        _, singular, vt = np.linalg.svd(jacobian, full_matrices=True)
        rank = int((singular > 1e-10 * max(singular.max(initial=0.0), 1.0)).sum())
        self.free = vt[rank:].T

    def close(self, gradient: np.ndarray) -> bool:
        """Whether a row of this gradient closes a direction; closes it."""
        along = gradient @ self.free
        size = np.linalg.norm(along)
        if self.free.shape[1] == 0 or size < OPEN:
            return False
        rest = np.linalg.svd(along[None, :] / size, full_matrices=True)[2][1:]
        self.free = self.free @ rest.T
        return True


def _by_rank(plan: SystemPlan, opened: _Open, overrides, fixed, guess) -> InitialRows:
    directions = _Directions(opened.jacobian)
    kept, independent, dropped = [], [], []
    for row in (*overrides, *fixed):
        closes = directions.close(opened.row(row))
        if not closes and overrides and row.given < 0:
            dropped.append(row.name)  # what the caller gave outranks it
            continue
        kept.append(row)
        independent.append(closes)
    redundant = tuple(k for k, closes in enumerate(independent) if not closes)
    promoted = []
    entries = [int(q) for q in (*plan.states, *plan.carried)]
    while directions.free.shape[1]:
        sizes = np.linalg.norm(directions.free[entries], axis=1)
        best = sizes.max(initial=0.0)
        if best < OPEN:
            break
        declared = [k for k in range(len(entries)) if sizes[k] >= 0.1 * best and guess[k] is not None]
        k = declared[0] if declared else int(np.argmax(sizes))
        row = guess[k] or Row(plan.quantity_name[entries[k]], entries[k], 1, None)
        directions.close(opened.row(dataclasses.replace(row, start=None)))
        kept.append(row)
        independent.append(True)
        promoted.append(plan.quantity_name[entries[k]])
    if opened.solve_for:
        _check_count(plan, opened, directions, [kept[k] for k in redundant], kept)
    return InitialRows(guess, tuple(kept), tuple(independent), False, redundant, tuple(promoted), tuple(dropped))


# --- what follows from what ----------------------------------------------------------------------------------------


def supports(plan: SystemPlan, names: tuple[str, ...], solve_for: tuple[int, ...] = ()) -> dict[int, tuple[Row, ...]]:
    """For each redundant row, by its place among the rows kept, the other rows it follows from together with the
    equations."""
    rows = initial_rows(plan, names, solve_for)
    if rows.direct:
        return {k: (next(r for r in rows.kept if r.quantity == rows.kept[k].quantity),) for k in rows.redundant}
    _, fixed, declared = _declared(plan, names)
    opened = _opened(plan, fixed, declared, solve_for) if rows.redundant else None
    if opened is None or opened.n > NUMERIC_LIMIT // 3:
        return {k: () for k in rows.redundant}
    base = [r for r, alone in zip(rows.kept, rows.independent or (), strict=True) if alone]
    return {k: _support(opened, rows.kept[k], base)[0] for k in rows.redundant}


def _support(opened: _Open, row: Row, base: list[Row]) -> tuple[tuple[Row, ...], np.ndarray]:
    """The rows of `base`, and the equations, of which a row is a combination."""
    matrix = np.concatenate([opened.jacobian, *(opened.row(r)[None, :] for r in base)])
    weight = np.abs(np.linalg.lstsq(matrix.T, opened.row(row), rcond=1e-12)[0])
    used = weight > 1e-6 * max(weight.max(initial=0.0), 1e-300)
    n = opened.jacobian.shape[0]
    return tuple(r for r, u in zip(base, used[n:], strict=True) if u), np.flatnonzero(used[:n])


def _check_count(plan: SystemPlan, opened: _Open, directions: _Directions, redundant: list[Row], kept: list[Row]):
    """Raises if the values given do not determine the parameters that are solved for, or determine one twice."""
    table = plan.flat.parameters
    wanted = [table.names[p] for p in opened.solve_for]
    given = [r for r in redundant if r.given >= 0]
    if given:
        base = [r for r in kept if r not in redundant]
        equations: set[int] = set()
        for row in given:
            equations |= set(_support(opened, row, base)[1].tolist())
        found = _parameters_of(plan, sorted(equations), set(opened.solve_for))
        others = f", or solve for one more parameter ({_some(found)})" if found else ""
        more = "a value" if len(given) == 1 else f"{len(given)} values"
        raise InitializationError(
            f"solve_for: {more} too many for {len(wanted)} unknown parameter{'s' * (len(wanted) > 1)} "
            f"({_some(wanted)}): {_some([r.name for r in given])} follow{'s' * (len(given) == 1)} from the others. "
            f"Leave {'it' if len(given) == 1 else 'them'} out{others}."
        )
    left = np.linalg.norm(directions.free[opened.n :], axis=1)
    undetermined = [w for w, size in zip(wanted, left, strict=True) if size >= OPEN]
    if undetermined:
        missing = directions.free.shape[1]
        moving = np.linalg.norm(directions.free[: opened.n], axis=1)
        pinned = {r.quantity for r in kept}
        names = [plan.quantity_name[q] for q in np.flatnonzero(moving >= OPEN) if q not in pinned]
        candidates = [n for n in names if ":" not in n]
        if candidates:
            hint = f"Give {'one' if missing == 1 else missing} of: {_some(candidates)}"
        else:
            hint = "No variable depends on it at the initial point: leave it out of solve_for"
        raise InitializationError(
            f"solve_for: {missing} value{'s' * (missing > 1)} too few: nothing determines {_some(undetermined)}. "
            f"{hint}, in initial={{...}} or as a fixed start."
            if candidates
            else f"solve_for: nothing determines {_some(undetermined)}. {hint}."
        )


def _parameters_of(plan: SystemPlan, equations: list[int], without: set[int]) -> list[str]:
    """The parameters in some extended equations, by name, in the order of declaration."""
    found: set[int] = set()
    chosen = np.zeros(plan.extended.n_equations, bool)
    chosen[equations] = True
    for group in plan.extended.groups:
        found |= set(group.parameter[chosen[group.equation]].ravel().tolist())
    return [plan.flat.parameters.names[p] for p in sorted(found - without)]


def _some(names: Any, shown: int = 6) -> str:
    names = [f"'{n}'" for n in names]
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")
