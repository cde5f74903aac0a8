"""Consistent initialization.

The unknowns are the state array's entries, and parameters that are solved for. The rows are: hidden constraints,
residuals of nonlinear blocks, values given by the caller, fixed starts, and the guesses that `initial_rows` keeps. The
rows may be redundant, as long as they agree. A ladder of methods finds the point, kept out of differentiation. Of two
last steps the first carries first derivatives, which by the implicit function theorem are exact, and the second one
second derivatives. Without guesses they are Gauss–Newton steps of the rows; with guesses Newton steps of the conditions
for the nearest point.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..errors import ModelError
from ..linear.least_squares import least_squares
from ..linear.sparse import sparse_jacobian
from ..linear.whole import solve_whole
from ..lowering.gather import Gather, take, times
from ..lowering.plan import SystemPlan
from ..model.declared import declared_scale, quantity_bounds
from ..programs.cache import PROGRAMS, compiled
from ..programs.platform import precisely
from ..programs.staging import is_staged
from ..system.evaluate import Refinement
from ..system.inputs import read_inputs
from ..system.system_at import SystemAt
from ..tolerances import CLOSE, NOISE, solved
from .given_solver import find_root_with
from .initial_values import check_initial
from .ladder import FAILED, STAGED, find_root
from .rows import InitialRows, StartRow, initial_rows
from .sizes import Sizes
from .sparse_newton import SparseRows, sparse_newton, sparse_rows
from .stages import solve_in_stages, stages

PERTURBATIONS = 8  # of the start, and of parameters, that show the sizes of terms


class InitialPoint(NamedTuple):
    """The result of the search for a consistent point.

    - `x`: the state array, shape (n_state,); `solved`: the parameters solved for.
    - `residual`, `limit`, `target`: of each row, the residual, the largest that counts as rounding, and the value the
        row should have had (zero for equations).
    - `method`: an index into `METHODS`; `evaluations`: their number.
    - `jacobian`: that of the rows with respect to (x, solved).
    """

    x: Any
    solved: Any
    residual: Any
    limit: Any
    target: Any
    method: Any
    evaluations: Any
    jacobian: Any


@precisely
def initialize(
    system,
    t0: Any,
    inputs: Mapping[str, Any] | None,
    initial: Mapping[str, Any] | None,
    solve_for: tuple[str, ...] = (),
    solver: Any = None,
) -> InitialPoint:
    """Finds a consistent point; a pure function, to be used inside jit. Raises errors for wrong names and counts only:
    see `check`."""
    plan: SystemPlan = system.plan
    names = tuple(initial or ())
    table = system.parameters.table
    unknown = np.array([table.index(n) for n in solve_for], np.int64)
    rows = initial_rows(plan, names, tuple(unknown.tolist()))
    given = [initial[n] for n in names] if initial else []
    point: SystemAt = system.at(t0, inputs)
    parameters = point.parameters
    n = plan.n_state
    x0 = _values(rows.guess, given, parameters) * jnp.asarray(_units(rows.guess), point.dtype)
    target = _values(rows.kept, given, parameters)
    starts, sizes_of_starts = _reader(plan, rows.kept)
    if rows.direct:
        nothing = jnp.zeros((), jnp.int32)
        residual = starts(point, x0) - target
        limit = solved(point.dtype) * (jnp.abs(starts(point, x0)) + _data_sizes(plan, rows, given, parameters)[0])
        return InitialPoint(x0, x0[:0], residual, limit, target, nothing, nothing, None)
    n_equations = plan.n_constraints + len(plan.carried)

    def residual(w, parameters, inputs, target):
        if len(unknown):
            parameters = table.complete(parameters.at[unknown].set(w[n:]))
            target = _values(rows.kept, given, parameters)
        here = SystemAt(plan, parameters, point.networks, t0, inputs, point.typical)
        state = here.split(w[:n])
        parts = [here.constraint_vector(state)]
        if len(plan.carried):
            parts.append(here.carried_vector(here.t, state))
        parts.append(starts(here, w[:n]) - target)
        return jnp.concatenate(parts)

    frozen = jax.lax.stop_gradient
    settings = (frozen(parameters), frozen_inputs(inputs), frozen(target))
    nominal = jnp.asarray(declared_scale(plan.model), point.dtype)
    nominal = nominal[np.concatenate([plan.states, plan.carried]).astype(np.int64)]

    def magnitude(w):
        parameters, inputs, _ = settings
        if len(unknown):
            parameters = table.complete(parameters.at[unknown].set(w[n:]))
        here = SystemAt(plan, parameters, point.networks, t0, inputs, point.typical)
        x = w[:n]
        reach = jnp.maximum(jnp.abs(x), nominal)
        parts = [here.constraint_magnitudes(x, reach)]
        if len(plan.carried):
            parts.append(here.carried_magnitudes(x, reach))
        return jnp.concatenate([*parts, sizes_of_starts(here, x, reach)])

    start = frozen(jnp.append(x0, parameters[unknown]) if len(unknown) else x0)
    sizes = frozen(_sizes(plan, rows, given, parameters, start))
    m = n_equations + len(rows.kept)
    if m > len(start):
        sizes = frozen(_with_velocities(sizes, start[:n], plan, system.at(t0, inputs)))
    is_soft = np.arange(m) >= m - rows.n_soft
    core = independent_rows(plan, rows, len(start))

    state = {int(q) for q in (*plan.states, *plan.carried)}
    read = [n_equations + k for k, row in enumerate(rows.kept) if row.quantity not in state]
    excused = None
    if read and rows.redundant and not rows.n_soft:
        excused = frozen(_rounding(residual, settings, start, sizes, _typical_of_rows(point, rows, n_equations, read)))

    def function(w):
        value = residual(w, *settings)
        return value if excused is None else jnp.where(excused > 0, 0, value)

    full = jnp.concatenate([jnp.zeros((n_equations,), point.dtype), target])
    bounds = _bounds(system, plan, unknown)
    sparse = None if len(unknown) or solver is not None else sparse_rows(plan, rows)
    if sparse is not None:
        alone = np.append(np.ones(n_equations, bool), rows.independent)
        return _large_point(
            lambda w, moving: residual(w, *moving), magnitude, settings, (parameters, inputs, target), start, sizes,
            sparse, core, np.flatnonzero(alone & ~is_soft), np.flatnonzero(is_soft), bounds, full,
        )  # fmt: skip
    staged = None if len(unknown) else stages(plan, rows)
    declared = start
    if staged is not None:
        start = frozen(solve_in_stages(function, start, sizes, *staged))
    if solver is None:
        entries = np.concatenate([plan.states, plan.carried]).astype(np.int64)
        typical = jnp.append(point.typical[entries], jnp.ones((len(unknown),), point.dtype))
        found = find_root(function, m, start, sizes, core, is_soft, bounds, typical, magnitude)
    else:
        square = core is not None or not rows.n_soft
        found = find_root_with(solver, function, start, sizes, is_soft, square, magnitude)
    if staged is not None:
        found = found._replace(method=jnp.where((found.method == 0) & jnp.any(start != declared), STAGED, found.method))
    found = frozen(found)
    # Where nothing was found, there is nothing to differentiate, and the others of a batch must not notice.
    good = found.method < FAILED
    jacobian = jnp.where(good, found.jacobian, jnp.asarray(np.eye(*found.jacobian.shape), point.dtype))
    if rows.n_soft:
        core = np.append(np.ones(n_equations, bool), rows.independent)
        w, remaining = _nearest_point(
            lambda w, moving: residual(w, *moving),
            settings,
            (parameters, inputs, target),
            found.x,
            jacobian,
            found.unit,
            sizes.soft,
            np.flatnonzero(core & ~is_soft),
            np.flatnonzero(is_soft),
            good,
        )
    else:
        # What rounding leaves of the gradient of a row that no unknown moves would count as much as other rows.
        settled = np.isin(np.arange(m), n_equations + np.array(rows.settled, int))
        jacobian = jnp.where(settled[:, None], 0, jacobian) * found.unit[None, :]

        def correct(w):
            remaining = residual(w, parameters, inputs, target)
            step = least_squares(jacobian, jnp.where(good, remaining, 0))
            return w - step * found.unit, (remaining, step)

        w, (remaining, step) = _twice(correct, found.x)
    limit = jnp.where(is_soft, jnp.inf, found.limit)
    if excused is not None:
        limit = limit + excused
    if not rows.n_soft:  # what held still does, though redundant rows that differ by rounding share the difference
        held = jnp.abs(frozen(remaining)) <= limit
        kept = jnp.abs(frozen(remaining - jacobian @ step)) <= limit / solved(point.dtype) ** 0.5
        w = jnp.where(good & jnp.any(held & ~kept), jnp.nan, w)
    return InitialPoint(w[:n], w[n:], remaining, limit, full, found.method, found.evaluations, found.jacobian)


def _large_point(
    residual: Callable[[Any, Any], Any], magnitude: Callable[[Any], Any], settings, moving, start, sizes: Sizes,
    sparse: SparseRows, core, hard, soft, bounds, full,
) -> InitialPoint:  # fmt: skip
    """The point of a large sparse model: the ladder is climbed only where sparse Newton steps do not arrive, and what
    carries the derivative is sparse unless guesses cannot all hold."""
    frozen = jax.lax.stop_gradient
    n, m = len(start), len(full)
    is_soft = np.isin(np.arange(m), soft)

    def function(w):
        return residual(w, settings)

    near = frozen(sparse_newton(function, start, sizes, sparse, bounds, magnitude))

    def climb(state):
        found = find_root(function, m, start, sizes, core, is_soft, bounds, magnitude=magnitude)
        return found.x, found.limit, found.method, found.evaluations, jnp.array(False)

    # A loop, not a branch: what it closes over must stay out of batches.
    state = near.x, near.limit, near.method, near.evaluations, ~near.holds
    x, limit, method, evaluations, _ = frozen(jax.lax.while_loop(lambda state: state[-1], climb, state))
    good = method < FAILED
    values = frozen(sparse_jacobian(function, sparse.pattern)(x))

    def correct(w):
        remaining = residual(w, moving)
        step = solve_whole(sparse.square, values[sparse.inside], remaining[sparse.core], checked=False)
        return jnp.where(good, w - step, w), remaining

    w, remaining = _twice(correct, x)
    if len(soft):

        def some_cannot():
            jacobian = jnp.where(good, sparse.pattern.dense(values), jnp.asarray(np.eye(m, n), start.dtype))
            unit = jnp.where(sizes.known > 0, sizes.known, 1)
            return _nearest_point(residual, settings, moving, x, jacobian, unit, sizes.soft, hard, soft, good)

        all_hold = jnp.all(jnp.abs(frozen(remaining)) <= limit)
        w, remaining = jax.lax.cond(all_hold, lambda: (w, remaining), some_cannot)
    return InitialPoint(w, w[:0], remaining, jnp.where(is_soft, jnp.inf, limit), full, method, evaluations, None)


def _typical_of_rows(point: SystemAt, rows: InitialRows, first: int, read: list[int]) -> Any:
    """Typical sizes of what the rows at `read` compare, shape (m,), zero for others; the rows of starts begin at
    `first`."""
    compared = [(k, rows.kept[k - first]) for k in read if rows.kept[k - first].quantity >= 0]
    place = np.array([k for k, _ in compared], np.int64)
    quantity = np.array([row.quantity for _, row in compared], np.int64)
    factor = jnp.asarray([abs(row.factor) for _, row in compared], point.dtype)
    return jnp.zeros((first + len(rows.kept),), point.dtype).at[place].set(factor * point.typical[quantity])


def _rounding(residual: Callable[..., Any], settings, start: Any, sizes: Sizes, typical: Any) -> Any:
    """Finds rows of variables outside of the state that are rounding errors and nothing else, given these variables'
    `typical` sizes: rows that hold at the start, where neither the start nor rounded parameters move them by more.
    Returns the residual that rounding may leave of each, shape (m,), zero for other rows.

    A variable that is zero because its terms cancel depends on the state by rounding errors. In units of these, other
    rows would give way to it.
    """
    parameters, inputs, target = settings
    dtype = start.dtype

    def rows(w, parameters):
        return residual(w, parameters, inputs, target)

    signs = np.random.default_rng(0).choice([-1.0, 1.0], (PERTURBATIONS, len(start) + len(parameters)))
    moves, changes = np.split(signs, [len(start)], axis=1)
    size = jnp.maximum(jnp.abs(start), sizes.known)
    none = np.zeros((PERTURBATIONS, 1))
    along = (
        jnp.asarray(np.concatenate([moves, none * moves]), dtype) * size,
        jnp.asarray(np.concatenate([none * changes, changes]), dtype) * parameters,
    )
    value = rows(start, parameters)
    moved = jax.vmap(lambda v, p: jax.jvp(rows, (start, parameters), (v, p))[1])(*along)
    slope, terms = (jnp.max(jnp.abs(m), axis=0) for m in jnp.split(moved, 2))
    eps = float(jnp.finfo(dtype).eps)
    noise = NOISE * eps * terms + CLOSE * eps * typical
    return jnp.where((typical > 0) & (jnp.abs(value) <= noise) & (slope <= noise), noise, 0)


def _nearest_point(
    residual: Callable[[Any, Any], Any], settings, moving, w, jacobian, unit, distances, hard, soft, good
) -> tuple[Any, Any]:
    """A differentiable point next to w, in units of the unknowns: min ½|S(w)|², S the soft rows, where the hard rows
    H(w) = 0 hold. Its conditions are ∇½|S|² + ∇(λᵀH) = 0, H = 0; a Newton step sharpens the point, and two more carry
    first and second derivatives. Returns w and the rows there."""
    largest = jnp.maximum(
        jnp.max(jnp.abs(jacobian * unit[None, :]), axis=1, initial=0.0), float(jnp.finfo(unit.dtype).tiny)
    )
    scale = 1 / jnp.where(distances > 0, distances, largest)

    def rows(v, data):
        return scale * residual(v * unit, data)

    def conditions(z, data):
        v, multiplier = z[: len(w)], z[len(w) :]

        def lagrangian(v):
            r = rows(v, data)
            return 0.5 * jnp.sum(r[soft] ** 2) + jnp.dot(multiplier, r[hard])

        return jnp.concatenate([jax.grad(lagrangian)(v), rows(v, data)[hard]])

    v = w / unit
    scaled = scale[:, None] * jacobian * unit[None, :]
    remaining = rows(v, settings)
    multiplier = -least_squares(scaled[hard].T, scaled[soft].T @ remaining[soft])
    z = jnp.concatenate([v, multiplier])
    matrix = jax.lax.stop_gradient(jax.jacfwd(lambda z: conditions(z, settings))(z))
    matrix = jnp.where(good, matrix, jnp.asarray(np.eye(len(z)), z.dtype))

    def correct(z, data):
        return z - least_squares(matrix, jnp.where(good, conditions(z, data), 0))

    z = jax.lax.stop_gradient(correct(jax.lax.stop_gradient(z), settings))
    z, _ = _twice(lambda z: (correct(z, moving), None), z)
    w = z[: len(w)] * unit
    return w, residual(jax.lax.stop_gradient(w), moving)


def _twice(step: Callable[[Any], tuple[Any, Any]], w: Any) -> tuple[Any, Any]:
    """w after two steps, in a loop, so that they are compiled once; and what the first one found on the way."""
    w, seen = jax.lax.scan(lambda w, _: step(w), w, length=2)
    return w, jax.tree.map(lambda a: a[0], seen)


def _sizes(plan: SystemPlan, rows: InitialRows, given: list, parameters: Any, start: Any) -> Sizes:
    """The known sizes of unknowns and of starts."""
    dtype, n = parameters.dtype, plan.n_state
    more = start.shape[0] - n
    entries = np.concatenate([plan.states, plan.carried])
    nominal = jnp.asarray(np.append(declared_scale(plan.model)[entries], np.zeros(more)), dtype)
    target, guess = _data_sizes(plan, rows, given, parameters)
    known = jnp.maximum(jnp.maximum(jnp.append(guess, jnp.zeros(more, dtype)), jnp.abs(start)), nominal)
    data = jnp.concatenate([jnp.zeros((plan.n_constraints + len(plan.carried),), dtype), target])
    return Sizes(nominal, known, data, _distances(plan, rows, data))


def _with_velocities(sizes: Sizes, x: Any, plan: SystemPlan, here: SystemAt) -> Sizes:
    """Sizes in which each velocity has at least ω·(known size of its position): redundant velocities that are all
    rounding errors would have none by which others could be judged. The frequency ω follows from all that moves, by
    |x'| = ω|x| and |x''| = ω²|x|, each position in units of its typical size."""
    owner, place = plan.extended.quantities.owner, {int(q): k for k, q in enumerate(plan.states)}
    pairs = [(k, place[q + 1]) for q, k in place.items() if q + 1 in place and owner[q] == owner[q + 1]]
    if not pairs:
        return sizes
    position, velocity = np.array(pairs).T
    unit = here.typical[plan.states[position]]
    acceleration = jnp.abs(here.semi_explicit(x)[velocity]) / unit
    fastest = jnp.max(jnp.where(jnp.isfinite(acceleration), acceleration, 0))
    largest = jnp.max(sizes.known[position] / unit)
    largest = jnp.where(largest > 0, largest, jnp.inf)
    frequency = jnp.maximum(jnp.max(sizes.known[velocity] / unit) / largest, jnp.sqrt(fastest / largest))
    return sizes._replace(known=sizes.known.at[velocity].max(frequency * sizes.known[position]))


