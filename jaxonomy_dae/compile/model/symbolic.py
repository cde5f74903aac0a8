"""Templates of equations written as expressions, and how these become templates."""

import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...base.aliases import Numeric
from ...base.tolerances import EPS, KNOWN, NOISE
from ...graph.expressions.differentiate import directional_derivative, partial_derivative, raised
from ...graph.expressions.errors import KernelWithErrors
from ...graph.expressions.kernel import Kernel
from ...graph.expressions.magnitude import magnitude
from ...graph.expressions.node import ONE, ZERO, Node, constant, divide, leaf, scale, split
from ...graph.expressions.substitute import substitute
from ...graph.expressions.terms import terms
from ...write.symbols import TIME_LABEL, ParameterSymbol, VariableSymbol, symbol_label
from .template import AbstractTemplate, Slot


def slot_label(slot: Slot) -> Hashable:
    return ("slot", *slot)


def size_label(label: Hashable) -> Hashable | None:
    """The label of the magnitude of a slot, given the slot's; None for other leaves, which are as large as they are."""
    return ("size", *label[1:]) if isinstance(label, tuple) and label[0] == "slot" else None


def parameter_label(k: int) -> Hashable:
    return ("parameter", k)


def number_label(k: int) -> Hashable:
    return ("number", k)


