"""Connections as equations: across variables of joined ports are equal, their through variables sum to zero, and what
enters by a stream is the mixture of what leaves the others."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ...base.errors import ModelError
from ...write.arrays import PortArray
from ...write.connections import Connection
from ...write.diagram import AcausalDiagram
from ...write.ports import Domain, Port
from ..model.linear_template import LinearTemplate
from ..model.names import Names
from ..model.provenance import Provenance, Provenances
from ..model.tables import EquationGroup, PortTable
from .number_model import Instances, ModelNumbers
from .spanning_tree import closings, tree_edges
from .stream_junctions import SMALL, mixed

NAMED = 4  # ports of a junction, in messages


@dataclasses.dataclass(frozen=True)
class _Ports:
    """The ports of a model, by id."""

    names: Names
    domains: list[Domain]  # that occur
    domain: np.ndarray
    owner: np.ndarray  # the component
    variable: np.ndarray  # (ports, variables of a domain), in the order of `Domain.variables`
    nominal: np.ndarray  # of the flow that carries streams; 0 if it is not declared
    position: dict[int, int]  # of a component's port, by the port's id


@dataclasses.dataclass(frozen=True)
class Junctions:
    """Source of provenances: entry `junction * width + k` is the equation for the k-th variable of the domain."""

    names: Names
    domains: list[Domain]
    domain: np.ndarray  # of each port
    port: np.ndarray  # the ports that meet, junction by junction
    start: np.ndarray
    width: int

    def __call__(self, item: int) -> Provenance:
        junction, k = divmod(item, self.width)
        members = self.port[self.start[junction] : self.start[junction + 1]].tolist()
        where = ", ".join(self.names[p] for p in members[:NAMED]) + (", …" if len(members) > NAMED else "")
        kind = "connection of" if len(members) > 1 else "unconnected port"
        domain = self.domains[self.domain[members[0]]]
        if k < len(domain.across):
            return Provenance(f"{kind} {where}: equal {domain.across[k][0]}")
        k -= len(domain.across)
        if k < len(domain.through):
            return Provenance(f"{kind} {where}: {domain.through[k][0]} sums to zero")
        return Provenance(f"{kind} {where}: what enters by {domain.streams[k - len(domain.through)][0]}")


def connect_ports(model: ModelNumbers, diagram: AcausalDiagram, builder: list[EquationGroup]) -> PortTable:
    """Across variables of joined ports are equal, their through variables sum to zero; loose ports carry none.

    A port has two faces: the outer one joins in the connections of the component's parent, the inner one in those of
    the component itself, where its through variables count negative. Face 2·p is the outer one of port p, 2·p + 1 the
    inner one.
    """
    ports = _list_ports(model)
    left, right = _joined_faces(model, diagram, ports)
    # With one face, a port that is connected inside and outside would join both sets into one, and flows would pass by
    # the component that owns it.
    n = 2 * model.n_ports
    graph = sp.coo_array((np.ones(len(left)), (left, right)), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    present = np.arange(n) % 2 == 0
    present[left] = present[right] = True
    face = np.flatnonzero(present)
    # Junctions in the order of their first faces, and in each the faces in their order.
    _, first, which = np.unique(part[face], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    junction = rank[which]
    by = np.argsort(junction, kind="stable")
    face, junction = face[by], junction[by]
    start = np.searchsorted(junction, np.arange(len(first) + 1))
    tree = _in_tree(model, ports, face, junction, start)
    _add_equations(ports, face, junction, start, tree, builder)
    has_inside = present[1::2]
    single = face[start[:-1][np.diff(start) == 1]]
    is_loose = np.zeros(model.n_ports, bool)
    is_loose[single[single % 2 == 0] // 2] = True
    domains = [d.name for d in ports.domains]
    return PortTable(ports.names, [domains[d] for d in ports.domain.tolist()], ports.owner, is_loose, has_inside)


def _list_ports(model: ModelNumbers) -> _Ports:
    numbers: dict[Domain, int] = {}
    position: dict[int, int] = {}
    shapes: dict[tuple, list[Instances]] = {}
    for i in model.instances:
        if i.component.ports:
            for j, port in enumerate(i.component.ports.values()):
                position[id(port)] = j
            shape = tuple((p.name, p.domain) for p in i.component.ports.values())
            shapes.setdefault((shape, id(i.variable_positions)), []).append(i)
    for shape, _ in shapes:
        for _, d in shape:
            numbers.setdefault(d, len(numbers))
    domain, owner = np.empty(model.n_ports, np.int64), np.empty(model.n_ports, np.int64)
    width = max((len(d.variables) for d in numbers), default=1)
    variable = np.full((model.n_ports, width), -1, np.int64)
    nominal = np.zeros(model.n_ports)
    for (shape, _), parts in shapes.items():
        first, number = np.concatenate([i.port for i in parts]), np.concatenate([i.number for i in parts])
        variables = np.concatenate([i.variable for i in parts])
        for j, (name, d) in enumerate(shape):
            domain[first + j], owner[first + j] = numbers[d], number
            places = [parts[0].variable_positions[f"{name}.{n}"] for n, _ in d.variables]
            variable[(first + j)[:, None], np.arange(len(places))] = variables[:, None] + np.array(places)
            if d.streams:
                for i in parts:
                    nominal[i.port + j] = i.component.variables[f"{name}.{d.through[0][0]}"].nominal
    return _Ports(model.port_names, list(numbers), domain, owner, variable, nominal, position)


def _in_tree(
    model: ModelNumbers, ports: _Ports, face: np.ndarray, junction: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """For each face, whether the across variables of its port equal those of the first of its junction. Of
    overdetermined quantities, this holds along the edges of a tree."""
    out = np.ones(len(face), bool)
    domains = [k for k, d in enumerate(ports.domains) if d.overdetermined]
    if not domains:
        return out
    mine = np.isin(ports.domain, domains)
    pairs = [(i, pair) for i in model.instances for pair in i.component.tree_branches]
    branches = [[i.port + ports.position[id(end)] for end in pair] for i, pair in pairs]
    roots = [i.port + ports.position[id(end)] for i in model.instances for end in i.component.tree_roots]
    first = face[start[:-1]][junction] // 2
    later = np.flatnonzero((np.arange(len(face)) > start[:-1][junction]) & mine[face // 2])
    none = np.zeros((0, 2), np.int64)
    out[later] = tree_edges(
        model.n_ports,
        np.concatenate([none[:, 0], *roots]),
        np.concatenate([none, *(np.stack(pair, axis=1) for pair in branches)]),
        np.stack([first[later], face[later] // 2], axis=1),
        ports.names,
        np.flatnonzero(mine),
    )
    return out


def _joined_faces(model: ModelNumbers, diagram: AcausalDiagram, ports: _Ports) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of faces that connections join."""
    left: list[np.ndarray] = [np.zeros(0, np.int64)]
    right: list[np.ndarray] = [np.zeros(0, np.int64)]
    a: list[int] = []
    b: list[int] = []

    def join(connections: Sequence[Connection], owner: Instances | None):
        n = 1 if owner is None else len(owner)
        for connection in connections:
            ends = [_faces(model, ports, end, owner) for end in connection.ends]
            if n == 1 and all(end.size == 1 for end in ends):
                first, *others = (int(end[0, 0]) for end in ends)
                a.extend([first] * len(others))
                b.extend(others)
            elif connection.by_element:
                for end in ends[1:]:
                    left.append(ends[0].ravel())
                    right.append(end.ravel())
            else:
                together = np.concatenate(ends, axis=1)
                left.append(np.repeat(together[:, 0], together.shape[1] - 1))
                right.append(together[:, 1:].ravel())

    join(diagram.connections, None)
    for i in model.instances:
        if i.component.connections:
            join(i.component.connections, i)
    return np.concatenate([*left, np.array(a, np.int64)]), np.concatenate([*right, np.array(b, np.int64)])