def _distances(plan: SystemPlan, rows: InitialRows, sizes: Any) -> Any:
    """Distances that weigh the same when the point nearest to guesses is looked for: nominal values, or the largest
    guess of all variables of one unit; `sizes` are those of the rows' targets, equations first."""
    out = jnp.zeros_like(sizes)
    if not rows.n_soft:
        return out
    soft = rows.kept[-rows.n_soft :]
    units = [_unit_of(plan, row.name) for row in soft]
    same = np.array([[a == b for b in units] for a in units])
    shared = jnp.max(jnp.where(same, sizes[-rows.n_soft :][None, :], 0), axis=1)
    factor = np.abs([row.factor for row in soft])
    nominal = jnp.asarray(factor * declared_scale(plan.model)[[row.quantity for row in soft]], sizes.dtype)
    return out.at[-rows.n_soft :].set(jnp.where(nominal > 0, nominal, shared))


def _unit_of(plan: SystemPlan, name: str) -> str:
    variable = plan.variable_index.get(name)
    return "" if variable is None else plan.flat.variables.unit[variable]


def _data_sizes(plan: SystemPlan, rows: InitialRows, given: list, parameters: Any) -> tuple[Any, Any]:
    """The sizes of the terms in the rows' targets, and in the guesses of the state array."""
    both = _values((*rows.kept, *rows.guess), given, parameters, sizes=True)
    units = jnp.asarray(np.abs(_units(rows.guess)), parameters.dtype)
    return both[: len(rows.kept)], both[len(rows.kept) :] * units


