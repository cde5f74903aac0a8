"""Declared energies and powers as templates and rows of integers, beside the equations."""

import numpy as np
import sympy

from ..expressions.node import Node
from ..model.symbolic import canonical
from ..model.tables import AccountGroup
from .number_model import ModelNumbers, ids_of
from .read_equations import read_expression, slots_of


def read_accounts(model: ModelNumbers) -> tuple[AccountGroup, ...]:
    """One group for each declaration of components of one shape.

    **Raises:**

    - `ModelError` for a symbol that no component declared.
    """
    read_once: dict[sympy.Expr, Node] = {}
    members: dict[tuple, list[int]] = {}
    for k, component in enumerate(model.components):
        for account in component.accounts:
            shape = (account.kind, account.expression, tuple(component.variables), tuple(component.parameters))
            members.setdefault(shape, []).append(k)
    groups = []
    for (kind, expression, *_), owners in members.items():
        if expression not in read_once:
            read_once[expression] = read_expression(expression, model.paths[owners[0]])
        graph = read_once[expression]
        variables, parameters = slots_of(model, owners[0], expression, graph)
        groups.append(
            AccountGroup(
                kind,
                canonical(graph, variables, parameters),
                ids_of(model, owners, [v.path for v in variables], "variable"),
                np.tile(np.array([v.order for v in variables], np.int64), (len(owners), 1)),
                ids_of(model, owners, [p.path for p in parameters], "parameter"),
                np.array(owners, np.int64),
            )
        )
    return tuple(groups)
