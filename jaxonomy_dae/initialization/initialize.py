"""Consistent initialization.

The unknowns are the state array's entries, and parameters that are solved for. The rows are: hidden constraints,
residuals of nonlinear blocks, values given by the caller, fixed starts, and the guesses that `initial_rows` keeps. The
rows may be redundant, as long as they agree. A ladder of methods finds the point, kept out of differentiation; one last
Gauss–Newton step carries the derivative, which by the implicit function theorem is exact where the rows hold.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..errors import InitializationError
from ..lowering.gather import Gather, take
from ..lowering.plan import SystemPlan
from ..system.inputs import read_inputs
from ..system.system_at import Point
from .ladder import FAILED, find_root
from .rows import InitialRows, Row, initial_rows


class InitialPoint(NamedTuple):
    """What the search found: `x` of shape (n_state,), `solved` the parameters solved for, the residual of every row
    and the value it should have had (zero for equations), an index into `METHODS`, the number of evaluations, and the
    Jacobian of the rows with respect to (x, solved)."""

    x: Any
    solved: Any
    residual: Any
    target: Any
    method: Any
    evaluations: Any
    jacobian: Any


def initialize(
    system,
    t0: Any,
    inputs: Mapping[str, Any] | None,
    initial: Mapping[str, Any] | None,
    solve_for: tuple[str, ...] = (),
) -> InitialPoint:
    """A pure function, to be used inside jit. Nothing is raised but for wrong names or counts: see `check`."""
    plan: SystemPlan = system.plan
    names = tuple(initial or ())
    unknown = np.array([system.parameters.table.index(n) for n in solve_for], np.int64)
    rows = initial_rows(plan, names, tuple(unknown.tolist()))
    given = [initial[n] for n in names] if initial else []
    point: Point = system._point(t0, inputs)
    parameters = point.parameters
    n = plan.n_state
    x0 = _values(rows.guess, given, parameters) * jnp.asarray(_signs(rows.guess), point.dtype)
    target = _values(rows.kept, given, parameters)
    starts = _reader(plan, rows.kept)
    if rows.direct:
        nothing = jnp.zeros((), jnp.int32)
        return InitialPoint(x0, x0[:0], starts(point, x0) - target, target, nothing, nothing, None)

    def residual(w, parameters, inputs, target):
        if len(unknown):
            parameters = parameters.at[unknown].set(w[n:])
            target = _values(rows.kept, given, parameters)
        here = Point(plan, parameters, point.networks, t0, inputs)
        state = here.split(w[:n])
        parts = [here.constraint_vector(state)]
        if len(plan.carried):
            parts.append(here.carried_vector(here.t, state))
        parts.append(starts(here, w[:n]) - target)
        return jnp.concatenate(parts)

    frozen = jax.lax.stop_gradient
    settings = (frozen(parameters), frozen_inputs(inputs), frozen(target))
    start = frozen(jnp.append(x0, parameters[unknown]) if len(unknown) else x0)
    scale = np.append(plan.nominal, np.ones(len(unknown)))
    core = independent_rows(plan, rows, len(start))
    eps = float(jnp.finfo(point.dtype).eps)
    close = min(1e3 * eps, 0.1 * eps**0.6)
    found = frozen(
        find_root(
            lambda w: residual(w, *settings),
            plan.n_constraints + len(plan.carried) + len(rows.kept),
            start,
            scale,
            core,
            lambda w: close * (1.0 + jnp.max(jnp.abs(w), initial=0.0)),
            lambda w: tolerance(point.dtype, w),
        )
    )
    remaining = residual(found.x, parameters, inputs, target)
    # Where nothing was found, there is nothing to differentiate, and the others of a batch must not notice.
    good = found.method < FAILED
    w = found.x - _least_squares(
        jnp.where(good, found.jacobian, jnp.asarray(np.eye(*found.jacobian.shape), point.dtype)),
        jnp.where(good, remaining, jnp.zeros_like(remaining)),
    )
    full = jnp.concatenate([jnp.zeros((remaining.shape[0] - target.shape[0],), point.dtype), target])
    return InitialPoint(w[:n], w[n:], remaining, full, found.method, found.evaluations, found.jacobian)


def _least_squares(matrix: Any, right: Any) -> Any:
    """The least-squares solution of A·x = b; the one of least norm where A has fewer rows than columns."""
    m, n = matrix.shape
    if m >= n:
        q, r = jnp.linalg.qr(matrix)
        return jax.scipy.linalg.solve_triangular(r, q.T @ right)
    q, r = jnp.linalg.qr(matrix.T)
    return q @ jax.scipy.linalg.solve_triangular(r, right, trans=1)


def independent_rows(plan: SystemPlan, rows: InitialRows, n: int) -> np.ndarray | None:
    """As many rows as unknowns, none of which follows from others; None if they are not known."""
    if rows.independent is None:
        return None
    equations = plan.n_constraints + len(plan.carried)
    core = np.append(np.ones(equations, bool), rows.independent).nonzero()[0]
    return core if len(core) == n else None


def _reader(plan: SystemPlan, kept: tuple[Row, ...]):
    """The values of the rows' variables as a function of the point and the state array."""
    quantity = np.array([r.quantity for r in kept], np.int64)
    sign = np.array([r.sign for r in kept], np.int64)
    place = {int(q): k for k, q in enumerate((*plan.states, *plan.carried))}
    in_state = all(int(q) in place for q in quantity)

    def starts(here: Point, x):
        if not len(quantity):
            return jnp.zeros((0,), here.dtype)
        if in_state:
            where = np.array([place[int(q)] for q in quantity])
            return take(x, where) * jnp.asarray(np.where(sign < 0, -1, 1), here.dtype)
        evaluation = here.run(plan.everything, here.split(x), refine=0)
        gather: Gather = plan.everything.layout.gather(quantity, sign)
        return jnp.broadcast_to(jnp.asarray(evaluation.read(gather), here.dtype), (len(quantity),))

    return starts


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


