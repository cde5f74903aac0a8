"""Outputs of a class that are kept from event to event, as signals: a variable of its own keeps each, and the output
follows it."""

import dataclasses
import re
from collections.abc import Collection
from typing import Any

from . import tree
from .definitions import assigned_in, read_before, whens_in
from .flat_model import FlatModel

HELD = ":held"  # ends the name of the variable that keeps an output


def with_held_outputs(flat: FlatModel, outputs: Collection[str]) -> FlatModel:
    """The model with variables that keep those outputs which events assign or whose values before an event are read."""
    model = flat.model
    statements = model.equations, model.algorithms, tuple(d.value for d in model.declarations)
    sections = [section for section in model.algorithms if any(whens_in(section))]
    kept = {_whole(n) for n in assigned_in(tuple(whens_in(model.equations)))}
    kept |= {_whole(n) for section in sections for n in assigned_in(section)}
    # What is Real and read before an event may be continuous.
    others = {_whole(n) for section in model.algorithms for n in assigned_in(section)}
    others |= {_whole(n) for n in read_before(statements)}
    kept |= others - {_whole(d.name) for d in model.declarations if d.type == "Real"}
    kept &= {_whole(n) for n in outputs}
    if not kept:
        return flat
    renamed: tree.Class = _renamed(model, kept)
    declarations, equations = [], list(renamed.equations)
    for d in model.declarations:
        if _whole(d.name) not in kept:
            continue
        modifiers = {k: v for k, v in d.modifiers.items() if k == "unit"}
        declarations.append(d._replace(prefixes=d.prefixes - {"discrete"}, modifiers=modifiers, value=None))
        equations.append(tree.Equality(tree.Reference((d.name,)), tree.Reference((_held(d.name),)), d.line))
    whole = renamed._replace(declarations=(*renamed.declarations, *declarations), equations=tuple(equations))
    return dataclasses.replace(flat, model=whole)


def _renamed(part: Any, kept: Collection[str]) -> Any:
    """A part of the tree with other names for the outputs that are kept."""
    if isinstance(part, tree.Reference) and len(part.parts) == 1 and _whole(part.parts[0]) in kept:
        return tree.Reference((_held(part.parts[0]),), _renamed(part.subscripts, kept))
    if isinstance(part, tree.Declaration):
        name = _held(part.name) if _whole(part.name) in kept else part.name
        prefixes = part.prefixes - {"output"} if name != part.name else part.prefixes
        modifiers, value = _renamed(part.modifiers, kept), _renamed(part.value, kept)
        return part._replace(name=name, prefixes=prefixes, modifiers=modifiers, value=value)
    if isinstance(part, tuple):
        parts = [_renamed(each, kept) for each in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    if isinstance(part, dict):
        return {k: _renamed(v, kept) for k, v in part.items()}
    return part


def _held(name: str) -> str:
    return _whole(name) + HELD + name[len(_whole(name)) :]


def _whole(name: str) -> str:
    """The array of an entry."""
    return re.sub(r"\[[\d,?]+\]$", "", name)
