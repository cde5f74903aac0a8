"""Laws of the user's for variables of a flat model: functions, and networks."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import sympy

from ..base.errors import ModelError
from ..write.component import Component
from ..write.symbols import VariableSymbol
from .values import Value

Law: TypeAlias = Callable[[Component, Value], Value]  # (component, written value) to the value in its place


@dataclasses.dataclass(frozen=True)
class LearnedLaw:
    """A network as a law: of the given inputs, or of the variables that the written value reads.

    - `name`: of the variable or part whose law it is; the network's name is `name.law`.
    - `beside`: True if it is a term beside the written value.
    """

    name: str
    network: Callable
    inputs: Sequence[str]
    beside: bool

    def __call__(self, m: Component, written: Value) -> Value:
        (value,) = m.learned(f"{self.name}.law", self.network, [m.symbol(i) for i in self.inputs] or _read(m, written))
        return written + value if self.beside else value


def _read(m: Component, written: Value) -> list[VariableSymbol]:
    """The variables that an expression reads, in the order of their declaration."""
    symbols = written.free_symbols if isinstance(written, sympy.Basic) else set()
    # In the order of declaration: a set's order differs between processes, and trained weights belong to places.
    order = list(m.variables)
    return sorted((s for s in symbols if isinstance(s, VariableSymbol)), key=lambda s: (order.index(s.path), s.order))


def law_of(name: str, law: Any, inputs: Sequence[str], beside: bool) -> Law:
    """A law from a network, or from a function of the component and the written value."""
    if isinstance(law, eqx.Module) and callable(law):
        return LearnedLaw(name, law, tuple(inputs), beside)
    if not callable(law):
        raise ModelError(f"the law of '{name}' is a network, or a function law(component, written value); got {law!r}")
    return (lambda m, written: written + law(m, written)) if beside else law
