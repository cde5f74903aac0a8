"""A linear combination of equations, in which some quantities cancel, as a new equation."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from ..expressions.differentiate import partial_derivative
from ..expressions.kernel import Kernel
from ..expressions.node import ZERO as ZERO_NODE
from ..expressions.node import Node, constant, leaf, linear, multiply, scale
from ..expressions.substitute import substitute
from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance, Provenances
from ..model.symbolic import SymbolicTemplate, number_label, parameter_label, slot_label, template_of
from ..model.tables import ZERO, EquationGroup
from ..modeling.symbols import TIME_LABEL
from .null_vectors import CANCELLED

POINTS = 4
NEARER = 6  # how often sample points come nearer to zero


def quantity_label(variable: int, order: int) -> Hashable:
    return ("quantity", variable, order)


def somewhere(variable: Any, order: Any, trial: int) -> Any:
    """Numbers in ±(0.5, 1.5) without pattern, always the same for the same quantity and trial."""
    x = np.sin(12.9898 * (np.asarray(variable) + 1) + 78.233 * (np.asarray(order) + 1) + 37.719 * trial) * 43758.5453
    x = 0.5 + x - np.floor(x)
    return x if trial % 2 else -x


def tried(variable: Any, order: Any, trial: int) -> Any:
    """The same for the first trials, then ever nearer to zero: what overflows near one has a value at last."""
    return somewhere(variable, order, trial) * 10.0 ** (-3 * (trial // 4))


def near(values: np.ndarray, trial: int) -> np.ndarray:
    """Other parameter values of the same signs; those given for trial 0."""
    if trial == 0:
        return values
    factor = 0.25 + np.abs(somewhere(np.arange(len(values)), 3, trial))
    return np.where(values == 0, factor, values * factor)


def graph_of(group: EquationGroup, i: int, times: int) -> Node | None:
    """Equation i of a group, differentiated `times` times, in quantities and the model's parameters; None for a
    function that is evaluated in JAX only."""
    template = group.template
    for _ in range(times):
        template = template.derivative
    slots = {}
    for base, q in template.slots:
        v = int(group.variable[i, base])
        placed = leaf(quantity_label(v, int(group.order[i, base]) + q))
        slots[slot_label((base, q))] = ZERO_NODE if v == ZERO else scale(_exact(float(group.factor[i, base])), placed)
    if isinstance(template, LinearTemplate):
        return linear(zip(map(_exact, group.coefficient[i].tolist()), slots.values(), strict=True))
    if not isinstance(template, SymbolicTemplate):
        return None
    parameters = {parameter_label(k): leaf(("of model", int(p))) for k, p in enumerate(group.parameter[i])}
    numbers = {number_label(k): constant(_exact(c)) for k, c in enumerate(group.coefficient[i].tolist())}
    return substitute(template.graph, slots | parameters | numbers)


def _exact(value: float) -> int | float:
    return int(value) if float(value).is_integer() and abs(value) < 1e15 else value


class Samples:
    """Values of graphs at random points: quantities near ±1, or if graphs have no values there, near their natural
    sizes or nearer to zero; parameters near those given."""

    def __init__(self, graphs: Sequence[Node], values: np.ndarray, natural: Callable[[], Mapping[Hashable, float]]):
        labels = sorted(frozenset().union(*(g.leaves for g in graphs)), key=repr)
        self._labels = labels
        sizes: Mapping[Hashable, float] = {}
        best, most = [], -1
        for k in range(NEARER + 1):
            factor = 0.1 ** max(k - 1, 0)
            unit = [factor * sizes.get(label, 1.0) for label in labels]
            self._points = [
                [self._value(label, values, p, u) for label, u in zip(labels, unit, strict=True)]
                for p in range(3 * POINTS)
            ]
            with_values = int(np.isfinite(self(graphs)).all(axis=0).sum())
            if with_values > most:
                best, most = self._points, with_values
            if with_values == len(self._points):
                break
            sizes = sizes or natural()
        self._points = best

    @staticmethod
    def _value(label, values: np.ndarray, trial: int, size: float) -> float:
        if label[0] == "quantity":
            return size * float(somewhere(label[1], label[2], trial))
        return 0.37 + 0.1 * trial if label == TIME_LABEL else float(near(values, trial // 3)[label[1]])

    def __call__(self, graphs: Sequence[Node]) -> np.ndarray:
        """Shape (graphs, points)."""
        columns = list(np.array(self._points).T) if self._labels else []
        n = len(self._points)
        found = Kernel(graphs, self._labels)(columns, "numpy")
        return np.stack([np.broadcast_to(np.asarray(v, float), (n,)) for v in found])


@np.errstate(all="ignore")  # points where equations overflow are left out
def combine(
    equations: Sequence[Node],
    weights: Sequence[Node],
    gone: Sequence[Hashable],
    values: np.ndarray,
    natural: Callable[[], Mapping[Hashable, float]],
) -> Node | None:
    """Σ weight·equation without the quantities that cancel; None if those in `gone` do not.

    `values` are those of the parameters; `natural` gives sizes of quantities at which the equations have values.
    """
    terms = [multiply(w, e) for w, e in zip(weights, equations, strict=True)]
    total = linear((1, t) for t in terms)
    quantities = sorted(
        (label for label in frozenset().union(*(e.leaves for e in equations)) if label[0] == "quantity"), key=repr
    )
    samples = Samples([*equations, *weights], values, natural)
    cancelled = []
    for label in quantities:
        slopes = samples([multiply(w, partial_derivative(e, label)) for w, e in zip(weights, equations, strict=True)])
        finite = np.isfinite(slopes).all(axis=0)
        size = np.abs(slopes).sum(axis=0)
        small = np.abs(slopes.sum(axis=0)) <= CANCELLED * size
        # Where there are values at some points only, slopes of zero may be what underflowed.
        seen = finite.all() or (size[finite] > 0).any()
        if finite.any() and seen and small[finite].all():
            cancelled.append(label)
    if not set(gone) <= set(cancelled) | (set(gone) - set(quantities)):
        return None
    before = samples(terms)
    for value in (0, 1, 0.7):
        rest = substitute(total, {label: constant(value) for label in cancelled})
        after = samples([rest])[0]
        finite = np.isfinite(before).all(axis=0)
        same = np.abs(after - before.sum(axis=0)) <= 1e-9 * np.abs(before).sum(axis=0)
        if finite.any() and same[finite].all():
            return rest
    return None


def group_of(graph: Node, provenance: Provenance) -> EquationGroup:
    """A group of one equation."""
    quantities = sorted(label[1:] for label in graph.leaves if label[0] == "quantity")
    parameters = sorted(label[1] for label in graph.leaves if label[0] == "of model")
    replaced = {quantity_label(*q): leaf(slot_label((k, 0))) for k, q in enumerate(quantities)}
    replaced |= {("of model", p): leaf(parameter_label(k)) for k, p in enumerate(parameters)}
    slots = tuple((k, 0) for k in range(len(quantities)))
    return EquationGroup(
        template_of(substitute(graph, replaced), slots, len(parameters)),
        np.array([[v for v, _ in quantities]], np.int64),
        np.array([[o for _, o in quantities]], np.int64),
        np.ones((1, len(quantities))),
        np.array([parameters], np.int64).reshape(1, -1),
        np.zeros((1, 0)),
        Provenances.of([provenance]),
    )
