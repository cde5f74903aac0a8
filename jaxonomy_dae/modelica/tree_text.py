"""Parts of a syntax tree as Modelica text."""

import re

from ..base.errors import ModelError
from . import tree
from .read_expressions import FUNCTION

_PLAIN = re.compile(r"[A-Za-z_]\w*\Z")


def text_of(e: tree.Expression | None) -> str:
    """An expression as text, with parentheses around all operations.

    **Raises:**

    - `ModelError` for parts that have no text: several results, fields and entries of what is not a reference.
    """
    if isinstance(e, tree.Number):
        # In parentheses, as two signs must not follow each other.
        return f"({e.value!r})" if e.value < 0 else repr(e.value)
    if isinstance(e, tree.Truth):
        return "true" if e.truth else "false"
    if isinstance(e, tree.Text):
        return f'"{e.text}"'
    if isinstance(e, tree.Whole):
        return ":"
    if isinstance(e, tree.End):
        return "end"
    if isinstance(e, tree.Reference):
        return ".".join(_name(n) + _subscripts(s) for n, s in zip(e.parts, e.subscripts, strict=True))
    if isinstance(e, tree.Unary):
        return f"({e.operator} {text_of(e.operand)})"
    if isinstance(e, tree.Binary):
        return f"({text_of(e.left)} {e.operator} {text_of(e.right)})"
    if isinstance(e, tree.Choice):
        branches = " elseif ".join(f"{text_of(c)} then {text_of(v)}" for c, v in e.branches)
        return f"(if {branches} else {text_of(e.otherwise)})"
    if isinstance(e, tree.Array):
        return f"{{{_listed(e.entries)}}}"
    if isinstance(e, tree.Matrix):
        return f"[{'; '.join(map(_listed, e.rows))}]"
    if isinstance(e, tree.Range):
        step = "" if e.step == tree.Number(1) else f"{text_of(e.step)} : "
        return f"{text_of(e.first)} : {step}{text_of(e.last)}"
    if isinstance(e, tree.Comprehension):
        ranges = (name if r is None else f"{name} in {text_of(r)}" for name, r in e.iterators)
        return f"{text_of(e.value)} for {', '.join(ranges)}"
    if isinstance(e, tree.Call):
        if e.function == FUNCTION:
            return f"function {_listed(e.arguments)}"
        named = [f"{n} = {text_of(v)}" for n, v in e.named]
        return f"{'.'.join(map(_name, e.function.split('.')))}({', '.join([*map(text_of, e.arguments), *named])})"
    raise ModelError(f"an expression of the kind {type(e).__name__} has no text")


def _listed(entries: tuple[tree.Expression, ...]) -> str:
    return ", ".join(map(text_of, entries))


def _subscripts(subscripts: tuple[tree.Expression, ...]) -> str:
    return f"[{_listed(subscripts)}]" if subscripts else ""


def _name(name: str) -> str:
    return name if _PLAIN.match(name) else f"'{name}'"
