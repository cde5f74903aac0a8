"""Learned terms, functions and learned corrections: equations that SymPy never sees."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ...base.aliases import PyTree
from ...base.errors import ModelError, nearest
from ...write.diagram import AcausalDiagram
from ...write.symbols import TimeSymbol, VariableSymbol
from ..model.opaque import OpaqueFunction, OpaqueTemplate
from ..model.provenance import Provenance, Provenances, Written
from ..model.tables import EquationGroup, RowInjection, VariableTable
from .group_builder import joined_by_template, linear_equation
from .number_model import ModelNumbers


def add_learned_terms(model: ModelNumbers, builder: list[EquationGroup], networks: dict[str, Callable]):
    """Adds an equation for each output of the networks and functions in components."""
    for i in model.instances:
        for term in i.component.learned_terms:
            name = f"{i.path}.{term.name}"  # one for all components of an array
            times = frozenset(j for j, s in enumerate(term.inputs) if isinstance(s, TimeSymbol))
            opaque = OpaqueFunction(len(networks), name, None, len(term.inputs), times)
            networks[name] = term.network
            inputs = [(model.variable(i, s.path), s.order) for s in term.inputs if isinstance(s, VariableSymbol)]
            for j, output in enumerate(term.outputs):
                source = Written(f"output {j} of the {term.noun}", [f"{model.paths[k]}.{term.name}" for k in i.number])
                provenance = Provenances.made(source, np.arange(len(i)), True)
                _add_opaque(builder, opaque, j, (model.variable(i, output.path), 0), inputs, provenance)


def _add_opaque(
    builder: list[EquationGroup],
    opaque: OpaqueFunction,
    output: int,
    y: tuple[np.ndarray, int],
    inputs: list[tuple[np.ndarray, int]],
    provenance: Provenances,
):
    """Adds an equation for each of n places where a function stands: variables have shape (n,)."""
    variables, orders = zip(y, *inputs, strict=True)
    order = np.tile(orders, (len(provenance), 1))
    builder.append(EquationGroup.of(OpaqueTemplate(opaque, output), np.stack(variables, axis=1), order, provenance))


@dataclasses.dataclass(frozen=True)
class _Correction:
    """A block of learned corrections: the function, and what it corrects and reads, by numbers of variables."""

    opaque: OpaqueFunction
    targets: tuple[int, ...]
    inputs: tuple[int, ...]
    inject: str


def add_corrections(
    model: ModelNumbers,
    diagram: AcausalDiagram,
    variables: VariableTable,
    groups: tuple[EquationGroup, ...],
    networks: dict[str, PyTree],
) -> tuple[VariableTable, tuple[EquationGroup, ...], tuple[RowInjection, ...]]:
    """Adds the learned corrections.

    `equation`: for a target v with corrections w₁, w₂, …, every equation that mentions dv/dt reads instead a new
    variable u, and dv/dt = u + w₁ + w₂ + … is added. `row`: kept for lowering.
    """
    found = _corrections(model, diagram, variables, groups, networks)
    rows = tuple(RowInjection(c.opaque, c.targets, c.inputs) for c in found if c.inject == "row")
    found = [c for c in found if c.inject != "row"]
    if not found:
        return variables, groups, rows
    names = list(variables.names)
    builder: list[EquationGroup] = []
    corrections: dict[int, list[int]] = {}
    for c in found:
        for j, v in enumerate(c.targets):
            corrections.setdefault(v, []).append(len(names))
            provenance = Provenances.of([Provenance(f"output {j} of the network", c.opaque.name)])
            columns = [(np.array([i]), 0) for i in c.inputs]
            _add_opaque(builder, c.opaque, j, (np.array([len(names)]), 0), columns, provenance)
            names.append(f"{c.opaque.name}[{j}]")
    first = len(names)  # of the new variables u
    physics = np.full(first, -1)
    for v, ws in corrections.items():
        physics[v] = u = len(names)
        names.append(f"{names[v]}:physics")
        terms = [(v, 1, 1.0), (u, 0, -1.0), *((w, 0, -1.0) for w in ws)]
        builder.append(linear_equation(terms, Provenance(f"corrected derivative of {names[v]}")))
    redirected = []
    for group in groups:
        new = physics[group.variable]
        hit = (new >= 0) & (group.order > 0)
        # u is dv/dt already, so that d²v/dt² becomes du/dt.
        variable, order = np.where(hit, new, group.variable), np.where(hit, group.order - 1, group.order)
        redirected.append(dataclasses.replace(group, variable=variable, order=order))
    return _extended(variables, names, first), (*redirected, *joined_by_template(builder)), rows


def _corrections(
    model: ModelNumbers, diagram: AcausalDiagram, variables: VariableTable, groups, networks: dict[str, PyTree]
) -> list[_Correction]:
    """The corrections of the diagram, whose functions are added to `networks`."""
    names, known = variables.names, variables.index if diagram.blocks else {}
    differentiated = np.zeros(len(names), bool)
    for group in groups:
        differentiated[group.variable[group.order > 0]] = True

    def find(reference, block, what: str) -> int:
        component, name = reference
        if component is not None:
            if id(component) not in model.of:
                raise ModelError(
                    f"neural block '{block.name}': its {what} '{component.path}.{name}' belongs to a component that "
                    "is not part of the diagram: add it"
                )
            name = f"{component.path}.{name}"
        if name not in known:
            raise ModelError(
                f"neural block '{block.name}': its {what} '{name}' is not a variable: " + nearest(name, known)
            )
        return known[name]

    found = []
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
        found.append(_Correction(opaque, targets, inputs, block.inject))
    return found


def _extended(variables: VariableTable, names: list[str], first_internal: int) -> VariableTable:
    """The table with more variables, of which nothing is declared. Those from `first_internal` on are nobody's."""
    extra = len(names) - len(variables)
    no = np.zeros(extra, bool)
    return VariableTable(
        names=variables.names.followed_by(names[len(variables) :]),
        is_input=np.append(variables.is_input, no),
        is_port=np.append(variables.is_port, no),
        start=variables.start.padded(extra),
        fixed=np.append(variables.fixed, no),
        nominal=np.append(variables.nominal, np.zeros(extra)),
        bounds=np.concatenate([variables.bounds, np.tile([-np.inf, np.inf], (extra, 1))]),
        unit=[*variables.unit, *[""] * extra],
        default=[*variables.default, *[None] * extra],
        owner=np.append(variables.owner, np.full(extra, -1)),
        port=np.append(variables.port, np.full(extra, -1)),
        potential=np.append(variables.potential, np.full(extra, -1)),
        potentials=variables.potentials,
        is_internal=np.append(variables.is_internal, np.arange(len(variables), len(names)) >= first_internal),
    )
