"""Checks that the units of a model fit together.

Given a diagram, compares the units in every equation, start, dependent parameter, event, account of energy and
connection of signals. Components of one shape and with the same units are checked once. (Ports need no check: joined
ones are of one domain, which says their units.)
"""

import dataclasses
from collections.abc import Callable, Iterator

import sympy

from ...base.errors import UnitError
from ...graph.expressions.from_sympy import symbols_of
from ...graph.expressions.node import Node
from ...graph.expressions.to_sympy import shortened
from ...graph.units.fit import misfit_of_units, misfits_of_condition, misfits_of_equation, misfits_of_value
from ...graph.units.parse import UnknownUnit, read_unit
from ...graph.units.unit import JOULE, SECOND, WATT, Unit, rate
from ...write.component import Component
from ...write.declarations import START, Parameter, Variable
from ...write.diagram import AcausalDiagram
from ...write.events import EventFlag, Sampled, Terminate, When
from ...write.symbols import TIME_LABEL, symbol_label
from .number_model import RELATION, Instances, ModelNumbers
from .read_equations import read_expression

SHOWN = 12  # mismatches that an error lists
UnitOf = Callable[[tuple], Unit | None]
ACCOUNTS = {"energy": JOULE, "dissipation": WATT, "supply": WATT}


@dataclasses.dataclass(frozen=True)
class Statement:
    """An expression of a component that is checked: what messages call it, and how its misfits are found."""

    text: str
    expression: sympy.Expr
    misfits: Callable[[Node, UnitOf], list[str]]


def check_units(diagram: AcausalDiagram) -> None:
    """**Raises:**

    - `UnitError` that lists what does not fit.
    - `ImportError` without the package that reads units.
    """
    model = ModelNumbers(diagram)
    units = _DeclaredUnits(model)
    wrong = [*units.unknown, *_misfits_in_components(model, units), *_misfits_of_signals(model, diagram, units)]
    if wrong:
        places = "1 place" if len(wrong) == 1 else f"{len(wrong)} places"
        rest = [f"… and {len(wrong) - SHOWN} more"] if len(wrong) > SHOWN else []
        raise UnitError("\n- ".join([f"units do not fit in {places}:", *wrong[:SHOWN], *rest]))


class _DeclaredUnits:
    """The units of all variables and parameters of a model; `unknown` lists texts that are not units."""

    def __init__(self, model: ModelNumbers):
        self.model = model
        self.unknown: list[str] = []
        texts: dict[str, list[str]] = {}

        def read(name: str, declared: Variable | Parameter) -> Unit | None:
            try:
                return read_unit(declared.unit)
            except UnknownUnit as why:
                texts.setdefault(declared.unit, []).append(
                    f"'{name}' has the unit '{declared.unit}', but {why}: units are texts such as 'm/s', 'N*m' or "
                    "'kg/(m*s)', '1' for a number, '' if there is none"
                )
                return None

        self.variables: list[Unit | None] = [None] * model.n_variables
        self.parameters: list[Unit | None] = [None] * model.n_parameters
        for i in model.instances:
            of_variables = self.variables, i.variable, i.component.variables
            of_parameters = self.parameters, i.parameter, i.component.parameters
            for units, first, declarations in (of_variables, of_parameters):
                for k, (name, declared) in enumerate(declarations.items()):
                    unit = read(f"{model.path(i)}.{name}", declared)
                    for place in (first + k).tolist():
                        units[place] = unit
        for found in texts.values():
            more = f" ({len(found) - 1} more have it)" if len(found) > 1 else ""
            self.unknown.append(found[0] + more)

    def of(self, i: Instances, label: tuple) -> Unit | None:
        """The unit of a leaf in an expression of a component; it is the same for all of an array."""
        if label == TIME_LABEL:
            return SECOND
        if label[0] != "variable":
            found = None if label[1].startswith(RELATION) else self.model.resolve(i, label[1], "parameters")
            return None if found is None else self.parameters[found[0]]
        found = self.model.resolve(i, label[1], "variables")
        unit = None if found is None else self.variables[found[0]]
        return None if unit is None else rate(unit, label[2])


def _misfits_in_components(model: ModelNumbers, units: _DeclaredUnits) -> list[str]:
    by_shape: dict[tuple, tuple[list[tuple], dict[tuple, list[Instances]]]] = {}
    for i in model.instances:
        outside, same = by_shape.setdefault(_shape(i.component), ([], {}))
        if not same:
            outside.extend(_outside(i.component))
        # Units of its own belong to the shape. What a component reads of its parent and of children may differ between
        # equals.
        same.setdefault(tuple(units.of(i, label) for label in outside), []).append(i)
    read_once: dict[sympy.Expr, Node] = {}
    wrong = []
    for _, same in by_shape.values():
        for members in same.values():
            i, others = members[0], sum(map(len, members)) - 1
            component, path = i.component, model.path(members[0])

            def unit_of(label: tuple, i: Instances = i) -> Unit | None:
                return units.of(i, label)

            for statement in _statements(component, unit_of):
                if statement.expression not in read_once:
                    read_once[statement.expression] = read_expression(statement.expression, path)
                where = f"{path} ({type(component).__name__}): {statement.text}"
                more = f" ({others} more components like it)" if others else ""
                found = statement.misfits(read_once[statement.expression], unit_of)
                wrong.extend(f"{where}: {misfit}{more}" for misfit in found)
    return wrong


