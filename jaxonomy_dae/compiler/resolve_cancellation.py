"""Cancellation that structure cannot see.

Index reduction trusts the incidence: where the highest derivatives of several equations cancel in a linear combination,
it stops too early (two equations with C·(y₁′ − y₂′) and C·(y₂′ − y₁′) are one differential and one algebraic equation).
Where a diagonal block of the system Jacobian has a left null vector w that is the same wherever the model is, a number
or a function of the parameters, the equation Σ wᵢ Fᵢ^(cᵢ − c_min), in which the highest derivatives are gone, replaces
one of lowest cᵢ, and index reduction starts again: the linear combination method of Tan, Nedialkov & Pryce (2017).
"""

import math
from collections.abc import Callable, Hashable, Sequence
from fractions import Fraction

import numpy as np

from ..diagnosis.wording import alternatives, itemised, some
from ..errors import StructuralError
from ..expressions.differentiate import partial_derivative
from ..expressions.errors import KNOWN, KernelWithErrors
from ..expressions.node import Node, constant, number
from ..expressions.substitute import substitute
from ..model.extended import ExtendedGroup
from ..model.group import Group, Point
from ..model.incidence import incidence
from ..model.natural_sizes import natural_sizes
from ..model.provenance import Provenance, combination
from ..model.tables import ZERO, EquationGroup, ParameterTable, equation_offsets, provenance_of
from ..modeling.symbols import TIME_LABEL
from ..structure.diagonal_blocks import diagonal_blocks
from ..structure.incidence import Incidence
from ..structure.matching import maximum_matching
from ..structure.pantelides import Offsets, reduce_index
from .combine_equations import cancels_elsewhere, combine, graph_of, group_of, near, quantity_label, somewhere, tried
from .exact_null_vectors import Row, sparsest_null_vector
from .null_vectors import CANCELLED, left_null_vectors, rational, weights_in_parameters
from .number_columns import Columns
from .rounded import Rounded, rounded

LARGEST_BLOCK = 200  # equations of a block that is sampled: those of larger ones have numbers, or are left
ROUNDS = 100
TRIALS = 44  # random points, of which STATES are used: the first where the equations have values
STATES = 3
HIGHER = 8  # derivatives that a quantity's size is taken for
PARAMETERS = 4  # sample values of the parameters


def reduce_with_cancellation(
    groups: tuple[EquationGroup, ...],
    signature: Incidence,
    columns: Columns,
    matching: np.ndarray,
    parameters: ParameterTable,
) -> tuple[tuple[EquationGroup, ...], Incidence, Offsets, tuple[str, ...]]:
    """Index reduction, repeated until no diagonal block with constant coefficients is singular.

    `signature` is the incidence of the equations, `matching` what `match_highest` finds in it. Returns the
    equations, changed where something cancelled, their incidence and offsets, and notes.

    **Raises:**

    - `StructuralError` if a block is singular for the given parameter values alone, or equations depend on each other.
    """
    notes: list[str] = []
    n_unknown = signature.n_variables
    highest: np.ndarray | None = matching
    for _ in range(ROUNDS):
        offsets = reduce_index(signature, columns.least_of_unknown, highest)
        jacobian = _Jacobian(groups, offsets, columns.number, parameters.values)
        replaced, added, combined = [], [], []
        for equations in _blocks_that_may_cancel(signature, jacobian):
            found = _combination(jacobian, equations, parameters.names, parameters.discrete)
            if found is not None:
                combined = [provenance_of(groups, int(e)) for e in equations]
                replaced.append(found[0])
                added.append(found[1])
        if not added:
            return groups, signature, offsets, tuple(notes)
        sources = [group.provenance[0] for group in added]
        notes += [f"highest derivatives cancel in {'a ' if source.sources else ''}{source}" for source in sources]
        groups = (*_without(groups, replaced), *added)
        signature, highest = incidence(groups, columns.number, n_unknown), None
        if (maximum_matching(signature.pointer, signature.variable, n_unknown) < 0).any():
            raise StructuralError(_dependent(combined))
    raise StructuralError(_dependent(combined))


