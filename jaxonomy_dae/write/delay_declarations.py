"""How a component declares delayed quantities."""

import dataclasses
from collections.abc import Callable

import sympy

from ..base.errors import ModelError
from .declarations import Value
from .discrete_declarations import DiscreteDeclarations
from .events import NO_FLAG, Assign, Sampled, When
from .real_number import real_number
from .symbols import DiscreteSymbol, EarlierSymbol, ParameterSymbol, PreviousSymbol, VariableSymbol, der

NEVER = sympy.Float(1e300)  # s: the offset of a clock whose ticks are found while running


@dataclasses.dataclass(frozen=True)
class Delay:
    """A delayed quantity of a component, by names in that component.

    - `name`: of the variable that is delayed; `source`: of the hidden one that it repeats; `instant`: of the hidden one
        that is the time at which it is read.
    - `begins`, `base`, `value`, `rate`, `bend`: of the discrete variables by which equations read the past: what is
        delayed is value + rate·(instant − base) + bend·(instant − base)²/2, or while `begins` is 1, what the source was
        at the initial time.
    - `longest`: the longest delay, in parameters; `is_constant`: all delays are that.
    """

    name: str
    source: str
    instant: str
    begins: str
    base: str
    value: str
    rate: str
    bend: str
    longest: sympy.Expr
    is_constant: bool


class DelayDeclarations(DiscreteDeclarations):
    """The part of `Component` that concerns delayed quantities."""

    # Attributes and methods of the other parts of `Component`.
    delays: list[Delay]
    initially: Callable[..., None]
    _claim: Callable[[str, str], None]

    def delayed(
        self, name: str, expression: Value, time: Value, longest: Value | None = None, unit: str = ""
    ) -> VariableSymbol:
        """Declares a variable that repeats an expression later: at the time t it is what the expression was at
        t − `time`; before the initial time plus `time`, what it was at the initial time.

        ```python
        late = self.delayed("late", x, T)                       # T: a parameter
        self.add_equations(Eq(der(x), -k * late))
        ```

        A run records the expression at six places of each step, along the dense output of the solver, and reads the
        polynomial through them, which is compared with the expression in between. Where a step is longer than the
        delay, what it reads is extrapolated, compared with what was, and the step is taken again if they differ by more
        than the tolerance. Steps end where a jump, a kink or the beginning of the record comes out of the delay, until
        five integrations have smoothed it. Derivatives by parameters, the delay among them, pass through the record.

        **Arguments:**

        - `name`: its local name.
        - `expression`: a number or an expression in variables, their derivatives, parameters and time.
        - `time`: the delay (second), positive. Without `longest`, a number or an expression in parameters.
        - `longest`: a number or an expression in parameters that a changing `time` does not exceed. It may vanish; if
            it becomes negative, the run ends with an error.
        - `unit`: shown in reports and plots.

        **Raises:**

        - `ModelError` for what is not an expression, and for a `time` that changes without a `longest`.
        """
        self._claim(name, "delayed quantity")
        where = f"component '{self.name}': delayed('{name}', …)"
        parts = [_expression(part, where) for part in (expression, time)]
        changes = not all(_is_parameter(s) for s in parts[1].free_symbols)
        if changes and longest is None:
            raise ModelError(
                f"{where}: the delay {parts[1]} changes in time: say how long it may be, "
                f"self.delayed('{name}', …, longest=…)"
            )
        limit = _expression(time if longest is None else longest, where)
        self._check_parameters_only(limit, f"the longest delay of '{self.name}.{name}'")
        if any(isinstance(s, DiscreteSymbol) for s in limit.free_symbols):
            raise ModelError(f"{where}: the longest delay must not change between events; it is {limit}")
        if limit.is_number and not real_number(limit, f"{where}: the delay") > 0:
            raise ModelError(f"{where}: the delay must be positive; got {limit}. Without a delay, write the expression")
        late = self._declare(name, "variable", unit=unit)
        source, instant, first = (self._declare(f":{name}.{part}", "event") for part in ("source", "instant", "first"))
        begins, base, value, rate, bend = (
            self._unshown(f":{name}.{part}", start)
            for part, start in (("begins", 1.0), ("base", 0.0), ("value", 0.0), ("rate", 0.0), ("bend", 0.0))
        )
        # Base is the instant itself: the terms count where this is differentiated, by time or by parameters.
        since = instant - base
        read = begins * first + (1 - begins) * (value + rate * since + bend * since**2 / 2)
        self.add_equations(
            sympy.Eq(source, parts[0], evaluate=False),
            sympy.Eq(instant, self.ev.t - parts[1], evaluate=False),
            sympy.Eq(der(first), 0, evaluate=False),
            sympy.Eq(late, read, evaluate=False),
        )
        self.initially(sympy.Eq(first, source, evaluate=False))
        # Where a break of the past comes out of the delay, the run has an event. Its times are found while running.
        over = When(f"delayed {name}", None, Sampled(None, NEVER), (Assign(begins, sympy.S.Zero),), (0.0,), NO_FLAG)
        self.events.append(over)
        self.delays.append(
            Delay(
                late.path, source.path, instant.path, begins.path, base.path, value.path, rate.path, bend.path, limit,
                is_constant=longest is None,
            )
        )  # fmt: skip
        return late


def _is_parameter(symbol: sympy.Basic) -> bool:
    return isinstance(symbol, ParameterSymbol) and not isinstance(symbol, DiscreteSymbol)


def _expression(value: object, where: str) -> sympy.Expr:
    found = None if isinstance(value, str) else sympy.sympify(value)
    if not isinstance(found, sympy.Expr):
        raise ModelError(f"{where} takes expressions or numbers; got {value!r}")
    past = sorted((s for s in found.free_symbols if isinstance(s, PreviousSymbol | EarlierSymbol)), key=str)
    if past:
        raise ModelError(f"{where}: {past[0]} is the value before an event: write {past[0].path}")
    return found
