"""Consistent initialization.

The unknowns are the state array's entries. The rows are: hidden constraints, residuals of nonlinear blocks, values
given by the caller, fixed starts, and as many guesses as it takes to determine the rest; which guesses are kept is
decided once, numerically, when the rows are chosen. The rows may be redundant, as long as they agree: they are solved
in the least-squares sense (Levenberg–Marquardt), and the last Gauss–Newton step carries the derivative, which by the
implicit function theorem is exact where the rows hold.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer

from ..compiler.numeric import Networks, consistent_point, residual_and_jacobian, start_values
from ..compiler.tables import ZERO, Start, describe_equation
from ..errors import InitializationError
from .dynamics import Point
from .gather import Gather, take
from .lower import SystemPlan

NUMERIC_LIMIT = 3000  # quantities up to which guesses are chosen by rank
MAX_STEPS = 256


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
    direct: bool  # every kept row is a state and nothing else constrains the states
    redundant: tuple[str, ...]
    promoted: tuple[str, ...]
    dropped: tuple[str, ...]


def choose_rows(plan: SystemPlan, values: np.ndarray, networks: tuple, names: tuple[str, ...], resolved) -> InitialRows:
    """Chooses the rows for the overrides `names` (with their quantities and signs)."""
    variables = plan.flat.variables
    overrides = [
        Row(name, int(q), int(s), None, k)
        for k, (name, q, s) in enumerate(zip(names, *resolved, strict=True))
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
    started |= {r.quantity: r for r in fixed}
    started |= {r.quantity: r for r in overrides}
    entries = [int(q) for q in (*plan.states, *plan.carried)]
    guess = tuple(started.get(q) for q in entries)
    inside = set(plan.states.tolist())
    rows = [*overrides, *fixed]
    if not plan.n_constraints and not len(plan.carried) and all(r.quantity in inside for r in rows):
        held: set[int] = set()
        again = []  # starts of variables that equal one with a start of its own
        for r in rows:
            if r.quantity in held:
                again.append(r.name)
            held.add(r.quantity)
        promoted = tuple(plan.quantity_name[q] for q in entries if q not in held)
        return InitialRows(guess, tuple(rows), True, tuple(again), promoted, ())
    return _by_rank(plan, values, networks, overrides, fixed, started, guess)


def _by_rank(plan: SystemPlan, values, networks, overrides, fixed, started, guess) -> InitialRows:
    extended = plan.extended
    n = extended.quantities.n_unknown
    if n > NUMERIC_LIMIT:
        return InitialRows(guess, (*overrides, *fixed), False, (), (), ())
    value_of = start_values([r.start for r in started.values()], values)
    point = np.zeros(extended.quantities.n)
    for k, (q, row) in enumerate(started.items()):
        if row.start is not None and q != ZERO:
            point[q] = row.sign * value_of(k)
    pins = [(r.quantity, r.sign * _number(r, values)) for r in fixed if r.quantity != ZERO]
    weights = Networks(networks)
    point, _ = consistent_point(extended, point, pins, values, 0.0, weights)
    _, jacobian = residual_and_jacobian(extended, point, values, 0.0, weights)
    dense = jacobian.toarray()[:, :n]
    if not np.isfinite(dense).all():
        return InitialRows(guess, (*overrides, *fixed), False, (), (), ())
    dense = dense / np.maximum(np.abs(dense).max(axis=1, keepdims=True), 1e-300)
    _, singular, vt = np.linalg.svd(dense, full_matrices=True)
    rank = int((singular > 1e-10 * max(singular.max(initial=0.0), 1.0)).sum())
    free = vt[rank:].T  # directions the equations leave open, (n, freedom)

    def pin(q: int) -> bool:
        """Whether fixing q closes a direction; closes it."""
        nonlocal free
        row = free[q]
        size = np.linalg.norm(row)
        if free.shape[1] == 0 or size < 1e-7:
            return False
        rest = np.linalg.svd(row[None, :] / size, full_matrices=True)[2][1:]
        free = free @ rest.T
        return True

    kept, redundant, dropped = [], [], []
    for row in overrides:
        kept.append(row)
        if not (row.quantity != ZERO and pin(row.quantity)):
            redundant.append(row.name)
    for row in fixed:
        if row.quantity != ZERO and pin(row.quantity):
            kept.append(row)
        elif overrides:
            dropped.append(row.name)  # what the caller gave outranks it
        else:
            kept.append(row)
            redundant.append(row.name)
    promoted = []
    entries = [int(q) for q in (*plan.states, *plan.carried)]
    while free.shape[1]:
        sizes = np.linalg.norm(free[entries], axis=1)
        best = sizes.max(initial=0.0)
        if best < 1e-7:
            break
        declared = [k for k in range(len(entries)) if sizes[k] >= 0.1 * best and guess[k] is not None]
        k = declared[0] if declared else int(np.argmax(sizes))
        q = entries[k]
        pin(q)
        kept.append(guess[k] or Row(plan.quantity_name[q], q, 1, None))
        promoted.append(plan.quantity_name[q])
    return InitialRows(guess, tuple(kept), False, tuple(redundant), tuple(promoted), tuple(dropped))


def _number(row: Row, values: np.ndarray) -> float:
    return start_values([row.start], values)(0)


@functools.lru_cache(maxsize=256)
def _rows(plan: SystemPlan, names: tuple[str, ...]) -> InitialRows:
    networks = tuple(plan.flat.networks.values())
    return choose_rows(plan, plan.flat.parameters.values, networks, names, plan.resolve(names))


def initialize(system, t0: Any, inputs: Mapping[str, Any] | None, initial: Mapping[str, Any] | None):
    """(state, residuals of all rows): a pure function, to be used inside jit."""
    plan: SystemPlan = system.plan
    names = tuple(initial or ())
    rows = _rows(plan, names)
    given = [initial[n] for n in names] if initial else []
    point: Point = system._point(t0, inputs)
    parameters = point.parameters
    x0 = _values(rows.guess, given, parameters) * jnp.asarray(_signs(rows.guess), point.dtype)
    target = _values(rows.kept, given, parameters)
    place = {int(q): k for k, q in enumerate((*plan.states, *plan.carried))}
    quantity = np.array([r.quantity for r in rows.kept], np.int64)
    sign = np.array([r.sign for r in rows.kept], np.int64)
    in_state = all(int(q) in place for q in quantity)

    def starts(here: Point, x):
        if not len(quantity):
            return jnp.zeros((0,), here.dtype)
        if in_state:
            return x[np.array([place[int(q)] for q in quantity])] * jnp.asarray(sign, here.dtype)
        evaluation = here.run(plan.everything, here.split(x), refine=0)
        gather: Gather = plan.everything.layout.gather(quantity, sign)
        return jnp.broadcast_to(jnp.asarray(evaluation.read(gather), here.dtype), (len(quantity),))

    if rows.direct:
        return x0, starts(point, x0) - target

    def residual(x, parameters, inputs, target):
        here = Point(plan, parameters, point.networks, t0, inputs)
        state = here.split(x)
        parts = [here.constraint_vector(state)]
        if len(plan.carried):
            parts.append(here.carried_vector(here.t, state))
        parts.append(starts(here, x) - target)
        return jnp.concatenate(parts)

    frozen = jax.lax.stop_gradient
    fixed = lambda x: residual(x, frozen(parameters), frozen_inputs(inputs), frozen(target))  # noqa: E731
    start = frozen(x0)
    eps = float(jnp.finfo(point.dtype).eps)
    close = 1e3 * eps * (1.0 + jnp.max(jnp.abs(start), initial=0.0))

    def search(x):
        solver = optx.LevenbergMarquardt(rtol=1e2 * eps, atol=1e2 * eps)
        solution = optx.least_squares(lambda y, _: fixed(y), solver, x, max_steps=MAX_STEPS, throw=False)
        return solution.value

    def far(carry):
        x, searched = carry
        return ~searched & ~(jnp.max(jnp.abs(fixed(x)), initial=0.0) <= close)

    # A loop that runs at most once, not a `cond`: under vmap it is skipped if all members start consistent.
    near, _ = jax.lax.while_loop(far, lambda c: (search(c[0]), jnp.array(True)), (start, jnp.array(False)))
    near = frozen(near)
    jacobian = frozen(jax.jacfwd(fixed)(near))
    remaining = residual(near, parameters, inputs, target)
    q, r = jnp.linalg.qr(jacobian)
    x = near - jax.scipy.linalg.solve_triangular(r, q.T @ remaining)
    return x, residual(x, parameters, inputs, target)


def frozen_inputs(inputs: Any) -> Any:
    """Inputs with their arrays kept out of differentiation."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, inputs)


