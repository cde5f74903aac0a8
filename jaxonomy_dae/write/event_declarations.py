"""How a component declares discrete variables and events."""

from collections.abc import Callable

import sympy

from ..base.aliases import Condition, Expression
from ..base.errors import ModelError
from ..graph.expressions.from_sympy import symbols_of
from .declarations import Value
from .environment import EqnEnv
from .events import (
    NO_FLAG,
    Action,
    Assign,
    EventFlag,
    Reinit,
    Sampled,
    Terminate,
    When,
    guard_of,
    is_strict,
    relation_in_discretes,
    while_on,
)
from .real_number import real_number
from .symbols import DiscreteSymbol, EarlierSymbol, PreviousSymbol, RelationSymbol, VariableSymbol


class EventDeclarations:
    """The part of `Component` that concerns events."""

    # Attributes and methods of the other parts of `Component`.
    ev: EqnEnv
    name: str
    path: str
    events: list[When]
    equations: list[sympy.Expr]
    _check_open: Callable[[str], None]
    add_equations: Callable[..., None]
    _declare: Callable[..., VariableSymbol]
    _declare_parameter: Callable[..., str]
    _check_parameters_only: Callable[[sympy.Expr, str], None]
    as_written: dict[sympy.Expr, sympy.Expr]
    _without_jumps: Callable[[Condition], Condition]
    _strict_apart: Callable[[Condition], Condition]

    def discrete(self, name: str, start: Value = 0.0, unit: str = "") -> DiscreteSymbol:
        """Declares a discrete variable: constant but for the events that assign it.

        **Arguments:**

        - `name`: its local name; `solution["component.name"]` is a step function of time.
        - `start`: a number or an expression in parameters: its value from the initial time to the first event that
            assigns it. It is a parameter of the system, `system.with_parameters({"component.name": 1.0})`.
        - `unit`: shown in reports and plots.

        **Raises:**

        - `ModelError` for a start that is not a finite number or an expression in parameters.
        """
        return DiscreteSymbol(self._declare_parameter(name, "discrete variable", start, unit))

    def sampled(self, period: Value, offset: Value = 0.0) -> Sampled:
        """A condition for `when` that becomes true again and again, at offset + k·period for k = 0, 1, 2, …

        **Arguments:**

        - `period` > 0, `offset`: second; numbers or expressions in parameters, which may be trained. It is
            true at the initial time, too, if that is one of these instants; those before it are left out.

        **Raises:**

        - `ModelError` for what is not an expression in parameters, and a period that is not positive.
        """
        parts = []
        for what, value in (("period", period), ("offset", offset)):
            found = sympy.sympify(value)
            where = f"component '{self.name}': the {what} of sampled"
            if isinstance(value, str) or not isinstance(found, sympy.Expr):
                raise ModelError(f"{where} is a number or an expression in parameters; got {value!r}")
            if found.is_number:
                real_number(found, where)
            self._check_parameters_only(found, where)
            if any(isinstance(s, DiscreteSymbol) for s in found.free_symbols):
                raise ModelError(f"{where} must not change between events; it uses a discrete variable: {found}")
            parts.append(found)
        # A period that follows parameters is checked when they have values.
        if parts[0].is_number and not float(parts[0]) > 0:
            raise ModelError(f"component '{self.name}': the period of sampled must be positive; got {parts[0]}")
        return Sampled(*parts)

    def when(
        self, condition: sympy.Basic | Sampled, *actions: Action, on: sympy.Basic | None = None, at_start: bool = False
    ) -> None:
        """Declares an event: what happens at the instant at which a condition becomes true.

        ```python
        self.when(h <= 0, reinit(v, -e * pre(v)))                       # a ball bounces
        self.when(T > high, assign(on, 0))                              # a thermostat
        self.when(self.sampled(0.1), assign(u, Kp * (r - y)))           # a sampled controller
        ```

        **Arguments:**

        - `condition`: a relation (`<`, `<=`, `>`, `>=`) in variables, discrete variables, parameters and time, several
            of them in `And` and `Or`, or `self.sampled(period)`. The event happens where it turns from false to true,
            and not again before it has been false.
        - `actions`: `reinit(state, value)`, `assign(discrete, value)`, `terminate("why")`. In values, variables are
            those before the event. Discrete variables are those before the event if read as `pre(d)`; read as `d`, what
            this event assigns to `d`.
        - `on`: a relation in discrete variables; the event happens only while it holds.
        - `at_start`: whether the event happens at the initial time, if the condition holds there.

        **Raises:**

        - `ModelError` for conditions and actions that cannot be meant.
        """
        self._event(condition, actions, on, EventFlag.LISTED | (EventFlag.AT_START if at_start else NO_FLAG))

    def _event(
        self,
        condition: Condition,
        actions: tuple[Action, ...],
        on: Condition,
        flags: EventFlag,
        text: str | None = None,
        watched: Condition = sympy.true,
    ) -> None:
        """Declares an event, shown as `text`; its guard is monitored only while `watched` holds."""
        self._check_open("declare its events")
        where = f"component '{self.name}': when"
        if not actions:
            raise ModelError(f"{where}({condition}): say what happens: reinit(…), assign(…) or terminate(…)")
        for action in actions:
            if not isinstance(action, Reinit | Assign | Terminate):
                raise ModelError(
                    f"{where}: what happens is said with reinit(…), assign(…) and terminate(…); got {action!r}"
                )
        clock = condition if isinstance(condition, Sampled) else None
        guard, shown = None, text or f"sampled({getattr(clock, 'period', '')})"
        if clock is None:
            shown = text or (str(condition) if on is None else f"{condition}, on={on}")
            own = condition if EventFlag.RELATION in flags else self._without_jumps(condition)
            watchable = self._strict_apart(own)  # either may add events
            expression = self._guard(watchable, on, watched, where)
            if is_strict(watchable):
                flags |= EventFlag.STRICT
            symbols = symbols_of(expression)
            changing = (VariableSymbol, DiscreteSymbol, RelationSymbol)
            if not any(isinstance(s, changing) or s is self.ev.t for s in symbols):
                raise ModelError(f"{where}({condition}): the condition contains no variable: it never changes")
            past = [s for s in symbols if isinstance(s, PreviousSymbol | EarlierSymbol)]
            if past:
                raise ModelError(f"{where}({condition}): a condition is on the present: write {past[0].path}")
            guard = self._hidden(f":when[{len(self.events)}]", expression)
            if watchable is not own:  # units are told in the user's words
                hidden = self.equations[-1]
                self.as_written[hidden] = hidden + expression - self._guard(own, on, watched, where)
        elif on is not None:
            raise ModelError(f"{where}: on= is for conditions on variables; a sampled event always happens")
        values = self._values(actions, len(self.events), where)
        self.events.append(When(shown, guard, clock, tuple(actions), values, flags))

    def _guard(self, condition: Condition, on: Condition, watched: Condition, where: str) -> sympy.Expr:
        """The guard of a condition, there only while `on` and `watched` hold."""
        guard = guard_of(condition, where)
        if on is not None:
            guard = while_on(guard, relation_in_discretes(on, f"{where}, on"))
        return while_on(guard, watched)

    def _hidden(self, name: str, expression: sympy.Expr) -> str:
        """Declares a variable that equals an expression, and is not shown."""
        symbol = self._declare(name, "event")
        self.equations.append(symbol - expression)
        return name

    def _values(self, actions: tuple[Action, ...], number: int, where: str) -> tuple:
        """The values that the actions of an event write: for each action a number, the name of a hidden variable that
        is declared here for its expression, or None for `terminate`."""
        new: dict[sympy.Expr, sympy.Expr] = {}
        targets: list[sympy.Expr] = []
        for action in actions:
            if isinstance(action, Terminate):
                continue
            if action.target in targets:
                raise ModelError(f"{where}: '{action.target}' is given two values by one event")
            if isinstance(action, Reinit) and action.target.order and isinstance(action.target, VariableSymbol):
                raise ModelError(
                    f"{where}: reinit takes a variable, not {action.target}: declare the derivative as a variable, "
                    f"Eq(v, {action.target}), and write reinit(v, …)"
                )
            targets.append(action.target)
            if isinstance(action, Assign):
                new[action.target] = action.value
        values: list[str | float | None] = []
        for k, action in enumerate(actions):
            if isinstance(action, Terminate):
                values.append(None)
                continue
            value = _as_read(_with_new_values(action.value, new, (), where))
            if value.is_number:
                values.append(float(value))
            elif isinstance(value, VariableSymbol) and value.path.startswith(":when"):  # it stands for a value already
                values.append(value.path)
            else:
                values.append(self._hidden(f":when[{number},{k}]", value))
        return tuple(values)


def _as_read(value: Expression) -> Expression:
    """A value of an action in what actions read: continuous variables before the event, with or without `pre`."""
    earlier = [s for s in value.free_symbols if isinstance(s, EarlierSymbol)]
    return value.xreplace({s: VariableSymbol(s.path, s.order) for s in earlier})


def _with_new_values(value: Expression, new: dict, above: tuple, where: str) -> Expression:
    """Substitutes the new values of discrete variables that the same event assigns. `above` are the symbols being
    substituted: a circle among them is refused."""
    # Sets of symbols have another order in each process: the message is to be the same.
    read = sorted((s for s in value.free_symbols if s in new), key=str)
    for symbol in read:
        if symbol in above:
            raise ModelError(
                f"{where}: the values of {', '.join(str(s) for s in above)} depend on each other; read the value "
                f"before the event with pre({symbol})"
            )
    return value.xreplace({s: _with_new_values(new[s], new, (*above, s), where) for s in read})
