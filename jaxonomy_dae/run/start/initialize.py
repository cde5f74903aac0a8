"""Consistent initialization.

`InitialProblem` has the equations. A ladder of methods finds the point, kept out of differentiation. Of two last steps
the first carries first derivatives, which by the implicit function theorem are exact, and the second one second
derivatives. Without guesses they are Gauss–Newton steps of the rows; with guesses Newton steps of the conditions for
the nearest point.

Where values are known the search runs outside of programs (`search_outside`), and a program holds the last steps alone.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...base.errors import ModelError
from ...base.tolerances import solved
from ...compile.lowering.plan import SystemPlan
from ...host.cache import PROGRAMS, compiled
from ...host.platform import precisely
from ...host.staging import as_argument, is_staged, is_traced
from ...solve.linear.dense import least_squares
from ...solve.linear.newton import twice
from ...solve.linear.sparse import sparse_jacobian
from ...solve.linear.whole import solve_whole
from ..system.inputs import read_inputs
from .explicit import Substitution, substitution
from .given_solver import find_root_with
from .initial_values import check_initial
from .ladder import FAILED, STAGED, Found, find_root
from .problem import InitialProblem, bounds_of, chooses, guessed_from, independent_rows
from .rows import InitialRows, initial_rows
from .search import Look
from .sizes import Sizes, column_sizes, row_sizes, terms_of, weighed
from .sparse_newton import SparseRows, sparse_newton, sparse_rows
from .stages import solve_in_stages, stages


class InitialPoint(NamedTuple):
    """The result of the search for a consistent point.

    - `x`: the state array, shape (n_state,); `solved`: the parameters solved for.
    - `residual`, `limit`, `target`: of each row, the residual, the largest that counts as rounding, and the value the
        row should have had (zero for equations).
    - `method`: an index into `METHODS`; `evaluations`: their number.
    - `jacobian`: that of the rows with respect to (x, solved); of sparse rows, the values at their places.
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
    found: Found | None = None,
) -> InitialPoint:
    """Finds a consistent point; a pure function, to be used inside jit. Raises errors for wrong names and counts only:
    see `check`. `found` is what `search_outside` found, if it did."""
    problem = InitialProblem(system, t0, inputs, initial, solve_for)
    plan, rows, dtype = problem.plan, problem.rows, problem.point.dtype
    # Most models: every start is a state, and nothing restricts the states. No search is compiled for them.
    if rows.direct:
        x0, nothing = problem.x0, jnp.zeros((), jnp.int32)
        value = problem.starts(problem.point, x0)
        limit = solved(dtype) * (jnp.abs(value) + problem.data)
        return InitialPoint(
            x=x0, solved=x0[:0], residual=value - problem.target, limit=limit, target=problem.target,
            method=nothing, evaluations=nothing, jacobian=None,
        )  # fmt: skip
    sparse = None if len(solve_for) or solver is not None else sparse_rows(plan, rows)
    if sparse is not None:
        return _large_point(problem, sparse)
    # Derivatives do not pass through the search, whose steps and decisions do not matter: by the implicit function
    # theorem they follow from the equations at the point found.
    root: Found = jax.lax.stop_gradient(_searched(problem, solver) if found is None else found)
    # Where nothing was found, there is nothing to differentiate, and the others of a batch must not notice.
    good = root.method < FAILED
    jacobian = jnp.where(good, root.jacobian, jnp.asarray(np.eye(len(root.limit), len(root.x)), dtype))
    if rows.n_soft:
        w, remaining = _nearest_point(problem, root.x, jacobian, root.unit, good)
        step = None
    else:
        # What rounding leaves of the gradient of a row that no unknown moves would count as much as other rows.
        settled = np.isin(np.arange(problem.m), problem.n_equations + np.array(rows.settled, int))
        jacobian = jnp.where(settled[:, None], 0, jacobian) * root.unit[None, :]

        def correct(w):
            remaining = problem.residual(w, problem.moving)
            step = least_squares(jacobian, jnp.where(good, remaining, 0))
            return w - step * root.unit, (remaining, step)

        w, (remaining, step) = twice(correct, root.x)
    limit = jnp.where(problem.is_soft, jnp.inf, root.limit)
    if problem.excused is not None:
        limit = limit + problem.excused
    if step is not None:  # what held still does, though redundant rows that differ by rounding share the difference
        remaining_here = jax.lax.stop_gradient(remaining)
        held = jnp.abs(remaining_here) <= limit
        kept = jnp.abs(jax.lax.stop_gradient(remaining - jacobian @ step)) <= limit / solved(dtype) ** 0.5
        w = jnp.where(good & jnp.any(held & ~kept), jnp.nan, w)
    n = plan.n_state
    return InitialPoint(
        x=w[:n], solved=w[n:], residual=remaining, limit=limit, target=problem.full,
        method=root.method, evaluations=root.evaluations, jacobian=root.jacobian,
    )  # fmt: skip