def _bounds(system: Any, plan: SystemPlan, unknown: np.ndarray) -> np.ndarray:
    """The bounds of the unknowns, shape (n, 2): those of parameters are checked afterwards."""
    entries = np.concatenate([plan.states, plan.carried])
    free = np.tile([-np.inf, np.inf], (len(unknown), 1))
    return np.concatenate([quantity_bounds(plan.model)[entries], free])


def independent_rows(plan: SystemPlan, rows: InitialRows, n: int) -> np.ndarray | None:
    """The places of as many rows as unknowns, none of which follows from others; None if guesses outnumber what is
    open."""
    if rows.n_soft and not all(rows.independent[-rows.n_soft :]):
        return None
    equations = plan.n_constraints + len(plan.carried)
    core = np.append(np.ones(equations, bool), rows.independent).nonzero()[0]
    return core if len(core) == n else None


def _reader(plan: SystemPlan, kept: tuple[StartRow, ...]):
    """The values of the rows' variables as a function of the point and the state array, and their magnitudes, given
    those of the array as well."""
    quantity = np.array([r.quantity for r in kept], np.int64)
    factor = np.array([r.factor for r in kept], float)
    place = {int(q): k for k, q in enumerate((*plan.states, *plan.carried))}
    in_state = all(int(q) in place for q in quantity)
    program = plan.reading(quantity)

    def starts(here: SystemAt, x):
        if not len(quantity):
            return jnp.zeros((0,), here.dtype)
        if in_state:
            where = np.array([place[int(q)] for q in quantity])
            return times(jnp.asarray(factor, here.dtype) if (factor != 1).any() else 1.0, take(x, where))
        evaluation = here.run(program, here.split(x), Refinement.NONE)
        gather: Gather = program.layout.gather(quantity, factor)
        return jnp.broadcast_to(jnp.asarray(evaluation.read(gather), here.dtype), (len(quantity),))

    def sizes(here: SystemAt, x, reach):
        if not len(quantity):
            return jnp.zeros((0,), here.dtype)
        return jnp.abs(starts(here, x)) if in_state else here.magnitudes(x, reach, quantity, factor)

    return starts, sizes