def _faces(model: ModelNumbers, ports: _Ports, end: Port | PortArray, owner: Instances | None) -> np.ndarray:
    """The faces of one end of a connection, shape (instances of the owner, ports of the end)."""
    port = end.port if isinstance(end, PortArray) else end
    component = port.component
    found = model.of.get(id(component))
    if found is None:
        raise ModelError(f"{end!r} is connected, but its component is not part of the diagram: add it")
    own = owner is not None and component is owner.component
    if isinstance(end, PortArray):
        above = end.chosen.parent if end.chosen.above is None else component  # reached through an instance
        is_direct = component is end.chosen.prototype and above is (owner.component if owner else None)
    elif owner is None:
        is_direct = len(found) == 1
    else:
        is_direct = own or (found.array is None and component.parent is owner.component)
    if not is_direct:
        where = "the diagram" if owner is None else f"component '{owner.component.path}'"
        raise ModelError(f"{where} connects {end!r}: it can connect its own ports and its children's")
    at = found.port + ports.position[id(port)]
    if isinstance(end, PortArray):
        at = at.reshape(-1, end.chosen.size)[:, end.chosen.numbers.ravel()]
    else:
        at = at[:, None]
    return 2 * at + int(own)


def _add_equations(
    ports: _Ports, face: np.ndarray, junction: np.ndarray, start: np.ndarray, tree: np.ndarray,
    builder: list[EquationGroup],
):  # fmt: skip
    """The equations of all junctions, in the junctions' order; those that are not linear follow."""
    size = np.diff(start)
    port, sign = face // 2, 1.0 - 2.0 * (face % 2)
    width = ports.variable.shape[1]
    source = Junctions(ports.names, ports.domains, ports.domain, port, start, width)
    # By length: (junction, place among its equations, item, variables, coefficients)
    found: dict[int, list[tuple[np.ndarray, ...]]] = {}
    curved: list[EquationGroup] = []
    for d, domain in enumerate(ports.domains):
        n_across = len(domain.across)
        mine = np.flatnonzero(ports.domain[port[start[:-1]]] == d)
        inside = np.isin(junction, mine)
        all_later = np.flatnonzero(inside & (np.arange(len(face)) > start[:-1][junction]))
        for k in range(n_across):
            of_tree = domain.overdetermined is not None and domain.across[k][0] in domain.overdetermined.names
            # Each of the later ports equals the first: n − 1 equations for n ports, whatever pairs the user has
            # connected. Pairs as written would repeat themselves where connections form a loop.
            later = all_later[tree[all_later]] if of_tree else all_later
            set_ = junction[later]
            variable = ports.variable[np.stack([port[start[:-1][set_]], port[later]], axis=1), k]
            place = k * size[set_] + (later - start[:-1][set_])
            rows = (set_, place, set_ * width + k, variable, np.broadcast_to([1.0, -1.0], variable.shape))
            found.setdefault(2, []).append(rows)
        for length in np.unique(size[mine]).tolist():
            sets = mine[size[mine] == length]
            members = start[:-1][sets][:, None] + np.arange(length)
            for k in range(n_across, n_across + len(domain.through)):
                place = np.full(len(sets), n_across * length + k)
                rows = (sets, place, sets * width + k, ports.variable[port[members], k], sign[members])
                found.setdefault(length, []).append(rows)
            for k in range(len(domain.streams)):
                column = n_across + len(domain.through) + k
                leaves = ports.variable[port[members], column]
                enters = ports.variable[port[members], column + len(domain.streams)]
                within = face[members] % 2 == 1  # seen from inside, what enters the component leaves its port
                leaves, enters = np.where(within, enters, leaves), np.where(within, leaves, enters)
                # Of two ports, what enters one leaves the other, without a mixture. The equation is linear, so that
                # alias elimination removes it, and no small flow has to be bridged.
                if length <= 2:
                    variable = np.stack([enters, leaves[:, ::-1]], axis=2).reshape(-1, 2)
                    place = np.tile(column * length + np.arange(length), len(sets))
                    item = np.repeat(sets * width + column, length)
                    signs = np.broadcast_to([1.0, -1.0], variable.shape)
                    found.setdefault(2, []).append((np.repeat(sets, length), place, item, variable, signs))
                else:
                    provenance = Provenances.made(source, sets * width + column, False)
                    flows = ports.variable[port[members], n_across]
                    curved += _mixtures(ports.nominal[port[members]], flows, sign[members], leaves, enters, provenance)
        if domain.overdetermined is not None:
            curved += _closed_loops(ports, domain, face, junction, start, all_later[~tree[all_later]], source, width)
    # Groups are collected by length across domains, since equal linear equations share a template. Their order must not
    # depend on which domain came first.
    ordered = []
    for length, parts in found.items():
        set_, place, item, variable, coefficient = (np.concatenate(c) for c in zip(*parts, strict=True))
        if len(set_):
            by = np.lexsort((place, set_))
            ordered.append((set_[by[0]], place[by[0]], length, item[by], variable[by], coefficient[by]))
    for _, _, length, item, variable, coefficient in sorted(ordered, key=lambda entry: entry[:3]):
        provenance = Provenances.made(source, item, False)
        order = np.zeros(variable.shape)
        builder.append(EquationGroup.of(LinearTemplate(length), variable, order, provenance, coefficient=coefficient))
    builder += curved


