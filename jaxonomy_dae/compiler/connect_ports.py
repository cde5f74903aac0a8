"""Connections as equations: across variables of joined ports are equal, their through variables sum to zero."""

import numpy as np

from ..errors import ModelError
from ..model.provenance import Provenance
from ..model.tables import PortTable
from ..modeling.component import Component
from ..modeling.diagram import AcausalDiagram
from ..modeling.ports import Port
from .group_builder import GroupBuilder
from .number_model import ModelNumbers


def connect_ports(model: ModelNumbers, diagram: AcausalDiagram, builder: GroupBuilder) -> PortTable:
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
                builder.add_linear([(first, 0, 1.0), (other, 0, -1.0)], Provenance(f"{kind} {where}: equal {name}"))
        for name, _ in domain.through:
            terms = [
                (model.port_variable(port, name), 0, -1.0 if inner else 1.0)
                for port, (_, inner) in zip(members, faces, strict=True)
            ]
            builder.add_linear(terms, Provenance(f"{kind} {where}: {name} sums to zero"))
    owners = [model.index[id(p.component)] for p in ports.values()]
    return PortTable(
        [f"{model.paths[k]}.{p.name}" for k, p in zip(owners, ports.values(), strict=True)],
        [p.domain.name for p in ports.values()],
        np.array(owners, np.int64),
        np.array([key in loose for key in ports], bool),
        np.array([(key, 1) in parent for key in ports], bool),
    )
