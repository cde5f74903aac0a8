"""State selection: which quantities are integrated, and which equations become constraints to project onto.

Candidates are all derivatives below the highest ones. The hidden constraints are the equations that index reduction
differentiated, below their last derivative. They fall into independent parts (connected components). In a part whose
Jacobian with respect to the candidates is constant, or where the user forces it, dummy derivatives (Mattsson &
Söderlind 1993) leave a minimal set of states, chosen by numerical pivots. In every other part all candidates are
states and the hidden constraints are kept for projection: no choice of fewer states would be regular everywhere.

What equations determine one variable after the other without any state (a pin at a constant place, a prescribed
motion) is set apart first: it is known and not a state.
"""

import dataclasses

import numpy as np

from ...base.errors import StructuralError
from ...base.tolerances import ALIKE, KNOWN
from ...graph.judgement.rank import above_errors, rank_of
from ..diagnosis.redundant_constraints import ModelAt, dependent_constraints
from ..model.consistent_point import initial_point
from ..model.constraint_jacobian import constraint_entries, independent_parts, values_and_errors
from ..model.declared import declared_scale
from ..model.extended import Extended
from ..model.group import Point
from ..model.quantities import ReducedModel
from ..model.tables import ZERO, EquationGroup, equation_offsets
from ..model.typical_sizes import typical_sizes, unrounded_sizes

POOR_PIVOT = 0.1  # a preferred pivot may be this much smaller than the best one
# If all good pivots are states that the user prefers, one that is so much smaller takes their place.
POORER_PIVOT = 1e-3


@dataclasses.dataclass(frozen=True)
class StateSelection:
    """The states, the constraints to project onto, and what was decided where."""

    states: np.ndarray  # quantities
    constraints: np.ndarray  # extended equations
    dummies: np.ndarray  # candidate quantities that are not states
    projected: np.ndarray  # equations as written whose hidden constraints are projected onto
    settled: np.ndarray  # quantities that no state influences
    notes: tuple[str, ...]


def _settled(groups: tuple[EquationGroup, ...], extended: Extended, c: np.ndarray) -> tuple[list[int], list[int]]:
    """Equations that each determine one variable, not differentiated there, from parameters, time, inputs and
    variables so determined before; and the columns of those variables."""
    quantities = extended.quantities
    first = equation_offsets(groups)
    rows_of: dict[int, list[int]] = {}  # by column
    unknowns: dict[int, dict[int, int | None]] = {}  # of each equation: the slot of each column, None if v' or v twice
    for g, group in enumerate(groups):
        chosen = np.flatnonzero(c[first[g] : first[g + 1]] > 0)
        for i in chosen.tolist():
            row = int(first[g]) + i
            slots: dict[int, int | None] = {}
            for slot, (v, order) in enumerate(zip(group.variable[i].tolist(), group.order[i].tolist(), strict=True)):
                column = int(quantities.column[v]) if v != ZERO else -1
                if 0 <= column < quantities.n_unknown_columns:
                    slots[column] = None if order or column in slots else slot
            # An equation that is not differentiated restricts no candidate: what it alone determines is not a state
            # anyway.
            unknowns[row] = slots
            for column in slots:
                rows_of.setdefault(column, []).append(row)
    found_rows: list[int] = []
    found_columns: list[int] = []
    ready = [row for row, slots in unknowns.items() if len(slots) == 1]
    while ready:
        row = ready.pop()
        if len(unknowns[row]) != 1:
            continue
        ((column, slot),) = unknowns[row].items()
        template = groups[int(np.searchsorted(first, row, side="right") - 1)].template
        # The equation must give the variable itself and all of its derivatives, by a coefficient that cannot vanish on
        # the way. Otherwise the variable is a state like others, and the constraint is projected onto.
        if slot is None or c[row] != quantities.highest[column] or not template.coefficient_is_constant(slot):
            continue
        found_rows.append(row)
        found_columns.append(column)
        for other in rows_of[column]:
            del unknowns[other][column]
            if len(unknowns[other]) == 1:
                ready.append(other)
    return found_rows, found_columns


