"""Cancellation that structure cannot see.

Index reduction trusts the incidence: where the highest derivatives of several equations cancel in a linear combination,
it stops too early (two equations with C·(y₁′ − y₂′) and C·(y₂′ − y₁′) are one differential and one algebraic equation).
Where a diagonal block of the system Jacobian has a left null vector w that is the same wherever the model is, a number
or a function of the parameters, the equation Σ wᵢ Fᵢ^(cᵢ − c_min), in which the highest derivatives are gone, replaces
one of lowest cᵢ, and index reduction starts again: the linear combination method of Tan, Nedialkov & Pryce (2017).
"""

from collections.abc import Hashable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ...base.errors import StructuralError
from ...base.tolerances import KNOWN
from ...graph.expressions.differentiate import partial_derivative
from ...graph.expressions.errors import KernelWithErrors
from ...graph.expressions.node import Node, constant
from ...graph.expressions.substitute import substitute
from ...graph.structure.incidence import Incidence
from ...graph.structure.matching import maximum_matching
from ...graph.structure.pantelides import Offsets, diagonal_blocks, reduce_index
from ...write.symbols import TIME_LABEL
from ..diagnosis.wording import alternatives, itemised, some
from ..model.entries import incidence
from ..model.provenance import Provenance, combination
from ..model.tables import ZERO, EquationGroup, ParameterTable, equation_offsets, provenance_of
from . import elimination
from .combine_equations import combine, graph_of, group_of, has_branches, near, quantity_label, slope_left, tried
from .combined_errors import errors_of_combination, own_errors, with_errors, without_errors
from .elimination import Row
from .highest_derivatives import HighestDerivatives
from .null_vectors import null_vectors, rational
from .number_columns import Columns
from .weights import weights_in_parameters

ROUNDS = 100  # of index reduction: each resolves one combination in every block
TRIALS = 44  # random points, of which STATES are used: the first where the equations have values
STATES = 3
PARAMETERS = 4  # sample values of the parameters


def reduce_with_cancellation(
    groups: tuple[EquationGroup, ...],
    signature: Incidence,
    columns: Columns,
    matching: np.ndarray,
    parameters: ParameterTable,
    values: np.ndarray,
) -> tuple[tuple[EquationGroup, ...], Incidence, Offsets, tuple[str, ...]]:
    """Index reduction, repeated until no diagonal block with constant coefficients is singular.

    `signature` is the incidence of the equations, `matching` what `match_highest` finds in it; `values` are those of
    all parameters. Returns the equations, changed where something cancelled, their incidence and offsets, and notes.

    **Raises:**

    - `StructuralError` if a block is singular for the given parameter values alone, or equations depend on each other.
    """
    notes: list[str] = []
    n_unknown = signature.n_variables
    # The matching of the structural check holds in the first round only: afterwards equations have been replaced.
    highest: np.ndarray | None = matching
    for _ in range(ROUNDS):
        offsets = reduce_index(signature, columns.least_of_unknown, highest)
        jacobian = HighestDerivatives(groups, offsets, columns.number, values)
        replaced, added, combined = [], [], []
        # One combination in every block and round: each replaced equation changes the offsets, and with these which
        # derivatives are the highest.
        for equations in _blocks_that_may_cancel(signature, jacobian):
            found = _combination(jacobian, equations, parameters.names, parameters.discrete)
            if found is not None:
                combined = [provenance_of(groups, int(e)) for e in equations]
                replaced.append(found[0])
                added.append(found[1])
        if not added:
            return tuple(map(without_errors, groups)), signature, offsets, tuple(notes)
        sources = [group.provenance[0] for group in added]
        notes += [f"highest derivatives cancel in {'a ' if source.sources else ''}{source}" for source in sources]
        groups = (*_without(groups, replaced), *added)
        signature, highest = incidence(groups, columns.number, n_unknown), None
        # A combination in which everything cancels has no unknown left: these equations repeat or contradict each
        # other. Pantelides' algorithm would not end on them.
        if (maximum_matching(signature.pointer, signature.variable, n_unknown) < 0).any():
            raise StructuralError(_dependent(combined))
    raise StructuralError(_dependent(combined))