def _mixtures(
    nominal: np.ndarray, flow: np.ndarray, sign: np.ndarray, leaves: np.ndarray, enters: np.ndarray, source: Provenances
) -> list[EquationGroup]:
    """The equations of what enters each of the ports that meet, one group for each place among them; all arrays have
    shape (junctions, ports)."""
    small = SMALL * np.where(nominal > 0, nominal, 1.0).min(axis=1)
    out = []
    for k in range(flow.shape[1]):
        others = np.delete(np.arange(flow.shape[1]), k)
        out.append(mixed(enters[:, k], flow[:, others], leaves[:, others], sign[:, others], small, source))
    return out


def _closed_loops(
    ports: _Ports, domain: Domain, face: np.ndarray, junction: np.ndarray, start: np.ndarray, later: np.ndarray,
    source: Junctions, width: int,
) -> list[EquationGroup]:  # fmt: skip
    """What connections demand that close loops of overdetermined quantities."""
    assert domain.overdetermined is not None
    if not len(later):
        return []
    columns = [[n for n, _ in domain.across].index(n) for n in domain.overdetermined.names]
    ends = np.stack([face[start[:-1]][junction[later]], face[later]], axis=1) // 2
    variable = ports.variable[ends[:, :, None], np.array(columns)].reshape(len(later), -1)
    provenance = Provenances.made(source, junction[later] * width + columns[0], False)
    order = np.zeros(variable.shape)
    return [EquationGroup.of(t, variable, order, provenance) for t in closings(domain.overdetermined)]