def frozen_inputs(inputs: Any) -> Any:
    """Inputs with their arrays kept out of differentiation."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, inputs)


def _units(rows: tuple[StartRow | None, ...]) -> np.ndarray:
    """The factors from a unit of each row's variable to its quantity."""
    return np.array([1.0 if row is None else 1.0 / (row.factor or 1.0) for row in rows])


def _values(rows: tuple[StartRow | None, ...], given: list, parameters: Any, sizes: bool = False) -> Any:
    """The values of start rows, shape (rows,): one vectorised kernel for each distinct start expression. Or the sizes
    of their terms, Σ |∂(value)/∂(parameter)|·|parameter|, which rounding is relative to."""
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
            stack = jnp.stack([jnp.asarray(given[row.given], parameters.dtype) for row in chosen if row])
            parts.append(jnp.abs(stack) if sizes else stack)
            continue
        starts = [row.start for row in chosen if row and row.start]
        columns = np.array([start.parameters for start in starts], np.int64).T
        values = [take(parameters, column) for column in columns]
        time = jnp.zeros((), parameters.dtype)
        template = starts[0].template

        def kernel(values, template=template, time=time):
            return template.residual([], values, [], time, None)

        value = _term_sizes(kernel, values, template) if sizes else kernel(values)
        parts.append(jnp.broadcast_to(jnp.asarray(value, parameters.dtype), (len(places),)))
    if not parts:
        return jnp.zeros((0,), parameters.dtype)
    back = np.argsort(np.concatenate(list(members.values())), kind="stable")
    return take(jnp.concatenate(parts), back)