def _dependent(equations: list[Provenance]) -> str:
    """The message for equations that depend on each other, or contradict."""
    lines = ["these equations depend on each other, or contradict each other. Remove or change one of:"]
    return "\n".join(lines + itemised(equations))


def _blocks_that_may_cancel(signature: Incidence, jacobian: HighestDerivatives) -> list[np.ndarray]:
    """The equations of each diagonal block that has more than one or in whose equation the terms of what it determines
    cancel."""
    label, _ = diagonal_blocks(signature, jacobian.offsets)
    sizes = np.bincount(label)
    order = np.argsort(label, kind="stable")
    start = np.concatenate([[0], np.cumsum(sizes)])
    several = sizes > 1
    # A single equation with a single slot of its highest derivative cannot cancel. These are nearly all equations of a
    # model, and no matrix of theirs is made.
    several[label[_cancelled_alone(jacobian)]] = True
    chosen = np.flatnonzero(several).tolist()
    return [np.sort(order[start[b] : start[b + 1]]) for b in chosen]


def _cancelled_alone(jacobian: HighestDerivatives) -> np.ndarray:
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
        # So the comparison is written such that not-a-number counts as suspect.
        # Equations without a value at this point are evaluated at others.
        found.append(own[several & ~(np.abs(total) > bound)])
    return np.concatenate(found)


def _combination(
    jacobian: HighestDerivatives, equations: np.ndarray, names: Sequence[str], discrete: np.ndarray
) -> tuple[int, EquationGroup] | None:
    """For a block that is singular wherever the model is: an equation of it, and what replaces that equation.

    **Raises:**

    - `StructuralError` if it is singular for the given parameter values alone, or in a way that depends on the point.
    """
    columns = jacobian.offsets.matched_variable[equations]
    # Coefficients of connections and differences are mostly ±1. With fractions nothing has to be judged, and a ring of
    # any size is eliminated in linear time.
    exact = jacobian.rows(equations, columns, _simple)
    if exact is None:
        return _sampled_combination(jacobian, equations, columns, names, discrete)
    found = elimination.null_vectors(exact)
    return _numeric_combination(jacobian, equations, columns, found[0]) if found else None


def _simple(value: float) -> Fraction | None:
    found = rational(value)
    return found if isinstance(found, Fraction) else None


def _numeric_combination(
    jacobian: HighestDerivatives, equations: np.ndarray, columns: np.ndarray, weights: Row
) -> tuple[int, EquationGroup]:
    """An equation of a block, and the combination of equations with these weights that replaces it."""
    # The equation that is replaced stands in the combination as it is, with the weight one. From a derivative of it,
    # it would follow up to a constant alone.
    used = sorted(weights)
    parts = _parts(jacobian, equations[used], columns)
    chosen: list[Node] = [constant(weights[k] / weights[used[parts.unit]]) for k in used]
    return _replacement(jacobian, parts, chosen, np.zeros(0, np.int64), exact=True)


