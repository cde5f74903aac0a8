"""A linear combination of equations, in which some quantities cancel, as a new equation."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from ..expressions.differentiate import partial_derivative
from ..expressions.errors import KernelWithErrors
from ..expressions.kernel import Kernel
from ..expressions.node import ZERO as ZERO_NODE
from ..expressions.node import Node, constant, leaf, linear, multiply, number, scale, split
from ..expressions.substitute import substitute
from ..expressions.terms import terms as multiplied_out
from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance, Provenances
from ..model.symbolic import SymbolicTemplate, number_label, parameter_label, slot_label, template_of
from ..model.tables import ZERO, EquationGroup
from ..modeling.symbols import TIME_LABEL
from ..tolerances import CANCELLED, MEANT_EQUAL, SLIGHT

POINTS = 4  # sample values of the parameters, the first of them those given (see `near`)
FAR = 64  # points at which a cancellation must hold, too, …
# … over these powers of ten of quantities and of parameters given: to where branches of conditions turn.
REACH, REACH_OF_PARAMETERS = 5.0, 2.0
NEARER = 6  # how often sample points come nearer to zero


def quantity_label(variable: int, order: int) -> Hashable:
    return ("quantity", variable, order)


def somewhere(variable: Any, order: Any, trial: int) -> Any:
    """Numbers in ±(0.5, 1.5) without pattern, always the same for the same quantity and trial."""
    x = np.sin(12.9898 * (np.asarray(variable) + 1) + 78.233 * (np.asarray(order) + 1) + 37.719 * trial) * 43758.5453
    x = 0.5 + x - np.floor(x)
    return x if trial % 2 else -x


def tried(variable: Any, order: Any, trial: int) -> Any:
    """Sample values for a trial: O(1) for the first four trials, then 1e-3 times smaller every four, so that
    expressions that overflow near 1 become finite."""
    return somewhere(variable, order, trial) * 10.0 ** (-3 * (trial // 4))


def near(values: np.ndarray, trial: int, kept: np.ndarray) -> np.ndarray:
    """Sample values of parameters, of the same signs as `values`: those given for trial 0. Entries in `kept`, discrete
    variables, stay as given: they say which branch holds."""
    if trial == 0:
        return values
    factor = 0.25 + np.abs(somewhere(np.arange(len(values)), 3, trial))
    moved = np.where(values == 0, factor, values * factor)
    moved[kept] = values[kept]
    return moved


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

    def __init__(
        self, graphs: Sequence[Node], values: np.ndarray, kept: np.ndarray,
        natural: Callable[[], Mapping[Hashable, float]],
    ):  # fmt: skip
        labels = sorted(frozenset().union(*(g.leaves for g in graphs)), key=repr)
        self._place = {label: k for k, label in enumerate(labels)}
        self._parameters = [near(values, trial, kept) for trial in range(POINTS)]
        sizes: Mapping[Hashable, float] = {}
        best, most = [], -1
        for k in range(NEARER + 1):
            factor = 0.1 ** max(k - 1, 0)
            unit = [factor * sizes.get(label, 1.0) for label in labels]
            self._columns = [
                np.array([self._value(label, p, u) for p in range(3 * POINTS)])
                for label, u in zip(labels, unit, strict=True)
            ]
            with_values = int(np.isfinite(self(graphs)).all(axis=0).sum())
            if with_values > most:
                best, most = self._columns, with_values
            if with_values == 3 * POINTS:
                break
            sizes = sizes or natural()
        self._columns = best

    def _value(self, label, trial: int, size: float) -> float:
        if label[0] == "quantity":
            return size * float(somewhere(label[1], label[2], trial))
        return 0.37 + 0.1 * trial if label == TIME_LABEL else float(self._parameters[trial // 3][label[1]])

    def __call__(self, graphs: Sequence[Node]) -> np.ndarray:
        """Shape (graphs, points)."""
        # Those of these graphs alone: a combination of n equations is asked about each of its n quantities.
        labels = sorted(frozenset().union(*(g.leaves for g in graphs)), key=self._place.__getitem__)
        found = Kernel(graphs, labels)([self._columns[self._place[label]] for label in labels], "numpy")
        return np.stack([np.broadcast_to(np.asarray(v, float), (3 * POINTS,)) for v in found])


@np.errstate(all="ignore")  # points where equations overflow are left out
def combine(
    equations: Sequence[Node],
    weights: Sequence[Node],
    gone: Sequence[Hashable],
    values: np.ndarray,
    kept: np.ndarray,
    natural: Callable[[], Mapping[Hashable, float]],
) -> Node | None:
    """Σ weight·equation without the quantities that cancel; None if those in `gone` do not.

    What cancels is a term: 1e-6·x³ stays, though near x = 1 nothing of it is seen beside 1e6·x − 1e6·x. What remains of
    a quantity in other terms cancels if it cannot be told from rounding errors wherever it has a value.

    `values` are those of the parameters, of which those in `kept` stay; `natural` gives sizes of quantities at which
    the equations have values.
    """
    terms = [multiply(w, e) for w, e in zip(weights, equations, strict=True)]
    total = linear((1, t) for t in terms)
    quantities = sorted(
        (label for label in frozenset().union(*(e.leaves for e in equations)) if label[0] == "quantity"), key=repr
    )
    without = _sum_of_terms(terms)
    samples = Samples([*equations, *weights], values, kept, natural)
    occurs: dict[Hashable, list[tuple[Node, Node]]] = {}
    for w, e in zip(weights, equations, strict=True):
        for label in e.leaves:
            occurs.setdefault(label, []).append((w, e))
    cancelled, stays = [], False
    for label in quantities:
        inside = occurs[label]
        slopes = samples([multiply(w, partial_derivative(e, label)) for w, e in inside])
        finite = np.isfinite(slopes).all(axis=0)
        size = np.abs(slopes).sum(axis=0)
        small = np.abs(slopes.sum(axis=0)) <= CANCELLED * size
        # Where there are values at some points only, slopes of zero may be what underflowed.
        seen = finite.all() or (size[finite] > 0).any()
        if finite.any() and seen and small[finite].all():
            if label not in without.leaves or label in gone or _is_rounding(without, label, values, kept):
                cancelled.append(label)
            else:
                stays = True
    total = without if stays else total
    if not set(gone) <= set(cancelled) | (set(gone) - set(quantities)):
        return None
    before = samples(terms)
    for value in (0, 1, 0.7):
        rest = substitute(total, {label: constant(value) for label in cancelled})
        after = samples([rest])[0]
        finite = np.isfinite(before).all(axis=0)
        same = np.abs(after - before.sum(axis=0)) <= MEANT_EQUAL * np.abs(before).sum(axis=0)
        if finite.any() and same[finite].all():
            return rest
    return None


def _sum_of_terms(parts: Sequence[Node]) -> Node:
    """The sum of parts, multiplied out, without terms of which rounding alone is left."""
    collected: dict[Node, list[Any]] = {}
    for c, rest in (split(t) for part in parts for t in multiplied_out(part)):
        collected.setdefault(rest, []).append(c)
    sums = {rest: (sum(found), sum(map(abs, found))) for rest, found in collected.items()}
    return linear((c, rest) for rest, (c, size) in sums.items() if abs(c) > CANCELLED * size)


def _is_rounding(graph: Node, label: Hashable, values: np.ndarray, kept: np.ndarray) -> bool:
    """True if a graph's slope in a quantity is a rounding error at all sampled points at which it has a value other
    than zero."""
    slope = _sum_of_terms([partial_derivative(graph, label)])
    labels = sorted(slope.leaves, key=repr)
    columns = _far_points(labels, values, kept, of_parameters=True)
    (value,), (bound,) = KernelWithErrors([slope], labels)(columns, [np.zeros(FAR)] * len(columns))
    value, bound = (np.broadcast_to(np.asarray(v, float), (FAR,)) for v in (value, bound))
    says = np.isfinite(value + bound) & (bound > 0)
    return number(slope) == 0 or bool(says.any() and (np.abs(value) <= bound)[says].all())


def _far_points(labels: Sequence[Any], values: np.ndarray, kept: np.ndarray, of_parameters: bool) -> list[np.ndarray]:
    """Values of quantities of all sizes and signs, FAR of each; and of parameters, those given or, with
    `of_parameters`, others, but for those in `kept`."""
    rng = np.random.default_rng(0)
    columns = []
    for label in labels:
        sign, power = rng.choice([-1.0, 1.0], FAR), rng.uniform(-1.0, 1.0, FAR)
        if label == TIME_LABEL:
            columns.append(10.0 ** (REACH * power))
        elif label[0] == "quantity":
            columns.append(sign * 10.0 ** (REACH * power))
        elif not of_parameters or label[1] in kept:
            columns.append(np.full(FAR, values[label[1]]))
        else:
            columns.append(sign * 10.0 ** (REACH_OF_PARAMETERS * power) * (abs(values[label[1]]) or 1.0))
    return columns


@np.errstate(all="ignore")
def cancels_elsewhere(
    equations: Sequence[Node], weights: Sequence[Node], gone: Sequence[Hashable], values: np.ndarray, kept: np.ndarray,
    of_parameters: bool,
) -> bool:  # fmt: skip
    """True if a combination that cancels near the points that were tried cancels at quantities of other sizes and
    signs, too, or with `of_parameters`, at other parameters: a condition may choose another branch there. Points
    without values say nothing.

    Parameters in `kept`, discrete variables, are as they are given.
    """
    place = {label: k for k, label in enumerate(gone)}
    inside = [
        (place[label], multiply(w, partial_derivative(e, label)))
        for w, e in zip(weights, equations, strict=True)
        for label in sorted(e.leaves & place.keys(), key=place.__getitem__)
    ]
    owner, graphs = [k for k, _ in inside], [graph for _, graph in inside]
    labels = sorted(frozenset().union(*(g.leaves for g in graphs)), key=repr)
    if not any(label[0] == "quantity" or label == TIME_LABEL or of_parameters for label in labels):
        return True
    columns = _far_points(labels, values, kept, of_parameters)
    # Points are exact, but far out 1 + x⁴ − x⁴ is zero: what evaluation loses says nothing either.
    left, size, lost = np.zeros((3, len(gone), FAR))
    for k, value, error in zip(
        owner, *KernelWithErrors(graphs, labels)(columns, [np.zeros(FAR)] * len(columns)), strict=True
    ):
        left[k] += value
        size[k] += np.abs(value)
        lost[k] += error
    return not (np.isfinite(size + lost).all(axis=0) & (np.abs(left) > SLIGHT * size + lost)).any()


def _coefficients(graph: Node) -> dict[Hashable, float] | None:
    """The coefficients of a linear form in quantities, by their labels; None if it is another expression."""
    is_linear = graph.operation == "sum" and graph.data[0] == 0
    if not is_linear or not all(a.operation == "leaf" and a.data[0] == "quantity" for a in graph.arguments):
        return None
    return {a.data: float(c) for a, c in zip(graph.arguments, graph.data[1], strict=True)}


def group_of(graph: Node, provenance: Provenance) -> EquationGroup:
    """A group of one equation."""
    quantities = sorted(label[1:] for label in graph.leaves if label[0] == "quantity")
    coefficients = _coefficients(graph)
    if coefficients is not None:
        return EquationGroup(
            LinearTemplate(len(quantities)),
            np.array([[v for v, _ in quantities]], np.int64),
            np.array([[o for _, o in quantities]], np.int64),
            np.ones((1, len(quantities))),
            np.zeros((1, 0), np.int64),
            np.array([[coefficients[quantity_label(*q)] for q in quantities]]),
            Provenances.of([provenance]),
        )
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
