"""The Jacobian of the constraints: of the equations that index reduction differentiated, before they are.

An equation that is differentiated c times restricts each variable in it at the order d − c, where d is the highest
order of the variable. The constraints fall into independent parts, which share no variable.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from .extended import Extended, ExtendedGroup
from .group import Columns, Point
from .tables import ZERO, EquationGroup, equation_offsets


@dataclasses.dataclass(frozen=True)
class ConstraintEntries(Columns):
    """Entries of the constraint Jacobian: ∂F_row/∂(variable column), at the matching orders."""

    row: np.ndarray
    column: np.ndarray
    constant: np.ndarray
    group: np.ndarray
    instance: np.ndarray
    slot: np.ndarray


def constraint_entries(groups: tuple[EquationGroup, ...], extended: Extended) -> ConstraintEntries:
    """All entries of the Jacobian."""
    quantities = extended.quantities
    # The extended equations hold each equation once for every level, from 0 to c.
    c = np.bincount(extended.base) - 1
    first = equation_offsets(groups)
    out: list[list[np.ndarray]] = [[] for _ in range(6)]
    for g, group in enumerate(groups):
        count = c[first[g] : first[g + 1]]
        if not len(group) or group.variable.shape[1] == 0 or not (count > 0).any():
            continue
        used = (group.variable != ZERO) & (count > 0)[:, None]
        column = np.where(used, quantities.column[group.variable], 0)
        used &= column < quantities.n_unknown_columns
        highest = quantities.highest[np.where(used, column, 0)]
        # The coefficient of the highest derivative is the same at every level, ∂F⁽ᶜ⁾/∂x⁽ᵈ⁾ = ∂F/∂x⁽ᵈ⁻ᶜ⁾ (Griewank's
        # lemma; Pryce 2001), so the equations as written give it and need not be differentiated.
        used &= (group.order + count[:, None] == highest) & (highest > 0)
        instance, slot = np.nonzero(used)
        if not len(instance):
            continue
        constant = np.array([group.template.coefficient_is_constant(k) for k in range(group.variable.shape[1])])
        values = (first[g] + instance, column[instance, slot], constant[slot], np.full(len(slot), g), instance, slot)
        for collected, value in zip(out, values, strict=True):
            collected.append(value)
    joined = [np.concatenate(v) if v else np.zeros(0, np.int64) for v in out]
    return ConstraintEntries(joined[0], joined[1], joined[2].astype(bool), *joined[3:])


def independent_parts(entries: ConstraintEntries, constrained: np.ndarray, shape: tuple[int, int]):
    """Independent sets of constrained equations, as (equations, indices of their entries), in order."""
    n_rows, n_columns = shape
    graph = sp.coo_array(
        (np.ones(len(entries.row)), (entries.row, n_rows + entries.column)), shape=(n_rows + n_columns,) * 2
    )
    _, label = connected_components(graph, directed=False)
    by_label: dict[int, list[int]] = {}
    for r in constrained.tolist():
        by_label.setdefault(int(label[r]), []).append(r)
    members: dict[int, list[int]] = {key: [] for key in by_label}
    for k, r in enumerate(entries.row.tolist()):
        members[int(label[r])].append(k)
    return [(np.array(rows), np.array(members[key], np.int64)) for key, rows in by_label.items()]


def gathered(
    groups: tuple[EquationGroup, ...],
    extended: Extended,
    entries: ConstraintEntries,
    of_group: Callable[[ExtendedGroup], np.ndarray],
) -> np.ndarray:
    """The numbers of all entries, from arrays (n, slots) of the groups as written: partial derivatives, bounds of their
    errors, or their rates of change."""
    by_base = {}
    first = equation_offsets(groups)
    for group in extended.groups:
        # At level zero stand the equations as written.
        if group.level == 0:
            g = int(np.searchsorted(first, group.base[0], side="right") - 1)
            by_base[g] = group
    numbers = np.empty(len(entries.row))
    for g in np.unique(entries.group):
        here = entries.group == g
        numbers[here] = of_group(by_base[int(g)])[entries.instance[here], entries.slot[here]]
    return numbers


def values_and_errors(
    groups: tuple[EquationGroup, ...], extended: Extended, entries: ConstraintEntries, at: Point, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of all entries at a point, and bounds of their errors, from those of all quantities, (quantities +
    1,)."""
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def both(group: ExtendedGroup) -> tuple[np.ndarray, np.ndarray]:
        if id(group) not in found:
            found[id(group)] = group.partials_with_errors(at, known)
        return found[id(group)]

    where = groups, extended, entries
    return gathered(*where, lambda group: both(group)[0]), gathered(*where, lambda group: both(group)[1])
