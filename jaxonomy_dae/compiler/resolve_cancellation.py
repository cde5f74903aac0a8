"""Cancellation that structure cannot see.

Index reduction trusts the incidence: where the highest derivatives of several equations cancel in a linear combination,
it stops too early (two equations with C·(y₁′ − y₂′) and C·(y₂′ − y₁′) are one differential and one algebraic equation).
Where the coefficients are constants or parameters, the combination is found exactly: a left null vector w of a diagonal
block of the system Jacobian, in rational functions of the parameters. The equation Σ wᵢ Fᵢ^(cᵢ − c_min), in which the
highest derivatives are gone, replaces one of lowest cᵢ, and index reduction starts again: the linear combination method
of Tan, Nedialkov & Pryce (2017).
"""

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse as sp
import sympy
from scipy.sparse.csgraph import connected_components

from ..diagnosis.wording import itemised
from ..errors import StructuralError
from ..model.incidence import incidence
from ..model.scaling import equilibrated
from ..model.tables import ZERO, EquationGroup, describe_equation, equation_offsets, written_by
from ..model.templates import LinearTemplate, Template, template_of
from ..structure.incidence import Incidence
from ..structure.matching import maximum_matching
from ..structure.pantelides import Offsets, reduce_index

LARGEST_BLOCK = 60
ROUNDS = 20
TRIALS = 4  # random points at which a block that depends on the point must be singular to be refused
COMBINED = "combination of "
SOURCES = 4  # equations named


@dataclasses.dataclass(frozen=True)
class _Equation:
    """One equation with its symbols: quantities are (variable, order), parameters ids."""

    expression: Any
    origin: str


def _quantity(variable: int, order: int) -> sympy.Symbol:
    return sympy.Symbol(f"v{variable}_{order}", real=True)


def _parameter(k: int) -> sympy.Symbol:
    # Positive: no parameter that divides is zero, and roots of squares simplify.
    return sympy.Symbol(f"q{k}", positive=True)


def reduce_with_cancellation(
    groups: tuple[EquationGroup, ...], column: np.ndarray, n_unknown: int, least: np.ndarray, values: np.ndarray
) -> tuple[tuple[EquationGroup, ...], Incidence, Offsets, tuple[str, ...]]:
    """Index reduction, repeated until no diagonal block with constant coefficients is singular.

    Returns the equations, changed where something cancelled, their incidence and offsets, and notes.

    **Raises:**

    - `StructuralError` if a block is singular for the given parameter values alone, or equations depend on each other.
    """
    notes: list[str] = []
    signature = incidence(groups, column, n_unknown)
    for _ in range(ROUNDS):
        offsets = reduce_index(signature, least)
        found = _singular_block(groups, signature, offsets, column, values)
        if found is None:
            return groups, signature, offsets, tuple(notes)
        combined = [describe_equation(groups, int(e)) for e in found[0]]
        groups, note = _replace(groups, offsets, column, *found)
        notes.append(note)
        signature = incidence(groups, column, n_unknown)
        if (maximum_matching(signature.pointer, signature.variable, n_unknown) < 0).any():
            raise StructuralError(_dependent(combined))
    raise StructuralError(_dependent(combined))


def _dependent(origins: list[str]) -> str:
    """The message for equations that depend on each other, or contradict."""
    lines = ["these equations depend on each other, or contradict. Remove or change one of:"]
    return "\n".join(lines + itemised([(written_by(o) or "", o) for o in origins]))


def _blocks(signature: Incidence, offsets: Offsets) -> tuple[np.ndarray, np.ndarray]:
    """The diagonal block of every equation in the system Jacobian, and how many equations that block has."""
    rows, n = signature.rows, signature.n_equations
    active = signature.order + offsets.equation[rows] == offsets.variable[signature.variable]
    owner = np.empty(signature.n_variables, np.int64)
    owner[offsets.matched_variable] = np.arange(n)
    follow = (rows[active], owner[signature.variable[active]])
    _, label = connected_components(
        sp.coo_array((np.ones(len(follow[0])), follow), shape=(n, n)), directed=True, connection="strong"
    )
    return label, np.bincount(label)[label]


