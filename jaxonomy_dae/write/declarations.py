"""What a component declares: parameters, variables, learned terms."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import sympy

from .interval import Interval
from .symbols import TimeSymbol, VariableSymbol

# Users' names contain no colon (`names.RESERVED`), so that internal names meet none of them.
INITIALLY = ":initially"  # begins the names of what is zero at the initial time
START = ":start"  # ends the name of what is declared by the start of a derivative
Value: TypeAlias = float | int | sympy.Expr  # a number, or an expression in parameters


# Compared by identity: arrays compare by entries, which is no truth.
@dataclasses.dataclass(frozen=True, eq=False)
class EachValue:
    """One value for each instance of an array, in the order of the instances."""

    values: np.ndarray
    prototype: object  # the component that stands for all of the array; it is only compared by `is`


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A declared parameter; its value is an expression if it depends on others. That of a discrete variable is what it
    starts at."""

    name: str
    value: float | sympy.Expr | EachValue
    unit: str
    bounds: Interval
    is_discrete: bool = False

    def with_value(self, value: float | sympy.Expr | EachValue) -> "Parameter":
        """A copy of the declaration with another value."""
        return dataclasses.replace(self, value=value)


@dataclasses.dataclass(frozen=True)
class Variable:
    """A declared variable: `kind` is 'variable', 'input', 'output', 'learned', 'port', 'start' for what equals a
    derivative and has a start, or 'event' for what guards and actions compute."""

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
    """A network or function in the equations: outputs = network(inputs), all named by local variables."""

    name: str
    network: Callable
    inputs: tuple[VariableSymbol | TimeSymbol, ...]
    outputs: tuple[VariableSymbol, ...]
    noun: str = "network"  # or "function"


@dataclasses.dataclass(frozen=True)
class Account:
    """A declared energy or power: `kind` is 'energy', 'dissipation' or 'supply'."""

    kind: str
    expression: sympy.Expr


def full_name(path: str, name: str) -> str:
    """The name in the model of a variable that a component declares: `path.x`, `der(path.x)`."""
    before, after = around_path(name)
    return f"{before}{path}{after}"


def around_path(name: str) -> tuple[str, str]:
    """What stands before and after a component's path in the full name of its variable."""
    before, der, inner = name.removesuffix(START).rpartition("der(") if name.endswith(START) else ("", "", name)
    return before + der, f".{inner}"