def select_states(model: ReducedModel, mode: str, merit: np.ndarray) -> StateSelection:
    """Selects states.

    **Arguments:**

    - `mode`: "auto", "dummy_derivatives" or "projection".
    - `merit`: how much each quantity should be a state; ties go to the first quantity.

    **Raises:**

    - `StructuralError` if hidden constraints depend on each other at the initial point.
    """
    groups, extended = model.groups, model.extended
    quantities = extended.quantities
    unknown = quantities.n_unknown
    order, owner = quantities.order[:unknown], quantities.owner[:unknown]
    candidate = order < quantities.highest[owner]
    c = np.bincount(extended.base) - 1
    entries = constraint_entries(groups, extended)
    notes: list[str] = []
    is_dummy = np.zeros(unknown, bool)
    projected = np.zeros(len(c), bool)
    settled = np.zeros(unknown, bool)
    alone = np.zeros(len(c), bool)
    if mode != "projection":
        rows, columns = _settled(groups, extended, c)
        alone[rows] = True
        settled = np.isin(owner, columns)
        is_dummy = settled & candidate
        entries = entries.take(~alone[entries.row] & ~np.isin(entries.column, columns))
        notes += [
            f"{model.names[q]} was preferred as a state, but equations without states determine it"
            for q in np.flatnonzero(is_dummy & (merit[: len(is_dummy), 0] > 0)).tolist()
        ]
    constrained = np.flatnonzero((c > 0) & ~alone)

    if len(constrained):
        shape = (len(c), quantities.n_unknown_columns)
        parts = independent_parts(entries, constrained, shape)
        at = None
        for rows, members in parts:
            constant = entries.constant[members].all()
            # Where the Jacobian of the constraints moves, every minimal set of states turns singular somewhere. A
            # pendulum whose states are y and its velocity is lost at the lowest point, where they tell nothing about x.
            # All candidates with a projection after each step pass there, in as many steps as without the projection.
            if mode == "projection" or (mode == "auto" and not constant):
                projected[rows] = True
                continue
            # The initial point is searched only where pivots are needed, since that solves for a consistent point.
            if at is None:
                at, scale = initial_point(model, model.flat.declares), _scale(model)
                # A start is known to some roundings of its typical size. A position of 1e-17 m that a computation left
                # is then zero, and no pivot.
                known = KNOWN * (np.abs(at.values) + np.append(typical_sizes(model, at.parameters), 0.0))
                numbers, errors = values_and_errors(groups, extended, entries, at, known)
            columns = np.unique(entries.column[members])
            dense, bounds = np.zeros((2, len(rows), len(columns)))
            place = np.searchsorted(rows, entries.row[members]), np.searchsorted(columns, entries.column[members])
            np.add.at(dense, place, numbers[members])
            np.add.at(bounds, place, errors[members])
            chosen, more = _dummy_derivatives(model, dense, bounds, c[rows], columns, merit, scale)
            if chosen is None:
                raise StructuralError(_dependence(model, np.flatnonzero(settled), at, rows))
            is_dummy[chosen] = True
            notes.extend(more)

    states = np.flatnonzero(candidate & ~is_dummy)
    below_last = extended.level < c[extended.base]
    constraints = np.flatnonzero(below_last & projected[extended.base])
    return StateSelection(
        states=states,
        constraints=constraints,
        dummies=np.flatnonzero(is_dummy & ~settled),
        projected=np.flatnonzero(projected),
        settled=np.flatnonzero(settled),
        notes=tuple(notes),
    )


def _scale(model: ReducedModel) -> np.ndarray:
    """The sizes by which variables are compared as states: as declared, or what their equations imply. They are not
    rounded, for rounding could turn a small difference into a factor of two."""
    declared = declared_scale(model)
    return np.where(declared == 0.0, unrounded_sizes(model, model.flat.declares.values), declared)


def _dependence(model: ReducedModel, settled: np.ndarray, at: Point, rows: np.ndarray) -> str:
    """The text of an error about constraints, the equations `rows`, that depend on each other at a point."""
    found = [str(one) for one in dependent_constraints(ModelAt(model, settled, at))]
    if found:
        return "\n".join(found)
    equations = [model.text(int(e)) for e in rows[:6]]
    return (
        f"the constraints {'; '.join(equations)} do not determine as many variables as there are constraints at the "
        "initial point: one of them follows from the others, or the start values are at a singular position. Remove "
        'the redundant constraint, or change the start values, or use state_selection="projection".'
    )