def _singular_block(groups, signature: Incidence, offsets: Offsets, column, values):
    """(equations, columns) of the first diagonal block of several equations with constant entries that is singular."""
    label, _ = _blocks(signature, offsets)
    sizes = np.bincount(label)
    first = equation_offsets(groups)
    order = np.argsort(label, kind="stable")
    start = np.concatenate([[0], np.cumsum(sizes)])
    for b in np.flatnonzero((sizes > 1) & (sizes <= LARGEST_BLOCK)).tolist():
        equations = np.sort(order[start[b] : start[b + 1]])
        columns = offsets.matched_variable[equations]
        for trial in range(TRIALS):
            dense, constant = _entries(groups, first, equations, columns, offsets, column, values, trial)
            if not _is_singular(dense):
                break
            if constant:
                return equations, columns
        else:
            raise StructuralError(_hidden([describe_equation(groups, int(e)) for e in equations]))
    return None


def _is_singular(dense: np.ndarray) -> bool:
    if not np.isfinite(dense).all():
        return False  # nothing can be said
    singular = np.linalg.svd(equilibrated(dense)[0].toarray(), compute_uv=False)  # units decide nothing
    return bool(singular[-1] < 1e-12 * max(singular[0], 1.0))


def _hidden(origins: list[str]) -> str:
    lines = [
        "these equations depend on each other in their highest derivatives, wherever the model is. Remove or change "
        "one, or state the constraint that they hide as an equation of its own:"
    ]
    return "\n".join(lines + itemised([(written_by(o) or "", o) for o in origins]))


def zero_pivots(groups, signature: Incidence, offsets: Offsets, column, values) -> np.ndarray:
    """Equations that alone determine a quantity, whose coefficient is zero for the given parameter values."""
    count = _blocks(signature, offsets)[1]
    first = equation_offsets(groups)
    found = []
    for g, group in enumerate(groups):
        template = group.template
        if not isinstance(template, Template) or not template.n_parameters or not len(group):
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
        point = [np.ones(len(group))] * len(template.slots)
        with np.errstate(all="ignore"):
            partial = template.partial_values(point, list(values[group.parameter].T), [], 0.0, None, backend="numpy")
        total = sum(used[:, k] * group.sign[:, k] * partial[k] for k in slots.tolist())
        found.append(equation[used.any(axis=1) & (total == 0)])
    return np.concatenate(found) if found else np.zeros(0, np.int64)


def _entries(groups, first, equations, columns, offsets: Offsets, column, values, trial: int):
    """(∂Fᵢ/∂(highest derivative of column j), whether these are constants); others are taken at a random point."""
    place = {int(c): k for k, c in enumerate(columns)}
    dense = np.zeros((len(equations), len(columns)))
    constant = True
    for k, e in enumerate(equations.tolist()):
        g = int(np.searchsorted(first, e, side="right") - 1)
        group, i = groups[g], e - int(first[g])
        template = group.template
        variable, order, sign = (a[i].tolist() for a in (group.variable, group.order, group.sign))
        hit = []
        for slot, v in enumerate(variable):
            j = place.get(int(column[v]), -1) if v != ZERO and column[v] >= 0 else -1
            if j >= 0 and order[slot] + offsets.equation[e] == offsets.variable[columns[j]]:
                constant &= template.coefficient_is_constant(slot)
                hit.append((slot, j))
        point = [
            0.0 if v == ZERO else s * _somewhere(v, o, trial) for v, o, s in zip(variable, order, sign, strict=True)
        ]
        if template.opaque is not None:
            partial = [1.0, *(_somewhere(k, slot, trial) for slot in range(1, len(point)))]  # a network is any function
        else:
            with np.errstate(all="ignore"):
                chosen, coefficient = list(values[group.parameter[i]]), list(group.coefficient[i])
                partial = template.partial_values(point, chosen, coefficient, 0.37, None, backend="numpy")
        for slot, j in hit:
            dense[k, j] += sign[slot] * float(partial[slot])
    return dense, constant


def _somewhere(variable: int, order: int, trial: int) -> float:
    """A number in ±(0.5, 1.5) without pattern, always the same for the same quantity."""
    x = np.sin(12.9898 * (variable + 1) + 78.233 * (order + 1) + 37.719 * trial) * 43758.5453
    x -= np.floor(x)
    return float(0.5 + x if trial % 2 else -0.5 - x)