def _shape(component: Component) -> tuple:
    """Equal for components in which the same is checked, but for what their symbols mean outside of them."""
    return (
        type(component),
        tuple(component.equations),
        tuple((v.name, v.unit, _symbolic(v.start)) for v in component.variables.values()),
        tuple((p.name, p.unit, _symbolic(p.value)) for p in component.parameters.values()),
        tuple(component.accounts),
        tuple((when.text, when.clock, _targets(when)) for when in component.events),
    )


def _symbolic(value: object) -> sympy.Expr | None:
    return value if isinstance(value, sympy.Expr) and not value.is_number else None


def _outside(component: Component) -> list[tuple]:
    """Labels of what a component's expressions read of its children and of its parent."""
    own = {*component.variables, *component.parameters}
    labels: set[tuple] = {
        symbol_label(symbol)
        for statement in _statements(component, lambda label: None)
        for symbol in symbols_of(statement.expression)
    }
    labels |= {symbol_label(target) for when in component.events for target in _targets(when)}
    return sorted((label for label in labels if label != TIME_LABEL and label[1] not in own), key=str)


def _targets(when: When) -> tuple[sympy.Symbol, ...]:
    return tuple(action.target for action in when.actions if not isinstance(action, Terminate))


def _statements(component: Component, unit_of: UnitOf) -> Iterator[Statement]:
    """All that is checked of a component."""
    guards = {when.guard: when for when in component.events if when.guard is not None}
    writes = {
        value: (when, action)
        for when in component.events
        for value, action in zip(when.values, when.actions, strict=True)
        if isinstance(value, str) and not isinstance(action, Terminate)
    }
    # A relation that is an event stands in an equation, too.
    unseen = {
        name for when in component.events if EventFlag.LISTED not in when.flags for name in (when.guard, *when.values)
    }
    for equation in (component.as_written.get(e, e) for e in component.equations):
        # What events compute are hidden variables, each with an equation of its own.
        event = None
        if guards or writes:
            event = next((s for s in symbols_of(equation) if s.name in guards or s.name in writes), None)
        if event is None:
            yield Statement(f"0 = {shortened(equation)}", equation, misfits_of_equation)
        elif event.name in unseen:
            continue
        elif event.name in guards:
            yield Statement(f"when({guards[event.name].text})", event - equation, misfits_of_condition)
        else:
            when, action = writes[event.name]
            target = action.target
            value = event - equation
            text = f"when({when.text}), {type(action).__name__.lower()}({target}, {shortened(value)})"
            yield _given(text, str(target), value, unit_of(symbol_label(target)))
    for name, variable in component.variables.items():
        if _symbolic(variable.start) is not None:
            of = name.removesuffix(START)  # x, der(x), der(der(x)), …
            order = of.count("der(") if of != name else 0
            label = ("variable", of[4 * order : len(of) - order], order)
            yield _given(f"the start of '{of}' = {shortened(variable.start)}", of, variable.start, unit_of(label))
    for name, parameter in component.parameters.items():
        value = _symbolic(parameter.value)
        if value is not None:
            yield _given(f"'{name}' = {shortened(value)}", name, value, unit_of(("parameter of", name)))
    for when in component.events:
        if isinstance(when.clock, Sampled) and (EventFlag.LISTED in when.flags):
            for what, value in (("period", when.clock.period), ("offset", when.clock.offset)):
                if value is not None and _symbolic(value) is not None:
                    yield _given(f"the {what} of {when.text} = {shortened(value)}", f"a {what}", value, SECOND)
    for account in component.accounts:
        text = f"the {account.kind} {shortened(account.expression)}"
        yield _given(text, account.kind, account.expression, ACCOUNTS[account.kind])


def _given(text: str, name: str, expression: sympy.Expr, expected: Unit | None) -> Statement:
    """An expression that gives what is called `name` its value."""
    return Statement(text, expression, lambda graph, unit_of: misfits_of_value(graph, unit_of, expected, name))


def _misfits_of_signals(model: ModelNumbers, diagram: AcausalDiagram, units: _DeclaredUnits) -> Iterator[str]:
    for i, signals in [(None, diagram.signals), *((i, i.component.signals) for i in model.instances)]:
        for signal in signals:
            named = []
            for symbol in signal:
                found = model.resolve(i, symbol.path, "variables")
                named.append((symbol.path, None if found is None else units.variables[found[0]]))
            wrong = misfit_of_units(named)
            if wrong is not None:
                where = "diagram" if i is None else f"{model.path(i)} ({type(i.component).__name__})"
                yield f"{where}: connect({', '.join(name for name, _ in named)}): {wrong}"
