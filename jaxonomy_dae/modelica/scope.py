"""What the names of a flat model mean, and the declarations that they need.

A Real variable is a variable of the component, a Real parameter becomes a parameter where it is first read, other
parameters are constants. Boolean, Integer and enumeration variables are of two kinds: those that are kept from event to
event are discrete variables; the others are expressions, put in wherever they are read.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TypeVar

import sympy

from ..base.errors import ModelError
from ..graph.expressions.from_sympy import symbols_of
from ..write.component import Component
from ..write.discrete_equations import BEFORE, STARTED, DiscreteEquations
from ..write.events import Sampled, terminate
from ..write.symbols import DiscreteSymbol, ParameterSymbol, TimeSymbol, VariableSymbol, der
from .builtin import filled
from .clocked import SAMPLED
from .definitions import assigned_in, find_definitions, remembered
from .evaluate import array_of
from .flat_model import FlatModel
from .interpret import Interpreter
from .iterations import is_of_parameters, previous, variables_in
from .kept_inputs import KEPT
from .left_out import LEFT_OUT, TIME_TABLE, time_table_coefficients
from .random_numbers import RandomNumbers
from .roots import ROOT, root
from .tables import CONSTANT, EXTERNALS, GET_VALUE, LINEAR, SMOOTHNESS, Table
from .tree import Assignment, Call, Class, Declaration, Equality, Expression, Reference, Statement, each_part
from .values import Record, Value, as_number, both, is_condition, negated, plain
from .written_out import entries_of, fields_of, unrolled

REAL = "Real"
_TEXTS = ("String", "StateSelect", "AssertionLevel")
_CONSTANT = {"parameter", "constant"}
_CLOCKED = ("Clock", "previous", "hold", "subSample", "superSample", "shiftSample", "backSample", "noClock")


class Scope:
    """The names of a flat model that is being written into a component.

    - `numbers`: parameters whose values are numbers.
    - `given`: values of parameters in place of those of the text: numbers, or expressions in parameters.
    - `signals`: Boolean and Integer inputs that are real inputs of the component: true above 1/2, or rounded.
    - `interpreter`: evaluates expressions in these names.
    - `definitions`: which statement determines which variable.
    - `discrete`: the discrete equations; `kept`: relations whose truth is kept between events.
    - `names`: names of long expressions of functions.
    - `carried_out`: what algorithms assign, by their numbers; `assigned_first`: what initial algorithms assign.
    - `said`: the discrete variables of which initial equations say what they are. `waiting`: initial equations of
      discrete variables that wait for others, which they do while `postpones` is true.
    - `clock`: the clock of the body of a `when` that is being read, if nothing else lets it act.
    - `as_numbers`: True while parameters are read as their values, which are final then.
    """

    def __init__(
        self, flat: FlatModel, component: Component, numbers: Collection[str] = (),
        given: Mapping[str, Value] | None = None, signals: Collection[str] = (),
    ):  # fmt: skip
        self.flat, self.component, self.numbers = flat, component, numbers
        self.given, self.signals = given or {}, signals
        self.declared = {d.name: d for d in flat.model.declarations}
        self.known: dict[str, Value] = {"time": component.ev.t}
        self.entries, self.fields = _gather(self.declared)
        self.being: list[str] = []
        special: dict[str, Callable[..., Value]] = {
            "pre": self._pre, "edge": self._edge, "change": self._change, "initial": self._is_initial,
            "terminal": lambda: False, "sample": self._sample, SAMPLED: self._sampled, "delay": self._delay,
        }  # fmt: skip
        special |= {name: functools.partial(self._table, name, place) for name, place in SMOOTHNESS.items()}
        special[TIME_TABLE] = self._time_table
        special |= {name: functools.partial(_clocked, name) for name in _CLOCKED if name not in flat.classes}
        self.random = RandomNumbers(component)
        self.interpreter = Interpreter(
            flat.classes, self.value, special,
            LEFT_OUT | EXTERNALS | self.random.functions() | {ROOT: self._root}
            | {name: functools.partial(self._read_table, EXTERNALS[name]) for name in GET_VALUE},
            self.entries, self._named, self._opaque,
        )  # fmt: skip
        self.interpreter.is_integer = self._is_integer
        self.discrete = DiscreteEquations(component, self.interpreter.quieted)
        self.kept = self.discrete.kept
        self.as_numbers = False
        self.clock: Sampled | None = None
        self.final: dict[str, Value] = {}
        # Only now: sizes may depend on parameters, records and functions, which the interpreter finds by their names.
        self.flat = flat = dataclasses.replace(flat, model=self._written_out(flat.model))
        self.declared = {d.name: d for d in flat.model.declarations}
        entries, fields = _gather(self.declared)
        self.entries.update(entries)
        self.fields.update(fields)
        self.definitions = find_definitions(self.flat.model, self.is_discrete)
        self.names: dict[sympy.Expr, sympy.Symbol] = {}
        self.delays: dict[tuple[Value, Value, Value], sympy.Symbol] = {}
        self.ends: set[sympy.Basic] = set()  # conditions that end the run
        self.carried_out: dict[int, dict[str, Value]] = {}
        self.assigned_first: dict[tuple[Statement, ...], dict[str, Value]] = {}
        self.said: set[DiscreteSymbol] = set()
        self.waiting: list[tuple[Value, Value]] = []
        self.postpones = True

    def _written_out(self, model: Class) -> Class:
        """The model with its arrays of variables and its loops of equations written out; sizes and ranges are known
        now."""

        def values_of(over: Expression | None) -> list:
            if over is None:
                raise ModelError("it must be written out, as 1:n")
            values = self.interpreter.constant(over)
            return values if isinstance(values, list) else [values]

        def is_array(e: Expression) -> bool:
            return isinstance(self.evaluate(e), list)

        declared: list[Declaration] = []
        waiting = list(reversed(model.declarations))
        while waiting:
            d = waiting.pop()
            record = self._record_of(d)
            if record is not None and not d.dimensions:
                waiting += reversed(list(fields_of(d, record)))
            elif d.dimensions and (record or not d.prefixes & _CONSTANT and self.kind(d.type) not in _TEXTS):
                sizes = [self.interpreter.count(n) for n in d.dimensions]
                entries = located(model.name, d.line, lambda d, n: list(entries_of(d, n, is_array)), d, sizes)
                if record is None:
                    declared += entries
                else:
                    waiting += reversed(entries)
            else:
                declared.append(d)
        equations, initial = (unrolled(s, values_of) for s in (model.equations, model.initial_equations))
        return model._replace(declarations=tuple(declared), equations=equations, initial_equations=initial)

    def _record_of(self, d: Declaration) -> Class | None:
        """The record of which a variable is one; a constant that has a value stays whole."""
        of = self.flat.classes.get(d.type)
        whole = d.value is not None and d.prefixes & _CONSTANT
        return None if of is None or of.kind != "record" or whole else of

    def evaluate(self, e: Expression) -> Value:
        return self.interpreter.evaluate(e)

    def is_discrete(self, name: str) -> bool:
        """True for variables that change at events only."""
        d = self.declared.get(name)
        if d is None or d.prefixes & _CONSTANT:
            return False
        return "discrete" in d.prefixes or self.kind(d.type) != REAL

    def kind(self, name: str) -> str:
        """Real, Integer, Boolean or String: what a type is made of; an enumeration is an Integer."""
        c = self.flat.classes.get(name)
        if c is None:
            return name
        if c.literals:
            return "Integer"
        return self.kind(c.made_of) if c.made_of is not None else name

    def _is_integer(self, symbol: str) -> bool:
        d = self.declared.get(symbol.removeprefix(BEFORE).removesuffix(")") if symbol.startswith(BEFORE) else symbol)
        return d is not None and self.kind(d.type) == "Integer"

    def value(self, name: str) -> Value:
        known = self.final if self.as_numbers else self.known
        if name in known:
            return known[name]
        d = self.declared.get(name)
        if d is None:
            return self.known.setdefault(name, self._gathered(name))
        if name in self.being:
            circle = " → ".join([*self.being[self.being.index(name) :], name])
            raise ModelError(f"the values of {circle} depend on each other")
        self.being.append(name)
        try:
            value = self._found(d)
        finally:
            self.being.pop()
        known[name] = value
        return value

    def _found(self, d: Declaration) -> Value:
        if d.prefixes & _CONSTANT:
            return self._constant(d)
        if d.name in self.definitions.stored:
            return self._declare_stored(d)
        return self._expression_of(d) if self.is_discrete(d.name) else self._declare_real(d)

    def _gathered(self, name: str) -> Value:
        """An array or a record whose entries are declared one by one."""
        if name in self.entries:
            return array_of(name, self.entries[name], self.value)
        if name in self.fields:
            return Record({f: self.value(f"{name}.{f}") for f in self.fields[name]})
        raise KeyError(name)

    def _constant(self, d: Declaration) -> Value:
        """The value of a parameter: a symbol for a Real, which is then a parameter of the component."""
        if d.name in self.given:
            return self._as_parameter(d, self.given[d.name])
        if d.value is None or self._is_unknown(d):
            found = self._initial_algorithm(d.name)
            if isinstance(found, int | float | bool):
                return self._as_parameter(d, found)
        if self._is_unknown(d):
            return self._unknown_parameter(d)
        if d.value is None and self.kind(d.type) != REAL:
            value = self._said_initially(d.name) if self._fixed(d) is False else None
            if value is not None:
                return value
            if "start" in d.modifiers:
                return self.evaluate(d.modifiers["start"])
        if d.value is None:
            if self.kind(d.type) == REAL and not d.dimensions:
                start = d.modifiers.get("start")
                return float(self._fall_back(d)) if start is None else self._as_parameter(d, self.evaluate(start))
            if "start" in d.modifiers:  # of an array
                start = self.evaluate(d.modifiers["start"])
                sizes = [self.interpreter.count(n) for n in d.dimensions]
                return start if isinstance(start, list) else filled(start, *sizes)
            raise ModelError(f"the parameter '{d.name}' has no value")
        return self._as_parameter(d, self.evaluate(d.value))

    def _initial_algorithm(self, name: str) -> Value:
        """What an initial algorithm assigns to a parameter; None if none does."""
        for statements in self.flat.model.initial_algorithms:
            if name not in assigned_in(statements):
                continue
            if statements not in self.assigned_first:
                self.assigned_first[statements] = self.interpreter.assigned_by(statements)
            return self.assigned_first[statements].get(name)
        return None

    def _as_parameter(self, d: Declaration, value: Value) -> Value:
        if self.kind(d.type) != REAL or "constant" in d.prefixes or isinstance(value, list):
            return value
        if isinstance(value, int | float):
            value = float(value)
            if self.as_numbers or d.name in self.numbers:
                return value
        elif not isinstance(value, sympy.Expr):
            return value
        elif not is_of_parameters(value):
            return value
        return self.component.parameter(d.name, value, unit=self._unit(d))

    def _unit(self, d: Declaration) -> str:
        value = d.modifiers.get("unit")
        return "" if value is None else str(getattr(value, "text", ""))

    def _expression_of(self, d: Declaration) -> Value:
        """What a Boolean or Integer variable is, in terms of what it depends on."""
        found = self.definitions.of.get(d.name)
        if d.name in self.signals:
            is_declared = d.name in self.component.variables
            signal = VariableSymbol(d.name) if is_declared else self.component.input(d.name)
            return sympy.Gt(signal, 0.5) if self.kind(d.type) == "Boolean" else sympy.floor(signal + 0.5)
        if found is None and "input" not in d.prefixes:
            raise ModelError(f"line {d.line}: nothing determines '{d.name}': it has neither an equation nor a when")
        if found is None:  # an input of the model that nothing drives
            start = self._start(d.modifiers.get("start")) or self._least(d.type)
            if isinstance(start, sympy.Expr):
                raise ModelError(f"line {d.line}: the start of '{d.name}', an input that nothing drives, is a number")
            return bool(start) if self.kind(d.type) == "Boolean" else int(start)
        return self.defined(d.name, found)

    def defined(self, name: str, found: Value) -> Value:
        if isinstance(found, int):  # the number of an algorithm
            values = self.algorithm(found)
            self.known.update({k: v for k, v in values.items() if k not in self.known})
            return values[name]
        return self.evaluate(found)

    def algorithm(self, number: int) -> dict[str, Value]:
        """What an algorithm assigns."""
        if number not in self.carried_out:
            assigned, kept = self.definitions.assigned[number], self.definitions.stored
            statements = self.definitions.algorithms[number]
            # What an algorithm does not assign in every case begins with what it was before, or with its start if it is
            # not discrete (section 11.1.2).
            first = {n: previous(self.stored(n)) for n in assigned if n in kept}
            for n in sorted(remembered(statements, self.flat.model) - first.keys()):
                start = self._start(self.declared[n].modifiers.get("start"))
                first[n] = float(self._fall_back(self.declared[n])) if start is None else start
            self.carried_out[number] = self.interpreter.assigned_by(statements, first)
        return self.carried_out[number]

    # --- declarations ------------------------------------------------------------------------------------------------

    def declare_variables(self) -> None:
        """Declares what is a variable of the component, in the order of the text."""
        for d in self.flat.model.declarations:
            if d.prefixes & _CONSTANT:
                if self._is_unknown(d):
                    self.value(d.name)
            elif self.kind(d.type) not in _TEXTS and (
                d.name in self.definitions.stored or not self.is_discrete(d.name)
            ):
                self.value(d.name)

    def _is_unknown(self, d: Declaration) -> bool:
        return self._fixed(d) is False and self.kind(d.type) == REAL

    def _fixed(self, d: Declaration) -> bool | None:
        """The attribute `fixed`; None where nothing gives it."""
        e = d.modifiers.get("fixed")
        value = None if e is None else self.interpreter.constant(e)
        if value is not None and not isinstance(value, bool):
            raise ModelError(f"line {d.line}: 'fixed' of '{d.name}' is true or false; got {value!r}")
        return value

    def _unknown_parameter(self, d: Declaration) -> Value:
        """A parameter that initial equations determine: a variable that does not change. If one of them just says
        what it is, it is a parameter."""
        value = self._said_initially(d.name)
        if isinstance(value, int | float) or isinstance(value, sympy.Expr) and is_of_parameters(value):
            return self._as_parameter(d, value)
        start = d.modifiers.get("start") if d.value is None else d.value
        symbol = self.component.variable(d.name, start=self._start(start), unit=self._unit(d))
        self.component.add_equations(sympy.Eq(der(symbol), 0, evaluate=False))
        return symbol

    def _said_initially(self, name: str) -> Value:
        """The value that an initial equation gives to a parameter by itself; None if there is none."""
        for s in self.definitions.initial:
            if isinstance(s, Equality | Assignment):
                if isinstance(s.left, Reference) and s.left.path == name and not any(s.left.subscripts):
                    try:
                        return self.interpreter.evaluate(s.right, self._at_start)
                    # Such as one that depends on itself through another parameter: then both are found by solving.
                    except ModelError:
                        return None
        return None

    def _at_start(self, name: str) -> Value:
        return self.flat.experiment.get("StartTime", 0.0) if name == "time" else self.value(name)

    def _declare_stored(self, d: Declaration) -> Value:
        start = self._start(d.modifiers.get("start"))
        start = self._fall_back(d) if start is None else as_number(start)
        self.component.discrete(d.name, start=start)
        self.discrete.before(d.name)
        if self.kind(d.type) == REAL:
            self.discrete.reals.add(d.name)
        return self.stored(d.name)

    def _fall_back(self, d: Declaration) -> float | int:
        """What a variable starts at if nothing says so: what is next to zero within its bounds (section 4.9)."""
        value: float | int = self._least(d.type)
        for bound, further in (("min", max), ("max", min)):
            e = d.modifiers.get(bound)
            limit = None if e is None else self.evaluate(e)
            value = further(value, limit) if isinstance(limit, int | float) else value
        return value

    def _least(self, type_name: str) -> int:
        """The number next to zero of a type: an enumeration has its first literal, others have 0."""
        c = self.flat.classes.get(type_name)
        if c is not None and c.made_of is not None:
            return self._least(c.made_of)
        return 1 if c is not None and c.literals else 0

    def stored(self, name: str) -> Value:
        symbol = DiscreteSymbol(name)
        return sympy.Eq(symbol, 1) if self.kind(self.declared[name].type) == "Boolean" else symbol

    def _declare_real(self, d: Declaration) -> Value:
        if self.kind(d.type) != REAL:
            raise ModelError(
                f"line {d.line}: '{d.name}' is of the type '{d.type}', which is not known here; "
                "Modelica that is not flat is read by load(source, model=…)"
            )
        nominal = self._start(d.modifiers.get("nominal"))
        start = self._start(d.modifiers.get("start"))
        # An input of a part is bound to what drives it, and is an ordinary variable.
        if "input" in d.prefixes and d.value is None:
            # One in parameters would not follow them.
            default = None if isinstance(start, sympy.Expr) and start.free_symbols else start
            return self.component.input(
                d.name, default=None if default is None else float(default), unit=self._unit(d)
            )  # fmt: skip
        fixed = self._fixed(d) is True
        if fixed and start is None:
            start = float(self._fall_back(d))
        if d.value is not None:
            self.definitions.equations.append(Equality(Reference((d.name,)), d.value, d.line))
        return self.component.variable(
            d.name, start=start, fixed=fixed, unit=self._unit(d),
            # A nominal value of zero, or in parameters, says nothing of a size that is known now.
            nominal=abs(nominal) if isinstance(nominal, int | float) and nominal else None,
        )  # fmt: skip

    def _start(self, e: Expression | None) -> Value:
        """A start value: a number, or an expression in parameters."""
        if e is None:
            return None
        value = self.evaluate(e)
        if is_condition(value):
            value = as_number(value)
        if isinstance(value, sympy.Expr) and any(not isinstance(s, ParameterSymbol) for s in symbols_of(value)):
            return None
        return float(value) if isinstance(value, int) and not isinstance(value, bool) else value

    def _named(self, e: sympy.Expr) -> Value:
        """A hidden parameter or variable that is equal to an expression of a function."""
        if e in self.names:
            return self.names[e]
        name = f":value[{len(self.names)}]"
        if is_of_parameters(e):
            self.names[e] = self.component.parameter(name, e)
        else:
            self.names[e] = self.component.variable(name)
            self.component.add_equations(sympy.Eq(self.names[e], self.kept.in_equations(e), evaluate=False))
        return self.names[e]

    def _opaque(self, function: Callable, arguments: Sequence[Value], count: int, called: str) -> Sequence[Value]:
        """The results of a function of JAX, as variables; its arguments are variables, too."""
        c = self.component
        inputs: list[sympy.Symbol] = []
        for value in arguments:
            if not isinstance(value, VariableSymbol) or value.order:
                symbol = c.variable(f":argument[{len(c.variables)}]")
                c.add_equations(sympy.Eq(symbol, value, evaluate=False))
                value = symbol
            inputs.append(value)
        return c.function(f":{called}[{len(c.learned_terms)}]", function, inputs, count)

    def _root(self, *arguments: Value) -> Value:
        return root(self.component, self.interpreter.guards, *arguments)

    def _table(self, name: str, place: int, *arguments: Expression) -> Value:
        """A table. The entries of a smooth one, whose polynomials depend on all of them, are numbers."""
        smoothness = self.evaluate(arguments[place]) if len(arguments) > place else LINEAR
        self.as_numbers = smoothness not in (LINEAR, CONSTANT)
        try:
            return EXTERNALS[name](*map(self.evaluate, arguments))
        finally:
            self.as_numbers = False

    def _time_table(self, table: Expression, *others: Expression) -> Value:
        """The line of a time table at an event; the entries of the table, which say when events are, are numbers."""
        self.as_numbers = True
        try:
            entries = self.evaluate(table)
        finally:
            self.as_numbers = False
        return time_table_coefficients(entries, *map(self.evaluate, others))

    def _read_table(self, read: Callable[..., Value], table: Table, column: int, u: Value, *more: Value) -> Value:
        """The value of a table. One without extrapolation ends the run where it is read outside of its rows."""
        outside = table.outside(u) if isinstance(u, sympy.Expr) else False
        outside = functools.reduce(both, self.interpreter.guards, outside)
        if not isinstance(outside, bool) and outside not in self.ends and outside.atoms(VariableSymbol, TimeSymbol):
            # One event for each condition, however many columns of a table are read.
            self.ends.add(outside)
            first, last = table.rows[0, 0] + table.shift, table.rows[-1, 0] + table.shift
            inside = ", ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in (first, last))
            told = f"a table is read outside of [{inside}], without extrapolation"
            self.component.when(self.kept.in_discrete(outside), terminate(told), at_start=True)
        return read(table, column, u, *more)

    def _pre(self, e: Expression) -> Value:
        value = self._now(e)
        if self.clock is not None and variables_in(value):
            return self._before_ticks(self.clock, value)
        for s in variables_in(value):
            # A state jumps by `reinit` alone, at the end of an iteration: until then it is what it was before.
            if not s.path.startswith(":") and s.path not in self.states:
                name = s.path.replace(KEPT, "")
                raise ModelError(
                    f"pre({name}): '{name}' is neither discrete nor a state, and may jump with others at the instant: "
                    "what it was before is not kept. Write pre(…) of what its equation reads"
                )
        return self._previous(e)

    def _previous(self, e: Expression) -> Value:
        """A variable in the iteration before. Its subscripts choose it as they are now."""
        if not isinstance(e, Reference):
            return previous(self.evaluate(e))
        return self.interpreter.referred(e, lambda name: previous(self.value(name)), self.interpreter.around)

    def _now(self, e: Expression) -> Value:
        if not isinstance(e, Reference):
            return self.evaluate(e)
        return self.interpreter.referred(e, self.value, self.interpreter.around)

    @functools.cached_property
    def states(self) -> set[str]:
        """The variables of which equations read the derivative."""
        parts = each_part((self.flat.model.equations, self.flat.model.algorithms))
        calls = (p for p in parts if isinstance(p, Call) and p.function == "der")
        return {s.path for c in calls for s in variables_in(self.evaluate(c.arguments[0]))}

    def _edge(self, e: Expression) -> Value:
        now = self._now(e)
        return both(now, negated(self._previous(e)))

    def _change(self, e: Expression) -> Value:
        now = self._now(e)
        return negated(plain(sympy.Eq(as_number(now), as_number(self._previous(e)))))

    def _is_initial(self) -> Value:
        return negated(self.discrete.phase(STARTED))

    def _sample(self, start: Expression, interval: Expression) -> Value:
        return self.discrete.tick(
            self.component.sampled(*(self.interpreter.evaluate(e, self.interpreter.around) for e in (interval, start)))
        )

    def _sampled(self, e: Expression, start: Expression, interval: Expression) -> Value:
        """A value before the ticks of a clock."""
        clock = self.component.sampled(self.evaluate(interval), self.evaluate(start))
        value = self.evaluate(e)
        return self._before_ticks(clock, value)

    def _before_ticks(self, clock: Sampled, value: Value) -> Value:
        if isinstance(value, list):
            return [self._before_ticks(clock, v) for v in value]
        found = self.discrete.at_ticks(clock, sympy.sympify(as_number(value)))
        return sympy.Eq(found, 1) if is_condition(value) else found

    def _delay(self, e: Expression, time: Expression, longest: Expression | None = None) -> Value:
        by = self.evaluate(time)
        # With a delay that is constant, the specification asks for no limit, and one that is given says nothing more.
        changes = isinstance(by, sympy.Expr) and not is_of_parameters(by)
        if changes and longest is None:
            raise ModelError(f"delay(…) with the delay {by}, which changes, needs a third argument, the longest delay")
        limit = self.evaluate(longest) if changes and longest is not None else None
        return self._delayed(self.evaluate(e), by, limit)

    def _delayed(self, value: Value, time: Value, longest: Value) -> Value:
        """A value, or each entry of an array, delayed."""
        if isinstance(value, list):
            return [self._delayed(v, time, longest) for v in value]
        value = as_number(value)
        if isinstance(time, int | float) and time == 0:
            return value
        if not isinstance(value, sympy.Expr) or (is_of_parameters(value) and not value.has(TimeSymbol)):
            return value
        key = value, time, longest
        if key not in self.delays:
            name, within = f":delayed[{len(self.delays)}]", self.kept.in_equations
            by = within(time) if isinstance(time, sympy.Basic) else time
            self.delays[key] = self.component.delayed(name, within(value), by, longest)
        return self.delays[key]


T = TypeVar("T")


def located(model: str, line: int, do: Callable[..., T], *arguments: object) -> T:
    """Does something for a statement of the text; errors say where it stands."""
    try:
        return do(*arguments)
    except ModelError as error:
        raise ModelError(f"{model}, line {line}: {error}") from None
    except (TypeError, ValueError, AttributeError, IndexError, RecursionError) as error:
        raise ModelError(f"{model}, line {line}: {type(error).__name__}: {error}") from error


def _clocked(name: str, *_: Expression) -> Value:
    raise ModelError(
        f"{name}(…) belongs to the synchronous language elements, chapter 16 of the specification, which are not "
        "read: write sample(start, interval) in a when"
    )


def _gather(names: Iterable[str]) -> tuple[dict[str, list[tuple[int, ...]]], dict[str, list[str]]]:
    """(places of the entries, names of the fields) by the name of an array or record that flattening took apart."""
    entries: dict[str, dict[tuple[int, ...], None]] = {}
    fields: dict[str, dict[str, None]] = {}
    for name in names:
        for end in re.finditer(r"\[([\d,]+)\]", name):
            place = tuple(map(int, end.group(1).split(",")))
            entries.setdefault(name[: end.start()], {})[place] = None
        for dot in re.finditer(r"\.", name):
            rest = name[dot.end() :]
            fields.setdefault(name[: dot.start()], {})[re.split(r"[.\[]", rest)[0]] = None
    return {k: list(v) for k, v in entries.items()}, {k: list(v) for k, v in fields.items()}
