"""Tables of a model that rumoca has flattened: its equations hold a number in place of each, the declarations of the
source hold the call that makes it."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import ModelError
from . import tree
from .flat_model import FlatModel
from .rumoca_expressions import Json
from .tables import SMOOTHNESS

_BINARY = {
    "Add": "+", "Sub": "-", "Mul": "*", "Div": "/", "Exp": "^", "AddElem": ".+", "SubElem": ".-", "MulElem": ".*",
    "DivElem": "./", "ExpElem": ".^", "Lt": "<", "Le": "<=", "Gt": ">", "Ge": ">=", "Eq": "==", "Neq": "<>",
    "And": "and", "Or": "or",
}  # fmt: skip


def with_external_objects(model: FlatModel, flat: Json) -> FlatModel:
    """The model with the calls that make its tables.

    **Raises:**

    - `ModelError` for arguments of a table that are not read.
    """
    ordinals: Mapping[str, int] = flat["enum_literal_ordinals"]
    declarations = []
    for d in model.model.declarations:
        call = ((flat["variables"].get(d.name) or {}).get("binding") or {}).get("FunctionCall")
        if call is not None and _name(call) in SMOOTHNESS:
            try:
                d = d._replace(value=_expression({"FunctionCall": call}, ordinals))
            except KeyError as kind:
                raise ModelError(f"{model.name}, line {d.line}: {kind} in the table '{d.name}' is not read") from None
        declarations.append(d)
    return dataclasses.replace(model, model=model.model._replace(declarations=tuple(declarations)))


def _name(inside: Json) -> str:
    name: Any = inside["name"]
    return name if isinstance(name, str) else name["name"]


def _expression(e: Json, ordinals: Mapping[str, int]) -> tree.Expression:
    """An expression of the declarations; a `KeyError` names what is not read."""
    kind, inside = next(iter(e.items()))

    def each(parts: Sequence[Json]) -> tuple[tree.Expression, ...]:
        return tuple(_expression(part, ordinals) for part in parts)

    if kind == "Literal":
        value = next(iter(inside["value"].values()))
        if isinstance(value, bool):
            return tree.Truth(value)
        return tree.Text(value) if isinstance(value, str) else tree.Number(value)
    if kind == "VarRef":
        name = _name(inside)
        if name in ordinals:
            return tree.Number(ordinals[name])
        if inside.get("subscripts"):
            raise KeyError(f"the subscript of '{name}'")
        return tree.Reference((name,))
    if kind == "Array":
        return tree.Array(each(inside["elements"]))
    if kind == "FunctionCall":
        return tree.Call(_name(inside), each(inside["args"]), ())
    if kind == "BuiltinCall":
        return tree.Call(inside["function"].lower(), each(inside["args"]), ())
    if kind == "Unary" and "Not" in inside["op"]:
        return tree.Unary("not", _expression(inside["rhs"], ordinals))
    if kind == "Unary" and "Minus" in inside["op"]:
        return tree.Unary("-", _expression(inside["rhs"], ordinals))
    if kind == "If":
        branches = tuple((_expression(c, ordinals), _expression(value, ordinals)) for c, value in inside["branches"])
        return tree.Choice(branches, _expression(inside["else_branch"], ordinals))
    if kind == "Binary":
        return tree.Binary(_BINARY[inside["op"]], *each([inside["lhs"], inside["rhs"]]))
    raise KeyError(f"an expression of the kind '{kind}'")
