"""Flatten: components and connections become integer tables.

Given a diagram, returns a `FlatModel`: one id for each variable and parameter, one group of rows for each equation
template. Components of equal shape (same declarations, literally the same equations) are treated together, so the
symbolic work does not grow with the number of instances.
"""

from collections.abc import Callable

from ...write.diagram import AcausalDiagram
from ..model.tables import Declared, EquationGroup, FlatModel
from .add_networks import add_corrections, add_learned_terms
from .collect_declarations import parameter_table, variable_table
from .collect_delays import delay_table
from .collect_events import event_table, held_table
from .connect_ports import connect_ports
from .connect_signals import connect_signals
from .group_builder import joined_by_template
from .number_model import ModelNumbers, array_names
from .read_equations import add_components, read_accounts


def flatten(diagram: AcausalDiagram) -> FlatModel:
    """Flattens a diagram.

    **Raises:**

    - `ModelError` for symbols no component declares, ports of components that are not in the diagram, and targets or
        inputs of neural blocks that do not exist.
    """
    model = ModelNumbers(diagram)
    builder: list[EquationGroup] = []
    networks: dict[str, Callable] = {}
    add_components(model, builder)
    add_learned_terms(model, builder, networks)
    ports = connect_ports(model, diagram, builder)
    driven = connect_signals(model, diagram, builder)
    variables = variable_table(model, driven)
    parameters, values = parameter_table(model)
    groups = joined_by_template(builder)
    # Corrections redirect derivatives in the equations that are there, so they come after all that writes equations.
    variables, groups, rows = add_corrections(model, diagram, variables, groups, networks)
    events, held, accounts = event_table(model), held_table(model), read_accounts(model)
    name = diagram.name or ""
    return FlatModel(
        variables, parameters, groups, Declared(values, networks), tuple(networks), rows, model.paths, ports, name,
        events, held, accounts, array_names(model), delay_table(model),
    )  # fmt: skip