def _dependent(equations: list[Provenance]) -> str:
    """The message for equations that depend on each other, or contradict."""
    lines = ["these equations depend on each other, or contradict each other. Remove or change one of:"]
    return "\n".join(lines + itemised(equations))


def _blocks_that_may_cancel(signature: Incidence, jacobian: "_Jacobian") -> list[np.ndarray]:
    """The equations of each diagonal block that has more than one or in whose equation the terms of what it determines
    cancel."""
    label, _ = diagonal_blocks(signature, jacobian.offsets)
    sizes = np.bincount(label)
    order = np.argsort(label, kind="stable")
    start = np.concatenate([[0], np.cumsum(sizes)])
    several = sizes > 1
    several[label[_cancelled_alone(jacobian)]] = True
    chosen = np.flatnonzero(several).tolist()
    return [np.sort(order[start[b] : start[b + 1]]) for b in chosen]


def _cancelled_alone(jacobian: "_Jacobian") -> np.ndarray:
    """The equations in which the highest derivative that is matched to them stands in several slots that cancel at a
    random point, as u′ in u′ − v = f where v has been found to be u′."""
    offsets, column = jacobian.offsets, jacobian.column
    found = [np.zeros(0, np.int64)]
    for g, group in enumerate(jacobian.groups):
        own = np.arange(jacobian.first[g], jacobian.first[g + 1])
        matched = offsets.matched_variable[own, None]
        there = (group.variable != ZERO) & (column[group.variable] == matched)
        highest = there & (group.order + offsets.equation[own, None] == offsets.variable[matched])
        several = highest.sum(axis=1) > 1
        if not several.any():
            continue
        partials, errors = jacobian.partials(g, 0)
        total, bound = (highest * partials).sum(axis=1), (highest * errors).sum(axis=1)
        # What has no value at this point is asked at others.
        found.append(own[several & ~(np.abs(total) > bound)])
    return np.concatenate(found)


