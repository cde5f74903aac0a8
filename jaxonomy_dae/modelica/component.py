"""A flat Modelica model as a component.

Real variables become variables and their equations equations. Boolean, Integer and enumeration variables are of three
kinds: those that a `when` assigns are discrete variables; those whose value before an event is read, `pre(m)`, are
discrete variables that follow their equation by events; the others are expressions, put in wherever they are read.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import sympy

from ..errors import ModelError
from ..modeling.component import Component
from ..modeling.environment import EqnEnv
from ..modeling.events import Sampled, assign, pre, reinit, terminate
from ..modeling.symbols import DiscreteSymbol, ParameterSymbol, PreviousSymbol, VariableSymbol, der
from .definitions import OfAlgorithm, assigned_in, find_definitions
from .interpret import Interpreter
from .kept_relations import KeptRelations
from .tables import EXTERNALS
from .tree import (
    Array,
    Assignment,
    Binary,
    Branches,
    Call,
    Class,
    Declaration,
    Effect,
    Equality,
    Expression,
    Loop,
    Number,
    Reference,
    Several,
    Statement,
    Truth,
    Unary,
)
from .values import (
    Record,
    Value,
    as_condition,
    as_number,
    both,
    chosen,
    is_condition,
    negated,
    parts_of_choice,
    plain,
)

REAL = "Real"
_TEXTS = ("String", "StateSelect", "AssertionLevel")


class FlatComponent(Component):
    """A flat Modelica model as a component. Its names are those of the text, with dots and brackets.

    **Arguments:**

    - `ev`: the model's `EqnEnv`.
    - `name`: the component's name.
    - `flat`: the text's model.
    """

    def __init__(self, ev: EqnEnv, name: str, flat: "FlatModel"):
        super().__init__(ev, name)
        self.flat = flat
        _Building(flat, self)

    def _claim(self, name: str, what: str):
        self._check_open(f"declare its {what} '{name}'")
        if name in self.variables or name in self.parameters:
            raise ModelError(f"component '{self.name}' uses the name '{name}' twice")

    def initially(self, left: Any, right: Any) -> None:
        """An equation that holds at the initial time."""
        name = f":initially[{sum(n.startswith(':initially') for n in self.variables)}]"
        self.add_equations(sympy.Eq(self._declare(name, "event", 0.0, True), left - right, evaluate=False))


@dataclasses.dataclass(frozen=True)
class FlatModel:
    """A model of a Base Modelica text with the functions and types that it needs."""

    model: Class
    classes: Mapping[str, Class]

    @property
    def name(self) -> str:
        return self.model.name

    def experiment(self) -> dict[str, float]:
        """The settings of the text's own experiment, such as `StopTime`, as numbers."""
        found = self.model.annotation.get("experiment", {})
        return {k: v.value for k, v in found.items() if isinstance(v, Number)}

    def component(self, ev: EqnEnv, name: str) -> FlatComponent:
        """A component of this model."""
        return FlatComponent(ev, name, self)


def flat_model(outermost: Class) -> FlatModel:
    """The model of a text.

    **Raises:**

    - `ModelError` if it does not hold exactly one.
    """
    if outermost.kind in ("model", "class", "block"):
        return FlatModel(outermost, {})
    models = [c for c in outermost.classes if c.kind == "model"]
    if len(models) != 1:
        raise ModelError(f"a flat text holds one model; got {len(models)}")
    return FlatModel(models[0], {c.name: c for c in outermost.classes if c is not models[0]})


