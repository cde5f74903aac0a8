"""Block lower triangular order (BLT): which equations determine which unknowns, and in which order.

Given the extended equations and the known quantities, matches equations with unknowns and orders the strongly connected
components (Duff & Reid 1978, Tarjan 1972). Each block is solved for its unknowns once the blocks of lower level are.
"""

import dataclasses

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ...base.errors import StructuralError
from ...graph.structure.integers import distinct, ranges
from ...graph.structure.matching import maximum_matching
from ..diagnosis.wording import itemised
from ..model.quantities import ReducedModel
from ..model.tables import provenance_of
from .select_states import StateSelection

MANY = 50  # blocks whose followers are found faster by array operations than one by one


@dataclasses.dataclass(frozen=True)
class Blocks:
    """The blocks, in an order in which they can be solved.

    Block b holds equations[pointer[b]:pointer[b+1]] and the unknowns at the same places; equal levels do not depend on
    each other.
    """

    pointer: np.ndarray
    equations: np.ndarray
    unknowns: np.ndarray
    level: np.ndarray

    def __len__(self):
        return len(self.level)


def order_blocks(model: ReducedModel, selection: StateSelection) -> Blocks:
    """Orders the equations that are no constraints for the quantities that are neither states nor inputs.

    **Raises:**

    - `StructuralError` if equations are left with nothing to determine.
    """
    extended = model.extended
    known = np.zeros(extended.quantities.n, bool)
    known[selection.states] = True
    unknown_id = np.full(extended.quantities.n, -1, np.int64)
    unknowns = np.flatnonzero(~known[: extended.quantities.n_unknown])
    unknown_id[unknowns] = np.arange(len(unknowns))
    kept = np.ones(extended.n_equations, bool)
    kept[selection.constraints] = False
    equations = np.flatnonzero(kept)
    wanted = unknown_id >= 0
    pointer, columns = extended.incidence(wanted)
    lengths = np.diff(pointer)
    entry_rows = np.repeat(np.arange(extended.n_equations), lengths)
    inside = kept[entry_rows]
    row_id = np.cumsum(kept) - 1
    rows, columns = row_id[entry_rows[inside]], unknown_id[columns[inside]]
    n = len(equations)
    pointer = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))]).astype(np.int64)
    matched = maximum_matching(pointer, columns, len(unknowns))
    # The structural check has passed before, but states and constraints have been taken away since.
    if (matched < 0).any() or n != len(unknowns):
        raise StructuralError(_nothing_left(model, equations[matched < 0]))

    # Equation i depends on the equation that is matched with each of its other unknowns.
    equation_of = np.empty(n, np.int64)
    equation_of[matched] = np.arange(n)
    source = equation_of[columns]
    dependency = sp.coo_array((np.ones(len(rows), np.int8), (rows, source)), shape=(n, n)).tocsr()
    # Whatever perfect matching was found, the strongly connected components are the same (Dulmage & Mendelsohn 1963).
    n_blocks, label = connected_components(dependency, directed=True, connection="strong")
    # Levels rather than one order: blocks of one level and one shape are evaluated at once.
    level = _levels(label[rows], label[source], n_blocks)
    # Deterministic order: by level, then by the block's first equation.
    first_equation = np.full(n_blocks, n, np.int64)
    np.minimum.at(first_equation, label, np.arange(n))
    block_order = np.lexsort((first_equation, level))
    rank = np.empty(n_blocks, np.int64)
    rank[block_order] = np.arange(n_blocks)
    sorting = np.lexsort((np.arange(n), rank[label]))
    sizes = np.bincount(rank[label], minlength=n_blocks)
    pointer = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return Blocks(pointer, equations[sorting], unknowns[matched[sorting]], level[block_order])


def _nothing_left(model: ReducedModel, equations: np.ndarray) -> str:
    """The text of an error about extended equations that no unknown is left for."""
    left = [provenance_of(model.groups, int(model.extended.base[e])) for e in equations]
    return "\n".join(
        [
            "after index reduction nothing is left for these equations to determine: they follow from the others, or "
            "contradict them. Remove or change one of:",
            *itemised(left),
        ]
    )


def _levels(block: np.ndarray, needs: np.ndarray, n_blocks: int) -> np.ndarray:
    """The length of the longest chain of blocks below each block."""
    # Several entries may join the same two blocks. They count once, since a block waits for blocks.
    outside = block != needs
    first, second = np.divmod(distinct(needs[outside] * np.int64(n_blocks) + block[outside]), max(n_blocks, 1))
    waiting = np.bincount(second, minlength=n_blocks)
    start = np.append(0, np.cumsum(np.bincount(first, minlength=n_blocks)))
    level, depth = np.zeros(n_blocks, np.int64), 0
    ready = np.flatnonzero(waiting == 0)
    while len(ready) >= MANY:  # all blocks of a level at once
        level[ready] = depth
        followers = second[ranges(start[ready], start[ready + 1] - start[ready])]
        np.subtract.at(waiting, followers, 1)
        ready, depth = distinct(followers[waiting[followers] == 0]), depth + 1
    if not len(ready):
        return level
    level[ready] = depth
    stack, starts, followers, left, found = (a.tolist() for a in (ready, start, second, waiting, level))
    while stack:
        b = stack.pop()
        for k in range(starts[b], starts[b + 1]):
            f = followers[k]
            found[f] = max(found[f], found[b] + 1)
            left[f] -= 1
            if left[f] == 0:
                stack.append(f)
    return np.array(found, np.int64)
