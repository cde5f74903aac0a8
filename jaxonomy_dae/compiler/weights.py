"""Weights with which rows of functions of the parameters cancel, as functions of the parameters.

The elimination runs on the functions themselves. Whether what is left of an entry is zero, no rule of algebra needs to
show: values at some parameters say so, to the errors of their evaluation.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..expressions.node import ONE, ZERO, Node, constant, divide, linear, multiply, number
from ..tolerances import CANCELLED, EPS, KNOWN
from . import elimination
from .null_vectors import rational


@dataclasses.dataclass(frozen=True, slots=True)
class Sampled:
    """A function of the parameters, its values at sample points and bounds of their errors; false where all of these
    may be zero."""

    graph: Node
    value: np.ndarray  # (samples,)
    error: np.ndarray

    def __bool__(self) -> bool:
        return self.graph is not ZERO and bool((np.abs(self.value) > self.error).any())

    @property
    def may_vanish(self) -> bool:
        """True if the function may be zero at one of the points."""
        return bool((np.abs(self.value) <= self.error).any())

    def __neg__(self) -> "Sampled":
        return Sampled(linear([(-1, self.graph)]), -self.value, self.error)

    def __add__(self, other: "Sampled") -> "Sampled":
        value = self.value + other.value
        return Sampled(linear([(1, self.graph), (1, other.graph)]), value, _sum(self, other, value))

    def __sub__(self, other: "Sampled") -> "Sampled":
        value = self.value - other.value
        return Sampled(linear([(1, self.graph), (-1, other.graph)]), value, _sum(self, other, value))

    def __mul__(self, other: "Sampled") -> "Sampled":
        value = self.value * other.value
        error = np.abs(self.value) * other.error + np.abs(other.value) * self.error + self.error * other.error
        return Sampled(multiply(self.graph, other.graph), value, error + EPS * np.abs(value))

    def __truediv__(self, other: "Sampled") -> "Sampled":
        value = self.value / other.value
        least = np.abs(other.value) - other.error
        error = (self.error + np.abs(value) * other.error) / least + EPS * np.abs(value)
        return Sampled(divide(self.graph, other.graph), value, error)


def _sum(a: Sampled, b: Sampled, value: np.ndarray) -> np.ndarray:
    return a.error + b.error + EPS * np.abs(value)


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
        found = Sampled(graph, value, np.maximum(error, KNOWN * np.abs(value)))  # given numbers are known to that
        if found:
            sampled[i][c] = found
    one = Sampled(ONE, np.ones(numbers.shape[1]), np.zeros(numbers.shape[1]))
    found = elimination.null_vectors(sampled, one, lambda entry: entry.may_vanish)
    if len(found) != 1 or unit not in found[0]:
        return None
    by = found[0][unit]
    quotients = [found[0].get(i, one - one) / by for i in range(len(rows))]
    if not all(np.isfinite(quotient.value).all() for quotient in quotients):
        return None
    return [_simplest(quotient) for quotient in quotients]


def _simplest(weight: Sampled) -> Node:
    """Its graph, a number where its values are the same."""
    first = float(weight.value[0])
    is_number = (np.abs(weight.value - first) <= CANCELLED * abs(first)).all()
    return constant(rational(first)) if is_number else weight.graph
