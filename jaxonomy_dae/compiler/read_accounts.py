"""Declared energies and powers as templates and rows of integers, beside the equations."""

import numpy as np
import sympy

from ..expressions.node import Node
from ..model.symbolic import canonical
from ..model.tables import AccountGroup
from .number_model import Instances, Members, ModelNumbers
from .read_equations import read_expression, slots_of


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
        groups.append(
            AccountGroup(
                kind,
                canonical(graph, variables, parameters),
                members.ids([v.path for v in variables], "variable"),
                np.tile(np.array([v.order for v in variables], np.int64), (len(members.number), 1)),
                members.ids([p.path for p in parameters], "parameter"),
                members.number,
            )
        )
    return tuple(groups)