def tolerance(dtype: Any, x: Any) -> Any:
    """The largest residual of an initial point that counts as rounding."""
    largest = np.max(np.abs(x), initial=0.0) if isinstance(x, np.ndarray) else jnp.max(jnp.abs(x), initial=0.0)
    return float(jnp.finfo(dtype).eps) ** 0.6 * (1.0 + largest)


def is_consistent(found: InitialPoint) -> Any:
    """Whether all rows hold, to rounding."""
    unknown = jnp.append(found.x, found.solved)
    holds = jnp.max(jnp.abs(found.residual), initial=0.0) <= tolerance(found.x.dtype, unknown)
    return holds & jnp.all(jnp.isfinite(unknown))


def find_initial(
    system: Any,
    t0: Any,
    inputs: Mapping[str, Any] | None,
    initial: Mapping[str, Any] | None,
    solve_for: tuple[str, ...] = (),
) -> InitialPoint:
    """`initialize`, compiled once for each structure where nothing is traced."""
    dtype = system.parameters.values.dtype
    inputs = read_inputs(system.inputs, dtype, inputs)
    initial = {name: jnp.asarray(v, dtype) for name, v in sorted((initial or {}).items())}
    arguments = (system, jnp.asarray(t0, dtype), inputs, initial, solve_for)
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments)):
        found = _compiled(*arguments)
        # An input's function may close over a traced value, which shows in the outcome only.
        if not isinstance(found.x, Tracer):
            return found
    return initialize(*arguments)


_compiled = eqx.filter_jit(initialize)


def check(
    system: Any, found: InitialPoint, t0: Any, inputs: Any, initial: Any, solve_for: tuple[str, ...] = ()
) -> InitialPoint:
    """The same point; raises an `InitializationError` if it is not consistent, if a block of equations is singular
    there, or if a parameter solved for is out of its bounds."""
    from .report import InitializationReport  # which reads what is defined here

    table = system.parameters.table
    low, high = table.bounds[np.array([table.index(n) for n in solve_for], np.int64)].T
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((found, system, t0))):
        x = eqx.error_if(
            found.x,
            ~is_consistent(found),
            "no consistent initial point: fixed starts contradict the equations, or the search failed. "
            "system.initialization_report() outside jit gives the names",
        )
        if not solve_for:
            return found._replace(x=x)
        slack = tolerance(found.x.dtype, found.solved)
        outside = ~((found.solved >= low - slack) & (found.solved <= high + slack))
        solved = eqx.error_if(found.solved, outside, f"a parameter of {list(solve_for)} is out of its bounds")
        return found._replace(x=x, solved=solved)
    problem = InitializationReport(system, found, t0, inputs, initial, solve_for).problem
    if problem is not None:
        raise InitializationError(problem)
    solved = np.asarray(found.solved)
    slack = float(tolerance(found.x.dtype, solved))
    for name, value, a, b in zip(solve_for, solved, low, high, strict=True):
        if not a - slack <= value <= b + slack:
            raise InitializationError(
                f"solve_for: the values given need {name} = {value:.6g}, which is out of its bounds [{a:g}, {b:g}]. "
                "Give other values in initial={...}, or start the search elsewhere with "
                f"system.with_parameters({{'{name}': guess}})"
            )
    return found