def _dummy_derivatives(model: ReducedModel, dense, errors, c, columns, merit: np.ndarray, scale):
    """Mattsson & Söderlind's selection, level by level: the candidate quantities that become dummies, None if rows
    depend on each other; and notes."""
    quantities = model.extended.quantities
    notes: list[str] = []
    chosen: list[int] = []
    available = np.arange(len(columns))
    for level in range(1, int(c.max()) + 1):
        rows = np.flatnonzero(c >= level)
        available = available[quantities.highest[columns[available]] >= level]
        # Mattsson & Söderlind (1993) go from the highest derivatives down, and a level chooses among the columns that
        # the level above has chosen: constraints of lower order are fewer, and have the same Jacobian.
        # If the (d − level + 1)-th derivative is a dummy, the quantity below it is not a state.
        below = quantities.first[columns[available]] + quantities.highest[columns[available]] - level
        inside = np.ix_(rows, available)
        keys = [(*merit[q].tolist(), -q) for q in below.tolist()]
        # Columns are compared in sizes of their variables. In the units of the model, a pressure of 1e5 Pa beside a
        # flow of 1e-3 m³/s would decide what is a state.
        picked = _pivots(dense[inside] * scale[below], errors[inside] * scale[below], keys)
        if picked is None:
            return None, notes
        by_merit = sorted(range(len(below)), key=keys.__getitem__)
        wanted = set(by_merit[: len(picked)])
        for k in picked:
            # A preference that is overruled without a word would look like a mistake of the compiler.
            if k not in wanted and _is_preferred(keys[k]):
                notes.append(
                    f"{model.names[below[k]]} was preferred as a state, but the constraints have to determine it: any "
                    "other choice is nearly singular at the initial point"
                )
        chosen.extend(int(below[k]) for k in picked)
        available = available[picked]
    return chosen, notes


def _pivots(matrix: np.ndarray, errors: np.ndarray, keys: list[tuple]) -> list[int] | None:
    """Chooses as many columns as rows that are nonsingular together: those least wanted as states (by `keys`) whose
    pivots are not poor. None if the matrix is singular.

    Errors are carried through the elimination: of columns that are nearly parallel, a pivot may be nothing but error.
    """
    if not rank_of(matrix, errors).is_regular:
        return None
    matrix = above_errors(matrix, errors)
    # Rows have units of their own: an equation that was multiplied by 1e9 must not be eliminated first.
    largest = np.abs(matrix).max(axis=1, keepdims=True)
    work, off = matrix / largest, errors / largest
    free_rows = list(range(work.shape[0]))
    free_columns = list(range(work.shape[1]))
    picked: list[int] = []
    while free_rows:
        if not free_columns:
            return None
        inside = np.ix_(free_rows, free_columns)
        sub = np.where(np.abs(work[inside]) > off[inside], np.abs(work[inside]), 0.0)
        best_of_column = sub.max(axis=0)
        best = best_of_column.max()
        if not best > 0:
            return None
        # A threshold as of sparse elimination, rather than the best pivot: which of two speeds on one shaft is a state
        # is as good as the other, even if their coefficients differ tenfold, and so the user's preference counts.
        good = np.flatnonzero(best_of_column >= POOR_PIVOT * best).tolist()
        if all(_is_preferred(keys[free_columns[k]]) for k in good):
            poorer = np.flatnonzero(best_of_column >= POORER_PIVOT * best).tolist()
            good = [k for k in poorer if not _is_preferred(keys[free_columns[k]])] or good
        k = min(good, key=lambda k: keys[free_columns[k]])
        column = free_columns.pop(k)
        # The first of the rows that are alike up to rounding, so that the kernel of BLAS does not choose.
        row = free_rows.pop(int(np.argmax(sub[:, k] >= (1 - ALIKE) * best_of_column[k])))
        picked.append(column)
        if free_rows:
            factors = work[free_rows, column] / work[row, column]
            of_factors = (off[free_rows, column] + np.abs(factors) * off[row, column]) / np.abs(work[row, column])
            work[free_rows] -= np.outer(factors, work[row])
            off[free_rows] += np.outer(np.abs(factors), off[row]) + np.outer(of_factors, np.abs(work[row]))
    return sorted(picked)


def _is_preferred(key: tuple) -> bool:
    return key[0] > 0