def _term_sizes(kernel: Callable[[list], Any], values: list, template: Any) -> Any:
    if not template.graph.arguments:
        return jnp.abs(kernel(values))
    total = jnp.abs(kernel(values))
    for k in range(len(values)):
        tangent = [v if j == k else jnp.zeros_like(v) for j, v in enumerate(values)]
        total = total + jnp.abs(jax.jvp(kernel, (values,), (tangent,))[1])
    return total


def is_consistent(found: InitialPoint) -> Any:
    """True if all rows hold, to rounding."""
    # What is not traced is compared by NumPy: each operation by itself would be a program to compile.
    parts: Any = (found.residual, found.limit, found.x, found.solved)
    traced = any(isinstance(part, Tracer) for part in parts)
    xp: Any = jnp if traced else np
    residual, limit, x, solved = parts if traced else map(np.asarray, parts)
    return xp.all(xp.abs(residual) <= limit) & xp.all(xp.isfinite(xp.append(x, solved)))


def find_initial(
    system: Any,
    t0: Any,
    inputs: Mapping[str, Any] | None,
    initial: Mapping[str, Any] | None,
    solve_for: tuple[str, ...] = (),
    solver: Any = None,
) -> InitialPoint:
    """`initialize`, compiled once for each structure outside of programs that others compile."""
    dtype = system.parameters.values.dtype
    if np.shape(t0) != () or isinstance(t0, Mapping | str):
        raise ModelError(f"t0 must be a time, a number; got {t0!r}. Values at the start go to initial={{...}}")
    check_initial(system, initial)
    inputs = read_inputs(system.plan, dtype, inputs)
    initial = {name: jnp.asarray(v, dtype) for name, v in sorted((initial or {}).items())}
    arguments = (system, jnp.asarray(t0, dtype), inputs, initial, solve_for, solver)
    if not is_staged(arguments):
        found = _compiled(*arguments)
        # An input's function may close over a traced value, which shows in the outcome only.
        if not is_staged(found.x):
            return found
    PROGRAMS.make_room()
    return initialize(*arguments)


_compiled = compiled(initialize)
