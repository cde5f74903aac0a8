"""Which quantities a model integrates: those whose derivative stands in an equation as it is written.

Guesses of these count first, whichever of them are states: which ones are is decided by the order of declaration among
equals, and by what else is asked of a model. So an equation does not count if it only says what a variable is that no
other equation reads, such as an output der(y).
"""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool

from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.remembered import remembered
from ...compile.model.entries import slots_of
from ...compile.model.tables import ZERO


@remembered
def integrated(plan: SystemPlan) -> Bool[np.ndarray, " quantities"]:
    """True for every quantity with a derivative in the equations of the model, before index reduction."""
    quantities, groups = plan.extended.quantities, plan.model.groups
    row, variable, order = slots_of(groups)
    column = np.where(variable == ZERO, -1, quantities.column[variable])
    known = column >= 0
    row, column, order = row[known], column[known], order[known]
    columns = len(quantities.highest)
    kept = _read(row, column, order, sum(map(len, groups)), columns)[row]
    highest = np.zeros(columns, np.int64)
    np.maximum.at(highest, column[kept], order[kept])
    return quantities.order < highest[quantities.owner]


def _read(row: np.ndarray, column: np.ndarray, order: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The equations but for those that determine what no other equation reads, one after the other."""
    inside = sp.csr_array((np.ones(len(row)), (row, column)), shape=(rows, columns))
    by_column = sp.csc_array(inside)
    is_differentiated = np.zeros(columns, bool)
    is_differentiated[column[order > 0]] = True
    count = np.diff(by_column.indptr)
    kept = np.ones(rows, bool)
    leaves = np.flatnonzero((count == 1) & ~is_differentiated).tolist()
    while leaves:
        leaf = leaves.pop()
        there = by_column.indices[by_column.indptr[leaf] : by_column.indptr[leaf + 1]]
        for k in there[kept[there]].tolist():
            kept[k] = False
            for other in inside.indices[inside.indptr[k] : inside.indptr[k + 1]].tolist():
                count[other] -= 1
                if count[other] == 1 and not is_differentiated[other]:
                    leaves.append(other)
    return kept
