"""Equations of components, and what they declare of energies and powers, as templates and rows of integers."""

import numpy as np
import sympy

from ...base.errors import ModelError
from ...graph.expressions.from_sympy import UnsupportedExpression, read, symbols_of
from ...graph.expressions.node import Node
from ...graph.expressions.to_sympy import shortened
from ...write.component import line_of
from ...write.symbols import EarlierSymbol, ParameterSymbol, PreviousSymbol, TimeSymbol, VariableSymbol, symbol_label
from ..model.linear_template import LinearTemplate
from ..model.provenance import Lines, Provenances, Written
from ..model.symbolic import canonical, linear_coefficients
from ..model.tables import AccountGroup, EquationGroup
from .lift_numbers import lifted
from .number_model import Instances, Members, ModelNumbers


def add_components(model: ModelNumbers, builder: list[EquationGroup]):
    read_once: dict[int, Node] = {}  # of an expression, by its id: equal components hold the same objects
    by_shape: dict[tuple, list[Instances]] = {}
    for i in model.instances:
        c = i.component
        if c.equations:
            # By id rather than by SymPy's equality, which compares whole trees. Components of one class share their
            # residuals.
            for residual in c.equations:
                if id(residual) not in read_once:
                    read_once[id(residual)] = read_expression(residual, model.path(i))
            graphs = tuple(read_once[id(r)] for r in c.equations)
            by_shape.setdefault((graphs, tuple(c.variables), tuple(c.parameters)), []).append(i)
    rows: list[EquationGroup] = []
    for (graphs, _, _), parts in by_shape.items():
        members = Members(model, parts)
        number = members.number
        for k, (graph, residual) in enumerate(zip(graphs, parts[0].component.equations, strict=True)):
            variables, parameters = slots_of(model, parts[0], residual, graph)
            # All linear equations of one length with plain numbers are one template, whoever wrote them: connections
            # and definitions take most of a model, and alias elimination works on their coefficients.
            coefficients = linear_coefficients(graph, variables)
            ids = members.ids([v.path for v in variables], "variable")
            parameter_ids = members.ids([p.path for p in parameters], "parameter")
            before = [isinstance(p, PreviousSymbol) for p in parameters]
            parameter_ids[:, before] = model.previous[parameter_ids[:, before]]
            order = np.tile([v.order for v in variables], (len(number), 1))
            shown = parts[0].component.as_written.get(residual, residual)
            lines = Lines([i.number for i in parts], [line_of(i.component, i.component.equations[k]) for i in parts])
            provenance = Provenances.made(Written(f"0 = {shortened(shown)}", model.paths, lines), number, True)
            if coefficients is None:
                template = canonical(graph, variables, parameters)
                rows.append(EquationGroup.of(template, ids, order, provenance, parameter=parameter_ids))
            else:
                numbers, template = np.tile(coefficients, (len(number), 1)), LinearTemplate(len(variables))
                rows.append(EquationGroup.of(template, ids, order, provenance, coefficient=numbers))
    builder += lifted(rows)


def slots_of(
    model: ModelNumbers, i: Instances, expression: sympy.Expr, graph: Node
) -> tuple[list[VariableSymbol], list[ParameterSymbol]]:
    """The variables and parameters in an expression of a component. Slots follow the order of declaration, never names,
    so names change nothing but names.

    **Raises:**

    - `ModelError` for a symbol that no component declared.
    """
    component = i.component
    position = {name: place for place, name in enumerate((*component.variables, *component.parameters))}

    def rank(s):
        # Symbols of children come after one's own, in the order the children's ids give.
        nth = getattr(s, "order", int(isinstance(s, PreviousSymbol)))
        if s.path in position:
            return (0, position[s.path], nth)
        resolve = model.variable if isinstance(s, VariableSymbol) else model.parameter
        # A path such as "a.v" would order by the children's names, so that renaming one made another template.
        return (1, int(resolve(i, s.path)[0]), nth)

    symbols = [s for s in symbols_of(expression) if symbol_label(s) in graph.leaves]
    for s in symbols:
        if isinstance(s, EarlierSymbol):
            raise ModelError(
                f"component '{model.path(i)}': 0 = {shortened(expression)}: {s} is the value before an event, which "
                f"what events write may read; an equation reads {s.path}"
            )
        if not isinstance(s, VariableSymbol | ParameterSymbol | TimeSymbol):
            raise ModelError(
                f"component '{model.path(i)}': the symbol '{s}' was declared by no component; "
                "declare it with self.variable(...) or self.parameter(...) and use the symbol they return"
            )
    variables = sorted((s for s in symbols if isinstance(s, VariableSymbol)), key=rank)
    parameters = sorted((s for s in symbols if isinstance(s, ParameterSymbol)), key=rank)
    return variables, parameters


def read_expression(expression: sympy.Expr, component: str) -> Node:
    try:
        return read(expression, symbol_label)
    except UnsupportedExpression as error:
        raise ModelError(f"component '{component}': 0 = {shortened(expression)}: {error}") from None


def read_accounts(model: ModelNumbers) -> tuple[AccountGroup, ...]:
    """One group for each declaration of components of one shape.

    **Raises:**

    - `ModelError` for a symbol that no component declared.
    """
    read_once: dict[sympy.Expr, Node] = {}
    owners: dict[tuple, list[Instances]] = {}
    for i in model.instances:
        for account in i.component.accounts:
            shape = (account.kind, account.expression, tuple(i.component.variables), tuple(i.component.parameters))
            owners.setdefault(shape, []).append(i)
    groups = []
    for (kind, expression, *_), parts in owners.items():
        if expression not in read_once:
            read_once[expression] = read_expression(expression, model.path(parts[0]))
        graph = read_once[expression]
        variables, parameters = slots_of(model, parts[0], expression, graph)
        members = Members(model, parts)
        number = members.number
        groups.append(
            AccountGroup.of(
                canonical(graph, variables, parameters),
                members.ids([v.path for v in variables], "variable"),
                np.tile([v.order for v in variables], (len(number), 1)),
                Provenances.made(Written(f"the {kind} {shortened(expression)}", model.paths), number, True),
                parameter=members.ids([p.path for p in parameters], "parameter"),
                kind=kind,
                component=number,
            )
        )
    return tuple(groups)
