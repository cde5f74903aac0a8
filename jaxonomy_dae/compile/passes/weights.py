"""Weights with which rows of functions of the parameters cancel, as functions of the parameters.

The elimination runs on the functions themselves. Whether what is left of an entry is zero, no rule of algebra needs to
show: values at some parameters say so, to the errors of their evaluation.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ...base.tolerances import CANCELLED, KNOWN
from ...graph.expressions.node import ONE, ZERO, Node, constant, divide, linear, multiply, number
from . import elimination
from .null_vectors import rational
from .rounded import Rounded


@dataclasses.dataclass(frozen=True, slots=True)
class Sampled:
    """A function of the parameters, and its values at sample points; false where all of these may be zero."""

    graph: Node
    value: Rounded  # arrays, (samples,)

    def __bool__(self) -> bool:
        return self.graph is not ZERO and bool(self.value)

    def __neg__(self) -> "Sampled":
        return Sampled(linear([(-1, self.graph)]), -self.value)

    def __add__(self, other: "Sampled") -> "Sampled":
        return Sampled(linear([(1, self.graph), (1, other.graph)]), self.value + other.value)

    def __sub__(self, other: "Sampled") -> "Sampled":
        return Sampled(linear([(1, self.graph), (-1, other.graph)]), self.value - other.value)

    def __mul__(self, other: "Sampled") -> "Sampled":
        return Sampled(multiply(self.graph, other.graph), self.value * other.value)

    def __truediv__(self, other: "Sampled") -> "Sampled":
        return Sampled(divide(self.graph, other.graph), self.value / other.value)


@np.errstate(all="ignore")  # a quotient without a value is found in the end
def weights_in_parameters(
    rows: Sequence[dict[int, Node]],
    values: Callable[[Sequence[Node]], tuple[np.ndarray, np.ndarray]],
    unit: int,
) -> list[Node] | None:
    """w(p) with w[unit] = 1 and Σ wᵢ·rowᵢ(p) = 0; None if there is none, or more than one.

    **Arguments:**

    - `rows`: the entries by column; their leaves are parameters.
    - `values`: of graphs, at sample parameters, and bounds of their errors: both of shape (graphs, samples).
    """
    entries = [(i, c, graph) for i, row in enumerate(rows) for c, graph in row.items() if number(graph) != 0]
    if not entries:  # one equation, in which all cancels by itself
        return [ONE] * len(rows) if len(rows) == 1 else None
    numbers, errors = values([graph for _, _, graph in entries])
    if not np.isfinite(numbers).all():
        return None
    sampled: list[elimination.Row] = [{} for _ in rows]
    for (i, c, graph), value, error in zip(entries, numbers, errors, strict=True):
        # Given numbers are known to that.
        found = Sampled(graph, Rounded(value, np.maximum(error, KNOWN * np.abs(value))))
        if found:
            sampled[i][c] = found
    one = Sampled(ONE, Rounded(np.ones(numbers.shape[1]), np.zeros(numbers.shape[1])))
    # To divide by an entry that vanishes at a sample leaves all later ones without a value there. Another pivot is
    # taken if there is one.
    found = elimination.null_vectors(sampled, one, lambda entry: entry.value.may_vanish)
    # With several combinations it is open which one to take; without the equation at `unit` in it, the equation to be
    # replaced would not be part of what replaces it.
    if len(found) != 1 or unit not in found[0]:
        return None
    by = found[0][unit]
    quotients = [found[0].get(i, one - one) / by for i in range(len(rows))]
    if not all(np.isfinite(quotient.value.value).all() for quotient in quotients):
        return None
    return [_simplest(quotient) for quotient in quotients]


def _simplest(weight: Sampled) -> Node:
    """Its graph, a number where its values are the same."""
    values = np.asarray(weight.value.value)
    first = float(values[0])
    is_number = (np.abs(values - first) <= CANCELLED * abs(first)).all()
    return constant(rational(first)) if is_number else weight.graph