def _sampled_combination(
    jacobian: HighestDerivatives, equations: np.ndarray, columns: np.ndarray, names: Sequence[str], discrete: np.ndarray
) -> tuple[int, EquationGroup] | None:
    """An equation of a block and the combination that replaces it, found from values at random points: for entries that
    are functions, or numbers that cancel to rounding. None if the block is regular at one of them."""
    groups = jacobian.groups
    trials, together = [], None
    # A block of functions may be singular at one point by chance. If it is regular at one point, it is regular in
    # general.
    wanted = 1 if jacobian.is_constant(equations, columns) else STATES
    for trial in range(TRIALS):
        matrix = jacobian.at(equations, columns, trial)
        if not matrix.is_finite:
            continue  # the equations have no values there
        if not null_vectors(matrix):
            return None
        trials.append(trial)
        together = together.beside(matrix) if together else matrix
        if len(trials) == wanted:
            break
    if together is None:
        return None
    if wanted > 1:
        # Near one, a term that is small there may be lost beside others: x′ + (1e12 + x)·y′ looks constant. At natural
        # sizes all terms of an equation are alike.
        natural = [jacobian.at_natural_size(equations, columns, trial) for trial in trials]
        if any(matrix.is_finite and not null_vectors(matrix) for matrix in natural):
            return None
    # Each matrix has a null vector of its own. Only one that they share is a combination of equations; otherwise the
    # weights would have to depend on the state.
    everywhere = null_vectors(together)
    if not everywhere:
        raise StructuralError(_hidden([provenance_of(groups, int(e)) for e in equations]))
    parts = _parts(jacobian, equations[sorted(everywhere[0])], columns)
    found = _weights(parts, jacobian.values, discrete, trials)
    if found is None:
        here = [jacobian.place(e) for e in parts.equations.tolist()]
        # The block has a null vector at these parameters and none as a function of them: it is the given values that
        # are special.
        concerned = list(dict.fromkeys(p for g, i in here for p in groups[g].parameter[i].tolist()))
        if not concerned:  # numbers alone, which cancel to rounding
            raise StructuralError(_hidden(parts.sources))
        said = _for_values(jacobian, equations, names, concerned, discrete)
        raise StructuralError("\n".join([said, *itemised(parts.sources)]))
    if any(has_branches(slope_left(parts.graphs, found, label), of_parameters=False) for label in parts.top):
        return None  # regular in general: singular where a condition says so
    return _replacement(jacobian, parts, found, discrete, exact=False)


class _Parts(NamedTuple):
    """Equations to be combined: their numbers, and graphs of them, differentiated so that the same derivatives are
    their highest; the place of one that is not differentiated; the labels of what cancels; who wrote them; the errors
    of their coefficients, beside rounding, by labels."""

    equations: np.ndarray
    graphs: list[Node]
    unit: int
    top: list
    sources: list[Provenance]
    errors: list[dict[Hashable, float]]


def _parts(jacobian: HighestDerivatives, equations: np.ndarray, columns: np.ndarray) -> _Parts:
    """**Raises:** `StructuralError` for a function that is evaluated in JAX only."""
    c = jacobian.offsets.equation[equations]
    # All equations are brought to the same highest derivatives, by as few differentiations as possible: what cancels in
    # F₁ − F₂′ does so in its derivatives, too.
    lowest = int(c.min())
    places = [jacobian.place(e) for e in equations.tolist()]
    given = [(jacobian.groups[g], i, k) for (g, i), k in zip(places, (c - lowest).tolist(), strict=True)]
    graphs = [graph_of(*each) for each in given]
    sources = [jacobian.groups[g].provenance[i] for g, i in places]
    known = [graph for graph in graphs if graph is not None]
    if len(known) < len(graphs):
        raise StructuralError(_hidden(sources))
    errors = [own_errors(*each) for each in given]
    return _Parts(equations, known, int(np.argmin(c)), _highest(jacobian, columns, lowest), sources, errors)


def _replacement(
    jacobian: HighestDerivatives, parts: _Parts, weights: Sequence[Node], discrete: np.ndarray, exact: bool
) -> tuple[int, EquationGroup]:
    """The equation at `unit`, and Σ weight·equation in its place, in which the quantities `top` are gone. `exact`: the
    weights are."""
    equations, graphs, unit, top, sources, errors = parts
    combined = combine(graphs, weights, top, jacobian.values, discrete, lambda: jacobian.natural(equations))
    if combined is None:
        raise StructuralError(_hidden(sources))
    if not any(label[0] == "quantity" for label in combined.leaves):
        raise StructuralError(_dependent(sources))
    origin = combination(sources) if len(sources) > 1 else sources[0]
    bounds = errors_of_combination(graphs, errors, weights, unit, top, exact)
    return int(equations[unit]), with_errors(group_of(combined, origin), bounds)