class _Building:
    """Writes a flat model into a component."""

    def __init__(self, flat: FlatModel, component: FlatComponent):
        self.flat, self.component = flat, component
        self.declared = {d.name: d for d in flat.model.declarations}
        self.known: dict[str, Value] = {"time": component.ev.t}
        self.entries, self.fields = _gather(self.declared)
        self.being: list[str] = []
        special: dict[str, Callable[..., Value]] = {
            "pre": self._pre, "edge": self._edge, "change": self._change, "initial": self._initial,
            "terminal": lambda: False, "sample": self._sample, "delay": self._delay,
        }  # fmt: skip
        self.interpreter = Interpreter(flat.classes, self._value, special)
        self.interpreter.externals.update(EXTERNALS)
        self.definitions = find_definitions(flat.model, self._is_discrete)
        self.starts: dict[str, Value] = {}
        self.in_action = False
        self.initial_symbol: Any = None
        self._declare_variables()
        self.kept = KeptRelations(self.component)
        self._modes()
        for s in self.definitions.whens:
            self._located(s, self._when)
        for s in self.definitions.equations:
            self._located(s, self._equation)
        self._initial_equations()
        if self.initial_symbol is not None:
            self.component._event(
                sympy.Eq(self.initial_symbol, 1), (assign(self.initial_symbol, 0),), None, True, noted=False
            )

    def _located(self, s: Any, what: Callable[[Any], None]) -> None:
        try:
            what(s)
        except ModelError as error:
            raise ModelError(f"{self.flat.name}, line {s.line}: {error}") from None
        except (TypeError, ValueError, AttributeError, IndexError) as error:
            raise ModelError(f"{self.flat.name}, line {s.line}: {type(error).__name__}: {error}") from error

    # --- names -------------------------------------------------------------------------------------------------------

    def _is_discrete(self, name: str) -> bool:
        d = self.declared.get(name)
        if d is None or d.prefixes & {"parameter", "constant"}:
            return False
        return "discrete" in d.prefixes or self._type(d.type) != REAL

    def _type(self, name: str) -> str:
        """Real, Integer, Boolean or String: what a type is made of; an enumeration is an Integer."""
        c = self.flat.classes.get(name)
        if c is None:
            return name
        if c.literals:
            return "Integer"
        return self._type(c.base.type) if c.base is not None else name

    def _value(self, name: str) -> Value:
        if name in self.known:
            return self.known[name]
        d = self.declared.get(name)
        if d is None:
            return self.known.setdefault(name, self._gathered(name))
        if name in self.being:
            circle = " → ".join([*self.being[self.being.index(name) :], name])
            raise ModelError(f"the values of {circle} depend on each other")
        self.being.append(name)
        try:
            value = self._constant(d) if d.prefixes & {"parameter", "constant"} else self._expression_of(d)
        finally:
            self.being.pop()
        self.known[name] = value
        return value

    def _gathered(self, name: str) -> Value:
        """An array or a record whose entries are declared one by one."""
        if name in self.entries:
            return self._array_of(name, self.entries[name], 0)
        if name in self.fields:
            return Record({f: self._value(f"{name}.{f}") for f in self.fields[name]})
        raise KeyError(name)

    def _array_of(self, name: str, places: list[tuple[int, ...]], depth: int) -> Value:
        """The array of the entries at these places, which have equal numbers before `depth`."""
        out = []
        for k in sorted({p[depth] for p in places}):
            inside = [p for p in places if p[depth] == k]
            if len(inside[0]) > depth + 1:
                out.append(self._array_of(name, inside, depth + 1))
            else:
                out.append(self._value(f"{name}[{','.join(map(str, inside[0]))}]"))
        return out

    def _constant(self, d: Declaration) -> Value:
        """The value of a parameter: a symbol for a Real, which is then a parameter of the component."""
        if d.value is None or self._is_unknown(d):
            found = self._initial_algorithm(d.name)
            if isinstance(found, int | float | bool):
                return self._as_parameter(d, found)
        if self._is_unknown(d):
            return self._unknown_parameter(d)
        if d.value is None and "start" in d.modifiers and self._type(d.type) != REAL:
            return self.interpreter.evaluate(d.modifiers["start"])
        if d.value is None:
            if self._type(d.type) == REAL and not d.dimensions:
                start = d.modifiers.get("start")
                return 0.0 if start is None else self._as_parameter(d, self.interpreter.evaluate(start))
            raise ModelError(f"the parameter '{d.name}' has no value")
        return self._as_parameter(d, self.interpreter.evaluate(d.value))

    def _initial_algorithm(self, name: str) -> Value:
        """What an initial algorithm assigns to a parameter; None if none does."""
        for statements in self.flat.model.initial_algorithms:
            if name not in assigned_in(statements):
                continue
            local: dict[str, Value] = {}
            self.interpreter.execute(
                statements, local, lambda n, local=local: local[n] if n in local else self._value(n)
            )
            self.known.update(local)
            return local.get(name)
        return None

    def _as_parameter(self, d: Declaration, value: Value) -> Value:
        if self._type(d.type) != REAL or "constant" in d.prefixes or isinstance(value, list):
            return value
        if isinstance(value, int | float):
            value = float(value)
        elif not isinstance(value, sympy.Expr):
            return value
        elif any(not isinstance(s, ParameterSymbol) or isinstance(s, DiscreteSymbol) for s in value.free_symbols):
            return value
        return self.component.parameter(d.name, value, unit=self._unit(d))

    def _unit(self, d: Declaration) -> str:
        value = d.modifiers.get("unit")
        return "" if value is None else str(getattr(value, "text", ""))

    def _expression_of(self, d: Declaration) -> Value:
        """What a Boolean or Integer variable is, in terms of what it depends on."""
        found = self.definitions.of.get(d.name)
        if found is None:  # an input of the model that nothing drives
            start = self._start(d.modifiers.get("start"))
            kind = self._type(d.type)
            return (
                (bool(start) if kind == "Boolean" else int(start))
                if start is not None
                else (0 if kind == "Integer" else False)
            )
        return self._defined(d.name, found)

    def _defined(self, name: str, found: Any) -> Value:
        if isinstance(found, int):  # the number of an algorithm
            values = self._algorithm(found)
            self.known.update({k: v for k, v in values.items() if k not in self.known})
            return values[name]
        return self.interpreter.evaluate(found)

    def _algorithm(self, number: int) -> dict[str, Value]:
        """What an algorithm assigns."""
        statements = self.definitions.algorithms[number]
        local: dict[str, Value] = {}
        for name in self.definitions.assigned[number]:
            if name in self.definitions.stored:
                local[name] = self._stored_value(name)

        def names(name: str) -> Value:
            return local[name] if name in local else self._value(name)

        self.interpreter.execute(statements, local, names)
        return local

    # --- declarations ------------------------------------------------------------------------------------------------

    def _declare_variables(self) -> None:
        for d in self.flat.model.declarations:
            kind = self._type(d.type)
            if d.prefixes & {"parameter", "constant"}:
                if self._is_unknown(d):
                    self._value(d.name)
                continue
            if kind in _TEXTS:
                continue
            if d.name in self.definitions.stored:
                self._declare_stored(d)
            elif not self._is_discrete(d.name):
                self._declare_real(d)

    def _is_unknown(self, d: Declaration) -> bool:
        return d.modifiers.get("fixed") == Truth(False) and self._type(d.type) == REAL

    def _unknown_parameter(self, d: Declaration) -> Value:
        """A parameter that initial equations determine: a variable that does not change, unless it is said what it is."""
        value = self._said_initially(d.name)
        if isinstance(value, int | float):
            return self._as_parameter(d, value)
        start = d.modifiers.get("start") if d.value is None else d.value
        symbol = self.component.variable(d.name, start=self._start(start), unit=self._unit(d))
        self.component.add_equations(sympy.Eq(der(symbol), 0, evaluate=False))
        return symbol

    def _said_initially(self, name: str) -> Value:
        """The value that an initial equation gives to a parameter by itself; None if there is none."""
        for s in self.definitions.initial:
            if isinstance(s, Equality | Assignment):
                target, value = (s.left, s.right) if isinstance(s, Equality) else (s.target, s.value)
                if isinstance(target, Reference) and target.path == name and not any(target.subscripts):
                    try:
                        return self.interpreter.evaluate(value, self._at_start)
                    except ModelError:
                        return None
        return None

    def _at_start(self, name: str) -> Value:
        return self.flat.experiment().get("StartTime", 0.0) if name == "time" else self._value(name)

    def _declare_stored(self, d: Declaration) -> None:
        start = self._start(d.modifiers.get("start"))
        start = 0 if start is None else as_number(start)
        self.component.discrete(d.name, start=start)
        self.known[d.name] = self._stored_value(d.name)

    def _stored_value(self, name: str) -> Value:
        symbol = DiscreteSymbol(name)
        return sympy.Eq(symbol, 1) if self._type(self.declared[name].type) == "Boolean" else symbol

    def _declare_real(self, d: Declaration) -> None:
        if self._type(d.type) != REAL:
            raise ModelError(f"line {d.line}: '{d.name}' is of the type '{d.type}', which is not known here")
        nominal = self._start(d.modifiers.get("nominal"))
        start = self._start(d.modifiers.get("start"))
        fixed = d.modifiers.get("fixed") == Truth(True)
        if fixed and start is None:
            start = 0.0
        self.known[d.name] = self.component.variable(
            d.name, start=start, fixed=fixed, unit=self._unit(d),
            nominal=abs(nominal) if isinstance(nominal, int | float) and nominal else None,
        )  # fmt: skip
        if d.value is not None:
            self.definitions.equations.append(Equality(Reference((d.name,), ((),)), d.value, d.line))

    def _start(self, e: Expression | None) -> Value:
        """A start value: a number, or an expression in parameters."""
        if e is None:
            return None
        value = self.interpreter.evaluate(e)
        if is_condition(value):
            value = as_number(value)
        if isinstance(value, sympy.Expr) and any(not isinstance(s, ParameterSymbol) for s in value.free_symbols):
            return None
        return float(value) if isinstance(value, int) and not isinstance(value, bool) else value

    # --- calls that the model answers --------------------------------------------------------------------------------

    def _pre(self, e: Expression) -> Value:
        value = self.interpreter.evaluate(e)
        if not self.in_action:
            return value  # between events the value before is the present one
        return _before(value)

    def _edge(self, e: Expression) -> Value:
        now = self.interpreter.evaluate(e)
        return both(now, negated(_before(now))) if self.in_action else now

    def _change(self, e: Expression) -> Value:
        now = self.interpreter.evaluate(e)
        return negated(plain(sympy.Eq(as_number(now), as_number(_before(now)))))

    def _initial(self) -> Value:
        if self.initial_symbol is None:
            self.component.discrete(":initial", start=1)
            self.initial_symbol = DiscreteSymbol(":initial")
        return sympy.Eq(self.initial_symbol, 1)

    def _sample(self, start: Expression, interval: Expression) -> Value:
        return self.component.sampled(self.interpreter.evaluate(interval), self.interpreter.evaluate(start))

    def _delay(self, *_: Expression) -> Value:
        raise ModelError("delay(…) needs the past of a variable, which is not kept")

    # --- equations ---------------------------------------------------------------------------------------------------

    def _equation(self, s: Statement) -> None:
        if isinstance(s, Equality):
            self._equal(s.left, s.right)
        elif isinstance(s, Branches):
            for residual in self._residuals(s):
                self._add(residual)
        elif isinstance(s, Loop):
            raise ModelError("a loop of equations")
        elif isinstance(s, Effect) and s.call.function not in ("assert", "print"):
            self._effect(s)

    def _effect(self, s: Effect) -> None:
        """A function that is called for several entries, or for what it does."""
        if s.call.function not in ("Modelica.Utilities.Streams.print",):
            raise ModelError(f"'{s.call.function}' stands where an equation is expected")

    def _equal(self, left: Expression, right: Expression) -> None:
        if isinstance(left, Several):
            results = self.interpreter.evaluate(right)
            for each, value in zip(left.entries, results, strict=False):
                if each is not None:
                    self._add_equal(self.interpreter.evaluate(each), value)
            return
        if isinstance(right, OfAlgorithm):
            self._add_equal(self.interpreter.evaluate(left), self._algorithm(right.number)[right.name])
            return
        self._add_equal(self.interpreter.evaluate(left), self.interpreter.evaluate(right))

    def _add_equal(self, a: Value, b: Value) -> None:
        for x, y in _pairs(a, b):
            self._add((as_number(x), as_number(y)))

    def _add(self, sides: tuple[Value, Value]) -> None:
        left, right = sides
        if isinstance(left, int | float) and isinstance(right, int | float):
            if left != right:
                raise ModelError(f"the equation {left} = {right} is false")
            return
        if isinstance(left, str) or isinstance(right, str):
            return
        left, right = (self.kept.in_equations(sympy.sympify(side)) for side in sides)
        self.component.add_equations(sympy.Eq(left, right, evaluate=False))

    def _sides(self, statements: tuple[Statement, ...]) -> list[tuple[Value, Value]]:
        out: list[tuple[Value, Value]] = []
        for s in statements:
            if isinstance(s, Equality):
                out += _pairs(self.interpreter.evaluate(s.left), self.interpreter.evaluate(s.right))
            elif isinstance(s, Branches) and s.kind == "if":
                out += self._residuals(s)
            elif not isinstance(s, Effect):
                raise ModelError("only equations can stand in an if")
        return [(as_number(a), as_number(b)) for a, b in out]

    def _residuals(self, s: Branches) -> list[tuple[Value, Value]]:
        """The equations of an `if`, in pairs (left, right): those of its branches, one beside the other."""
        branches: list[tuple[Value, list[tuple[Value, Value]]]] = []
        for condition, body in s.branches:
            holds = self.interpreter.evaluate(condition)
            if holds is False:
                continue
            branches.append((holds, self._sides(body)))
            if holds is True:
                break
        if not branches:
            return []
        if branches[0][0] is True:
            return branches[0][1]
        counts = {len(sides) for _, sides in branches}
        if branches[-1][0] is not True or len(counts) != 1:
            if not any(sides for _, sides in branches):
                return []
            raise ModelError(f"the branches of an if have {sorted(counts)} equations; they must have equally many")
        out = []
        for k in range(counts.pop()):
            one: Value = branches[-1][1][k]
            residual: Value = _difference(one)
            same = all(sides[k][0] == one[0] for _, sides in branches)
            value: Value = one[1]
            for holds, sides in reversed(branches[:-1]):
                quiet = holds in self.interpreter.quieted
                residual = chosen(holds, _difference(sides[k]), residual, quiet)
                value = chosen(holds, sides[k][1], value, quiet) if same else value
            out.append((one[0], value) if same else (residual, 0.0))
        return out

    # --- discrete equations ------------------------------------------------------------------------------------------

    def _modes(self) -> None:
        """Events by which stored variables follow their equations."""
        for name in self.definitions.followed:
            d = self.declared[name]
            try:
                self._follow(DiscreteSymbol(name), self._defined_anew(name))
            except ModelError as error:
                raise ModelError(f"{self.flat.name}, line {d.line}, '{name}': {error}") from None

    def _defined_anew(self, name: str) -> Value:
        return self._defined(name, self.definitions.of[name])

    def _follow(self, m: Any, value: Value) -> None:
        if is_condition(value):
            value = as_condition(value)
            cases = [(sympy.Integer(1), value), (sympy.Integer(0), negated(value))]
        else:
            cases = parts_of_choice(sympy.sympify(value))
        for result, holds in cases:
            if result == m:
                continue
            if any(isinstance(s, VariableSymbol) for s in sympy.sympify(result).free_symbols):
                raise ModelError(f"its value {result} changes in time")
            condition = self.kept.in_events(both(holds, plain(sympy.Ne(m, result))))
            if isinstance(condition, bool):
                continue
            self.component._event(condition, (assign(m, result),), None, True, noted=False, revocable=True)

    # --- when --------------------------------------------------------------------------------------------------------

    def _when(self, s: Branches) -> None:
        earlier: list[Value] = []
        for condition, body in s.branches:
            found: list[Value] = []
            for each in _each_condition(condition):
                happens = self._one_when(each, body, earlier)
                if happens is not None:
                    found.append(happens)
            earlier += found

    def _one_when(self, condition: Expression, body: tuple[Statement, ...], earlier: list[Value]) -> Value:
        """One event; returns its condition, or None for a clock. That of an `elsewhen` does not happen while an
        earlier condition holds."""
        parts = _conjuncts(condition)
        values = [self.interpreter.evaluate(_inner(p)) for p in parts]
        clocks = [v for v in values if isinstance(v, Sampled)]
        holds: Value = True
        for v in values:
            holds = holds if isinstance(v, Sampled) else both(holds, v)
        for e in earlier:
            holds = both(holds, negated(e))
        if holds is False or (holds is True and not clocks):
            return None  # it never becomes true
        at_start = any(isinstance(p, Call) and p.function == "initial" for p in parts)
        actions = self._actions(body, holds if clocks else True)
        if actions:
            condition = clocks[0] if clocks else self.kept.in_events(holds)
            self.component.when(condition, *actions, at_start=at_start)
        return None if clocks else holds

    def _actions(self, body: tuple[Statement, ...], extra: Value) -> list[Any]:
        self.in_action = True
        try:
            local: dict[str, Value] = {}
            actions = list(self._each_action(body, local))
        finally:
            self.in_action = False
        out = []
        for target, value in actions:
            if isinstance(target, str):
                out.append(terminate(target))
            elif isinstance(target, DiscreteSymbol):
                out.append(assign(target, chosen(extra, as_number(value), pre(target))))
            else:
                out.append(reinit(target, chosen(extra, value, target)))
        return out

    def _each_action(self, body: tuple[Statement, ...], local: dict[str, Value]) -> Iterator[tuple[Any, Value]]:
        for s in body:
            if isinstance(s, Effect):
                name, arguments = s.call.function, s.call.arguments
                if name == "reinit":
                    yield (
                        self.interpreter.evaluate(arguments[0]),
                        sympy.sympify(self.interpreter.evaluate(arguments[1])),
                    )
                elif name == "terminate":
                    yield str(self.interpreter.evaluate(arguments[0])), None
            elif isinstance(s, Equality | Assignment):
                target, value = (s.left, s.right) if isinstance(s, Equality) else (s.target, s.value)
                yield from self._assigned(target, self.interpreter.evaluate(value))
            elif isinstance(s, Branches) and s.kind == "if":
                yield from self._chosen_actions(s, local)
            else:
                raise ModelError(f"a {type(s).__name__.lower()} in a when")

    def _assigned(self, target: Expression, value: Value) -> Iterator[tuple[Any, Value]]:
        if isinstance(target, Several):
            for each, v in zip(target.entries, value, strict=False):
                if each is not None:
                    yield from self._assigned(each, v)
            return
        if not isinstance(target, Reference):
            raise ModelError("in a when, a variable stands on the left")
        name = target.path if not any(target.subscripts) else self.interpreter._entry_name(target, self._value)
        if name not in self.definitions.stored:
            raise ModelError(f"'{name}' cannot be assigned in a when")
        if isinstance(value, str):
            return
        yield DiscreteSymbol(name), sympy.sympify(as_number(value))

    def _chosen_actions(self, s: Branches, local: dict[str, Value]) -> Iterator[tuple[Any, Value]]:
        """An `if` within a when: each target has the value of the branch that holds, or the one before."""
        found: dict[Any, list[tuple[Value, Value]]] = {}
        otherwise: Value = True
        for condition, body in s.branches:
            holds = as_condition(self.interpreter.evaluate(condition))
            here = both(otherwise, holds)
            if here is not False:
                for target, value in self._each_action(body, local):
                    if isinstance(target, str):
                        raise ModelError("terminate under an if in a when")
                    found.setdefault(target, []).append((here, value))
            otherwise = both(otherwise, negated(holds))
            if otherwise is False:
                break
        for target, cases in found.items():
            value: Value = pre(target) if isinstance(target, DiscreteSymbol) else target
            for condition, result in reversed(cases):
                value = chosen(condition, result, value)
            yield target, value

    # --- initial equations -------------------------------------------------------------------------------------------

    def _initial_equations(self) -> None:
        for s in self.definitions.initial:
            self._located(s, self._initial_equation)

    def _initial_equation(self, s: Statement) -> None:
        if isinstance(s, Branches):
            for left, right in self._residuals(s):
                self._holds_initially(left, right)
        elif isinstance(s, Equality | Assignment):
            a, b = (s.left, s.right) if isinstance(s, Equality) else (s.target, s.value)
            if isinstance(a, Call) and a.function == "pre":
                a = a.arguments[0]
            for left, right in _pairs(self.interpreter.evaluate(a), self.interpreter.evaluate(b)):
                self._holds_initially(left, right)

    def _holds_initially(self, left: Value, right: Value) -> None:
        c = self.component
        if is_condition(left) or is_condition(right):
            left, right = as_number(left), as_number(right)
            if isinstance(left, sympy.Piecewise) and isinstance(left.args[0][1], sympy.Eq):
                left = left.args[0][1].lhs
        for a, b in ((left, right), (right, left)):
            only = _in_parameters(b)
            if isinstance(a, DiscreteSymbol):
                if only:
                    c.parameters[a.path] = c.parameters[a.path].with_value(_number(b))
                return
            if isinstance(a, VariableSymbol) and only and not a.order:
                variable = c.variables[a.path]
                if not variable.fixed:
                    c.variables[a.path] = dataclasses.replace(variable, start=sympy.sympify(b), fixed=True)
                    return
            if isinstance(a, VariableSymbol) and only and a.order:
                c.start(a, b, fixed=True)
                return
        if _in_parameters(left) and _in_parameters(right):
            return
        c.initially(sympy.sympify(left), sympy.sympify(right))


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


