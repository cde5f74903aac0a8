"""Differentiation of the equations that index reduction chose.

Given the offsets, returns the extended system: each equation with its derivatives up to the order that was found, in
quantities, which are numbered derivatives of variables. The derivative of a template is taken once for its shape
(`graph/expressions/differentiate.py`), whatever the number of its instances. Nothing is removed.
"""

import numpy as np

from ...graph.structure.pantelides import Offsets
from ..model.extended import Extended, ExtendedGroup, Quantities
from ..model.tables import ZERO, EquationGroup
from .number_columns import Columns


def differentiate_equations(groups: tuple[EquationGroup, ...], offsets: Offsets, columns: Columns) -> Extended:
    """Builds the extended system; inputs have derivatives as high as equations and variables need them."""
    column, n_unknown = columns.with_inputs, columns.n_unknown
    # Index reduction sees unknowns only. How often an input is differentiated follows from the equations that read it.
    highest = np.concatenate([offsets.variable, columns.least[n_unknown:]])
    first_equation = 0
    for group in groups:
        c = offsets.equation[first_equation : first_equation + len(group)]
        first_equation += len(group)
        known = (group.variable != ZERO) & columns.is_input[group.variable]
        reached = (group.order + c[:, None])[known]
        np.maximum.at(highest, column[group.variable[known]], reached)
    first = np.concatenate([[0], np.cumsum(highest + 1)]).astype(np.int64)
    quantities = Quantities(column, columns.variable, n_unknown, highest, first)

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
        # The template is differentiated once for each order, whatever the number of its equations: those that need
        # fewer derivatives drop out of `rows`.
        while len(rows):
            slot_base = np.array([b for b, _ in template.slots], np.int64)
            slot_q = np.array([q for _, q in template.slots], np.int64)
            places = np.ix_(rows, slot_base)
            variable, order = group.variable[places], group.order[places] + slot_q
            zero = variable == ZERO
            out.append(
                ExtendedGroup(
                    template=template,
                    equation=first_extended[first_equation + rows] + k,
                    quantity=np.where(zero, ZERO, first[column[variable]] + order),
                    factor=np.where(zero, 0, group.factor[places]),
                    parameter=group.parameter[rows],
                    coefficient=group.coefficient[rows],
                    base=first_equation + rows,
                    level=k,
                )
            )
            k += 1
            rows = rows[counts[rows] >= k]
            if len(rows):
                template = template.derivative
        first_equation += len(group)
    return Extended(tuple(out), n_extended, quantities, base, level)
