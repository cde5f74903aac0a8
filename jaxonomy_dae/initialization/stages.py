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

from ..lowering.plan import SystemPlan
from ..lowering.remembered import remembered
from ..structure.matching import maximum_matching
from ..tolerances import close as close_within
from .rows import InitialRows
from .sizes import Sizes, column_sizes

LEAST_LEVEL = 2  # times that a constraint must have been differentiated for stages to be worth their compile time
LIMIT = 40  # steps in a block


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
    """Levenberg–Marquardt steps in one block after the other, blocks before it held."""
    n, last = len(block), int(block.max(initial=0))
    dtype = start.dtype
    close = close_within(dtype)

    def step(state):
        trial, base, merit_base, damping, number, count = state
        jacobian, value = jax.jacfwd(lambda y: (function(y),) * 2, has_aux=True)(trial)
        value, jacobian = jax.lax.stop_gradient((value, jacobian))
        unit = column_sizes(value, jacobian, sizes)
        jacobian, value = (jacobian * unit[None, :])[row_of], value[row_of]
        inside = jnp.asarray(block, jnp.int32) == number
        largest = jnp.max(jnp.abs(jacobian), axis=1)
        weight = jnp.where(inside & (largest > 0), 1 / jnp.where(largest > 0, largest, 1), 0)
        residual = weight * value
        merit = jnp.max(jnp.abs(residual), initial=0.0)
        accepted = jnp.isfinite(merit + jnp.sum(jacobian)) & ((merit < merit_base) | (merit_base < 0))
        damping = jnp.where(accepted, 0.1 * damping, jnp.minimum(10 * damping, 1e6))
        matrix = jnp.where(inside[None, :], weight[:, None] * jacobian, 0)
        idle = jnp.where(inside, jnp.sqrt(damping), 1)
        stacked = jnp.concatenate([matrix, jnp.diag(idle)])
        q, r = jnp.linalg.qr(stacked)
        move = jnp.where(inside, unit * jax.scipy.linalg.solve_triangular(r, q[:n].T @ -residual), 0)
        base = jnp.where(accepted, trial, base)
        done = (merit <= close) | (count >= LIMIT)
        ahead = jnp.where(accepted & ~done & jnp.all(jnp.isfinite(move)), base + move, base)
        # After a rejected step the Jacobian at the base is needed again.
        merit_base = jnp.where(done | ~accepted, -1, merit)
        moved = done.astype(jnp.int32)
        return (ahead, base, merit_base, jnp.where(done, 1e-6, damping), number + moved, jnp.where(done, 0, count + 1))

    one = jnp.ones((), dtype)
    state = (start, start, -one, 1e-6 * one, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
    found = jax.lax.while_loop(lambda s: s[4] <= last, step, state)[1]
    return jnp.where(jnp.all(jnp.isfinite(found)), found, start)
