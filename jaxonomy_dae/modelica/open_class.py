"""A Modelica class with open connectors: what a flattening says of it, without the equations that would close it.

A flattening gives each flow of a connector that nothing is connected to the equation `flow = 0`. These equations go
out, one for each flow, and a connection of the port takes the place of each. All others are the class's own.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..base.errors import ModelError
from . import tree
from .boundaries import Closed, without_boundaries
from .external_objects import with_external_objects
from .flat_model import FlatModel
from .held_outputs import with_held_outputs
from .kept_inputs import with_starts_of_inputs
from .model_algorithms import with_algorithms
from .read_rumoca import read_open
from .rumoca_expressions import Json
from .sources import Sources

AS_TEXT = (
    "a part of a model that has such connectors inside opens as a whole: write it as a Modelica text with plain "
    "connectors outside, component(name, source=text, roots=[…])"
)
# Overdetermined quantities: the rotations of frames, and the angles of quasi-static references, which connections of a
# tree only make equal.
_KNOWN = re.compile(r"\.R\.[Tw]$|\.reference\.gamma$")


@dataclasses.dataclass(frozen=True)
class OpenPort:
    """A connector: pairs (name, unit) of its potentials, of its flows, which count positive into the class, and of its
    streams; and the names of those potentials that are an overdetermined record."""

    name: str
    potentials: tuple[tuple[str, str], ...]
    flows: tuple[tuple[str, str], ...]
    streams: tuple[tuple[str, str], ...] = ()
    orientation: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class OpenClass:
    """A flattened class whose connectors are open.

    - `name`: of the class, as it was asked for.
    - `description`: the comment of the class.
    - `flat`: declarations and equations, without `flow = 0` of the connectors.
    - `ports`: those of physical connectors. Of a connector of connectors, each innermost one is a port.
    - `inputs`, `outputs`: names of signals, in the order of the class.
    - `tunable`: parameters that stand as symbols in the equations.
    - `required`: those of them without a value.
    - `fixed`: the other parameters, which decide the equations or are given by the class.
    - `branches`: pairs of ports whose orientations the class relates.
    - `roots`: ports whose orientations the class determines.
    """

    name: str
    description: str
    flat: FlatModel
    ports: tuple[OpenPort, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    tunable: tuple[str, ...]
    required: tuple[str, ...]
    fixed: tuple[str, ...]
    branches: tuple[tuple[str, str], ...] = ()
    roots: tuple[str, ...] = ()


def opened(name: str, closed: Closed, sources: Sources) -> OpenClass:
    """A class with open connectors, from its flattening and the libraries that it belongs to.

    **Raises:**

    - `ModelError` for connectors of overdetermined graphs other than those of frames and quasi-static references, for
        those without variables, and for those that have not as many flows as potentials.
    """
    found = closed.found
    if found.flat.get("is_partial"):
        raise ModelError(f"'{name}' is partial: open a class that extends it, or write one as source=…")
    ports = tuple(p for top in found.flat["top_level_connectors"] for p in _ports(name, top, found.flat["variables"]))
    # A connector that was connected to a boundary has no equation that closes it.
    loose = [p for p in ports if not {p.name, re.sub(r"\[[\d,]+\]$", "", p.name)} & closed.bounded]
    flows = [f"{port.name}.{flow}" for port in loose for flow, _ in port.flows]
    flat = with_external_objects(read_open(found.dae, name.rpartition(".")[2], flows), found.flat)
    flat = with_starts_of_inputs(with_algorithms(without_boundaries(flat, closed.outer), sources))
    storage = found.dae["storage"]
    given = [v["name"] for v in storage["variables"] if v["attributes"]["causality"] == "output"]
    flat = with_held_outputs(flat, [n for n in given if "." not in n])
    tunable, required, fixed = [], [], []
    roles: dict[str, list[str]] = {"input": [], "output": []}
    declared = {d.name: d for d in flat.model.declarations}
    entries: dict[str, list[str]] = {}
    for n in declared:
        entries.setdefault(re.sub(r"\[[\d,]+\]$", "", n), []).append(n)
    for v in storage["variables"]:
        at = v["attributes"]
        is_real = storage["value_types"][v["value_type"]]["scalar"] == "real"
        names = [v["name"]] if v["name"] in declared else entries.get(v["name"], [])
        if v["role"] == "parameter" and at.get("fixed") != [False]:
            free = is_real and at["is_tunable"] and not found.flat["variable_final_flags"].get(v["name"])
            (tunable if free else fixed).extend(names)
            required += [n for n in names if free and declared[n].value is None]
        elif "." not in re.sub(r"\[[^]]*\]", "", v["name"]) or v["role"] == "input":
            if at["causality"] == "input":  # those that the class binds are its own variables
                names = [n for n in names if v["role"] == "input" and declared[n].value is None]
            roles.get(at["causality"], []).extend(names)
    deciding = _deciding(flat.model, tunable)
    tunable, fixed = [n for n in tunable if n not in deciding], [*fixed, *(n for n in tunable if n in deciding)]
    required = [n for n in required if n not in deciding]
    return OpenClass(
        name, found.flat.get("model_description") or "", flat, ports, tuple(roles["input"]), tuple(roles["output"]),
        tuple(tunable), tuple(required), tuple(fixed), *_tree_of(ports, closed),
    )  # fmt: skip


def _deciding(model: tree.Class, tunable: Sequence[str]) -> set[str]:
    """The parameters among `tunable` that determine a Boolean or an Integer variable, with other parameters alone.

    The front end knows such a variable, and decides by it which equations stand in the class: with the values that it
    has then. Another value would belong to other equations: a `LossyGear` that was opened without losses has none.
    """
    discrete = {
        d.name for d in model.declarations if d.type in ("Boolean", "Integer") and "parameter" not in d.prefixes
    }
    constant = {d.name for d in model.declarations if d.prefixes & {"parameter", "constant"}}
    entries: dict[str, set[str]] = {}
    for n in constant:
        entries.setdefault(n.partition("[")[0], set()).add(n)
    reads = {
        e.left.path: {part.path for part in tree.each_part(e.right) if isinstance(part, tree.Reference)}
        for e in model.equations
        if isinstance(e, tree.Equality) and isinstance(e.left, tree.Reference) and e.left.path in discrete
    }
    known: dict[str, set[str]] = {}  # of variables that parameters determine: these parameters
    while True:
        found = {
            name: set().union(*(known.get(r) or entries.get(r, set()) for r in read))
            for name, read in reads.items()
            if name not in known and all(r in known or r in entries for r in read)
        }
        if not found:
            return set().union(*known.values()) & set(tunable)
        known |= found


def _tree_of(ports: Sequence[OpenPort], closed: Closed) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """The branches between ports with orientations, and the ports that are roots."""
    groups: dict[str, set[str]] = {}
    for a, b in closed.graph:
        joined = groups.get(a, {a}) | groups.get(b, {b})
        groups |= dict.fromkeys(joined, joined)
    branches, roots = [], []
    seen: dict[int, str] = {}
    for port in ports:
        if port.orientation:
            record = f"{port.name}.{port.orientation[0].partition('.')[0]}"
            group = groups.get(record, {record})
            first = seen.setdefault(id(group), port.name)
            if first != port.name:
                branches.append((first, port.name))
            elif group & set(closed.roots):
                roots.append(port.name)
    return tuple(branches), tuple(roots)


def _ports(name: str, top: str, variables: Mapping[str, Json]) -> Iterator[OpenPort]:
    """The ports of one connector of the class."""
    inside = {n: v for n, v in variables.items() if n == top or n.startswith((f"{top}.", f"{top}["))}
    physical = {n: v for n, v in inside.items() if v["causality"] == "Empty" and not _is_constant(v)}
    where = f"'{name}': the connector '{top}'"
    if not inside:
        raise ModelError(f"{where} is expandable: {AS_TEXT}")
    if any(v["is_overconstrained"] and not _KNOWN.search(n) for n, v in inside.items()):
        raise ModelError(f"{where} is of an overdetermined graph, whose root its surroundings decide: {AS_TEXT}")
    scalars = {entry: v for n, v in physical.items() for entry in _entries(n, v["dims"])}
    for group in _innermost(top, list(scalars), scalars):
        prefix, members = group
        sides: dict[str, list[tuple[str, str]]] = {"potential": [], "flow": [], "stream": []}
        for n in members:
            kind = next((k for k in ("flow", "stream") if scalars[n][k]), "potential")
            sides[kind].append((n[len(prefix) + 1 :], scalars[n].get("unit") or ""))
        orientation = tuple(n[len(prefix) + 1 :] for n in members if scalars[n]["is_overconstrained"])
        # The rotation of a frame has three degrees of freedom, and three torques, however many numbers say it.
        freedom = len(sides["potential"]) - len(orientation) + (3 if is_frame(orientation) else 0)
        if freedom != len(sides["flow"]):
            counts = f"{len(sides['potential'])} potentials and {len(sides['flow'])} flows"
            raise ModelError(f"'{name}': the connector '{prefix}' has {counts}: {AS_TEXT}")
        if members:
            potentials, flows, streams = map(tuple, sides.values())
            yield OpenPort(prefix, potentials, flows, streams, orientation)


def is_frame(orientation: Sequence[str]) -> bool:
    """True if overdetermined quantities are those of a frame, which turns in three directions."""
    return any(n.startswith("R.") for n in orientation)


def _is_constant(v: Json) -> bool:
    kind: Any = v["variability"]
    return (kind if isinstance(kind, str) else next(iter(kind))) in ("Parameter", "Constant")


def _entries(name: str, dims: Sequence[int]) -> list[str]:
    names = [""]
    for n in dims:
        names = [f"{before}{',' if before else ''}{k + 1}" for before in names for k in range(n)]
    return [f"{name}[{place}]" for place in names] if dims else [name]


def _innermost(prefix: str, members: Sequence[str], variables: Mapping[str, Json]) -> Iterator[tuple[str, list[str]]]:
    """The innermost connectors, with the names of their variables: a part of a connector is one by itself if every
    part has both potentials and flows."""
    groups: dict[str, list[str]] = {}
    for n in members:
        rest = n[len(prefix) :]
        head = re.match(r"\[[\d,]+\](?=\.)|\.[^.]*(?=\.)", rest)
        groups.setdefault(prefix + head[0] if head else n, []).append(n)
    if members and all({variables[n]["flow"] for n in each} == {False, True} for each in groups.values()):
        for inner, each in groups.items():
            yield from _innermost(inner, each, variables)
    else:
        yield prefix, list(members)
