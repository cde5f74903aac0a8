"""Learned terms, functions and learned corrections: equations that SymPy never sees."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..errors import ModelError, nearest
from ..model.opaque import OpaqueFunction, OpaqueTemplate
from ..model.provenance import Provenance, Provenances, Written
from ..model.tables import RowInjection, VariableTable
from ..modeling.diagram import AcausalDiagram
from ..modeling.symbols import TimeSymbol, VariableSymbol
from .group_builder import GroupBuilder
from .number_model import ModelNumbers


def add_learned_terms(model: ModelNumbers, builder: GroupBuilder, networks: dict[str, Callable]):
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
    builder: GroupBuilder,
    opaque: OpaqueFunction,
    output: int,
    y: tuple[np.ndarray, int],
    inputs: list[tuple[np.ndarray, int]],
    provenance: Provenances,
):
    """Adds an equation for each of n places where a function stands: variables have shape (n,)."""
    pairs = [y, *inputs]
    n = len(provenance)
    builder.add(
        OpaqueTemplate(opaque, output),
        np.stack([v for v, _ in pairs], axis=1),
        np.tile([o for _, o in pairs], (n, 1)),
        np.zeros((n, 0)),
        np.zeros((n, 0)),
        provenance,
    )


def add_corrections(model: ModelNumbers, diagram: AcausalDiagram, variables: VariableTable, groups, networks):
    """Adds the learned corrections.

    `equation`: for a target v with corrections w₁, w₂, …, every equation that mentions dv/dt reads instead a new
    variable u, and dv/dt = u + w₁ + w₂ + … is added. `row`: kept for lowering.
    """
    rows: list[RowInjection] = []
    corrections: dict[int, list[int]] = {}
    physics: list[int] = []  # the new variables u
    builder = GroupBuilder()
    names = list(variables.names)
    known = variables.index if diagram.blocks else {}

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
            provenance = Provenances.of([Provenance(f"output {j} of the network", block.name)])
            columns = [(np.array([i]), 0) for i in inputs]
            _add_opaque(builder, opaque, j, (np.array([w]), 0), columns, provenance)
    if corrections:
        target_index = np.full(len(names) + len(corrections), -1)
        for v, ws in corrections.items():
            u = len(names)
            target_index[v] = u
            names.append(f"{names[v]}:physics")
            physics.append(u)
            builder.add_linear(
                [(v, 1, 1.0), (u, 0, -1.0), *((w, 0, -1.0) for w in ws)],
                Provenance(f"corrected derivative of {names[v]}"),
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
            names=names,
            is_input=np.concatenate([variables.is_input, np.zeros(extra, bool)]),
            is_port=np.concatenate([variables.is_port, np.zeros(extra, bool)]),
            start=variables.start.padded(extra),
            fixed=np.concatenate([variables.fixed, np.zeros(extra, bool)]),
            nominal=np.concatenate([variables.nominal, np.zeros(extra)]),
            bounds=np.concatenate([variables.bounds, np.tile([-np.inf, np.inf], (extra, 1))]),
            unit=[*variables.unit, *[""] * extra],
            default=[*variables.default, *[None] * extra],
            owner=np.concatenate([variables.owner, np.full(extra, -1)]),
            port=np.concatenate([variables.port, np.full(extra, -1)]),
            is_across=np.concatenate([variables.is_across, np.zeros(extra, bool)]),
            is_internal=np.concatenate(
                [variables.is_internal, np.isin(np.arange(len(variables), len(names)), physics)]
            ),
        )
    return variables, groups, tuple(rows)
