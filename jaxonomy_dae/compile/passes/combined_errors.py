"""How well the coefficients of a combination of equations are known.

A coefficient Σ wᵢ·cᵢ is known to the errors of its terms, not of itself: after a few combinations of combinations, what
is a rounding error can be a thousand times the rounding of the number that it stands beside, and looks like a
coefficient. The weights are known to what the errors of the matrix make of them: with wᵀA = 0, where one weight is 1,
the others move by δw = −(wᵀE)·R for errors E of A, with any right inverse R of their rows.
"""

import dataclasses
from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from ...base.tolerances import KNOWN
from ...graph.expressions.differentiate import partial_derivative
from ...graph.expressions.node import Node, Number, number
from ...graph.judgement.scaling import equilibrated
from ..model.tables import EquationGroup
from .combine_equations import quantity_label


@dataclasses.dataclass(frozen=True)
class CombinedGroup(EquationGroup):
    """A combination of equations; `error` bounds the errors of its partial derivatives that are numbers, (1, slots),
    and is zero for others."""

    error: np.ndarray


def with_errors(group: EquationGroup, bounds: Mapping[Hashable, float]) -> CombinedGroup:
    """A group of one equation with bounds of the errors of its coefficients, by the labels of their quantities."""
    labels = map(quantity_label, group.variable[0].tolist(), group.order[0].tolist())
    error = np.array([[bounds.get(label, 0.0) for label in labels]])
    fields = {f.name: getattr(group, f.name) for f in dataclasses.fields(EquationGroup)}
    return CombinedGroup(**fields, error=error)


def without_errors(group: EquationGroup) -> EquationGroup:
    """The group as passes take it that judge no combination."""
    if not isinstance(group, CombinedGroup):
        return group
    return EquationGroup(**{f.name: getattr(group, f.name) for f in dataclasses.fields(EquationGroup)})


def own_errors(group: EquationGroup, i: int, times: int) -> dict[Hashable, float]:
    """The errors of the coefficients of equation i, differentiated `times` times, where they are above rounding."""
    if not isinstance(group, CombinedGroup):
        return {}
    pairs = zip(group.variable[i].tolist(), (group.order[i] + times).tolist(), group.error[i].tolist(), strict=True)
    return {quantity_label(v, q): error for v, q, error in pairs}


def errors_of_combination(
    equations: Sequence[Node],
    errors: Sequence[Mapping[Hashable, float]],
    weights: Sequence[Node],
    unit: int,
    gone: Sequence[Hashable],
    exact: bool,
) -> dict[Hashable, float]:
    """Bounds of the errors of the coefficients of Σ weight·equation, by their quantities; none of those that are no
    numbers, nor where weights are none.

    **Arguments:**

    - `errors`: of the coefficients of each equation, beside one rounding.
    - `unit`: the equation with the weight 1; `gone`: the quantities that cancel.
    - `exact`: whether the weights are.
    """
    w = _floats(map(number, weights))
    if w is None:
        return {}
    labels = {x for e in equations for x in e.leaves if x[0] == "quantity"}
    slopes = {x: _numbers(equations, x) for x in labels}
    known = {x: s for x, s in slopes.items() if s is not None}
    bound = {x: np.maximum(KNOWN * np.abs(s), [own.get(x, 0.0) for own in errors]) for x, s in known.items()}
    moved = np.zeros(len(w))
    others = np.arange(len(w)) != unit
    top = [x for x in gone if x in known]
    if not exact and others.any() and len(top) == len(labels.intersection(gone)):
        matrix = np.stack([known[x] for x in top], axis=1)
        scaled, rows, columns = equilibrated(matrix[others])
        inverse = columns[:, None] * np.linalg.pinv(scaled.toarray()) * rows
        moved[others] = (np.abs(w) @ np.stack([bound[x] for x in top], axis=1)) @ np.abs(inverse)
    return {x: float(np.abs(w) @ bound[x] + moved @ np.abs(s)) for x, s in known.items()}


def _numbers(equations: Sequence[Node], label: Hashable) -> np.ndarray | None:
    """The coefficients of a quantity in equations; None if one is no number."""
    return _floats(number(partial_derivative(e, label)) if label in e.leaves else 0 for e in equations)


def _floats(numbers: Iterable[Number | None]) -> np.ndarray | None:
    found = [None if x is None else float(x) for x in numbers]
    return None if None in found else np.array(found, float)