def _signs(rows: tuple[Row | None, ...]) -> np.ndarray:
    return np.array([1 if row is None or row.sign >= 0 else -1 for row in rows], np.int64)


def _values(rows: tuple[Row | None, ...], given: list, parameters: Any) -> Any:
    """The values of start rows, shape (rows,): one vectorised kernel for each distinct start expression."""
    members: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        key = "zero" if row is None or (row.start is None and row.given < 0) else "given"
        if row is not None and row.start is not None and row.given < 0:
            key = row.start.template.key
        members.setdefault(key, []).append(k)
    parts = []
    for key, places in members.items():
        if key == "zero":
            parts.append(jnp.zeros((len(places),), parameters.dtype))
            continue
        chosen = [rows[k] for k in places]
        if key == "given":
            parts.append(jnp.stack([jnp.asarray(given[row.given], parameters.dtype) for row in chosen if row]))
            continue
        starts = [row.start for row in chosen if row and row.start]
        columns = np.array([start.parameters for start in starts], np.int64).T
        values = [take(parameters, column) for column in columns]
        time = jnp.zeros((), parameters.dtype)
        value = starts[0].template.residual([], values, [], time, None)
        parts.append(jnp.broadcast_to(jnp.asarray(value, parameters.dtype), (len(places),)))
    if not parts:
        return jnp.zeros((0,), parameters.dtype)
    back = np.argsort(np.concatenate(list(members.values())), kind="stable")
    return take(jnp.concatenate(parts), back)


