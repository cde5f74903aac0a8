"""Equations that determine a quantity alone must have a coefficient of it that is not zero."""

import numpy as np

from ...base.errors import StructuralError
from ...graph.structure.incidence import Incidence
from ...graph.structure.pantelides import Offsets, diagonal_blocks
from ..model.group import Point
from ..model.tables import ZERO, EquationGroup, ParameterTable, equation_offsets, locate
from .number_columns import Columns


def check_pivots(
    groups: tuple[EquationGroup, ...],
    signature: Incidence,
    offsets: Offsets,
    columns: Columns,
    parameters: ParameterTable,
    numbers: np.ndarray,
):
    """Checks the equations that alone determine a quantity; `numbers` are the values of all parameters.

    **Raises:**

    - `StructuralError` if its coefficient is zero for the given parameter values, to rounding of its terms.
    """
    zero = _zero_pivots(groups, signature, offsets, columns.number, numbers)
    if not len(zero):
        return
    group, place = locate(groups, int(zero[0]))
    read = list(dict.fromkeys(group.parameter[place].tolist()))
    values = [f"{parameters.names[p]} = {numbers[p]:g}" for p in read]
    modes = [v for p, v in zip(read, values, strict=True) if p in parameters.discrete]
    if modes:
        raise StructuralError(
            f"the equation {group.provenance[place]} determines nothing in the mode {', '.join(modes)}: the "
            "coefficient of what it should determine is zero. If it fixes a state there, put storage between what "
            "switches and that state (a capacitor, a volume of fluid), or let the mode hold the state back, with "
            "self.complementary(state, other, order=1) or self.either(…, order=1)"
        )
    raise StructuralError(
        f"the equation {group.provenance[place]} determines nothing for {', '.join(values)}: the coefficient of what "
        "it should determine is zero. Give other values, or leave the component out."
    )


def _zero_pivots(groups, signature: Incidence, offsets: Offsets, column, values) -> np.ndarray:
    """The numbers of such equations."""
    count = diagonal_blocks(signature, offsets)[1]
    first = equation_offsets(groups)
    found = []
    for g, group in enumerate(groups):
        template = group.template
        # Numbers that are zero are no entries of the incidence. What depends on the state may vanish here and not
        # elsewhere, which the run finds. So only coefficients that are functions of parameters are left to check.
        if not template.n_parameters or not len(group):
            continue
        equation = np.arange(first[g], first[g + 1])
        alone = count[equation] == 1
        wanted = offsets.matched_variable[equation]
        used = (group.variable != ZERO) & alone[:, None]
        used &= column[group.variable] == wanted[:, None]
        used &= group.order + offsets.equation[equation][:, None] == offsets.variable[wanted][:, None]
        slots = np.flatnonzero(used.any(axis=0))
        if not len(slots) or not all(template.coefficient_is_constant(int(k)) for k in slots):
            continue
        reads = np.zeros(group.variable.shape, np.int64)  # whatever the slots are: these entries are constant
        own = group.reading(reads)
        at = Point.of(np.ones(1), values, 0.0)
        found_there = own.partials_with_errors(at, np.zeros(2))
        coefficient, bound = (np.where(used, x, 0.0)[:, slots].sum(axis=1) for x in found_there)
        found.append(equation[used.any(axis=1) & (np.abs(coefficient) <= bound)])
    return np.concatenate(found) if found else np.zeros(0, np.int64)
