"""The equations of a consistent start: unknowns, rows, and what measures them.

The unknowns w are the state array's entries, and parameters that are solved for. The rows are: hidden constraints,
residuals of nonlinear blocks, values given by the caller, fixed starts, and the guesses that `initial_rows` keeps. The
rows may be redundant, as long as they agree.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ...base.tolerances import CLOSE, KNOWN, NOISE
from ...compile.lowering.gather import Gather, take, times
from ...compile.lowering.plan import SystemPlan
from ...compile.model.declared import declared_scale, quantity_bounds
from ...solve.linear.choice import DENSE_UPTO
from ..system.nonlinear import Refinement
from ..system.system_at import SystemAt
from .guessed_point import guessed_point
from .ladder import looking
from .rows import InitialRows, StartRow, initial_rows
from .search import Look
from .sizes import Sizes

# Patterns of small changes of the start and of parameters, which show how large terms are.
PERTURBATIONS = 8


class InitialProblem:
    """The rows F(w) = 0 of a start.

    - `start`: where the search begins, shape (n,), and `sizes`: of unknowns and of what rows are compared with.
    - `moving`: parameters, inputs and targets with their derivatives; `settings` are the same without.
    - `target`, `full`: the values that starts should have, and those of all rows, zero for equations.
    - `excused`: what rounding may leave of each row, or None.
    """

    def __init__(
        self,
        system: Any,
        t0: Any,
        inputs: Any,
        initial: Mapping[str, Any] | None,
        solve_for: tuple[str, ...] = (),
    ):
        frozen = jax.lax.stop_gradient
        plan: SystemPlan = system.plan
        self.plan, self.t0, self._table = plan, t0, system.parameters.table
        names = tuple(initial or ())
        self.unknown = np.array([self._table.index(n) for n in solve_for], np.int64)
        self.rows = rows = initial_rows(plan, names, tuple(self.unknown.tolist()))
        self._given = [initial[n] for n in names] if initial else []
        self.point: SystemAt = system.at(t0, inputs)
        parameters, dtype = self.point.parameters, self.point.dtype
        both = (*rows.kept, *rows.guess, *rows.hints)
        values, sizes = start_values(both, self._given, parameters)
        n_hints = len(rows.hints)
        values, hinted = jnp.split(values, [len(both) - n_hints])
        sizes, self._sizes_of_hints = jnp.split(sizes, [len(both) - n_hints])
        # From a unit of each row's variable to its quantity.
        units = jnp.asarray([1.0 if row is None else 1.0 / (row.factor or 1.0) for row in rows.guess], dtype)
        kept = len(rows.kept)
        self.target, self.data = values[:kept], sizes[:kept]
        self.x0 = values[kept:] * units
        self.starts, self._sizes_of_starts = _reader(plan, rows.kept)
        self.hinted, (self._hints, _) = jax.lax.stop_gradient(hinted), _reader(plan, rows.hints)
        self.n_equations = plan.n_constraints + len(plan.carried)
        self.m = self.n_equations + kept
        self.moving = parameters, inputs, self.target
        self.settings = frozen(parameters), frozen_inputs(inputs), frozen(self.target)
        self.full = jnp.concatenate([jnp.zeros((self.n_equations,), dtype), self.target])
        # Rows that must hold come first, guesses last: everything below reads them by this order.
        self.is_soft = np.arange(self.m) >= self.m - rows.n_soft
        self.excused = None
        if rows.direct:
            return
        entries = np.concatenate([plan.states, plan.carried]).astype(np.int64)
        more = np.zeros(len(self.unknown))
        self._nominal = jnp.asarray(declared_scale(plan.model)[entries], dtype)
        self.typical = jnp.append(self.point.typical[entries], jnp.asarray(more + 1, dtype))
        self.start = frozen(jnp.append(self.x0, parameters[self.unknown]) if len(more) else self.x0)
        nominal = jnp.append(self._nominal, jnp.asarray(more, dtype))
        guess = jnp.append(sizes[kept:] * jnp.abs(units), jnp.asarray(more, dtype))
        # The largest of what is known: a guess of zero for a pressure says nothing of its size, its nominal value does.
        known = jnp.maximum(jnp.maximum(guess, jnp.abs(self.start)), nominal)
        # A guess that is rounding, as π − 3.14159…, says nothing of a size.
        known = jnp.where((known > 0) & (known <= KNOWN * self.typical), self.typical, known)
        data = jnp.concatenate([jnp.zeros((self.n_equations,), dtype), self.data])
        self.sizes = frozen(Sizes(nominal, known, data, _distances(plan, rows, data)))
        if self.m > len(self.start):
            self.sizes = frozen(_with_velocities(self.sizes, self.start[: plan.n_state], plan, system.at(t0, inputs)))
        state = {int(q) for q in entries}
        # Only rows of variables outside of the state can be rounding errors and nothing else: an entry of the state is
        # an unknown itself. Where no row is redundant, there is none to give way to it.
        read = [self.n_equations + k for k, row in enumerate(rows.kept) if row.quantity not in state]
        if read and rows.redundant and not rows.n_soft:
            typical = _typical_of_rows(self.point, rows, self.n_equations, read)
            self.excused = frozen(_rounding(self.residual, self.settings, self.start, self.sizes, typical))

    def _at(self, parameters: Any, inputs: Any, w: Any) -> SystemAt:
        if len(self.unknown):
            parameters = self._table.complete(parameters.at[self.unknown].set(w[self.plan.n_state :]))
        once = self.point.once
        return SystemAt(self.plan, parameters, self.point.networks, self.t0, inputs, self.point.typical, once=once)

    def residual(self, w: Any, moving: tuple[Any, Any, Any]) -> Any:
        """F(w), shape (m,), with parameters, inputs and targets."""
        parameters, inputs, target = moving
        here, x = self._at(parameters, inputs, w), w[: self.plan.n_state]
        if len(self.unknown):
            # Starts may be expressions in a parameter that is solved for, such as a release angle.
            target, _ = start_values(self.rows.kept, self._given, here.parameters)
        parts = [here.constraint_vector(x)]
        if len(self.plan.carried):
            parts.append(here.carried_vector(here.t, x))
        return jnp.concatenate([*parts, self.starts(here, x) - target])

    def function(self, w: Any) -> Any:
        """F(w) as it is searched for: not differentiated, without rows that are rounding errors."""
        value = self.residual(w, self.settings)
        return value if self.excused is None else jnp.where(self.excused > 0, 0, value)

    def magnitude(self, w: Any) -> Any:
        """How large the terms of each row are, shape (m,)."""
        parameters, inputs, _ = self.settings
        here, x = self._at(parameters, inputs, w), w[: self.plan.n_state]
        reach = jnp.maximum(jnp.abs(x), self._nominal)
        parts = [here.constraint_magnitudes(x, reach)]
        if len(self.plan.carried):
            parts.append(here.carried_magnitudes(x, reach))
        return jnp.concatenate([*parts, self._sizes_of_starts(here, x, reach)])

    def look(self, w: Any) -> Any:
        """The rows at a point, for the search."""
        return looking(self.function, self.magnitude)(w)

    @property
    def chooses(self) -> bool:
        """True if declared guesses may choose among solutions: more of them than the equations leave open."""
        return chooses(self.plan, self.rows)

    def look_at_guesses(self, w: Any) -> Look:
        """The rows at a point, those of guesses that the others determine at the end."""

        def function(w: Any) -> Any:
            here = self._at(*self.settings[:2], w)
            return jnp.append(self.function(w), self._hints(here, w[: self.plan.n_state]) - self.hinted)

        def magnitude(w: Any) -> Any:
            return jnp.append(self.magnitude(w), jnp.abs(self.hinted))

        return looking(function, magnitude)(w)

    @property
    def core(self) -> np.ndarray | None:
        """As `independent_rows`."""
        return independent_rows(self.plan, self.rows, self.plan.n_state + len(self.unknown))

    @property
    def bounds(self) -> np.ndarray:
        """As `bounds_of`."""
        return bounds_of(self.plan, len(self.unknown))

    @property
    def alone(self) -> np.ndarray:
        """True for rows that do not follow from those before them, shape (m,)."""
        return np.append(np.ones(self.n_equations, bool), self.rows.independent)


def chooses(plan: SystemPlan, rows: InitialRows) -> bool:
    """True if declared guesses may choose among solutions: more of them than the equations leave open."""
    shares = rows.n_soft and not all(rows.independent[-rows.n_soft :])
    return not rows.direct and plan.n_state <= DENSE_UPTO and bool(rows.hints or shares)


def guessed_from(plan: SystemPlan, rows: InitialRows, look: Any, start: Any, typical: Any) -> Any:
    """As `guessed_point`, of rows that end with `rows.hints`."""
    n_equations, n_more = plan.n_constraints + len(plan.carried), len(start) - plan.n_state
    is_start = np.append(np.zeros(n_equations, bool), np.ones(len(rows.kept) + len(rows.hints), bool))
    # Zeros that nobody wrote must not choose between solutions.
    undeclared = [k for k, row in enumerate(rows.kept, n_equations) if row.start is None and row.given < 0]
    counts = np.ones(len(is_start), bool)
    counts[undeclared] = False
    return guessed_point(look, start, typical, is_start, counts, bounds_of(plan, n_more))


def bounds_of(plan: SystemPlan, n_unknown: int) -> np.ndarray:
    """The bounds of the unknowns, shape (n, 2): those of parameters are checked afterwards."""
    entries = np.concatenate([plan.states, plan.carried])
    return np.concatenate([quantity_bounds(plan.model)[entries], np.tile([-np.inf, np.inf], (n_unknown, 1))])


def independent_rows(plan: SystemPlan, rows: InitialRows, n: int) -> np.ndarray | None:
    """The places of as many rows as unknowns, none of which follows from others; None if guesses outnumber what is
    open."""
    if rows.n_soft and not all(rows.independent[-rows.n_soft :]):
        return None
    equations = plan.n_constraints + len(plan.carried)
    core = np.append(np.ones(equations, bool), rows.independent).nonzero()[0]
    return core if len(core) == n else None


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
        return residual(w, (parameters, inputs, target))

    # Changes of all arguments at once, with several patterns of signs: one alone may let two terms cancel, and a
    # direction for each argument would take as many derivatives as there are arguments.
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
    return sizes._replace(known=jnp.asarray(sizes.known).at[velocity].max(frequency * sizes.known[position]))


def _distances(plan: SystemPlan, rows: InitialRows, sizes: Any) -> Any:
    """Distances that weigh the same when the point nearest to guesses is looked for: nominal values, or the largest
    guess of all variables of one unit; `sizes` are those of the rows' targets, equations first."""
    out = jnp.zeros_like(sizes)
    if not rows.n_soft:
        return out
    soft = rows.kept[-rows.n_soft :]
    index, unit = plan.variable_index, plan.flat.variables.unit
    units = [unit[index[row.name]] if row.name in index else "" for row in soft]
    same = np.array([[a == b for b in units] for a in units])
    # One distance for all guesses of a unit: by its own size, a small guess would weigh more than a large one.
    shared = jnp.max(jnp.where(same, sizes[-rows.n_soft :][None, :], 0), axis=1)
    factor = np.abs([row.factor for row in soft])
    nominal = jnp.asarray(factor * declared_scale(plan.model)[[row.quantity for row in soft]], sizes.dtype)
    return out.at[-rows.n_soft :].set(jnp.where(nominal > 0, nominal, shared))


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
        evaluation = here.run(program, x, Refinement.NONE)
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