def _symbolic(groups, e: int, times: int) -> _Equation:
    """An equation, differentiated `times` times, in quantities and parameters."""
    first = equation_offsets(groups)
    g = int(np.searchsorted(first, e, side="right") - 1)
    group, i = groups[g], e - int(first[g])
    template = group.template
    for _ in range(times):
        template = template.derivative
    values = []
    for base, q in template.slots:
        v = int(group.variable[i, base])
        values.append(
            sympy.S.Zero if v == ZERO else int(group.sign[i, base]) * _quantity(v, int(group.order[i, base]) + q)
        )
    if isinstance(template, LinearTemplate):
        terms = [sympy.nsimplify(c) * s for c, s in zip(group.coefficient[i].tolist(), values, strict=True)]
        return _Equation(sympy.Add(*terms), group.origin[i])
    assert isinstance(template, Template)
    symbols = template.arguments
    replaced = dict(zip(symbols, [*values, *(_parameter(int(k)) for k in group.parameter[i])], strict=False))
    return _Equation(template.expression.xreplace(replaced), group.origin[i])


def _replace(groups, offsets: Offsets, column, equations, columns):
    c = offsets.equation[equations]
    lowest = int(c.min())
    written = [_symbolic(groups, int(e), int(k) - lowest) for e, k in zip(equations, c, strict=True)]
    variable_of = {int(column[v]): v for v in np.flatnonzero(column >= 0).tolist()}
    top = [_quantity(variable_of[int(j)], int(offsets.variable[j]) - lowest) for j in columns]
    matrix = sympy.Matrix([[sympy.diff(w.expression, t) for t in top] for w in written])
    null = matrix.T.nullspace(simplify=True)
    if not null:
        lines = itemised([(written_by(w.origin) or "", w.origin) for w in written])
        raise StructuralError(
            "\n".join(
                [
                    "these equations are singular for the given parameter values, though not in general. Change the "
                    "parameters, or state the constraint that follows as an equation of its own:",
                    *lines,
                ]
            )
        )
    weights = list(null[0])
    combined = sympy.Add(*(w * equation.expression for w, equation in zip(weights, written, strict=True)))
    for symbol in sorted(combined.free_symbols, key=str):
        if str(symbol).startswith("v") and sympy.simplify(sympy.diff(combined, symbol)) == 0:
            combined = combined.subs(symbol, 0)
    combined = sympy.nsimplify(combined) if combined.is_number else combined
    used = [k for k, w in enumerate(weights) if w != 0]
    sources = list(dict.fromkeys(p for k in used for p in written[k].origin.removeprefix(COMBINED).split("; ")))
    origin = COMBINED + "; ".join([*sources[:SOURCES], *(["…"] if len(sources) > SOURCES else [])])
    if not any(str(s).startswith("v") for s in combined.free_symbols):
        raise StructuralError(_dependent([written[k].origin for k in used]))
    replaced = next(int(equations[k]) for k in used if c[k] == lowest)
    new = _group(combined, origin)
    first = equation_offsets(groups)
    g = int(np.searchsorted(first, replaced, side="right") - 1)
    rest = [k for k in range(len(groups[g])) if k != replaced - int(first[g])]
    kept = (*groups[:g], groups[g].take(rest), *groups[g + 1 :], new)
    return tuple(k for k in kept if len(k)), f"highest derivatives cancel in a {origin}"


def _group(expression: Any, origin: str) -> EquationGroup:
    """A group of one equation from its symbolic form."""
    quantities = sorted(
        tuple(map(int, str(s)[1:].split("_"))) for s in expression.free_symbols if str(s).startswith("v")
    )
    parameters = sorted(int(str(s)[1:]) for s in expression.free_symbols if str(s).startswith("q"))
    slots = tuple((k, 0) for k in range(len(quantities)))
    placeholder = Template(sympy.S.Zero, slots, len(parameters))
    replaced = dict(
        zip(
            [*(_quantity(*q) for q in quantities), *(_parameter(p) for p in parameters)],
            placeholder.arguments,
            strict=False,
        )
    )
    template = template_of(expression.xreplace(replaced), slots, len(parameters))
    return EquationGroup(
        template,
        np.array([[v for v, _ in quantities]], np.int64),
        np.array([[o for _, o in quantities]], np.int64),
        np.ones((1, len(quantities)), np.int64),
        np.array([parameters], np.int64).reshape(1, -1),
        np.zeros((1, 0)),
        [origin],
    )
