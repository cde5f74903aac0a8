"""Connected signals as equations: inputs equal the variable that drives them."""

from collections.abc import Sequence

import numpy as np

from ...base.errors import ModelError
from ...write.component import Component
from ...write.connections import Signal
from ...write.diagram import AcausalDiagram
from ..model.provenance import Provenance
from ..model.tables import EquationGroup
from .group_builder import linear_equation
from .number_model import Instances, ModelNumbers


def connect_signals(model: ModelNumbers, diagram: AcausalDiagram, builder: list[EquationGroup]) -> set[int]:
    """Inputs equal what drives them; returns the inputs that are driven, which are unknowns from then on."""
    owners: list[tuple[Instances | None, Sequence[Signal]]] = [(None, diagram.signals)]
    owners.extend((i, i.component.signals) for i in model.instances if i.component.signals)
    if not any(signals for _, signals in owners):
        return set()
    names = model.variable_names
    is_input = np.zeros(model.n_variables, bool)
    for i in model.instances:
        for k, v in enumerate(i.component.variables.values()):
            is_input[i.variable + k] = v.kind == "input"
    driven: dict[int, str] = {}
    for i, signals in owners:
        paths = ["diagram"] if i is None else [f"component '{model.paths[k]}'" for k in i.number.tolist()]
        for signal in signals:
            columns = []
            for symbol in signal:
                found = model.resolve(i, symbol.path, "variables")
                if found is None:
                    raise ModelError(f"{paths[0]}: '{symbol.path}' is connected, but {_why(model, i, symbol.path)}")
                columns.append(found)
            for where, ids in zip(paths, np.stack(columns, axis=1).tolist(), strict=True):
                # A component's own input is given from outside; inside it drives like any variable.
                drives = [not is_input[v] or "." not in s.path for v, s in zip(ids, signal, strict=True)]
                what = ", ".join(f"'{names[v]}'" for v in ids)
                if sum(drives) != 1:
                    count = "none of them drives the others" if not any(drives) else "more than one is not an input"
                    raise ModelError(
                        f"{where}: connect({what}) joins one variable with inputs; {count}. (Two variables are made "
                        "equal by an equation, Eq(a.x, b.x), in the component that holds both.)"
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
                    says = Provenance(f"connection of {names[source]}, {names[v]}: equal signals")
                    builder.append(linear_equation([(v, 0, 1.0), (source, 0, -1.0)], says))
    return set(driven)


def _why(model: ModelNumbers, i: Instances | None, path: str) -> str:
    """Why a path of a connected variable leads nowhere in a component, or in the diagram if i is None."""
    children = model.top if i is None else i.component.children
    adding = "diagram.add" if i is None else "self.add"
    place = "the diagram" if i is None else f"'{model.path(i)}'"
    head, dot, rest = path.partition(".")
    if not dot:
        return f"{place} has no such variable: connect variables of its components, such as component.{path}"
    while dot and head in children:
        child = children[head]
        children = child.children if isinstance(child, Component) else {}
        place, (head, dot, rest) = f"'{child.path}'", rest.partition(".")
    if dot:
        return f"'{head}' is not a component of {place}: add it, {adding}({head})"
    inside = [name for name, child in children.items() if isinstance(child, Component) and head in child.variables]
    return f"{place} has no variable '{head}'" + (f": connect that of {inside[0]}" if inside else "")
