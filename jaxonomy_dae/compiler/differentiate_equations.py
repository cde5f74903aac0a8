"""Differentiates the equations as often as index reduction asks for: the extended system, in quantities."""

import numpy as np

from ..model.extended import Extended, ExtendedGroup, Quantities
from ..model.tables import ZERO, EquationGroup
from ..structure.pantelides import Offsets


def differentiate_equations(
    groups: tuple[EquationGroup, ...],
    offsets: Offsets,
    column: np.ndarray,
    is_input: np.ndarray,
    least: np.ndarray,
    n_unknown: int,
) -> Extended:
    """Builds the extended system; column[v] numbers root variables, unknowns first, then inputs, least[v] is the lowest
    order that root variable v must have."""
    n_columns = int(column.max(initial=-1)) + 1
    variable = np.full(n_columns, -1, np.int64)
    present = np.flatnonzero(column >= 0)
    variable[column[present]] = present
    highest = np.zeros(n_columns, np.int64)
    highest[:n_unknown] = offsets.variable
    highest[n_unknown:] = least[variable[n_unknown:]]
    first_equation = 0
    for group in groups:
        c = offsets.equation[first_equation : first_equation + len(group)]
        first_equation += len(group)
        known = (group.variable != ZERO) & is_input[group.variable]
        reached = (group.order + c[:, None])[known]
        np.maximum.at(highest, column[group.variable[known]], reached)
    first = np.concatenate([[0], np.cumsum(highest + 1)]).astype(np.int64)
    quantities = Quantities(column, variable, n_unknown, highest, first)

    c = offsets.equation
    first_extended = np.concatenate([[0], np.cumsum(c + 1)]).astype(np.int64)
    n_extended = int(first_extended[-1])
    base = np.repeat(np.arange(len(c)), c + 1)
    level = np.arange(n_extended) - first_extended[base]
    out = []
    first_equation = 0
    for group in groups:
        rows = np.arange(len(group))
        counts = c[first_equation : first_equation + len(group)]
        template, k = group.template, 0
        while len(rows):
            slot_base = np.array([b for b, _ in template.slots], np.int64)
            slot_q = np.array([q for _, q in template.slots], np.int64)
            v = group.variable[np.ix_(rows, slot_base)] if len(slot_base) else np.zeros((len(rows), 0), np.int64)
            o = group.order[np.ix_(rows, slot_base)] + slot_q if len(slot_base) else v
            s = group.factor[np.ix_(rows, slot_base)] if len(slot_base) else v
            zero = v == ZERO
            quantity = np.where(zero, ZERO, first[column[v]] + o)
            out.append(
                ExtendedGroup(
                    template,
                    first_extended[first_equation + rows] + k,
                    quantity,
                    np.where(zero, 0, s),
                    group.parameter[rows],
                    group.coefficient[rows],
                    first_equation + rows,
                    k,
                )
            )
            k += 1
            rows = rows[counts[rows] >= k]
            if len(rows):
                template = template.derivative
        first_equation += len(group)
    return Extended(tuple(out), n_extended, quantities, base, level)