def _for_values(
    jacobian: HighestDerivatives,
    equations: np.ndarray,
    names: Sequence[str],
    concerned: list[int],
    discrete: np.ndarray,
) -> str:
    """The message for equations that are singular with these parameters: zeros, where there are, else all; in a mode,
    where there are discrete variables among them."""
    values = jacobian.values
    modes = [p for p in concerned if p in discrete]
    shown = [p for p in concerned if values[p] == 0.0 and p not in modes] or [p for p in concerned if p not in modes]
    given = some([f"{names[p]} = {values[p]:g}" for p in shown])
    mode = some([f"{names[p]} = {values[p]:g}" for p in modes if " " not in names[p]])  # hidden ones
    # Where a block is singular more than once, no value alone makes it regular: the parameters that leave the smallest
    # rank deficiency are taken.
    left = {p: _deficiency(jacobian, equations, p) for p in shown if values[p] == 0.0}
    least = min(left.values(), default=np.inf)
    if least < _deficiency(jacobian, equations):
        mends = [p for p, count in left.items() if count == least]
        mend = f"Give a value other than zero to {alternatives([names[p] for p in mends])}"
    else:
        mend = "Change the parameters"
    return (
        f"these equations are singular for {given or 'the given parameter values'}, though not in general"
        f"{f', in the mode {mode}' if mode else ''}. {mend}, or state the constraint that follows as an equation of "
        "its own:"
    )


def _deficiency(jacobian: HighestDerivatives, equations: np.ndarray, parameter: int | None = None) -> float:
    """The number of redundant equations of a block at a sample point; with `parameter`, if that parameter, which is
    zero, were not. Infinite where the equations have no values."""
    values = jacobian.values.copy()
    if parameter is not None:
        values[parameter] = 0.37
    matrix = jacobian.with_values(values).at(equations, jacobian.offsets.matched_variable[equations], 0)
    return len(null_vectors(matrix)) if matrix.is_finite else np.inf


def _highest(jacobian: HighestDerivatives, columns: np.ndarray, lowest: int) -> list:
    """The labels of the quantities that cancel."""
    variable_of = {int(jacobian.column[v]): v for v in np.flatnonzero(jacobian.column >= 0).tolist()}
    return [quantity_label(variable_of[int(j)], int(jacobian.offsets.variable[j]) - lowest) for j in columns]


def _weights(parts: _Parts, values: np.ndarray, discrete: np.ndarray, trials: Sequence[int]) -> list[Node] | None:
    """Weights in parameters with which the quantities `top` cancel in the equations; the one at `unit` is 1."""
    place = {label: k for k, label in enumerate(parts.top)}
    rows: list[dict[int, Node]] = []
    for equation in parts.graphs:
        row: dict[int, Node] = {}
        for label in sorted(equation.leaves & place.keys(), key=place.__getitem__):
            graph = partial_derivative(equation, label)
            moving = [leaf for leaf in graph.leaves if leaf[0] == "quantity"]
            for k, trial in enumerate(trials):
                # Weights may depend on parameters, not on the state. So states are numbers here, the same ones in all
                # entries, with a column for each point.
                point = {leaf: constant(float(tried(leaf[1], leaf[2], trial))) for leaf in moving}
                if TIME_LABEL in graph.leaves:
                    point[TIME_LABEL] = constant(0.37 + 0.1 * trial)
                row[place[label] + k * len(place)] = substitute(graph, point) if point else graph
        rows.append(row)
    labels = sorted(frozenset().union(*(g.leaves for row in rows for g in row.values())), key=repr)
    samples = np.array([near(values, k, discrete) for k in range(PARAMETERS if labels else 1)])

    def evaluate(graphs: Sequence[Node]) -> tuple[np.ndarray, np.ndarray]:
        columns = [samples[:, label[1]] for label in labels]
        values, errors = KernelWithErrors(graphs, labels)(columns, [KNOWN * np.abs(column) for column in columns])
        return _over(values, len(samples)), _over(errors, len(samples))

    return weights_in_parameters(rows, evaluate, parts.unit)


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
