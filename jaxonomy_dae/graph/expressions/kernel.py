"""Kernels: graphs evaluated in NumPy or in JAX, each shared node once."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from fractions import Fraction
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from ...base.aliases import Numeric
from .branches import before, guards
from .functions import TABLE, real_power
from .node import Node, Number, as_float, postorder

_BACKENDS: dict[str, Any] = {"numpy": np, "jax": jnp}
_Operation = Callable[..., Any]


class Kernel:
    """A function of the leaves' values, in the order of `labels`, that returns one value for each root.

    In NumPy everything is float64: what is not real is not a number, never complex.

    Nodes have places in the order in which they are computed: `leaves` are (place, position of the label), `constants`
    (place, value), `steps` (place, node, places of its arguments, guard or None), `results` the places of the roots.
    """

    def __init__(self, roots: Sequence[Node], labels: Sequence[Hashable]):
        position = {label: k for k, label in enumerate(labels)}
        guard = guards(roots)
        # The conditions of a guarded node come before it, though they are no arguments of it.
        order = postorder(roots, lambda node: before(node, guard))
        place = {n: k for k, n in enumerate(order)}
        self.leaves = [(place[n], position[n.data]) for n in order if n.operation == "leaf"]
        self.constants = [(place[n], _constant(n)) for n in order if n.operation in ("constant", "true", "false")]
        self.steps = [
            (
                place[n],
                n,
                tuple(place[a] for a in n.arguments),
                [[(place[c], holds) for c, holds in part] for part in _sorted(guard[n])] if n in guard else None,
            )
            for n in order
            if n.operation not in ("leaf", "constant", "true", "false")
        ]
        self.results = [place[r] for r in roots]
        self._compiled: dict[str, list] = {}

    def _operations(self, backend: str) -> list:
        if backend not in self._compiled:
            xp = _BACKENDS[backend]
            self._compiled[backend] = [
                (k, _operation(node, xp, backend), arguments, guard, _safe(node))
                for k, node, arguments, guard in self.steps
            ]
        return self._compiled[backend]

    def __call__(self, values: Sequence[Numeric], backend: str = "jax") -> list[Numeric]:
        if backend == "numpy":
            # Values that are not finite are answers here. Who asks judges them, and a warning would name no equation.
            with np.errstate(all="ignore"):
                return self._run([np.asarray(v, float) for v in values], backend)
        return self._run(values, backend)

    def _run(self, values: Sequence[Numeric], backend: str) -> list[Numeric]:
        found = self.all_values(values, backend)
        return [found[r] for r in self.results]

    def all_values(self, values: Sequence[Numeric], backend: str = "numpy") -> list[Numeric]:
        """The values of all nodes, by place."""
        xp = _BACKENDS[backend]
        found: list[Numeric] = [None] * (len(self.leaves) + len(self.constants) + len(self.steps))
        for k, position in self.leaves:
            found[k] = values[position]
        for k, value in self.constants:
            found[k] = value
        for k, function, arguments, guard, safe in self._operations(backend):
            inside = [found[a] for a in arguments]
            if guard is not None:
                # Arguments of a function that is not needed here are replaced by safe ones, so that neither it nor its
                # derivatives are infinite: zero times infinity would be left of it in gradients.
                active = is_active(found, guard)
                inside = [
                    v if s is None or isinstance(v, float) and v != 0.0 else xp.where(active, v, s)
                    for v, s in zip(inside, safe, strict=True)
                ]
            found[k] = function(*inside)
        return found


def _sorted(needed: Iterable) -> list:
    """The intersections of a union, and the literals (condition, truth) in each, in an order without chance."""
    parts = [sorted(part, key=lambda literal: (literal[0].digest, literal[1])) for part in needed]
    return sorted(parts, key=lambda part: [(c.digest, holds) for c, holds in part])


def is_active(found: list[Numeric], guard: list) -> Numeric:
    """True if a node is needed, given the values `found` of all nodes. `guard` is a union of intersections of literals
    (node number, truth); an empty one means that the node is never needed."""
    total: Numeric = np.bool_(False)
    for part in guard:
        inside: Numeric = None
        for k, holds in part:
            literal = found[k] if holds else ~found[k]
            inside = literal if inside is None else inside & literal
        total = inside | total
    return total


def _constant(node: Node) -> Numeric:
    if node.operation != "constant":
        return np.bool_(node.operation == "true")
    return as_float(node.data)


def _safe(node: Node) -> tuple[float | None, ...]:
    if node.operation == "product":
        return tuple(None if isinstance(e, int) and e > 0 else 1.0 for e in node.data)
    if node.operation == "power":
        return (1.0, 1.0)
    return TABLE[node.operation].safe if node.operation in TABLE else (None,) * len(node.arguments)


def _operation(node: Node, xp: ModuleType, backend: str) -> _Operation:
    operation = node.operation
    if operation == "sum":
        return _sum(*node.data)
    if operation == "product":
        return _product(node.data, xp)
    if operation in TABLE:
        return getattr(TABLE[operation], backend)
    return {
        "power": real_power if backend == "jax" else xp.power,
        "select": xp.where,
        "less": lambda a, b: xp.less(a, b),
        "less_equal": lambda a, b: xp.less_equal(a, b),
        "equal": lambda a, b: xp.equal(a, b),
        "not": lambda a: ~a,
        "and": _all,
        "or": _any,
    }[operation]


def _all(*conditions: Numeric) -> Numeric:
    total = conditions[0]
    for c in conditions[1:]:
        total = total & c
    return total


def _any(*conditions: Numeric) -> Numeric:
    total = conditions[0]
    for c in conditions[1:]:
        total = total | c
    return total


def _sum(start: Number, coefficients: Sequence[Number]) -> _Operation:
    start = as_float(start)
    # A positive term first, so that no sign is changed for nothing.
    order = sorted(range(len(coefficients)), key=lambda k: coefficients[k] < 0)
    scaled = [(k, as_float(coefficients[k])) for k in order]

    begins = start != 0 and scaled[0][1] == -1  # start − x rather than −x + start

    def function(*terms: Numeric) -> Numeric:
        total = start if begins else None
        for k, c in scaled:
            term = terms[k]
            if _is_nought(term):
                continue
            if total is None:
                total = term if c == 1 else -term if c == -1 else c * term
            elif c == 1:
                total = total + term
            elif c == -1:
                total = total - term
            else:
                total = total + c * term
        if total is None:
            return start
        return total if begins or start == 0 else total + start

    return function


def _is_nought(value: Numeric) -> bool:
    """True if a value is the Python number 0.0 when a program is traced: an unknown whose share in the sum is left
    out."""
    return type(value) is float and value == 0.0  # that NumPy's numbers are floats, too, is no matter here


def _product(exponents: Sequence[Number], xp: ModuleType) -> _Operation:
    def raised(base: Numeric, exponent: Number) -> Numeric:
        if exponent == 1:
            return base
        if isinstance(exponent, int):
            return base**exponent
        if exponent == Fraction(1, 2):
            return xp.sqrt(base)
        return xp.power(base, float(exponent))

    def function(*bases: Numeric) -> Numeric:
        over, under = None, None
        noughts = [exponent for base, exponent in zip(bases, exponents, strict=True) if _is_nought(base)]
        if noughts and min(noughts) > 0:
            return 0.0
        for base, exponent in zip(bases, exponents, strict=True):
            if exponent > 0:
                value = raised(base, exponent)
                over = value if over is None else over * value
            else:
                value = raised(base, -exponent)
                under = value if under is None else under * value
        if under is None:
            return over
        over = 1.0 if over is None else over
        # Where both are Python's numbers, a division by zero would be an error.
        return xp.true_divide(over, under) if _is_nought(under) else over / under

    return function