def tolerance(dtype, x: Any) -> Any:
    """The largest residual of an initial point that counts as rounding."""
    return float(jnp.finfo(dtype).eps) ** 0.6 * (1.0 + jnp.max(jnp.abs(x), initial=0.0))


def row_names(plan: SystemPlan, rows: InitialRows) -> list[str]:
    """What each residual of `initialize` says, in user names."""
    out = []
    if rows.direct:
        return [f"start of {r.name}" for r in rows.kept]
    for planned in plan.constraints:
        for base, level in zip(planned.group.base, [planned.group.level] * len(planned.group), strict=True):
            text = describe_equation(plan.groups, int(base))
            out.append(text + (f" (differentiated {level}×)" if level else ""))
    out.extend(f"block of {plan.quantity_name[q]}" for q in plan.carried)
    out.extend(f"start of {r.name}" for r in rows.kept)
    return out


def check(system, x: Any, residual: Any, initial: Mapping[str, Any] | None) -> Any:
    """Raises an `InitializationError` that names the worst rows if the initial point is not consistent."""
    limit = tolerance(x.dtype, x)
    bad = ~(jnp.max(jnp.abs(residual), initial=0.0) <= limit) | ~jnp.all(jnp.isfinite(x))
    if isinstance(bad, Tracer):
        return eqx.error_if(
            x,
            bad,
            "no consistent initial point: fixed starts contradict the equations, or the search failed. Call "
            "system.initialize() outside jit for the names",
        )
    if bool(bad):
        raise InitializationError(explain(system, x, residual, initial))
    return x


def explain(system, x: Any, residual: Any, initial: Mapping[str, Any] | None) -> str:
    """The message for an inconsistent initial point."""
    plan: SystemPlan = system.plan
    rows = _rows(plan, tuple(initial or ()))
    names = row_names(plan, rows)
    size = np.abs(np.asarray(residual))
    if not np.isfinite(size).all() or not np.isfinite(np.asarray(x)).all():
        wrong = [n for n, s in zip(names, size, strict=True) if not np.isfinite(s)][:4]
        return (
            "no consistent initial point: the equations are not finite at the start values"
            + (f" ({'; '.join(wrong)})" if wrong else "")
            + ". Give start values at a regular point with `initial={...}` or in the components."
        )
    worst = [k for k in np.argsort(-size)[:5] if size[k] > 0]
    lines = [f"  {names[k]}: off by {size[k]:.3g}" for k in worst]
    redundant = [r for r in rows.redundant]
    hint = (
        f"The starts of {', '.join(repr(r) for r in redundant[:4])} follow from the others: free them "
        "(fixed=False) or give values that agree."
        if redundant
        else "Check the starts named above, or give better guesses with `initial={...}`."
    )
    return "no consistent initial point was found; what does not hold:\n" + "\n".join(lines) + "\n" + hint
