"""Boundaries that a class meets while it is flattened, where its surroundings decide what its connectors mean.

A front end that flattens a class alone takes it for a complete model: what enters by a stream is then what leaves, and
a body believes that it is the root of all frames. So the class becomes a component of a model. Each of its connectors
with streams is connected to a boundary, whose stream variables are what `inStream` reads. In a class with semiLinear
each connector with flows is: the front end takes flows of loose connectors for zero, and puts h = h1 in the place of
H_flow = semiLinear(m_flow, h, h1). So is each one whose `cardinality` an equation reads, which is zero for loose ones.
A boundary that is a root is joined to each tree of frames; in place of the equations that a connection to it would
bring, as many others stand.
Afterwards, everything that reads variables of boundaries goes out, and so does an `inner` component that the front end
has added by itself, as `world`, if no equation of the class reads its variables.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ..write.ports import inflow
from . import tree
from .flat_model import FlatModel
from .front_end import Flattened, FrontEnd, Unbalanced, Unrooted
from .rumoca_expressions import SCALAR, Json

MODEL = "Opened"  # of the text in which a class is opened
INSIDE, RIM = "opened__", "rim__"  # the class, and its boundaries, in that model


class _Kind(NamedTuple):
    """A kind of overdetermined records, by the end of their names.

    - `connector`: a class of connectors with such a record.
    - `root`: equations of a boundary `{rim}` that is a root.
    - `in_place`: those in place of a connection of a record `{of}` to it.
    - `lacking`: how many these are.
    """

    ending: str
    connector: str
    root: str
    in_place: str
    lacking: int


# A frame has 12 overdetermined quantities and 3 torques: its boundary lacks 9 equations.
_KINDS = (
    _Kind(
        ".R", "Modelica.Mechanics.MultiBody.Interfaces.Frame_a",
        "{rim}.r_0 = zeros(3); {rim}.R = Modelica.Mechanics.MultiBody.Frames.nullRotation();",
        "{of}.w = {rim}.r_0; {of}.T[1, :] = {rim}.r_0; {of}.T[2, :] = {rim}.r_0;", 9,
    ),
    _Kind(
        ".reference", "Modelica.Electrical.QuasiStatic.SinglePhase.Interfaces.PositivePin",
        "{rim}.v.re = 0; {rim}.v.im = 0; {rim}.reference.gamma = 0;", "{of}.gamma = {rim}.reference.gamma;", 1,
    ),
)  # fmt: skip


class Closed(NamedTuple):
    """A class that was flattened as a component of a model: `bounded` are the connectors that met a boundary, `outer`
    the variables of components that the front end has added, `graph` edges of the trees of overdetermined records, and
    `roots` those of its records that begin a tree."""

    found: Flattened
    bounded: frozenset[str] = frozenset()
    outer: frozenset[str] = frozenset()
    graph: tuple[tuple[str, str], ...] = ()
    roots: tuple[str, ...] = ()


def flattened(
    front_end: FrontEnd,
    name: str,
    changes: str = "",
    source: str | None = None,
    records: Callable[[], Mapping[str, bool]] = dict,
    counted: frozenset[str] = frozenset(),
) -> Closed:
    """Flattens a class, alone or, if its connectors ask for it, with boundaries. `records` names the overdetermined
    records of its connectors, and says whether the connector is conditional: nothing else tells of those that no
    equation relates to others. `counted` are those of its connectors whose connections its equations count.

    **Raises:**

    - `ModelError` as `FrontEnd.flatten`.
    """
    before = f"{source or ''}\n"
    modified = f"{INSIDE}({changes})" if changes else INSIDE
    alone, trees = _alone(front_end, name, changes, source, records)
    bounded = list(_connectors(alone.flat, "flow" if _with_semi_linear(alone.dae) else "stream"))
    bounded += [
        n for n in _connectors(alone.flat, "flow") if n in counted - {*bounded} and not _in_graph(alone.flat, n)
    ]
    if not trees and not bounded:
        return Closed(alone, graph=_edges(alone.flat), roots=tuple(alone.flat["definite_roots"]))
    variables = alone.flat["variables"]
    declared, equations, renamed = [f"{name} {modified};"], [], {}
    if "world.enableAnimation" in variables:
        # Without animation, whose shapes are variables that nothing reads.
        declared.append("inner Modelica.Mechanics.MultiBody.World world(enableAnimation = false);")
    for k, top in enumerate(bounded):
        declared += _rim(k, top, variables)
        equations.append(f"connect({INSIDE}.{top}, {RIM}{k}.port);")
        for n, v in variables.items():
            if n.startswith(f"{top}.") and v["stream"]:
                stream = n[len(top) + 1 :]
                renamed[f"{RIM}{k}.port.{stream}"] = f"{top}.{inflow(stream)}"
    for k, (n, kind) in enumerate(_inputs(alone.dae)):
        declared.append(f"input {kind} {RIM}u{k}{_size(n, variables)};")
        equations.append(f"{INSIDE}.{n} = {RIM}u{k};")
    roots = _roots(trees, f"{INSIDE}.")
    text = f"{before}{_model([*declared, *roots[0]], [*roots[1], *equations])}"
    return _as_alone(front_end.flatten(text, MODEL, called=name), alone, renamed)._replace(bounded=frozenset(bounded))


def _alone(
    front_end: FrontEnd, name: str, changes: str, source: str | None, records: Callable[[], Mapping[str, bool]]
) -> tuple[Flattened, list[str]]:
    """The class by itself, and the overdetermined records that need a root outside."""
    extended = f"extends {name}({changes});" if changes else f"extends {name};"
    # rumoca names one record without a root at a time, so that each one costs another flattening.
    trees: list[str] = []
    while True:
        try:
            if changes or trees:
                declared, equations = _roots(trees, "")
                text = f"{source or ''}\n{_model([extended, *declared], equations)}"
                found = front_end.flatten(text, MODEL, called=name)
            else:
                found = front_end.flatten(source, name)
        except Unrooted as error:
            if _kind_of(error.record) is None or error.record in trees:
                raise
            trees.append(error.record)
            continue
        except Unbalanced as error:
            loose = {r: conditional for r, conditional in records().items() if r not in trees}
            there = [[r for r, conditional in loose.items() if not conditional], [*loose]]
            chosen = next((rs for rs in there if rs and error.missing == sum(map(_lacking, rs))), None)
            if chosen is None:
                raise
            trees += chosen
            continue
        wanting = [r for r in _believed(found.flat) if _kind_of(r) and r not in trees]
        if not wanting:
            return found, trees
        trees += wanting


def _model(declared: Sequence[str], equations: Sequence[str]) -> str:
    body = f" equation {' '.join(equations)}" if equations else ""
    return f"model {MODEL} {' '.join(declared)}{body} end {MODEL};\n"


def _kind_of(record: str) -> _Kind | None:
    return next((kind for kind in _KINDS if record.endswith(kind.ending)), None)


def _lacking(record: str) -> int:
    """How many equations a connector lacks whose record meets no boundary."""
    kind = _kind_of(record)
    return kind.lacking if kind else 0


def _believed(flat: Json) -> Iterator[str]:
    """The overdetermined records of connectors that take themselves for roots as nothing else is one."""
    edges = [*flat["branches"], *flat["optional_edges"]]
    reached = set(flat["definite_roots"])
    while more := {n for edge in edges for n in edge if set(edge) & reached} - reached:
        reached |= more
    for record, *_ in flat["potential_roots"]:
        if record not in reached and record.partition(".")[0] in flat["top_level_connectors"]:
            yield record


def _roots(trees: Sequence[str], inside: str) -> tuple[list[str], list[str]]:
    """Boundaries that are roots of trees, and equations that begin with them."""
    declared, equations = [], []
    for k, record in enumerate(trees):
        rim, of, kind = f"{RIM}r{k}", f"{inside}{record}", _kind_of(record)
        assert kind is not None
        declared.append(f"{kind.connector} {rim};")
        root = f"{rim}{kind.ending}"
        equations.append(f"Connections.root({root}); Connections.branch({root}, {of});")
        equations.append(f"{kind.root} {kind.in_place}".format(rim=rim, of=of))
    return declared, equations


def _with_semi_linear(dae: Json) -> bool:
    """Whether the front end has put something else in the place of a semiLinear."""
    return any(
        p["origin"] == {"generated": "semi_linear_lowering"} for p in dae["storage"]["expressions"]["provenance"]
    )


def _connectors(flat: Json, prefix: str) -> Iterator[str]:
    """The innermost connectors of the class that have variables with this prefix, flow or stream."""
    tops = {n.partition("[")[0] for n in flat["top_level_connectors"]}
    found = [n.rpartition(".")[0] for n, v in flat["variables"].items() if v[prefix]]
    yield from (n for n in dict.fromkeys(found) if re.split(r"[.\[]", n)[0] in tops)


def _in_graph(flat: Json, connector: str) -> bool:
    """Whether a connector has an overdetermined record, which boundaries of another kind close."""
    return any(v["is_overconstrained"] for n, v in flat["variables"].items() if n.startswith(f"{connector}."))


def _rim(k: int, top: str, variables: Mapping[str, Json]) -> Iterator[str]:
    """A boundary for a connector: a connector with the same variables, and values of all but its flows."""
    declared, values = [], []
    for n, v in variables.items():
        # A connector may have parameters, such as a record of its medium.
        if not n.startswith(f"{top}.") or v["causality"] != "Empty" or v["variability"] != "Empty":
            continue
        name, size = n[len(top) + 1 :], _size(n, variables)
        prefix = "flow " if v["flow"] else "stream " if v["stream"] else ""
        declared.append(f"{prefix}Real {name}{size};")
        if not v["flow"]:
            values.append(f"port.{name} = fill(z, {size[1:-1]});" if size else f"port.{name} = z;")
    yield f"connector {RIM}K{k} {' '.join(declared)} end {RIM}K{k};"
    yield f"model {RIM}B{k} {RIM}K{k} port; Real z = 0; equation {' '.join(values)} end {RIM}B{k};"
    yield f"{RIM}B{k} {RIM}{k};"


def _size(name: str, variables: Mapping[str, Json]) -> str:
    dims = variables[name]["dims"] if name in variables else []
    return f"[{', '.join(map(str, dims))}]" if dims else ""


def _inputs(dae: Json) -> Iterator[tuple[str, str]]:
    """The inputs of a class, and their types."""
    types = dae["storage"]["value_types"]
    for v in dae["storage"]["variables"]:
        if v["role"] == "input" and v["attributes"].get("binding") is None:
            yield v["name"], SCALAR[types[v["value_type"]]["scalar"]]


def _as_alone(found: Flattened, alone: Flattened, renamed: Mapping[str, str]) -> Closed:
    """A flattened model with boundaries, under the names that the class has alone."""
    names = [v["name"] for v in found.dae["storage"]["variables"]]
    outer = frozenset(n for n in names if not n.startswith((INSIDE, RIM)))

    def under_own_names(of: Json, also: Mapping[str, str]) -> Json:
        # As text, since names stand in many lists of these records.
        text = json.dumps(of).replace(f'"{INSIDE}.', '"')
        for before, after in also.items():
            text = text.replace(f'"{before}"', f'"{after}"')
        return json.loads(text)

    dae, told = under_own_names(found.dae, renamed), under_own_names(found.flat, {})
    flat: dict[str, Any] = {
        **told,
        "top_level_connectors": [n for n in alone.flat["top_level_connectors"] if not n.startswith(RIM)],
        "model_description": alone.flat.get("model_description"),
    }
    for n, v in flat["variables"].items():
        if n in alone.flat["variables"]:
            v["causality"] = alone.flat["variables"][n]["causality"]
    inputs = {n for n, _ in _inputs(alone.dae)}
    before = {v["name"]: v for v in alone.dae["storage"]["variables"]}
    for v in dae["storage"]["variables"]:
        n = v["name"]
        if n in inputs:
            v["role"] = "input"
        if n in inputs or n in before and before[n]["role"] != "input":
            v["attributes"]["causality"] = before[n]["attributes"]["causality"]
    return Closed(
        Flattened(found.name, dae, flat), outer=outer, graph=_edges(flat), roots=tuple(flat["definite_roots"])
    )


def _edges(flat: Json) -> tuple[tuple[str, str], ...]:
    """The edges of trees that a class has inside."""
    return tuple((a, b) for a, b in (*flat["branches"], *flat["optional_edges"]) if not a.startswith(RIM))


def without_boundaries(model: FlatModel, outer: frozenset[str]) -> FlatModel:
    """The model without what reads variables of boundaries, and without the variables of outer components that no
    equation of the class reads."""
    own = model.model
    equations = [(e, set(_names(e))) for e in map(_without_rim, own.equations) if e is not None]
    kept = [(e, names) for e, names in equations if not any(n.startswith(RIM) for n in names)]
    parameters = {d.name for d in own.declarations if d.prefixes & {"parameter", "constant"}}
    around = {n for d in own.declarations for n in [re.sub(r"\[[\d,]+\]$", "", d.name)] if n in outer} - parameters
    around -= {re.sub(r"\[[\d,]+\]$", "", n) for n in parameters}
    mine = [(e, names) for e, names in kept if not names or names - around - parameters]
    others = [(e, names) for e, names in kept if names and not names - around - parameters]
    # What the class reads of an outer component belongs to it, with all that determines this.
    read = {n for _, names in mine for n in names & around}
    while more := [(e, names) for e, names in others if names & read and (e, names) not in mine]:
        mine += more
        read |= {n for _, names in more for n in names & around}
    chosen = {id(e) for e, _ in mine}
    gone = around - read
    declarations = tuple(
        d for d in own.declarations if not d.name.startswith(RIM) and re.sub(r"\[[\d,]+\]$", "", d.name) not in gone
    )
    initial = tuple(e for e in own.initial_equations if not any(n.startswith(RIM) or n in gone for n in _names(e)))
    left = own._replace(
        declarations=declarations,
        equations=tuple(e for e, _ in equations if id(e) in chosen),
        initial_equations=initial,
    )
    return dataclasses.replace(model, model=left)


def _without_rim(e: tree.Statement) -> tree.Statement | None:
    """A `when` without what it does to boundaries; None if nothing is left of it."""
    if not isinstance(e, tree.Branches) or e.kind != "when":
        return e
    bodies = [(c, tuple(s for s in body if not any(n.startswith(RIM) for n in _names(s)))) for c, body in e.branches]
    return e._replace(branches=tuple(bodies)) if any(body for _, body in bodies) else None


def _names(e: Any) -> Iterator[str]:
    """The names of all references inside."""
    if isinstance(e, tree.Reference):
        yield e.path
    if isinstance(e, tuple):
        for part in e:
            yield from _names(part)
