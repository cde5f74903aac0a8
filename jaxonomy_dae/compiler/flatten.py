"""Flatten: components and connections become integer tables.

Given a diagram, returns a `FlatModel`: one id for each variable and parameter, one group of rows for each equation
template. Components of equal shape (same declarations, literally the same equations) are treated together, so the
symbolic work does not grow with the number of instances.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy

from ..errors import ModelError, nearest
from ..expressions.from_sympy import UnsupportedExpression, read, symbols_of
from ..expressions.node import Node
from ..expressions.to_sympy import shortened
from ..model.dependent_parameters import complete
from ..model.linear_template import LinearTemplate
from ..model.opaque import OpaqueFunction, OpaqueTemplate
from ..model.symbolic import SymbolicTemplate, canonical, linear_coefficients
from ..model.tables import (
    DependentParameters,
    EquationGroup,
    FlatModel,
    ParameterTable,
    PortTable,
    RowInjection,
    Start,
    VariableTable,
)
from ..model.template import AbstractTemplate
from ..modeling.component import Component
from ..modeling.connections import Signal
from ..modeling.diagram import AcausalDiagram
from ..modeling.ports import Port
from ..modeling.symbols import ParameterSymbol, TimeSymbol, VariableSymbol, symbol_label


@dataclasses.dataclass
class _Rows:
    """A group under construction."""

    template: AbstractTemplate
    variable: list[np.ndarray] = dataclasses.field(default_factory=list)
    order: list[np.ndarray] = dataclasses.field(default_factory=list)
    parameter: list[np.ndarray] = dataclasses.field(default_factory=list)
    coefficient: list[np.ndarray] = dataclasses.field(default_factory=list)
    origin: list[str] = dataclasses.field(default_factory=list)


class GroupBuilder:
    """Collects equation rows by template."""

    def __init__(self):
        self._rows: dict[str, _Rows] = {}

    def add(self, template: AbstractTemplate, variable, order, parameter, coefficient, origin: Sequence[str]):
        """Adds n instances: arrays of shape (n, slots), (n, slots), (n, parameters), (n, coefficients)."""
        rows = self._rows.setdefault(template.key, _Rows(template))
        n = len(origin)
        rows.variable.append(np.asarray(variable, np.int64).reshape(n, -1))
        rows.order.append(np.asarray(order, np.int64).reshape(n, -1))
        rows.parameter.append(np.asarray(parameter, np.int64).reshape(n, template.n_parameters))
        rows.coefficient.append(np.asarray(coefficient, np.float64).reshape(n, template.n_coefficients))
        rows.origin.extend(origin)

    def add_linear(self, terms: Sequence[tuple[int, int, float]], origin: str):
        """Adds Σ coefficient·variable^(order) = 0."""
        variable, order, coefficient = zip(*terms, strict=True)
        self.add(LinearTemplate(len(terms)), [variable], [order], np.zeros((1, 0)), [coefficient], [origin])

    def groups(self) -> tuple[EquationGroup, ...]:
        out = []
        for rows in self._rows.values():
            variable = np.concatenate(rows.variable)
            out.append(
                EquationGroup(
                    rows.template,
                    variable,
                    np.concatenate(rows.order),
                    np.ones_like(variable),
                    np.concatenate(rows.parameter),
                    np.concatenate(rows.coefficient),
                    rows.origin,
                )
            )
        return tuple(out)


class _Model:
    """Ids of everything in a diagram, in the order it was added."""

    def __init__(self, diagram: AcausalDiagram):
        self.components: list[Component] = []
        self.top = diagram.components
        stack = list(reversed(diagram.components.values()))
        while stack:
            component = stack.pop()
            self.components.append(component)
            stack.extend(reversed(component.children.values()))
        if not self.components:
            raise ModelError("the diagram has no components: add some with diagram.add(...)")
        self.index = {id(c): k for k, c in enumerate(self.components)}
        paths: dict[int, str] = {}
        for c in self.components:
            paths[id(c)] = c.name if c.parent is None else f"{paths[id(c.parent)]}.{c.name}"
        self.paths = [paths[id(c)] for c in self.components]
        n_variables = [len(c.variables) for c in self.components]
        n_parameters = [len(c.parameters) for c in self.components]
        self.first_variable = np.concatenate([[0], np.cumsum(n_variables)]).astype(np.int64)
        self.first_parameter = np.concatenate([[0], np.cumsum(n_parameters)]).astype(np.int64)
        # One position table for each distinct list of names.
        self._positions: dict[tuple[str, ...], dict[str, int]] = {}
        self.variable_positions = [self._position(tuple(c.variables)) for c in self.components]
        self.parameter_positions = [self._position(tuple(c.parameters)) for c in self.components]

    def _position(self, names: tuple[str, ...]) -> dict[str, int]:
        return self._positions.setdefault(names, {n: k for k, n in enumerate(names)})

    def _resolve(self, k: int | None, path: str, table: str) -> int | None:
        """The id behind a path as component k sees it, or the diagram if k is None."""
        positions = self.variable_positions if table == "variables" else self.parameter_positions
        first = self.first_variable if table == "variables" else self.first_parameter
        component = None if k is None else self.components[k]
        while path.startswith("../"):
            if component is None:
                return None
            path, component = path[3:], component.parent
        if component is not None and path in positions[self.index[id(component)]]:
            j = self.index[id(component)]
            return int(first[j]) + positions[j][path]
        while "." in path:
            head, path = path.split(".", 1)
            children = self.top if component is None else component.children
            if head not in children:
                return None
            component = children[head]
            j = self.index[id(component)]
            if path in positions[j]:
                return int(first[j]) + positions[j][path]
        return None

    def variable(self, k: int, path: str) -> int:
        found = self._resolve(k, path, "variables")
        if found is None:
            component = self.components[k]
            inside = [
                *component.variables,
                *(f"{c.name}.{v}" for c in component.children.values() for v in c.variables),
            ]
            raise ModelError(
                f"component '{self.paths[k]}': the symbol '{path}' in its equations is no variable of it or of a child "
                "component: " + nearest(path, inside)
            )
        return found

    def parameter(self, k: int, path: str) -> int:
        found = self._resolve(k, path, "parameters")
        if found is None:
            component = self.components[k]
            if path.startswith("../"):
                parent = "the diagram" if component.parent is None else f"'{component.parent.path}'"
                raise ModelError(
                    f"component '{self.paths[k]}' was given an expression in the parameter '{path[3:]}', which is not "
                    f"known in {parent}, where the component is: add it where its parameters are"
                )
            raise ModelError(
                f"component '{self.paths[k]}': the symbol '{path}' in its equations is not a parameter of it or of a "
                "child component: " + nearest(path, component.parameters)
            )
        return found

    def port_variable(self, port: Port, name: str) -> int:
        k = self.index.get(id(port.component))
        if k is None:
            raise ModelError(f"{port!r} is connected, but its component is not part of the diagram: add it")
        return int(self.first_variable[k]) + self.variable_positions[k][f"{port.name}.{name}"]


def flatten(diagram: AcausalDiagram) -> FlatModel:
    """Flattens a diagram.

    **Raises:**

    - `ModelError` for symbols no component declares, ports of components that are not in the diagram, and targets or
        inputs of neural blocks that do not exist.
    """
    model = _Model(diagram)
    builder = GroupBuilder()
    networks: dict[str, Any] = {}
    _add_components(model, builder)
    _add_learned_terms(model, builder, networks)
    ports = _add_connections(model, diagram, builder)
    driven = _add_signals(model, diagram, builder)
    variables = _variable_table(model, driven)
    parameters = _parameter_table(model)
    groups = builder.groups()
    variables, groups, rows = _add_blocks(model, diagram, variables, groups, networks)
    return FlatModel(variables, parameters, groups, networks, rows, model.paths, ports, diagram.name or "")


def _add_components(model: _Model, builder: GroupBuilder):
    read_once: dict[int, Any] = {}  # of an expression, by its id: equal components hold the same objects
    by_shape: dict[tuple, list[int]] = {}
    for k, c in enumerate(model.components):
        if c.equations:
            for residual in c.equations:
                if id(residual) not in read_once:
                    read_once[id(residual)] = _read(residual, model.paths[k])
            graphs = tuple(read_once[id(r)] for r in c.equations)
            by_shape.setdefault((graphs, tuple(c.variables), tuple(c.parameters)), []).append(k)
    for (graphs, local_variables, local_parameters), members in by_shape.items():
        position = {name: k for k, name in enumerate((*local_variables, *local_parameters))}
        for graph, residual in zip(graphs, model.components[members[0]].equations, strict=True):
            # Slots follow the order of declaration, never names, so names change nothing but names.
            def rank(s, position=position, members=members):
                # Symbols of children come after one's own, in the order the children's ids give.
                if s.path in position:
                    return (0, position[s.path], getattr(s, "order", 0))
                resolve = model.variable if isinstance(s, VariableSymbol) else model.parameter
                return (1, resolve(members[0], s.path), getattr(s, "order", 0))

            symbols = [s for s in symbols_of(residual) if symbol_label(s) in graph.leaves]
            for s in symbols:
                if not isinstance(s, VariableSymbol | ParameterSymbol | TimeSymbol):
                    raise ModelError(
                        f"component '{model.paths[members[0]]}': the symbol '{s}' was declared by no component; "
                        "declare it with self.variable(...) or self.parameter(...) and use the symbol that returns"
                    )
            variables = sorted((s for s in symbols if isinstance(s, VariableSymbol)), key=rank)
            parameters = sorted((s for s in symbols if isinstance(s, ParameterSymbol)), key=rank)
            coefficients = linear_coefficients(graph, variables)
            ids = _ids(model, members, [v.path for v in variables], "variable")
            parameter_ids = _ids(model, members, [p.path for p in parameters], "parameter")
            order = np.tile([v.order for v in variables], (len(members), 1))
            text = f"0 = {shortened(residual)}"
            origin = [f"{model.paths[k]}: {text}" for k in members]
            if coefficients is None:
                template: AbstractTemplate = canonical(graph, variables, parameters)
                builder.add(template, ids, order, parameter_ids, np.zeros((len(members), 0)), origin)
            else:
                template = LinearTemplate(len(variables))
                rows = np.tile(coefficients, (len(members), 1))
                builder.add(template, ids, order, np.zeros((len(members), 0)), rows, origin)


def _read(expression: Any, component: str) -> Node:
    try:
        return read(expression, symbol_label)
    except UnsupportedExpression as error:
        raise ModelError(f"component '{component}': 0 = {shortened(expression)}: {error}") from None


def _ids(model: _Model, members: list[int], paths: list[str], kind: str) -> np.ndarray:
    """Ids of `paths` in each member component, shape (members, paths)."""
    out = np.empty((len(members), len(paths)), np.int64)
    for j, path in enumerate(paths):
        positions = (model.variable_positions if kind == "variable" else model.parameter_positions)[members[0]]
        if path in positions:
            first = model.first_variable if kind == "variable" else model.first_parameter
            out[:, j] = first[members] + positions[path]
        else:
            resolve = model.variable if kind == "variable" else model.parameter
            out[:, j] = [resolve(k, path) for k in members]
    return out


def _add_learned_terms(model: _Model, builder: GroupBuilder, networks: dict[str, Any]):
    for k, component in enumerate(model.components):
        for term in component.learned_terms:
            name = f"{model.paths[k]}.{term.name}"
            times = frozenset(j for j, s in enumerate(term.inputs) if isinstance(s, TimeSymbol))
            opaque = OpaqueFunction(len(networks), name, None, len(term.inputs), times)
            networks[name] = term.network
            inputs = [(model.variable(k, s.path), s.order) for s in term.inputs if isinstance(s, VariableSymbol)]
            for j, output in enumerate(term.outputs):
                _add_opaque(builder, opaque, j, (model.variable(k, output.path), 0), inputs)


def _add_opaque(builder: GroupBuilder, opaque: OpaqueFunction, output: int, y: tuple[int, int], inputs):
    pairs = [y, *inputs]
    builder.add(
        OpaqueTemplate(opaque, output),
        [[v for v, _ in pairs]],
        [[o for _, o in pairs]],
        np.zeros((1, 0)),
        np.zeros((1, 0)),
        [f"{opaque.name}: output {output} of the network"],
    )


def _add_connections(model: _Model, diagram: AcausalDiagram, builder: GroupBuilder) -> PortTable:
    """Across variables of joined ports are equal, their through variables sum to zero; loose ports carry none.

    A port has two faces: the outer one joins in the connections of the component's parent, the inner one in those of
    the component itself, where its through variables count negative.
    """
    parent: dict[tuple[int, int], tuple[int, int]] = {}  # faces (port id, 0 outer | 1 inner)
    ports: dict[int, Port] = {}
    for component in model.components:
        for port in component.ports.values():
            ports[id(port)] = port
            parent[id(port), 0] = (id(port), 0)
    rank = {key: k for k, key in enumerate(ports)}

    def find(face):
        while parent[face] != face:
            parent[face] = parent[parent[face]]
            face = parent[face]
        return face

    def join(connections, owner: Component | None):
        for ends in connections:
            faces = []
            for port in ends:
                if id(port) not in ports:
                    raise ModelError(f"{port!r} is connected, but its component is not part of the diagram: add it")
                if owner is not None and port.component is not owner and port.component.parent is not owner:
                    raise ModelError(
                        f"component '{owner.path}' connects {port!r}: it can connect its own ports and its children's"
                    )
                inner = int(owner is not None and port.component is owner)
                faces.append((id(port), inner))
                parent.setdefault(faces[-1], faces[-1])
            for face in faces[1:]:
                a, b = find(faces[0]), find(face)
                if a != b:
                    parent[max(a, b, key=lambda f: (rank[f[0]], f[1]))] = min(a, b, key=lambda f: (rank[f[0]], f[1]))

    join(diagram.connections, None)
    for component in model.components:
        join(component.connections, component)
    sets: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for face in sorted(parent, key=lambda f: (rank[f[0]], f[1])):
        sets.setdefault(find(face), []).append(face)
    loose: set[int] = set()
    for faces in sets.values():
        members = [ports[p] for p, _ in faces]
        if len(faces) == 1 and faces[0][1] == 0:
            loose.add(faces[0][0])
        where = ", ".join(f"{model.paths[model.index[id(p.component)]]}.{p.name}" for p in members[:4])
        where += ", …" if len(members) > 4 else ""
        kind = "connection of" if len(faces) > 1 else "unconnected port"
        domain = members[0].domain
        for name, _ in domain.across:
            first = model.port_variable(members[0], name)
            for port in members[1:]:
                other = model.port_variable(port, name)
                builder.add_linear([(first, 0, 1.0), (other, 0, -1.0)], f"{kind} {where}: equal {name}")
        for name, _ in domain.through:
            terms = [
                (model.port_variable(port, name), 0, -1.0 if inner else 1.0)
                for port, (_, inner) in zip(members, faces, strict=True)
            ]
            builder.add_linear(terms, f"{kind} {where}: {name} sums to zero")
    return PortTable(
        [f"{model.paths[model.index[id(p.component)]]}.{p.name}" for p in ports.values()],
        [p.domain.name for p in ports.values()],
        np.array([key in loose for key in ports], bool),
        np.array([(key, 1) in parent for key in ports], bool),
    )


def _add_signals(model: _Model, diagram: AcausalDiagram, builder: GroupBuilder) -> set[int]:
    """Inputs equal what drives them; returns the inputs that are driven, which are unknowns from then on."""
    owners: list[tuple[int | None, Sequence[Signal]]] = [(None, diagram.signals)]
    owners.extend((k, c.signals) for k, c in enumerate(model.components) if c.signals)
    if not any(signals for _, signals in owners):
        return set()
    names, is_input = [], []
    for path, component in zip(model.paths, model.components, strict=True):
        names.extend(f"{path}.{v}" for v in component.variables)
        is_input.extend(v.kind == "input" for v in component.variables.values())
    driven: dict[int, str] = {}
    for k, signals in owners:
        where = "diagram" if k is None else f"component '{model.paths[k]}'"
        for signal in signals:
            ids = []
            for symbol in signal:
                found = model._resolve(k, symbol.path, "variables")
                if found is None:
                    raise ModelError(
                        f"{where}: '{symbol.path}' is connected, but it is not a variable there: add the component to "
                        "the diagram, and connect what it, or its direct children, declare"
                    )
                ids.append(found)
            # A component's own input is given from outside; inside it drives like any variable.
            drives = [not is_input[v] or "." not in s.path for v, s in zip(ids, signal, strict=True)]
            what = ", ".join(f"'{names[v]}'" for v in ids)
            if sum(drives) != 1:
                count = "none of them drives the others" if not any(drives) else "more than one is not an input"
                raise ModelError(
                    f"{where}: connect({what}) joins one variable with inputs; {count}. (Two variables are made equal "
                    "by an equation, Eq(a.x, b.x), in the component that holds both.)"
                )
            source = ids[drives.index(True)]
            for v, drive in zip(ids, drives, strict=True):
                if drive:
                    continue
                if v in driven:
                    raise ModelError(
                        f"{where}: the input '{names[v]}' is driven by '{driven[v]}' already, so '{names[source]}' "
                        "cannot drive it too"
                    )
                driven[v] = names[source]
                builder.add_linear(
                    [(v, 0, 1.0), (source, 0, -1.0)], f"connection of {names[source]}, {names[v]}: equal signals"
                )
    return set(driven)


def _variable_table(model: _Model, driven: set[int]) -> VariableTable:
    names: list[str] = []
    start: list[Start | None] = []
    unit: list[str] = []
    default: list[float | None] = []
    is_input, is_port, fixed, nominal, bounds, owner, port, is_across = [], [], [], [], [], [], [], []
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
            names.append(f"{path}.{variable.name}")
            is_input.append(variable.kind == "input" and len(is_input) not in driven)
            is_port.append(variable.kind == "port")
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
                graph = _read(variable.start, path)
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
    )


def _parameter_table(model: _Model) -> ParameterTable:
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
    return ParameterTable(names, array, units, bounds, dependents, expressions)


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
                known_templates[expression] = canonical(_read(expression, names[p].rpartition(".")[0]), (), symbols)
            template = known_templates[expression]
            _, targets, parameters = rows.setdefault(template.key, (template, [], []))
            targets.append(p)
            parameters.append(ids)
        for template, targets, parameters in rows.values():
            groups.append(DependentParameters(template, np.array(targets), np.array(parameters, np.int64)))
    return tuple(groups)


def _add_blocks(model: _Model, diagram: AcausalDiagram, variables: VariableTable, groups, networks):
    """Adds the learned corrections.

    `equation`: for a target v with corrections w₁, w₂, …, every equation that mentions dv/dt reads instead a new
    variable u, and dv/dt = u + w₁ + w₂ + … is added. `row`: kept for lowering.
    """
    rows: list[RowInjection] = []
    corrections: dict[int, list[int]] = {}
    builder = GroupBuilder()
    names = list(variables.names)
    known = {name: k for k, name in enumerate(names)}

    def find(reference, block, what: str) -> int:
        component, name = reference
        if component is not None:
            if id(component) not in model.index:
                raise ModelError(
                    f"neural block '{block.name}': its {what} '{component.path}.{name}' belongs to a component that "
                    "is not part of the diagram: add it"
                )
            name = f"{component.path}.{name}"
        if name not in known:
            raise ModelError(
                f"neural block '{block.name}': its {what} '{name}' is no variable: " + nearest(name, known)
            )
        return known[name]

    differentiated = np.zeros(len(names), bool)
    for group in groups:
        differentiated[group.variable[group.order > 0]] = True
    for block in diagram.blocks.values():
        targets = tuple(find(t, block, "target") for t in block.targets)
        times = frozenset(k for k, (c, n) in enumerate(block.inputs) if c is None and n == "time")
        inputs = tuple(find(r, block, "input") for k, r in enumerate(block.inputs) if k not in times)
        theta = block.theta is not None
        opaque = OpaqueFunction(len(networks), block.name, block.network if theta else None, len(block.inputs), times)
        networks[block.name] = block.theta if theta else block.network
        for v in targets:
            if not differentiated[v]:
                raise ModelError(
                    f"neural block '{block.name}': its target '{names[v]}' is differentiated in no equation, so there "
                    "is no derivative to correct; targets can be "
                    + ", ".join(repr(names[k]) for k in np.flatnonzero(differentiated)[:8])
                )
        if block.inject == "row":
            rows.append(RowInjection(opaque, targets, inputs))
            continue
        for j, v in enumerate(targets):
            w = len(names)
            names.append(f"{block.name}[{j}]")
            corrections.setdefault(v, []).append(w)
            _add_opaque(builder, opaque, j, (w, 0), [(i, 0) for i in inputs])
    if corrections:
        target_index = np.full(len(names) + len(corrections), -1)
        for v, ws in corrections.items():
            u = len(names)
            target_index[v] = u
            names.append(f"{names[v]}:physics")
            builder.add_linear(
                [(v, 1, 1.0), (u, 0, -1.0), *((w, 0, -1.0) for w in ws)], f"corrected derivative of {names[v]}"
            )
        redirected = []
        for group in groups:
            new = target_index[group.variable]
            hit = (new >= 0) & (group.order > 0)
            variable = np.where(hit, new, group.variable)
            order = np.where(hit, group.order - 1, group.order)
            redirected.append(dataclasses.replace(group, variable=variable, order=order))
        groups = (*redirected, *builder.groups())
    extra = len(names) - len(variables)
    if extra:
        variables = VariableTable(
            names,
            np.concatenate([variables.is_input, np.zeros(extra, bool)]),
            np.concatenate([variables.is_port, np.zeros(extra, bool)]),
            [*variables.start, *[None] * extra],
            np.concatenate([variables.fixed, np.zeros(extra, bool)]),
            np.concatenate([variables.nominal, np.zeros(extra)]),
            np.concatenate([variables.bounds, np.tile([-np.inf, np.inf], (extra, 1))]),
            [*variables.unit, *[""] * extra],
            [*variables.default, *[None] * extra],
            np.concatenate([variables.owner, np.full(extra, -1)]),
            np.concatenate([variables.port, np.full(extra, -1)]),
            np.concatenate([variables.is_across, np.zeros(extra, bool)]),
        )
    return variables, groups, tuple(rows)