def _searched(problem: InitialProblem, solver: Any) -> Found:
    """The search inside a program."""
    plan, rows, start, sizes = problem.plan, problem.rows, problem.start, problem.sizes
    core = problem.core
    searched = solver is not None or len(problem.unknown) or (rows.n_soft and core is None)
    if not searched and not np.isfinite(problem.bounds).any():
        order = substitution(plan, rows)
        if order is not None:
            return _substituted(problem, order)
    # In this order: blocks one after the other give a start to guesses, and guesses one to the ladder.
    staged = None if len(problem.unknown) else stages(plan, rows)
    if staged is not None:
        start = jax.lax.stop_gradient(solve_in_stages(problem.function, start, sizes, *staged))
    if problem.chooses:
        start = jax.lax.stop_gradient(guessed_from(plan, rows, problem.look_at_guesses, start, problem.typical))
    if solver is not None:
        square = core is not None or not rows.n_soft
        return find_root_with(solver, problem.function, start, sizes, problem.is_soft, square, problem.magnitude)
    found = find_root(
        problem.look,
        problem.m,
        start,
        sizes,
        core,
        soft=problem.is_soft,
        bounds=problem.bounds,
        typical=problem.typical,
    )
    if staged is None:
        return found
    moved = jnp.any(start != problem.start)
    return found._replace(method=jnp.where((found.method == 0) & moved, STAGED, found.method))


def _substituted(problem: InitialProblem, order: Substitution) -> Found:
    """The point where unknowns follow from each other."""
    start, sizes, unit = problem.start, problem.sizes, problem.typical
    over = jnp.asarray(1 / order.coefficient, start.dtype)
    x = start
    if order.levels:
        x, _ = jax.lax.scan(lambda w, _: (w - over * problem.function(w)[order.row], None), start, length=order.levels)
    at = problem.look(x)
    measured = sizes._replace(nominal=sizes.nominal / unit, known=sizes.known / unit)
    unit = unit * column_sizes(terms_of(at.value, at.terms), at.jacobian * unit, measured)
    size, noise = row_sizes(weighed(at.jacobian), x, sizes, unit, at.terms)
    limit = solved(start.dtype) * size + noise
    holds = jnp.all(jnp.abs(at.value) <= limit) & jnp.all(jnp.isfinite(at.jacobian))
    method = jnp.where(holds, int(order.levels > 0), FAILED).astype(jnp.int32)
    return Found(x, at.jacobian, limit, unit, method, jnp.asarray(order.levels + 1, jnp.int32))


class _Looked(NamedTuple):
    """What a search outside of programs asks for: the point itself, sizes of unknowns and rows, and the rows there."""

    w: Any
    sizes: Sizes
    typical: Any
    rows: Look


@precisely
def _look(system, t0, inputs, initial, solve_for: tuple[str, ...], w: Any) -> _Looked:
    """The rows at w; at the start where w is not-a-number."""
    problem = InitialProblem(system, t0, inputs, initial, solve_for)
    w = jnp.where(jnp.all(jnp.isnan(w)), problem.start, w)
    return _Looked(w, problem.sizes, problem.typical, (problem.look_at_guesses if problem.chooses else problem.look)(w))


_compiled_look = compiled(_look)


