"""Classes whose clock their surroundings decide, opened with a periodic one.

The class becomes a component of a model that has the clock: its clocked inputs are sampled there, and its clock inputs
are the clock. A class without either has outputs that belong to the clock. As everywhere, outputs are held.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ..base.errors import ModelError
from . import tree
from .boundaries import INSIDE, MODEL, RIM, Closed
from .front_end import FrontEnd
from .rumoca_expressions import Json
from .sources import Found, Sources

SAMPLED = "__sampled"  # ends the name of a clocked input at the ticks
_ALWAYS = {"Real": "{y} + {v}", "Integer": "{y} + {v}", "Boolean": "{y} and {v}"}


class Signal(NamedTuple):
    """An input or output of a class: its name, `Real`, `Integer`, `Boolean` or `Clock`, its dimensions' number, and
    whether the class itself samples it."""

    name: str
    kind: str
    rank: int
    is_input: bool
    is_sampled: bool


def with_clock(
    front_end: FrontEnd, name: str, changes: str, source: str | None, signals: Sequence[Signal], interval: float
) -> Closed:
    """A class flattened in a model with a clock that ticks every `interval` seconds.

    **Raises:**

    - `ModelError` for outputs that are clocks, and as `FrontEnd.flatten`.
    """
    for s in signals:
        if s.kind == "Clock" and not s.is_input:
            raise ModelError(
                f"'{name}': its output '{s.name}' is a clock, which is no signal of a component: open the part of a "
                "model that the clock belongs to as a whole, component(name, source=text, roots=[…])"
            )
    modified = f"{INSIDE}({changes})" if changes else INSIDE
    declared = [f"{name} {modified};", f"Clock {RIM}clock = Clock({interval!r});"]
    equations, renamed = [], {}
    for k, s in enumerate(signals):
        if not s.is_input:
            continue
        inside = f"{INSIDE}.{s.name}"
        if s.kind == "Clock":
            clock = f"{RIM}clock" if not s.rank else f"fill({RIM}clock, size({inside}, 1))"
            equations.append(f"{inside} = {clock};")
            continue
        size = "".join(f"[{', '.join(f'size({inside}, {n + 1})' for n in range(s.rank))}]" if s.rank else "")
        declared.append(f"input {s.kind} {RIM}u{k}{size};")
        if s.is_sampled:
            equations.append(f"{inside} = {RIM}u{k};")
        else:
            equations.append(f"{inside} = sample({RIM}u{k}, {RIM}clock);")
            renamed |= {inside: f"{s.name}{SAMPLED}", f"{RIM}u{k}": s.name}
    if not any(s.is_input and not s.is_sampled for s in signals):
        for k, s in enumerate(s for s in signals if not s.is_input and not s.rank):
            declared.append(f"input {s.kind} {RIM}s{k}; {s.kind} {RIM}v{k}; {s.kind} {RIM}w{k};")
            equations.append(f"{RIM}v{k} = sample({RIM}s{k}, {RIM}clock);")
            equations.append(f"{RIM}w{k} = {_ALWAYS[s.kind].format(y=f'{INSIDE}.{s.name}', v=f'{RIM}v{k}')};")
    text = f"{source or ''}\nmodel {MODEL} {' '.join(declared)} equation {' '.join(equations)} end {MODEL};\n"
    found = front_end.flatten(text, MODEL, called=name)
    dae = _under_own_names(found.dae, renamed)
    flat = {**_under_own_names(found.flat, renamed), "top_level_connectors": [], "model_description": None}
    by_name = {s.name: s for s in signals}
    for v in dae["storage"]["variables"]:
        s = by_name.get(v["name"])
        if s is not None:
            v["attributes"]["causality"] = "input" if s.is_input else "output"
            v["role"] = "input" if s.is_input else v["role"]
    return Closed(found._replace(dae=dae, flat=flat))


def _under_own_names(of: Json, also: Mapping[str, str]) -> dict[str, Any]:
    text = json.dumps(of)
    for before, after in also.items():
        text = text.replace(f'"{before}"', f'"{after}"')
    return json.loads(text.replace(f'"{INSIDE}.', '"'))


def signals_of(sources: Sources, of: Found) -> Iterator[Signal]:
    """The inputs and outputs of a class."""
    for d, scopes in sources.declarations(of):
        kind, prefixes = _kind(sources, d, scopes)
        causality = prefixes & {"input", "output"}
        if kind and causality and "protected" not in d.prefixes and "conditional" not in d.prefixes:
            yield Signal(d.name, kind, len(d.dimensions), "input" in causality, _is_sampled(sources, of, d.name))


def _kind(sources: Sources, d: tree.Declaration, scopes: tuple[Found, ...]) -> tuple[str, frozenset[str]]:
    """The built-in type of a declaration, and its prefixes and those of its type."""
    name, prefixes = d.type, d.prefixes
    while name not in ("Real", "Integer", "Boolean", "Clock"):
        found = sources.class_of(name, scopes)
        if found is None or found.source.alias is None:
            return "", prefixes
        prefixes |= found.prefixes | found.source.alias.prefixes
        name, scopes = found.source.alias.type, found.scopes
    return name, prefixes


def _is_sampled(sources: Sources, of: Found, name: str) -> bool:
    """True for an input that the class samples, or a part of it to which it is connected."""
    for part in sources.lineage(of):
        for e in tree.each_part(part.source.equations):
            if not isinstance(e, tree.Call):
                continue
            paths = [a.path if isinstance(a, tree.Reference) else "" for a in e.arguments]
            if e.function == "sample" and paths[0] == name:
                return True
            if e.function == "connect" and name in paths:
                other = paths[1 - paths.index(name)].partition(".")
                inner = next(((d, s) for d, s in sources.declarations(of) if d.name == other[0]), None)
                kind = sources.class_of(inner[0].type, inner[1]) if inner is not None else None
                if kind is not None and other[2] and _is_sampled(sources, kind, other[2]):
                    return True
    return False