def _before(value: Value) -> Value:
    """A value before the event."""
    if not isinstance(value, sympy.Basic):
        return value
    return value.xreplace({s: PreviousSymbol(s.path) for s in value.free_symbols if isinstance(s, DiscreteSymbol)})


def _conjuncts(e: Expression) -> list[Expression]:
    """The conditions that `and` joins."""
    if isinstance(e, Binary) and e.operator == "and":
        return [*_conjuncts(e.left), *_conjuncts(e.right)]
    return [e]


def _each_condition(condition: Expression) -> tuple[Expression, ...]:
    """The conditions of which each makes the event: the entries of an array; `change(b)` is b and not b."""
    if isinstance(condition, Array):
        return tuple(c for entry in condition.entries for c in _each_condition(entry))
    if isinstance(condition, Call) and condition.function == "change":
        return (condition.arguments[0], Unary("not", condition.arguments[0]))
    return (condition,)


def _inner(condition: Expression) -> Expression:
    """The condition whose change to true makes an event: `edge(b)` is that of b."""
    return condition.arguments[0] if isinstance(condition, Call) and condition.function == "edge" else condition


def _pairs(a: Value, b: Value) -> list[tuple[Value, Value]]:
    """The entries of two values, one beside the other."""
    if isinstance(a, list) or isinstance(b, list):
        if not (isinstance(a, list) and isinstance(b, list)) or len(a) != len(b):
            raise ModelError(f"the sides of an equation differ in size: {a} and {b}")
        return [pair for x, y in zip(a, b, strict=True) for pair in _pairs(x, y)]
    if isinstance(a, Record) or isinstance(b, Record):
        return [pair for k in a for pair in _pairs(a[k], b[k])]
    return [(a, b)]


def _difference(sides: tuple[Value, Value]) -> Value:
    return sides[0] - sides[1]


def _in_parameters(value: Value) -> bool:
    symbols = value.free_symbols if isinstance(value, sympy.Basic) else set()
    return all(isinstance(s, ParameterSymbol) and not isinstance(s, DiscreteSymbol) for s in symbols)


def _number(value: Value) -> Value:
    value = as_number(value)
    return float(value) if isinstance(value, int | float) or value.is_number else value