def search_outside(
    system: Any, t0: Any, inputs: Any, initial: Mapping[str, Any], solve_for: tuple[str, ...] = ()
) -> Found | None:
    """The point found by a ladder that runs in NumPy: a program of the rows and their Jacobian is all that is compiled.
    None where values are not known, as inside jit, and where the search is another one."""
    plan, system = system.plan, system.without_stiffness
    system, t0, inputs, initial = known = jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf) if is_traced(leaf) else leaf, (system, t0, inputs, initial)
    )
    if is_traced(known):
        return None
    unknown = tuple(system.parameters.table.index(n) for n in solve_for)
    rows = initial_rows(plan, tuple(initial), unknown)
    if rows.direct or (not unknown and (sparse_rows(plan, rows) is not None or stages(plan, rows) is not None)):
        return None
    n, dtype = plan.n_state + len(unknown), system.parameters.values.dtype

    def looked(w: Any) -> Any:
        return _compiled_look(system, t0, inputs, initial, solve_for, as_argument(w))

    # The program of the rows finds the start by itself, since that is computed from values that only it has.
    # Not-a-number asks for it, so that one program serves.
    first = looked(np.full(n, np.nan, dtype))
    if is_traced(first):  # a network may close over a traced value
        return None
    first = jax.device_get(first)

    def look_at_all(w: Any) -> Look:
        return first.rows if np.array_equal(w, first.w) else jax.device_get(looked(w).rows)

    m = plan.n_constraints + len(plan.carried) + len(rows.kept)

    def look(w: Any) -> Look:
        value, jacobian, terms = look_at_all(w)
        return Look(value[:m], jacobian[:m], None if terms is None else terms[:m])

    soft = np.arange(m) >= m - rows.n_soft
    core, bounds = independent_rows(plan, rows, n), bounds_of(plan, len(unknown))
    with np.errstate(all="ignore"):  # what is not finite is a rung's failure, as in a program
        start = first.w
        if chooses(plan, rows):
            start = guessed_from(plan, rows, look_at_all, start, first.typical)
        root = find_root(look, m, start, first.sizes, core, soft=soft, bounds=bounds, typical=first.typical)
    return jax.tree.map(as_argument, root)


def slopes_at_guess(
    system: Any, t0: Any, inputs: Any, initial: Mapping[str, Any], solve_for: tuple[str, ...] = ()
) -> np.ndarray:
    """The Jacobian of the rows where a search outside of programs begins."""
    n = system.plan.n_state + len(solve_for)
    nowhere = np.full(n, np.nan, system.parameters.values.dtype)
    return jax.device_get(
        _compiled_look(system.without_stiffness, t0, inputs, initial, solve_for, nowhere)
    ).rows.jacobian


def known_start(system: Any, t0: Any, inputs: Any, initial: Mapping[str, Any] | None) -> InitialPoint | None:
    """For a program that somebody else compiles: the consistent point, if all that it follows from has a value while
    that is traced, as where the weights of networks are trained that no constraint reads. None otherwise.

    Inputs that are functions may close over anything, and are left to the program.
    """
    plan = system.plan
    numbers = all(isinstance(v, int | float | tuple | list | np.ndarray | jax.Array) for v in (inputs or {}).values())
    if not numbers or is_traced((eqx.tree_at(lambda s: s.neural, system, {}), t0, inputs, initial)):
        return None
    rows = initial_rows(plan, tuple(sorted(initial or ())))
    if rows.direct or _read_networks(plan, rows):
        return None
    # Only the field reads weights then, which tells at most how fast is fast: what is not finite there says nothing.
    neural = jax.tree.map(
        lambda leaf: np.full(leaf.shape, np.nan, leaf.dtype) if eqx.is_inexact_array(leaf) else leaf, system.neural
    )
    with jax.ensure_compile_time_eval():
        neural = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, neural)
        found = find_initial(eqx.tree_at(lambda s: s.neural, system, neural), t0, inputs, initial)
    return None if is_traced(found) else found


def _read_networks(plan: SystemPlan, rows: InitialRows) -> bool:
    """True if a row of the initial equations depends on a network."""
    programs = (
        plan.constraint_program,
        plan.carried_residuals,
        plan.reading(np.array([row.quantity for row in rows.kept], np.int64)),
    )
    return any(p.reads_networks for p in programs) or any(
        planned.equation.template.opaque is not None for planned in plan.constraints
    )


