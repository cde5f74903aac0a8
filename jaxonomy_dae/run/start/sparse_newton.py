"""Newton's method for starts of large sparse models: a line search, and no dense matrix.

Given the rows of initialization and where the entries of their Jacobian lie, returns the point at which all of them
hold, guesses included, or says that it found none; then the ladder climbs on. A Jacobian costs as many directional
derivatives as its pattern has colours, a step one factorization by KLU.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...base.tolerances import close as close_within
from ...base.tolerances import solved
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.remembered import remembered
from ...solve.linear.choice import SPARSE_DENSITY, SPARSE_FROM
from ...solve.linear.newton import Tried, newton
from ...solve.linear.sparse import SparsePattern, available, is_double, sparse_jacobian
from ...solve.linear.whole import solve_whole
from .gauss_newton import DECREASE, NEWTON_LIMIT, SHORTEST
from .ladder import METHODS
from .rows import InitialRows
from .sizes import Sizes, row_sizes


class SparseRows(NamedTuple):
    """The sparse Jacobian of all rows: its pattern; `core`, as many rows as unknowns, none of which follows from
    others; and the entries of these, as a square pattern."""

    pattern: SparsePattern
    core: Int[np.ndarray, " n"]
    square: SparsePattern
    inside: Int[np.ndarray, " entries"]


class SparseFound(NamedTuple):
    """The last point, the largest value of each row that counts as zero, whether all rows hold, an index into
    `METHODS`, and the evaluations it took."""

    x: Float[Array, " n"]
    limit: Float[Array, " m"]
    holds: Bool[Array, ""]
    method: Int[Array, ""]
    evaluations: Int[Array, ""]


@remembered
def sparse_rows(plan: SystemPlan, rows: InitialRows) -> SparseRows | None:
    """The pattern of the rows; None if dense algebra will do, or must."""
    n, equations = plan.n_state, plan.n_constraints + len(plan.carried)
    core = np.append(np.ones(equations, bool), rows.independent).nonzero()[0]
    if rows.n_soft and any(step.whole and step.linear for step in plan.steps):
        return None  # the nearest point to guesses is a branch, and batches cannot have sparse solves in one
    if n < SPARSE_FROM or len(core) != n or not (is_double() and available()):
        return None
    if (plan.n_constraints and plan.constraint_pattern is None) or (len(plan.carried) and plan.dae_pattern is None):
        return None
    place = {int(q): k for k, q in enumerate((*plan.states, *plan.carried))}
    if not all(row.quantity in place for row in rows.kept):
        return None
    reads = [sorted(read) for read in plan.constraint_pattern or ()] if plan.n_constraints else []
    lengths = [len(read) for read in reads]
    row: list[np.ndarray] = [np.repeat(np.arange(len(reads)), lengths)]
    column: list[np.ndarray] = [np.array([c for read in reads for c in read], np.int64)]
    if len(plan.carried) and plan.dae_pattern is not None:
        below = plan.dae_pattern.rows >= len(plan.states)
        row.append(plan.dae_pattern.rows[below] - len(plan.states) + len(reads))
        column.append(plan.dae_pattern.cols[below])
    row.append(equations + np.arange(len(rows.kept)))
    column.append(np.array([place[r.quantity] for r in rows.kept], np.int64))
    pattern = SparsePattern(np.concatenate(row), np.concatenate(column), n, equations + len(rows.kept))
    if pattern.density > SPARSE_DENSITY:
        return None
    number = np.full(pattern.n_rows, -1)
    number[core] = np.arange(n)
    inside = np.flatnonzero(number[pattern.rows] >= 0)
    return SparseRows(pattern, core, SparsePattern(number[pattern.rows[inside]], pattern.cols[inside], n), inside)


def sparse_newton(
    function: Callable[[Any], Any],
    start: Float[Array, " n"],
    sizes: Sizes,
    rows: SparseRows,
    bounds: Float[np.ndarray, "n 2"],
    magnitude: Callable[[Any], Any],
) -> SparseFound:
    """Newton's method from `start`, steps halved until the residual falls and no bound is crossed; `magnitude` says how
    large the terms of each row are, as for `find_root`."""
    dtype = start.dtype
    close, enough = close_within(dtype), solved(dtype)
    low, high = jnp.asarray(bounds.T, dtype)
    start = jnp.clip(start, low, high)
    unit = jnp.where(sizes.known > 0, sizes.known, 1)
    jacobian = sparse_jacobian(function, rows.pattern)

    def sizes_of_rows(x, values):
        slopes = jnp.where(jnp.isfinite(values), jnp.abs(values), 0)
        return row_sizes(lambda v: rows.pattern.multiply(slopes, jnp.asarray(v)), x, sizes, unit, magnitude(x))

    def largest(values):
        moved = jnp.abs(values) * unit[rows.pattern.cols]
        found = jnp.zeros(rows.pattern.n_rows, dtype).at[rows.pattern.rows].max(moved)
        return 1 / jnp.where((found > 0) & (found < jnp.inf), found, 1)

    def look(x, part, last):
        weight, least, *_ = last
        value, values = jax.lax.stop_gradient((function(x), jacobian(x)))
        size, noise = sizes_of_rows(x, values)
        # The weights of the start are kept: sums of squares with different weights cannot be compared.
        weight = jnp.where(least < jnp.inf, weight, largest(values))
        # Redundant rows fall with those they follow from, and would only weigh them twice.
        merit = jnp.sqrt(jnp.sum((weight * value)[rows.core] ** 2))
        inside = jnp.all((x >= low) & (x <= high))
        holds = inside & jnp.all(jnp.abs(value) <= close * size + noise)
        falls = inside & (merit < (1 - DECREASE * part) * least)
        step = -solve_whole(rows.square, values[rows.inside], value[rows.core], checked=False)
        limit = enough * size + noise
        return Tried(falls, holds, step, (weight, merit, limit, jnp.all(jnp.abs(value) <= limit)))

    none = jnp.zeros((rows.pattern.n_rows,), dtype)
    found = newton(look, start, (none, jnp.asarray(jnp.inf, dtype), none, jnp.array(False)), NEWTON_LIMIT, SHORTEST)
    *_, limit, holds = found.memory
    method = jnp.where(found.count > 1, METHODS.index("Newton"), 0).astype(jnp.int32)
    return SparseFound(found.x, jnp.asarray(limit), holds, method, found.count)