class SymbolicTemplate(AbstractTemplate):
    """An expression in slots, parameters, coefficients and time; its `graph` has the leaves labelled by the functions
    above. Coefficients are numbers other than zero that belong to the instance."""

    def __init__(self, graph: Node, slots: tuple[Slot, ...], n_parameters: int, n_coefficients: int = 0):
        self.graph = graph
        self.slots = slots
        self.n_parameters = n_parameters
        self.n_coefficients = n_coefficients
        self.key = f"{graph.digest.hex()}|{slots}|{n_parameters}|{n_coefficients}"
        self._numbers = [number_label(k) for k in range(n_coefficients)]
        parameters = map(parameter_label, range(n_parameters))
        self._labels = [*map(slot_label, slots), *parameters, *self._numbers, TIME_LABEL]
        self._kernels: dict[Hashable, Kernel] = {}

    def __reduce__(self):  # kernels are made again
        return template_of, (self.graph, self.slots, self.n_parameters, self.n_coefficients)

    @functools.cached_property
    def partials(self) -> tuple[Node, ...]:
        """∂(residual)/∂(slot) for each slot."""
        return tuple(partial_derivative(self.graph, slot_label(s)) for s in self.slots)

    @functools.cached_property
    def derivative(self) -> "SymbolicTemplate":
        moved = {slot_label(s): slot_label((s[0], s[1] + 1)) for s in self.slots}
        total = directional_derivative(self.graph, raised(moved, TIME_LABEL))
        # Of the slots that may occur only those that do are kept: a slot that nothing reads would be an entry of the
        # incidence.
        slots = sorted({*self.slots, *((b, q + 1) for b, q in self.slots)})
        used = tuple(s for s in slots if slot_label(s) in total.leaves)
        return template_of(total, used, self.n_parameters, self.n_coefficients)

    @functools.cached_property
    def _slots_of_partials(self) -> tuple[frozenset[int], ...]:
        position = {slot_label(s): k for k, s in enumerate(self.slots)}
        return tuple(frozenset(position[f] for f in p.leaves if f in position) for p in self.partials)

    def slots_of_partial(self, position: int) -> frozenset[int]:
        return self._slots_of_partials[position]

    def coefficient_is_constant(self, position: int) -> bool:
        return not self._slots_of_partials[position] and TIME_LABEL not in self.partials[position].leaves

    def coefficient_is_number(self, position: int) -> bool:
        # Coefficients of instances are numbers other than zero, so a product of them is one, too.
        factor, rest = split(self.partials[position])
        bases = rest.arguments if rest.operation == "product" else () if rest is ONE else (rest,)
        return factor != 0 and all(b.operation == "leaf" and b.data in self._numbers for b in bases)

    def coefficient_never_vanishes(self, position: int) -> bool:
        if not self.coefficient_is_constant(position):
            return False
        factor, rest = split(self.partials[position])
        if factor == 0:
            return False
        return (
            rest is ONE
            or rest.operation == "leaf"
            or (rest.operation == "product" and all(b.operation == "leaf" for b in rest.arguments))
        )

    def numbers(self, coefficients: np.ndarray) -> np.ndarray:
        out = np.full((len(coefficients), len(self.slots)), np.nan)
        for k, partial in enumerate(self.partials):
            if partial is ZERO or self.coefficient_is_number(k):
                out[:, k] = Kernel([partial], self._numbers)(list(coefficients.T), "numpy")[0]
        return out

    def is_unmoved(self, direction: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        n = len(self.slots)
        # Graphs are put together once for each distinct row: in a large model most rows are alike.
        patterns, which = np.unique(np.hstack([direction, coefficients]), axis=0, return_inverse=True)
        zero = []
        for pattern in patterns.tolist():
            values = dict(zip(self._numbers, map(constant, pattern[n:]), strict=True))
            partials = [substitute(p, values) for p in self.partials] if values else self.partials
            along: dict[Node, list[float]] = {}
            for weight, partial in zip(pattern[:n], partials, strict=True):
                # Parts that are the same function of slots and parameters are compared by their numbers. Parts that are
                # different functions cannot cancel wherever the slots are.
                for factor, rest in map(split, terms(partial) if weight else ()):
                    along.setdefault(rest, []).append(weight * float(factor))
            zero.append(all(abs(sum(parts)) <= NOISE * EPS * sum(map(abs, parts)) for parts in along.values()))
        return np.array(zero, bool)[which.ravel()]

    def _evaluate(
        self, key: Hashable, graphs: Callable[[], Sequence[Node]], arguments: tuple[Numeric, ...], backend: str
    ):
        if key not in self._kernels:
            self._kernels[key] = Kernel(graphs(), self._labels)
        slots, parameters, coefficients, t = arguments
        coefficients = _in_dtype(coefficients, [*slots, *parameters])
        return self._kernels[key]([*slots, *parameters, *coefficients, t], backend)

    def residual(self, slots, parameters, coefficients, t, networks, backend="jax") -> Any:
        return self._evaluate("residual", lambda: [self.graph], (slots, parameters, coefficients, t), backend)[0]

    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax") -> tuple:
        return tuple(self._evaluate("partials", lambda: self.partials, (slots, parameters, coefficients, t), backend))

    def magnitude(self, sizes, slots, parameters, coefficients, t, networks, backend="jax") -> Numeric:
        if "magnitude" not in self._kernels:
            sizes_of = [size_label(slot_label(s)) for s in self.slots]
            self._kernels["magnitude"] = Kernel([magnitude(self.graph, size_label)], [*self._labels, *sizes_of])
        coefficients = _in_dtype(coefficients, [*slots, *parameters])
        return self._kernels["magnitude"]([*slots, *parameters, *coefficients, t, *sizes], backend)[0]

    @functools.cached_property
    def _partials_with_errors(self) -> KernelWithErrors:
        return KernelWithErrors(self.partials, self._labels)

    def partials_with_errors(self, slots, errors, parameters, coefficients, t, networks) -> tuple[tuple, tuple]:
        given = [*parameters, *coefficients, t]
        known = [KNOWN * np.abs(v) for v in given]
        found, bounds = self._partials_with_errors([*slots, *given], [*errors, *known])
        return tuple(found), tuple(bounds)

    @functools.cached_property
    def _terms(self) -> Sequence[Node]:
        # In a linear equation the partial derivatives times sizes are the terms already.
        is_linear = all(self.coefficient_is_number(k) for k in range(len(self.slots)))
        return [] if is_linear else terms(self.graph)

    def term_values(self, slots, parameters, coefficients, t) -> list:
        if not self._terms:
            return []
        return self._evaluate("terms", lambda: self._terms, (slots, parameters, coefficients, t), "numpy")

    def values_of(self, nodes: Sequence[Node], slots, parameters, coefficients, t) -> list:
        """The values of parts of the graph, in NumPy."""
        return self._evaluate(("parts", *nodes), lambda: nodes, (slots, parameters, coefficients, t), "numpy")

    def readers_of_partials(self) -> tuple[list[frozenset[int]], list[frozenset[int]]]:
        return self._readers(self.partials)

    def readers_of_terms(self) -> tuple[list[frozenset[int]], list[frozenset[int]]]:
        return self._readers(self._terms)

    def _readers(self, graphs: Sequence[Node]) -> tuple[list[frozenset[int]], list[frozenset[int]]]:
        reading: dict[Hashable, set[int]] = {}
        for k, graph in enumerate(graphs):
            for label in graph.leaves:
                reading.setdefault(label, set()).add(k)
        labels = list(map(slot_label, self.slots)), list(map(parameter_label, range(self.n_parameters)))
        of_slots, of_parameters = ([frozenset(reading.get(label, ())) for label in side] for side in labels)
        return of_slots, of_parameters

    def solve(self, position: int, slots, parameters, coefficients, t, networks, backend="jax") -> Numeric:
        def solved() -> list[Node]:
            rest = substitute(self.graph, {slot_label(self.slots[position]): constant(0)})
            # Affine in the slot, F is zero at −F(0)/(∂F/∂slot).
            return [scale(-1, divide(rest, self.partials[position]))]

        return self._evaluate(("solve", position), solved, (slots, parameters, coefficients, t), backend)[0]


def _in_dtype(coefficients: Sequence[Numeric], values: Sequence[Numeric]) -> Sequence[Numeric]:
    """Coefficients that differ by instance, in the dtype of traced values."""
    # Coefficients are of double precision. Beside traced values of single precision, strict promotion of dtypes would
    # refuse them.
    arrays = [v for v in values if isinstance(v, jax.Array)]
    return [c if np.ndim(c) == 0 else jnp.asarray(c, arrays[0].dtype) for c in coefficients] if arrays else coefficients


# Templates keep their kernels and derivatives. One object for equal residuals lets models that are compiled one after
# the other share them.
@functools.lru_cache(maxsize=4096)
def template_of(graph: Node, slots: tuple[Slot, ...], n_parameters: int, n_coefficients: int = 0) -> SymbolicTemplate:
    """The one template of this canonical residual."""
    return SymbolicTemplate(graph, slots, n_parameters, n_coefficients)


def canonical(
    residual: Node, variables: Sequence[VariableSymbol], parameters: Sequence[ParameterSymbol]
) -> SymbolicTemplate:
    """The template of a residual in symbols: slot k stands for variables[k], parameter k for parameters[k]."""
    replaced: dict[Hashable, Node] = {symbol_label(v): leaf(slot_label((k, 0))) for k, v in enumerate(variables)}
    replaced |= {symbol_label(p): leaf(parameter_label(k)) for k, p in enumerate(parameters)}
    slots = tuple((k, 0) for k in range(len(variables)))
    return template_of(substitute(residual, replaced), slots, len(parameters))


def linear_coefficients(residual: Node, variables: Sequence[VariableSymbol]) -> tuple[float, ...] | None:
    """The coefficients of a residual that is a linear form in its variables with numeric coefficients, else None."""
    if residual.operation == "sum":
        start, terms = residual.data[0], zip(residual.arguments, residual.data[1], strict=True)
    else:
        start, terms = 0, [(residual, 1)]
    found = {node.data: float(c) for node, c in terms if node.operation == "leaf"}
    labels = [symbol_label(v) for v in variables]
    if start != 0 or not variables or not all(math.isfinite(c) for c in found.values()):
        return None
    # A leaf that is not one of the variables is a parameter or the time, whose value is no number of the template.
    inside = len(found) == len(residual.arguments or (residual,)) and set(found) == set(labels)
    return tuple(found[label] for label in labels) if inside else None
