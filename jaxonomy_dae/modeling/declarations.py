"""What a component declares: parameters, variables, learned terms."""

import dataclasses
from typing import Any

from .interval import Interval
from .symbols import TimeSymbol, VariableSymbol


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A declared parameter: its local name, value, unit and admissible values."""

    name: str
    value: float
    unit: str
    bounds: Interval


@dataclasses.dataclass(frozen=True)
class Variable:
    """A declared variable: `kind` is 'variable', 'input', 'output', 'learned' or 'port'."""

    name: str
    kind: str
    start: Any
    fixed: bool
    nominal: float  # 0 if not declared
    unit: str
    default: float | None = None
    bounds: Interval = Interval()


@dataclasses.dataclass(frozen=True)
class Learned:
    """A network in the equations: outputs = network(inputs), all named by local variables."""

    name: str
    network: Any
    inputs: tuple[VariableSymbol | TimeSymbol, ...]
    outputs: tuple[VariableSymbol, ...]
