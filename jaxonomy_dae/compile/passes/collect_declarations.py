"""What components declare of variables and parameters, as tables."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import DTypeLike

from ...base.errors import ModelError
from ...write.declarations import EachValue, Variable
from ...write.interval import Interval
from ..model.names import Names
from ..model.starts import Formulas, Starts
from ..model.symbolic import SymbolicTemplate, canonical
from ..model.tables import ParameterTable, VariableTable, complete
from .number_model import Instances, ModelNumbers
from .read_equations import read_expression


def variable_table(model: ModelNumbers, driven: set[int]) -> VariableTable:
    records: list[tuple[Variable, int, int]] = []  # variables as declared, each with its port and its potential
    potentials: dict[tuple[str, str], int] = {}
    record = np.empty(model.n_variables, np.int32)
    places: list[int] = []
    rows: list[int] = []
    started: list[tuple[Variable, Instances, int]] = []
    for i in model.instances:
        component = i.component
        in_port = {
            f"{p.name}.{name}": (j, potentials.setdefault((p.domain.name, name), len(potentials)) if is_across else -1)
            for j, p in enumerate(component.ports.values())
            for table, is_across in ((p.domain.across, True), (p.domain.through, False))
            for name, _ in table
        }
        first = len(records)
        for k, variable in enumerate(component.variables.values()):
            records.append((variable, *in_port.get(variable.name, (-1, -1))))
            if variable.start is not None:
                started.append((variable, i, k))
        n = len(component.variables)
        if len(i) == 1:
            start = int(i.variable[0])
            places.extend(range(start, start + n))
            rows.extend(range(first, first + n))
        else:
            record[i.variable[:, None] + np.arange(n)] = first + np.arange(n)
    record[places], owner = rows, model.variable_names.owner

    def column(of, dtype: DTypeLike) -> np.ndarray:
        return np.array([of(*entry) for entry in records], dtype)[record]

    first_port = np.empty(model.n_components, np.int32)
    for i in model.instances:
        first_port[i.number] = i.port
    own_port = column(lambda v, p, a: p, np.int32)
    port = np.where(own_port >= 0, first_port[owner] + own_port, np.int32(-1))
    is_input = column(lambda v, p, a: v.kind == "input", bool)
    is_input[list(driven)] = False
    default = column(lambda v, p, a: v.default, object)
    default[~is_input] = None
    bounds = np.array([(v.bounds.low, v.bounds.high) for v, *_ in records], float).reshape(-1, 2)
    return VariableTable(
        names=model.variable_names,
        is_input=is_input,
        is_port=column(lambda v, p, a: v.kind == "port", bool),
        start=_starts(model, started),
        fixed=column(lambda v, p, a: v.fixed, bool),
        nominal=column(lambda v, p, a: v.nominal, float),
        bounds=bounds[record],
        unit=column(lambda v, p, a: v.unit, object).tolist(),
        default=default.tolist(),
        owner=owner,
        port=port,
        potential=column(lambda v, p, a: a, np.int32),
        potentials=tuple(potentials),
        is_internal=column(lambda v, p, a: v.kind in ("start", "event"), bool),
    )


def _starts(model: ModelNumbers, started: Sequence[tuple[Variable, Instances, int]]) -> Starts:
    """The starts of variables, each declared as the k-th of a component."""
    read: dict[sympy.Expr, tuple[SymbolicTemplate, list[str]]] = {}
    groups: dict[tuple[str, tuple[str, ...]], tuple[SymbolicTemplate, list[str], list[tuple[Instances, int]]]] = {}
    for variable, i, k in started:
        expression = variable.start
        if expression not in read:
            # A set of symbols has another order in each process, and templates are told apart by the places of their
            # parameters.
            symbols: list[Any] = sorted(expression.free_symbols, key=lambda s: int(model.parameter(i, s.path)[0]))
            graph = read_expression(expression, model.path(i))
            read[expression] = canonical(graph, (), symbols), [s.path for s in symbols]
        template, paths = read[expression]
        groups.setdefault((template.key, tuple(paths)), (template, paths, []))[2].append((i, k))
    found = []
    for template, paths, members in groups.values():
        ids = np.concatenate([i.variable + k for i, k in members])
        columns = [np.concatenate(c) for c in zip(*_parameters(model, members, paths), strict=True)]
        found.append(Formulas.of(template, ids, np.stack(columns, axis=1) if columns else np.zeros((len(ids), 0))))
    return Starts(model.n_variables, found)


def _parameters(model: ModelNumbers, members: Sequence[tuple[Instances, int]], paths: Sequence[str]):
    """The ids of parameters for each member, one array for each path."""
    for i, _ in members:
        own = i.parameter_positions
        yield [i.parameter + own[path] if path in own else model.parameter(i, path) for path in paths]


def parameter_table(model: ModelNumbers) -> tuple[ParameterTable, np.ndarray]:
    """The declarations of all parameters, and their values."""
    n, names = model.n_parameters, model.parameter_names
    units, bounds = np.empty((2, n), object)
    values = np.zeros(n)
    reads: dict[int, tuple[sympy.Expr, list[int]]] = {}  # of the dependent ones: the expression, what it reads
    for i in model.instances:
        for k, parameter in enumerate(i.component.parameters.values()):
            value, at = parameter.value, i.parameter + k
            units[at], bounds[at] = parameter.unit, parameter.bounds
            if isinstance(value, sympy.Expr):
                symbols: list[Any] = sorted(value.free_symbols, key=lambda s: s.path)  # type: ignore
                columns = np.stack([model.parameter(i, s.path) for s in symbols], axis=1)
                reads.update((p, (value, row)) for p, row in zip(at.tolist(), columns.tolist(), strict=True))
            else:
                values[at] = value.values[_place_in(value, i)] if isinstance(value, EachValue) else value
    expressions: dict[int, str] = {}
    for p, (value, ids) in sorted(reads.items()):
        symbols = sorted(value.free_symbols, key=lambda s: s.path)  # type: ignore
        full = {s: sympy.Symbol(names[i]) for s, i in zip(symbols, ids, strict=True)}
        expressions[p] = str(value.xreplace(full))
    reads = dict(sorted(reads.items()))
    dependents = _dependent_parameters(reads, expressions, names)
    array = complete(dependents, values)
    for p in reads:
        if float(array[p]) not in bounds[p]:
            must = f"lie in {bounds[p]}" if np.isfinite(array[p]) else "be finite"
            raise ModelError(f"parameter '{names[p]}' is {expressions[p]} and must {must}; got {array[p]:g}")
    # Beside what was declared: hidden discrete variables, such as relations that are events, and what discrete
    # variables were before an event.
    n_relations = len(model.relations)
    names = names.followed_by([f"relation {k}" for k in range(n_relations)])
    starts = np.zeros(n_relations)
    for i in model.instances:
        starts[i.relation[:, None] - model.n_parameters + np.arange(len(i.component.relations))] = i.component.relations
    n_more = n_relations + len(model.discrete)
    table = ParameterTable(
        names.followed_by([f"pre({names[p]})" for p in model.discrete.tolist()]),
        [*units, *[""] * n_more],
        [*bounds, *[Interval()] * n_more],
        dependents,
        expressions,
        model.discrete,
        model.n_shown,
        starts,
    )
    return table, table.everything(array)


def _place_in(value: EachValue, i: Instances) -> np.ndarray:
    """For each instance, the position of its value in `value.values`, shape (instances,)."""
    rows, at = np.arange(len(i)), i
    while at.component is not value.prototype:
        assert at.parent is not None
        rows, at = at.up[rows], at.parent
    return rows % len(value.values)


def _dependent_parameters(
    reads: dict[int, tuple[sympy.Expr, list[int]]], expressions: dict[int, str], names: Names
) -> tuple[Formulas, ...]:
    """Groups of equal templates, in an order in which everything that one reads is known."""
    groups: list[Formulas] = []
    known_templates: dict[sympy.Expr, SymbolicTemplate] = {}
    left = dict(reads)
    while left:
        # By levels, so that all of one template at a level are computed at once.
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
            groups.append(Formulas.of(template, targets, parameters))
    return tuple(groups)
