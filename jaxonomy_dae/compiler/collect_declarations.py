"""What components declare of variables and parameters, as tables."""

from typing import Any

import numpy as np
import sympy

from ..errors import ModelError
from ..model.dependent_parameters import complete
from ..model.symbolic import SymbolicTemplate, canonical
from ..model.tables import DependentParameters, ParameterTable, Start, VariableTable
from ..modeling.declarations import full_name
from ..modeling.events import LIVE
from ..modeling.interval import Interval
from .number_model import ModelNumbers
from .read_equations import read_expression


def variable_table(model: ModelNumbers, driven: set[int]) -> VariableTable:
    names: list[str] = []
    start: list[Start | None] = []
    unit: list[str] = []
    default: list[float | None] = []
    is_input, is_port, is_internal, fixed, nominal, bounds, owner, port, is_across = [], [], [], [], [], [], [], [], []
    n_ports = 0
    expressions: dict[sympy.Expr, tuple[SymbolicTemplate, list[str]]] = {}
    for k, component in enumerate(model.components):
        path = model.paths[k]
        place: dict[str, tuple[int, bool]] = {}
        for p in component.ports.values():
            for table, across in ((p.domain.across, True), (p.domain.through, False)):
                place |= {f"{p.name}.{name}": (n_ports, across) for name, _ in table}
            n_ports += 1
        for variable in component.variables.values():
            names.append(full_name(path, variable.name))
            is_input.append(variable.kind == "input" and len(is_input) not in driven)
            is_port.append(variable.kind == "port")
            is_internal.append(variable.kind in ("start", "event"))
            fixed.append(variable.fixed)
            nominal.append(variable.nominal)
            bounds.append(variable.bounds)
            unit.append(variable.unit)
            default.append(variable.default if is_input[-1] else None)
            owner.append(k)
            port.append(place.get(variable.name, (-1, False))[0])
            is_across.append(place.get(variable.name, (-1, False))[1])
            if variable.start is None:
                start.append(None)
                continue
            if variable.start not in expressions:
                symbols = sorted(variable.start.free_symbols, key=lambda s: model.parameter(k, s.path))  # type: ignore
                graph = read_expression(variable.start, path)
                expressions[variable.start] = (canonical(graph, (), symbols), [s.path for s in symbols])  # type: ignore
            template, paths = expressions[variable.start]
            start.append(Start(template, tuple(model.parameter(k, p) for p in paths)))
    return VariableTable(
        names,
        np.array(is_input, bool),
        np.array(is_port, bool),
        start,
        np.array(fixed, bool),
        np.array(nominal, float),
        np.array([(b.low, b.high) for b in bounds], float).reshape(-1, 2),
        unit,
        default,
        np.array(owner, np.int64),
        np.array(port, np.int64),
        np.array(is_across, bool),
        np.array(is_internal, bool),
    )


def parameter_table(model: ModelNumbers) -> ParameterTable:
    names, values, units, bounds = [], [], [], []
    reads: dict[int, tuple[sympy.Expr, list[int]]] = {}  # of the dependent ones: the expression, what it reads
    expressions: dict[int, str] = {}
    for k, component in enumerate(model.components):
        for parameter in component.parameters.values():
            value = parameter.value
            if isinstance(value, sympy.Expr):
                symbols: list[Any] = sorted(value.free_symbols, key=lambda s: s.path)  # type: ignore
                reads[len(names)] = value, [model.parameter(k, s.path) for s in symbols]
                value = 0.0
            names.append(f"{model.paths[k]}.{parameter.name}")
            values.append(value)
            units.append(parameter.unit)
            bounds.append(parameter.bounds)
    for p, (value, ids) in reads.items():
        symbols = sorted(value.free_symbols, key=lambda s: s.path)  # type: ignore
        full = {s: sympy.Symbol(names[i]) for s, i in zip(symbols, ids, strict=True)}
        expressions[p] = str(value.xreplace(full))
    dependents = _dependent_parameters(reads, expressions, names)
    array = complete(dependents, np.array(values, np.float64))
    for p in reads:
        if float(array[p]) not in bounds[p]:
            must = f"lie in {bounds[p]}" if np.isfinite(array[p]) else "be finite"
            raise ModelError(f"parameter '{names[p]}' is {expressions[p]} and must {must}; got {array[p]:g}")
    # Beside what was declared: relations that are events, 2 while they are as their sides say, and what discrete
    # variables were before an event.
    n_relations = len(model.relations)
    names += [f"relation {k}" for k in range(n_relations)]
    array = np.concatenate([array, np.full(n_relations, float(LIVE))])
    n_more = n_relations + len(model.discrete)
    return ParameterTable(
        [*names, *(f"pre({names[p]})" for p in model.discrete)],
        np.concatenate([array, array[model.discrete]]),
        [*units, *[""] * n_more],
        [*bounds, *[Interval()] * n_more],
        dependents,
        expressions,
        model.discrete,
        n_relations,
    )


def _dependent_parameters(
    reads: dict[int, tuple[sympy.Expr, list[int]]], expressions: dict[int, str], names: list[str]
) -> tuple[DependentParameters, ...]:
    """Groups of equal templates, in an order in which everything that one reads is known."""
    groups: list[DependentParameters] = []
    known_templates: dict[sympy.Expr, SymbolicTemplate] = {}
    left = dict(reads)
    while left:
        ready = [p for p, (_, ids) in left.items() if not any(i in left for i in ids)]
        if not ready:
            p = next(iter(left))
            raise ModelError(f"parameter '{names[p]}' is {expressions[p]}, which depends on itself")
        rows: dict[str, tuple[SymbolicTemplate, list[int], list[list[int]]]] = {}
        for p in ready:
            expression, ids = left.pop(p)
            if expression not in known_templates:
                symbols: list[Any] = sorted(expression.free_symbols, key=lambda s: s.path)  # type: ignore
                graph = read_expression(expression, names[p].rpartition(".")[0])
                known_templates[expression] = canonical(graph, (), symbols)
            template = known_templates[expression]
            _, targets, parameters = rows.setdefault(template.key, (template, [], []))
            targets.append(p)
            parameters.append(ids)
        for template, targets, parameters in rows.values():
            groups.append(DependentParameters(template, np.array(targets), np.array(parameters, np.int64)))
    return tuple(groups)