def start_values(rows: tuple[StartRow | None, ...], given: list, parameters: Any) -> tuple[Any, Any]:
    """The values of start rows, shape (rows,): one vectorised kernel for each distinct start expression. And the sizes
    of their terms, |value| + Σ |∂(value)/∂(parameter)|·|parameter|, which rounding is relative to: constants. Where a
    slope is infinite, as that of a root at zero, it tells no size."""
    members: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        key = "zero" if row is None or (row.start is None and row.given < 0) else "given"
        if row is not None and row.start is not None and row.given < 0:
            key = row.start.template.key
        members.setdefault(key, []).append(k)
    dtype, parts, sizes = parameters.dtype, [], []
    for key, places in members.items():
        shape, chosen = (len(places),), [rows[k] for k in places]
        if key == "zero":
            value = size = jnp.zeros(shape, dtype)
        elif key == "given":
            value = jnp.stack([jnp.asarray(given[row.given], dtype) for row in chosen if row])
            size = jnp.abs(value)
        else:
            starts = [row.start for row in chosen if row and row.start]
            columns = np.array([start.parameters for start in starts], np.int64).T
            template = starts[0].template

            def kernel(*values, template=template, shape=shape):
                value = template.residual([], list(values), [], jnp.zeros((), dtype), None)
                return jnp.broadcast_to(jnp.asarray(value, dtype), shape)

            read = [_column(parameters, column) for column in columns]
            value, pull = jax.vjp(kernel, *read)
            slopes = pull(jnp.ones(shape, dtype))
            terms = (jnp.where(jnp.isfinite(s), jnp.abs(s * v), 0) for s, v in zip(slopes, read, strict=True))
            size = sum(terms, jnp.abs(value))
        parts.append(value)
        sizes.append(jax.lax.stop_gradient(size))
    if not parts:
        return jnp.zeros((0,), dtype), jnp.zeros((0,), dtype)
    order = np.argsort(np.concatenate(list(members.values())), kind="stable")
    value, size = (take(jnp.concatenate(found), order) for found in (parts, sizes))
    return value, size


def _column(parameters: Any, column: Int[np.ndarray, " n"]) -> Any:
    """parameters[column]; a single one that all read is no gather."""
    if (column == column[0]).all():
        return jnp.broadcast_to(parameters[int(column[0])], column.shape)
    return take(parameters, column)