def _large_point(problem: InitialProblem, sparse: SparseRows) -> InitialPoint:
    """The point of a large sparse model: the ladder is climbed only where sparse Newton steps do not arrive, and what
    carries the derivative is sparse unless guesses cannot all hold."""
    frozen = jax.lax.stop_gradient
    start, sizes, m = problem.start, problem.sizes, problem.m
    n = len(start)
    # The dense ladder takes n³ operations in each of its steps: for 800 unknowns 41 s.
    near = frozen(sparse_newton(problem.function, start, sizes, sparse, problem.bounds, problem.magnitude))

    def climb(state):
        found = find_root(problem.look, m, start, sizes, problem.core, problem.is_soft, problem.bounds)
        return found.x, found.limit, found.method, found.evaluations, jnp.array(False)

    # A loop, not a branch: what it closes over must stay out of batches.
    state = near.x, near.limit, near.method, near.evaluations, ~near.holds
    x, limit, method, evaluations, _ = frozen(jax.lax.while_loop(lambda state: state[-1], climb, state))
    good = method < FAILED
    values = frozen(sparse_jacobian(problem.function, sparse.pattern)(x))

    def correct(w):
        remaining = problem.residual(w, problem.moving)
        step = solve_whole(sparse.square, values[sparse.inside], remaining[sparse.core], checked=False)
        return jnp.where(good, w - step, w), remaining

    w, remaining = twice(correct, x)
    if problem.rows.n_soft:

        def some_cannot():
            jacobian = jnp.where(good, sparse.pattern.dense(values), jnp.asarray(np.eye(m, n), start.dtype))
            return _nearest_point(problem, x, jacobian, jnp.where(sizes.known > 0, sizes.known, 1), good)

        # Where all guesses hold, the point nearest to them is the root itself, and nothing dense is computed.
        all_hold = jnp.all(jnp.abs(frozen(remaining)) <= limit)
        w, remaining = jax.lax.cond(all_hold, lambda: (w, remaining), some_cannot)
    limit = jnp.where(problem.is_soft, jnp.inf, limit)
    return InitialPoint(
        x=w, solved=w[:0], residual=remaining, limit=limit, target=problem.full,
        method=method, evaluations=evaluations, jacobian=values,
    )  # fmt: skip


def _nearest_point(problem: InitialProblem, w, jacobian, unit, good) -> tuple[Any, Any]:
    """A differentiable point next to w, in units of the unknowns: min ½|S(w)|², S the soft rows, where the hard rows
    H(w) = 0 hold. Its conditions are ∇½|S|² + ∇(λᵀH) = 0, H = 0; a Newton step sharpens the point, and two more carry
    first and second derivatives. Returns w and the rows there."""
    settings, moving, distances = problem.settings, problem.moving, problem.sizes.soft
    hard, soft = np.flatnonzero(problem.alone & ~problem.is_soft), np.flatnonzero(problem.is_soft)
    largest = jnp.maximum(
        jnp.max(jnp.abs(jacobian * unit[None, :]), axis=1, initial=0.0), float(jnp.finfo(unit.dtype).tiny)
    )
    scale = 1 / jnp.where(distances > 0, distances, largest)

    def rows(v, data):
        return scale * problem.residual(v * unit, data)

    def conditions(z, data):
        v, multiplier = z[: len(w)], z[len(w) :]

        def lagrangian(v):
            r = rows(v, data)
            return 0.5 * jnp.sum(r[soft] ** 2) + jnp.dot(multiplier, r[hard])

        return jnp.concatenate([jax.grad(lagrangian)(v), rows(v, data)[hard]])

    v = w / unit
    scaled = scale[:, None] * jacobian * unit[None, :]
    remaining = rows(v, settings)
    # Multipliers of the point that the ladder found: from there, one Newton step of the conditions is enough.
    multiplier = -least_squares(scaled[hard].T, scaled[soft].T @ remaining[soft])
    z = jnp.concatenate([v, multiplier])
    matrix = jax.lax.stop_gradient(jax.jacfwd(lambda z: conditions(z, settings))(z))
    matrix = jnp.where(good, matrix, jnp.asarray(np.eye(len(z)), z.dtype))

    def correct(z, data):
        return z - least_squares(matrix, jnp.where(good, conditions(z, data), 0))

    z = jax.lax.stop_gradient(correct(jax.lax.stop_gradient(z), settings))
    z, _ = twice(lambda z: (correct(z, moving), None), z)
    w = z[: len(w)] * unit
    return w, problem.residual(jax.lax.stop_gradient(w), moving)


def is_consistent(found: InitialPoint) -> Any:
    """True if all rows hold, to rounding."""
    # What is not traced is compared by NumPy: each operation by itself would be a program to compile.
    parts: Any = (found.residual, found.limit, found.x, found.solved)
    traced = is_traced(parts)
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
    initial = {name: as_argument(v, dtype) for name, v in sorted((initial or {}).items())}
    arguments = (system.without_stiffness, as_argument(t0, dtype), inputs, initial, solve_for)
    if not is_staged(arguments):
        begun = search_outside(*arguments) if solver is None else None
        found = _compiled(*arguments, solver, begun)
        # An input's function may close over a traced value, which shows in the outcome only.
        if not is_staged(found.x):
            return found
    PROGRAMS.make_room()
    return initialize(*arguments, solver)


_compiled = compiled(initialize)