class _Jacobian:
    """∂F_e/∂(highest derivative of a column): numbers at random points, and graphs."""

    def __init__(self, groups: tuple[EquationGroup, ...], offsets: Offsets, column: np.ndarray, values: np.ndarray):
        self.groups = groups
        self.offsets = offsets
        self.column = column
        self.values = values
        self.first = equation_offsets(groups)
        self._partials: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def place(self, e: int) -> tuple[int, int]:
        """(group, row) of an equation."""
        g = int(np.searchsorted(self.first, e, side="right") - 1)
        return g, e - int(self.first[g])

    def partials(self, g: int, trial: int) -> tuple[np.ndarray, np.ndarray]:
        """The partial derivatives of all equations of group g at a trial's sample point, factors included, and bounds
        of their errors: shape (n, slots) each."""
        if (g, trial) not in self._partials:
            group = self.groups[g]
            point = np.where(group.variable == ZERO, 0.0, tried(group.variable, group.order, trial))
            slots = point.shape[1]
            if group.template.opaque is not None:  # any function
                slopes = [np.ones(len(group)), *(somewhere(group.variable[:, 0], k, trial) for k in range(1, slots))]
                values = np.stack(slopes, axis=-1) * group.factor
                found = values, KNOWN * np.abs(values)
            else:
                at = Point.of(point.ravel(), self.values, 0.37 + 0.1 * trial)
                own = Group(
                    group.template,
                    np.arange(len(group)),
                    np.arange(point.size).reshape(point.shape),
                    group.factor,
                    group.parameter,
                    group.coefficient,
                )
                found = own.partials(at), own.partial_errors(at, KNOWN * np.abs(at.values))
            self._partials[g, trial] = found
        return self._partials[g, trial]

    def hits(self, e: int, columns: np.ndarray) -> list[tuple[int, int]]:
        """The slots of an equation that hold highest derivatives of these columns: (slot, position of the column)."""
        g, i = self.place(e)
        group = self.groups[g]
        where = {int(c): k for k, c in enumerate(columns)}
        found = []
        for slot, (v, order) in enumerate(zip(group.variable[i].tolist(), group.order[i].tolist(), strict=True)):
            j = where.get(int(self.column[v]), -1) if v != ZERO and self.column[v] >= 0 else -1
            if j >= 0 and order + self.offsets.equation[e] == self.offsets.variable[columns[j]]:
                found.append((slot, j))
        return found

    def at(self, equations: np.ndarray, columns: np.ndarray, trial: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns (the matrix, bounds of the errors of its entries) at a trial's random point."""
        dense, errors = np.zeros((2, len(equations), len(columns)))
        for k, e in enumerate(equations.tolist()):
            g, i = self.place(e)
            partials, bounds = self.partials(g, trial)
            for slot, j in self.hits(e, columns):
                dense[k, j] += partials[i, slot]
                errors[k, j] += bounds[i, slot]
        return dense, errors

    def _at_natural_sizes(self, equations: np.ndarray) -> tuple[list[ExtendedGroup], list[int], np.ndarray, np.ndarray]:
        """Regroups `equations`. Returns (groups, equation numbers in group order, quantities as (variable, order) of
        shape (q, 2), sizes of shape (q,)); the sizes balance the terms of each equation."""
        rows: dict[int, list[int]] = {}
        for e in equations.tolist():
            g, i = self.place(e)
            rows.setdefault(g, []).append(i)
        number: dict[tuple[int, int], int] = {}
        groups, order = [], []
        for g, chosen in rows.items():
            group = self.groups[g].take(chosen)
            pairs = zip(group.variable.ravel().tolist(), group.order.ravel().tolist(), strict=True)
            found = [ZERO if v == ZERO else number.setdefault((v, q), len(number)) for v, q in pairs]
            quantity = np.array(found, np.int64).reshape(group.variable.shape)
            own = len(order) + np.arange(len(chosen))
            order += [int(self.first[g]) + i for i in chosen]
            groups.append(
                ExtendedGroup(group.template, own, quantity, group.factor, group.parameter, group.coefficient, own, 0)
            )
        size, _ = natural_sizes(groups, len(order), np.ones(len(number)), self.values, by_terms=True)
        return groups, order, np.array(list(number), np.int64).reshape(-1, 2), np.abs(size)

    def natural(self, equations: np.ndarray) -> dict[Hashable, float]:
        """Sizes of the quantities of equations, by their labels; those of the lower derivatives for higher ones."""
        _, _, pairs, size = self._at_natural_sizes(equations)
        found: dict[Hashable, float] = {}
        for (v, q), s in sorted(zip(map(tuple, pairs.tolist()), size.tolist(), strict=True), reverse=True):
            found |= {quantity_label(v, k): s for k in range(q, q + HIGHER)}
        return found

    def at_natural_size(self, equations: np.ndarray, columns: np.ndarray, trial: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns (the matrix, bounds of its errors) at a random point where all terms of the equations are alike.
        Elsewhere, an entry that depends on the point may look constant, because one of its terms is too small to be
        seen."""
        groups, order, pairs, size = self._at_natural_sizes(equations)
        at = Point.of(size * somewhere(pairs[:, 0], pairs[:, 1], trial), self.values, 0.37 + 0.1 * trial)
        place = {e: k for k, e in enumerate(equations.tolist())}
        dense, errors = np.zeros((2, len(equations), len(columns)))
        for group in groups:
            if group.template.opaque is not None:
                return self.at(equations, columns, trial)
            partials, bounds = group.partials(at), group.partial_errors(at, KNOWN * np.abs(at.values))
            for i, e in enumerate(order[int(group.equation[0]) : int(group.equation[-1]) + 1]):
                for slot, j in self.hits(e, columns):
                    dense[place[e], j] += partials[i, slot]
                    errors[place[e], j] += bounds[i, slot]
        return dense, errors

    def deficiency(self, equations: np.ndarray, parameter: int | None = None) -> float:
        """The number of redundant equations of a block at a sample point; with `parameter`, if that parameter, which is
        zero, were not. Infinite where the equations have no values."""
        values = self.values.copy()
        if parameter is not None:
            values[parameter] = 0.37
        changed = _Jacobian(self.groups, self.offsets, self.column, values)
        matrix, bounds = changed.at(equations, self.offsets.matched_variable[equations], 0)
        return len(left_null_vectors(matrix, bounds)) if np.isfinite(matrix).all() else np.inf

    def rows(
        self, equations: np.ndarray, columns: np.ndarray, as_number: Callable[[float], Fraction | Rounded | None]
    ) -> list[Row] | None:
        """The rows of the matrix, if all its entries are numbers that `as_number` has something for; `equations` are
        sorted."""
        where = np.full(len(self.offsets.variable), -1)
        where[columns] = np.arange(len(columns))
        rows: list[Row] = [{} for _ in equations]
        group_of_each = np.searchsorted(self.first, equations, side="right") - 1
        for g in np.unique(group_of_each).tolist():
            places = np.flatnonzero(group_of_each == g)
            group = self.groups[g].take((equations[places] - self.first[g]).tolist())
            column = np.where(group.variable == ZERO, -1, self.column[group.variable])
            highest = self.offsets.variable[column] == group.order + self.offsets.equation[equations[places], None]
            used = (column >= 0) & (where[column] >= 0) & highest
            numbers = group.template.numbers(group.coefficient) * group.factor
            if np.isnan(numbers[used]).any():
                return None
            for i, slot in zip(*np.nonzero(used), strict=True):
                value = as_number(float(numbers[i, slot]))
                if value is None:
                    return None
                row, j = rows[places[i]], int(where[column[i, slot]])
                row[j] = row[j] + value if j in row else value
        return [{j: value for j, value in row.items() if value} for row in rows]

    def is_constant(self, equations: np.ndarray, columns: np.ndarray) -> bool:
        """True if no entry of the block depends on the point."""
        return all(
            self.groups[self.place(e)[0]].template.coefficient_is_constant(slot)
            for e in equations.tolist()
            for slot, _ in self.hits(e, columns)
        )


def _combination(
    jacobian: _Jacobian, equations: np.ndarray, names: Sequence[str], discrete: np.ndarray
) -> tuple[int, EquationGroup] | None:
    """For a block that is singular wherever the model is: an equation of it, and what replaces that equation.

    **Raises:**

    - `StructuralError` if it is singular for the given parameter values alone, or in a way that depends on the point.
    """
    columns = jacobian.offsets.matched_variable[equations]
    exact = jacobian.rows(equations, columns, _simple)
    if exact is not None:
        weights = sparsest_null_vector(exact)
        return None if weights is None else _numeric_combination(jacobian, equations, columns, weights)
    if len(equations) <= LARGEST_BLOCK:
        return _sampled_combination(jacobian, equations, columns, names, discrete)
    numbers = jacobian.rows(equations, columns, rounded)
    if numbers is None:
        return None
    weights = sparsest_null_vector(numbers, rounded(1.0))
    if weights is None or not _cancels(weights, numbers):
        return None
    return _numeric_combination(jacobian, equations, columns, {i: w.value for i, w in weights.items()})


def _simple(value: float) -> Fraction | None:
    found = rational(value)
    return found if isinstance(found, Fraction) else None


def _cancels(weights: Row, rows: Sequence[Row]) -> bool:
    """True if every column of Σ weight·row is a rounding error. An elimination that lost all digits shows no
    combination."""
    terms: dict[int, list[float]] = {}
    for i, weight in weights.items():
        for c, entry in rows[i].items():
            terms.setdefault(c, []).append(weight.value * entry.value)
    return all(abs(math.fsum(found)) <= CANCELLED * sum(map(abs, found)) for found in terms.values())


def _numeric_combination(
    jacobian: _Jacobian, equations: np.ndarray, columns: np.ndarray, weights: Row
) -> tuple[int, EquationGroup]:
    """An equation of a block, and the combination of equations with these weights that replaces it."""
    used = np.array(sorted(weights), np.int64)
    sources = [provenance_of(jacobian.groups, int(e)) for e in equations[used]]
    written, unit, top = _written(jacobian, equations, columns, used)
    if written is None:
        raise StructuralError(_hidden(sources))
    chosen: list[Node] = [constant(weights[int(k)] / weights[int(used[unit])]) for k in used]
    return _replacement(jacobian, equations, used, written, chosen, unit, top, sources, np.zeros(0, np.int64))


def _sampled_combination(
    jacobian: _Jacobian, equations: np.ndarray, columns: np.ndarray, names: Sequence[str], discrete: np.ndarray
) -> tuple[int, EquationGroup] | None:
    """An equation of a block and the combination that replaces it, found from values at random points: for entries that
    are functions, or numbers that cancel to rounding. None if the block is regular at one of them."""
    groups = jacobian.groups
    trials, matrices, errors = [], [], []
    wanted = 1 if jacobian.is_constant(equations, columns) else STATES
    for trial in range(TRIALS):
        matrix, bounds = jacobian.at(equations, columns, trial)
        if not np.isfinite(matrix).all():
            continue  # the equations have no values there
        if not left_null_vectors(matrix, bounds):
            return None
        trials.append(trial)
        matrices.append(matrix)
        errors.append(bounds)
        if len(trials) == wanted:
            break
    if not trials:
        return None
    if wanted > 1:
        natural = [jacobian.at_natural_size(equations, columns, trial) for trial in trials]
        if any(np.isfinite(matrix).all() and not left_null_vectors(matrix, bounds) for matrix, bounds in natural):
            return None
    everywhere = left_null_vectors(np.hstack(matrices), np.hstack(errors))
    provenance = [provenance_of(groups, int(e)) for e in equations]
    if not everywhere:
        raise StructuralError(_hidden(provenance))
    used = np.flatnonzero(everywhere[0])
    written, unit, top = _written(jacobian, equations, columns, used)
    if written is None:
        raise StructuralError(_hidden(provenance))
    sources = [provenance[k] for k in used]
    found = _weights(written, top, unit, jacobian.values, discrete, trials)
    if found is None:
        here = [jacobian.place(e) for e in equations[used].tolist()]
        concerned = list(dict.fromkeys(p for g, i in here for p in groups[g].parameter[i].tolist()))
        if not concerned:  # numbers alone, which cancel to rounding
            raise StructuralError(_hidden(sources))
        raise StructuralError(
            "\n".join([_for_values(jacobian, equations, names, concerned, discrete), *itemised(sources)])
        )
    if not cancels_elsewhere(written, found, top, jacobian.values, discrete, of_parameters=False):
        return None  # regular in general: singular where a condition says so
    if not cancels_elsewhere(written, found, top, jacobian.values, discrete, of_parameters=True):
        concerned = sorted({label[1] for e in written for label in e.leaves if label[0] == "of model"})
        message = _for_values(jacobian, equations, names, concerned, discrete)
        raise StructuralError("\n".join([message, *itemised(sources)]))
    return _replacement(jacobian, equations, used, written, found, unit, top, sources, discrete)


def _written(
    jacobian: _Jacobian, equations: np.ndarray, columns: np.ndarray, used: np.ndarray
) -> tuple[list[Node] | None, int, list]:
    """The equations at `used`, differentiated so that the same derivatives are their highest, None if one of them is a
    function that is evaluated in JAX only; the place of one that is not differentiated; and what cancels."""
    c = jacobian.offsets.equation[equations[used]]
    written = []
    for e, k in zip(equations[used].tolist(), (c - c.min()).tolist(), strict=True):
        g, i = jacobian.place(e)
        written.append(graph_of(jacobian.groups[g], i, k))
    unit, top = int(np.flatnonzero(c == c.min())[0]), _highest(jacobian, columns, int(c.min()))
    return (None if any(graph is None for graph in written) else written), unit, top


def _replacement(
    jacobian: _Jacobian, equations: np.ndarray, used: np.ndarray, written: Sequence[Node], weights: Sequence[Node],
    unit: int, top: list, sources: list[Provenance], discrete: np.ndarray,
) -> tuple[int, EquationGroup]:  # fmt: skip
    """The equation at `unit`, and Σ weight·equation in its place, in which the quantities `top` are gone."""
    combined = combine(written, weights, top, jacobian.values, discrete, lambda: jacobian.natural(equations[used]))
    if combined is None:
        raise StructuralError(_hidden(sources))
    if not any(label[0] == "quantity" for label in combined.leaves):
        raise StructuralError(_dependent(sources))
    origin = combination(sources) if len(sources) > 1 else sources[0]
    return int(equations[used[unit]]), group_of(combined, origin)


def _for_values(
    jacobian: _Jacobian, equations: np.ndarray, names: Sequence[str], concerned: list[int], discrete: np.ndarray
) -> str:
    """The message for equations that are singular with these parameters: zeros, where there are, else all; in a mode,
    where there are discrete variables among them."""
    values = jacobian.values
    modes = [p for p in concerned if p in discrete]
    shown = [p for p in concerned if values[p] == 0.0 and p not in modes] or [p for p in concerned if p not in modes]
    given = some([f"{names[p]} = {values[p]:g}" for p in shown])
    mode = some([f"{names[p]} = {values[p]:g}" for p in modes if " " not in names[p]])  # hidden ones
    # Where a block is singular more than once, no value alone makes it regular: then those that take it nearest.
    left = {p: jacobian.deficiency(equations, p) for p in shown if values[p] == 0.0}
    least = min(left.values(), default=np.inf)
    if least < jacobian.deficiency(equations):
        mends = [p for p, count in left.items() if count == least]
        mend = f"Give a value other than zero to {alternatives([names[p] for p in mends])}"
    else:
        mend = "Change the parameters"
    return (
        f"these equations are singular for {given or 'the given parameter values'}, though not in general"
        f"{f', in the mode {mode}' if mode else ''}. {mend}, or state the constraint that follows as an equation of "
        "its own:"
    )


def _highest(jacobian: _Jacobian, columns: np.ndarray, lowest: int) -> list:
    """The labels of the quantities that cancel."""
    variable_of = {int(jacobian.column[v]): v for v in np.flatnonzero(jacobian.column >= 0).tolist()}
    return [quantity_label(variable_of[int(j)], int(jacobian.offsets.variable[j]) - lowest) for j in columns]


def _weights(
    written: Sequence[Node], top: Sequence, unit: int, values: np.ndarray, discrete: np.ndarray, trials: Sequence[int]
) -> list[Node] | None:
    """Weights in parameters with which the quantities `top` cancel in the equations; the one at `unit` is 1."""
    entries = [[partial_derivative(e, label) for label in top] for e in written]
    rows: list[list[Node]] = [[] for _ in written]
    for trial in trials:
        for row, given in zip(rows, entries, strict=True):
            for graph in given:
                point = {
                    label: constant(float(tried(label[1], label[2], trial)))
                    for label in graph.leaves
                    if label[0] == "quantity"
                }
                if TIME_LABEL in graph.leaves:
                    point[TIME_LABEL] = constant(0.37 + 0.1 * trial)
                row.append(substitute(graph, point) if point else graph)
    kept = [j for j in range(len(rows[0])) if any(number(row[j]) != 0 for row in rows)]
    if not kept:  # of one equation, in which they cancel by themselves
        return [constant(1)]
    rows = [[row[j] for j in kept] for row in rows]
    labels = sorted(frozenset().union(*(g.leaves for row in rows for g in row)), key=repr)
    samples = np.array([near(values, k, discrete) for k in range(PARAMETERS if labels else 1)])

    def evaluate(graphs: Sequence[Node]) -> tuple[np.ndarray, np.ndarray]:
        columns = [samples[:, label[1]] for label in labels]
        values, errors = KernelWithErrors(graphs, labels)(columns, [KNOWN * np.abs(column) for column in columns])
        return _over(values, len(samples)), _over(errors, len(samples))

    return weights_in_parameters(rows, evaluate, unit)


def _over(values: Sequence, n: int) -> np.ndarray:
    """Numbers and arrays (n,) as the rows of one array."""
    return np.stack([np.broadcast_to(np.asarray(v, float), (n,)) for v in values])


def _without(groups: tuple[EquationGroup, ...], equations: Sequence[int]) -> tuple[EquationGroup, ...]:
    first = equation_offsets(groups)
    out = []
    for g, group in enumerate(groups):
        rows = [k for k in range(len(group)) if int(first[g]) + k not in equations]
        if rows:
            out.append(group if len(rows) == len(group) else group.take(rows))
    return tuple(out)


def _hidden(equations: list[Provenance]) -> str:
    lines = [
        "these equations depend on each other in their highest derivatives, at every point. Remove or change one, "
        "or state the constraint that they hide as an equation of its own:"
    ]
    return "\n".join(lines + itemised(equations))
