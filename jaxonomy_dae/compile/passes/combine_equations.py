"""A linear combination of equations, in which some quantities cancel, as a new equation.

A quantity cancels if its slope in the combination is zero. Where the algebra of terms shows that, it is so for all
parameters and states. Where only values at sample points show it, as of Min(p, 1e4) − p, the new equation guards
itself: it has no value where the slope is not zero, so that nothing is computed from an equation that does not hold.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from fractions import Fraction

import numpy as np

from ...base.tolerances import CANCELLED, MEANT_EQUAL, SLIGHT
from ...graph.expressions.differentiate import partial_derivative
from ...graph.expressions.errors import KernelWithErrors
from ...graph.expressions.functions import apply
from ...graph.expressions.kernel import Kernel
from ...graph.expressions.node import (
    ONE,
    TRUE,
    Node,
    Number,
    both,
    compare,
    constant,
    leaf,
    linear,
    multiply,
    number,
    postorder,
    power,
    scale,
    select,
    split,
)
from ...graph.expressions.node import ZERO as ZERO_NODE
from ...graph.expressions.substitute import substitute
from ...graph.expressions.terms import terms as multiplied_out
from ...write.symbols import TIME_LABEL
from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance, Provenances
from ..model.symbolic import SymbolicTemplate, number_label, parameter_label, slot_label, template_of
from ..model.tables import ZERO, EquationGroup

POINTS = 4  # sample values of the parameters, the first of them those given (see `near`)
# Operations whose values say nothing of those elsewhere. Of all others, values at random points tell whether a sum of
# them is zero everywhere.
BRANCHES = frozenset({"select", "abs", "sign", "floor", "ceiling", "heaviside", "max", "min", "mod"})
NEARER = 6  # how often sample points come nearer to zero

MINUS, HALF = constant(-1), Fraction(1, 2)


def quantity_label(variable: int, order: int) -> Hashable:
    return ("quantity", variable, order)


def somewhere(variable: np.ndarray | int, order: np.ndarray | int, trial: int) -> np.ndarray:
    """Numbers in ±(0.5, 1.5) without pattern, always the same for the same quantity and trial."""
    # Not a random generator: a sample belongs to its quantity and trial, whatever was drawn before.
    x = np.sin(12.9898 * (np.asarray(variable) + 1) + 78.233 * (np.asarray(order) + 1) + 37.719 * trial) * 43758.5453
    x = 0.5 + x - np.floor(x)
    return x if trial % 2 else -x


def tried(variable: np.ndarray | int, order: np.ndarray | int, trial: int) -> np.ndarray:
    """Sample values for a trial: O(1) for the first four trials, then 1e-3 times smaller every four, so that
    expressions that overflow near 1 become finite."""
    return somewhere(variable, order, trial) * 10.0 ** (-3 * (trial // 4))


def near(values: np.ndarray, trial: int, kept: np.ndarray) -> np.ndarray:
    """Sample values of parameters, of the same signs as `values`: those given for trial 0. Entries in `kept`, discrete
    variables, stay as given: they say which branch holds."""
    if trial == 0:
        return values
    # Signs are kept, because equations may have no value beyond them, as roots and logarithms.
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
            # Sizes of order one first, then natural sizes, then nearer and nearer to zero: exponentials of volts over
            # thermal volts overflow at one, and have values at natural sizes.
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
            # Natural sizes take least squares over the equations, so they are asked for only if the first points do not
            # do.
            sizes = sizes or natural()
        self._columns = best

    def _value(self, label, trial: int, size: float) -> float:
        if label[0] == "quantity":
            return size * float(somewhere(label[1], label[2], trial))
        return 0.37 + 0.1 * trial if label == TIME_LABEL else float(self._parameters[trial // 3][label[1]])

    def __call__(self, graphs: Sequence[Node]) -> np.ndarray:
        """Shape (graphs, points)."""
        labels, columns = self._of(graphs)
        found = Kernel(graphs, labels)(columns, "numpy")
        return np.stack([np.broadcast_to(np.asarray(v, float), (3 * POINTS,)) for v in found])

    def is_rounding(self, graph: Node) -> bool:
        """True if a graph is a rounding error at all points at which it has a value other than zero."""
        if number(graph) is not None:
            return number(graph) == 0
        labels, columns = self._of([graph])
        (value,), (bound,) = KernelWithErrors([graph], labels)(columns, [np.zeros(3 * POINTS)] * len(columns))
        value, bound = (np.broadcast_to(np.asarray(v, float), (3 * POINTS,)) for v in (value, bound))
        says = np.isfinite(value + bound) & (bound > 0)
        return bool(says.any() and (np.abs(value) <= bound)[says].all())

    def _of(self, graphs: Sequence[Node]) -> tuple[list[Hashable], list[np.ndarray]]:
        """The labels of these graphs alone, and their values: a combination of n equations is asked about each of its n
        quantities."""
        labels = sorted(frozenset().union(*(g.leaves for g in graphs)), key=self._place.__getitem__)
        return labels, [self._columns[self._place[label]] for label in labels]


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
    # Cancellation is looked for term by term. At sample points near one, 1e-6·x³ beside 1e6·x − 1e6·x is nothing,
    # though it is as large as other terms at x = 1,000.
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
        # Only a first sieve, with the errors of weights that were computed in it. What passes must vanish term by term,
        # or be rounding wherever it has a value.
        small = np.abs(slopes.sum(axis=0)) <= CANCELLED * size
        # Where there are values at some points only, slopes of zero may be what underflowed.
        seen = finite.all() or (size[finite] > 0).any()
        if finite.any() and seen and small[finite].all():
            left = ZERO_NODE
            if label in without.leaves and label not in gone:
                left = _sum_of_terms([partial_derivative(without, label)])
            # An expression that is zero on one branch need not be zero on another.
            # The sample points may all lie on one branch: Min(p, 1e4) − p is zero at each of them.
            if number(left) == 0 or (not has_branches(left) and samples.is_rounding(left)):
                cancelled.append(label)
            else:
                stays = True
    total = without if stays else total
    # The highest derivatives must go, or index reduction would meet the same block again and again.
    if not set(gone) <= set(cancelled) | (set(gone) - set(quantities)):
        return None
    # The last proof is by values: the combination without the quantities must be the sum of the weighted equations. A
    # quantity is put in as 0, 1 or 0.7, because one of these may be a pole or make an expression vanish.
    before = samples(terms)
    for value in (0, 1, 0.7):
        chosen = {label: constant(value) for label in cancelled}
        rest = substitute(total, chosen)
        after = samples([rest])[0]
        finite = np.isfinite(before).all(axis=0)
        same = np.abs(after - before.sum(axis=0)) <= MEANT_EQUAL * np.abs(before).sum(axis=0)
        if finite.any() and same[finite].all():
            slopes = [[multiply(w, partial_derivative(e, label)) for w, e in occurs[label]] for label in cancelled]
            return _guarded(rest, [[substitute(s, chosen) for s in terms] for terms in slopes])
    return None


def slope_left(equations: Sequence[Node], weights: Sequence[Node], label: Hashable) -> Node:
    """The slope of a combination in a quantity, multiplied out: zero if that shows that the quantity cancels."""
    inside = [(w, e) for w, e in zip(weights, equations, strict=True) if label in e.leaves]
    return _sum_of_terms([multiply(w, partial_derivative(e, label)) for w, e in inside])


def has_branches(graph: Node, of_parameters: bool = True) -> bool:
    """True if a condition decides what a graph is; one on quantities or time, without `of_parameters`."""
    return any(
        n.operation in BRANCHES
        and (of_parameters or any(label == TIME_LABEL or label[0] == "quantity" for label in n.leaves))
        for n in postorder([graph])
    )


def _guarded(graph: Node, slopes: Sequence[Sequence[Node]]) -> Node | None:
    """The graph, without a value where one of these sums is not zero beside its terms; None if they read quantities
    that the graph does not, which it would then seem to determine."""
    holds = []
    for terms in slopes:
        left = _sum_of_terms(terms)
        if number(left) == 0:
            continue
        size = linear((1, apply("abs", term)) for term in terms)
        # Rounding leaves far less than this of terms that cancel, and another branch far more.
        holds.append(compare("less_equal", apply("abs", left), scale(SLIGHT, size)))
        if any(label[0] == "quantity" and label not in graph.leaves for label in left.leaves | size.leaves):
            return None
    condition = both(*holds)
    # A factor, for the equation is differentiated, too. The root of minus one is not a number.
    return graph if condition is TRUE else multiply(graph, power(select(condition, ONE, MINUS), HALF))


def _sum_of_terms(parts: Sequence[Node]) -> Node:
    """The sum of parts, multiplied out, without terms of which rounding alone is left."""
    collected: dict[Node, list[Number]] = {}
    for c, rest in (split(t) for part in parts for t in multiplied_out(part)):
        collected.setdefault(rest, []).append(c)
    sums = {rest: (sum(found), sum(map(abs, found))) for rest, found in collected.items()}
    return linear((c, rest) for rest, (c, size) in sums.items() if abs(c) > CANCELLED * size)


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
    variable, order, written = [v for v, _ in quantities], [o for _, o in quantities], Provenances.of([provenance])
    if coefficients is not None:
        numbers = [coefficients[quantity_label(*q)] for q in quantities]
        return EquationGroup.of(LinearTemplate(len(quantities)), variable, order, written, coefficient=numbers)
    parameters = sorted(label[1] for label in graph.leaves if label[0] == "of model")
    replaced = {quantity_label(*q): leaf(slot_label((k, 0))) for k, q in enumerate(quantities)}
    replaced |= {("of model", p): leaf(parameter_label(k)) for k, p in enumerate(parameters)}
    slots = tuple((k, 0) for k in range(len(quantities)))
    template = template_of(substitute(graph, replaced), slots, len(parameters))
    return EquationGroup.of(template, variable, order, written, parameter=parameters)
