"""Starts of chains of high index, block by block.

The initial equations of such a model are triangular: positions, then velocities, then what accelerations determine,
and so on up the derivatives. All at once, from guesses of zero, their search may fail; block by block each solve is
small. What comes out is where the ladder starts, not a result.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import connected_components

from ...base.tolerances import close as close_within
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.remembered import remembered
from ...graph.structure.matching import maximum_matching
from ...solve.linear.dense import least_squares
from ...solve.linear.newton import Tried, newton
from .gauss_newton import DECREASE, SHORTEST
from .rows import InitialRows
from .sizes import Sizes, column_sizes

LEAST_LEVEL = 2  # times that a constraint must have been differentiated for stages to be worth their compile time
LIMIT = 40  # looks, for each block


@remembered
def stages(plan: SystemPlan, rows: InitialRows) -> tuple[np.ndarray, np.ndarray] | None:
    """For each unknown the row that is matched with it, and the place of its block in the order of solution; None where
    stages are of no use, or not known."""
    pattern, n = plan.constraint_pattern, plan.n_state
    levels = plan.extended.level[plan.selection.constraints]
    if pattern is None or len(plan.carried) or levels.max(initial=0) < LEAST_LEVEL:
        return None
    place = {int(q): k for k, q in enumerate(plan.states)}
    if not all(row.quantity in place for row in rows.kept):
        return None
    chosen = np.flatnonzero(np.append(np.ones(plan.n_constraints, bool), rows.independent))
    reads = [sorted(p) for p in pattern] + [[place[row.quantity]] for row in rows.kept]
    pointer = np.concatenate([[0], np.cumsum([len(reads[k]) for k in chosen])])
    columns = np.array([c for k in chosen for c in reads[k]], np.int64)
    matched = maximum_matching(pointer, columns, n)
    if len(chosen) != n or (matched < 0).any():
        return None
    row_of = np.empty(n, np.int64)
    row_of[matched] = chosen
    # An edge from each unknown to those that its row reads.
    source = np.repeat(matched, np.diff(pointer))
    graph = sp.csr_array((np.ones(len(columns)), (source, columns)), shape=(n, n))
    count, label = connected_components(graph, directed=True, connection="strong")
    block = np.zeros(count, np.int64)
    for _ in range(count):  # the longest way to each block
        deeper = block.copy()
        outside = label[source] != label[columns]
        np.maximum.at(deeper, label[source][outside], block[label[columns][outside]] + 1)
        if (deeper == block).all():
            break
        block = deeper
    return row_of, block[label]


def solve_in_stages(
    function: Callable[[Any], Any],
    start: Float[Array, " n"],
    sizes: Sizes,
    row_of: Int[np.ndarray, " n"],
    block: Int[np.ndarray, " n"],
) -> Float[Array, " n"]:
    """Newton steps in one block after the other, blocks before it held; least squares where a block is singular."""
    last = int(block.max(initial=0))
    dtype = start.dtype
    close, number_of = close_within(dtype), jnp.asarray(block, jnp.int32)

    def look(x, part, state):
        number, least = state
        jacobian, value = jax.lax.stop_gradient(jax.jacfwd(lambda y: (function(y),) * 2, has_aux=True)(x))
        unit = column_sizes(value, jacobian, sizes)
        jacobian, value = (jacobian * unit[None, :])[row_of], value[row_of]
        largest = jnp.max(jnp.abs(jacobian), axis=1)
        residual = jnp.abs(value) / jnp.where(largest > 0, largest, 1)
        # The first block that does not hold is the next one.
        off = jnp.zeros((last + 1,), dtype).at[number_of].max(residual)
        ahead = jnp.arange(last + 1, dtype=jnp.int32) >= number
        wrong = ahead & ~(off <= close)
        new = jnp.where(jnp.any(wrong), jnp.argmax(wrong).astype(jnp.int32), last + 1)
        falls = (new > number) | (off[number] < (1 - DECREASE * part) * least)
        inside = number_of == new
        matrix = jnp.where(inside[:, None] & inside[None, :], jacobian, 0)
        step = jnp.where(inside, -unit * least_squares(matrix, value), 0)
        return Tried(falls, new > last, step, (new, off[jnp.minimum(new, last)]))

    begin = jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, dtype)
    found = newton(look, start, begin, LIMIT * (last + 1), SHORTEST).x
    # No verdict is asked for: the ladder goes on from here in any case, and judges all rows at once.
    return jnp.where(jnp.all(jnp.isfinite(found)), found, start)
