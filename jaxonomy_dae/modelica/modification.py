"""Modifications of a class, given as Python values, as Modelica text."""

from collections.abc import Mapping
from typing import Any

from ..base.errors import ModelError


def modification(texts: tuple[str, ...], values: Mapping[str, Any]) -> str:
    """The text between the parentheses: `redeclare package Medium = M, useHeatPort = true, inertia(J = 2.0)`.

    A Python text is an expression of Modelica, as it is written; names with dots lead into components.
    """
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *outer, last = name.split(".")
        inside = nested
        for part in outer:
            inside = inside.setdefault(part, {})
            if not isinstance(inside, dict):
                raise _both_given(name)
        if last in inside:
            raise _both_given(name)
        inside[last] = value
    return ", ".join([*texts, *_each(nested)])


def _both_given(name: str) -> ModelError:
    return ModelError(f"the modification '{name}' and another one modify the same: give either the whole or its parts")


def _each(values: Mapping[str, Any]) -> list[str]:
    return [
        f"{name}({', '.join(_each(v))})" if isinstance(v, Mapping) else f"{name} = {_expression(name, v)}"
        for name, v in values.items()
    ]


def _expression(name: str, value: Any) -> str:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return value
    if isinstance(value, list | tuple):
        return "{" + ", ".join(_expression(name, v) for v in value) + "}"
    raise ModelError(
        f"the modification '{name}' is a number, a truth, a list of these, or a text of Modelica; got {value!r}. "
        "A symbol is given to the component: Class(ev, name, parameter=symbol)"
    )
