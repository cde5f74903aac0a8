"""What emitters of primitives have in common: their table, indices and copies."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .c_types import number
from .elementwise import ELEMENTWISE, Cell
from .straight import is_uniform
from .writer import Value, Writer

Params = Mapping[str, Any]
Emit = Callable[[Writer, Params, Sequence[Value], Sequence[Value]], None]


def emits(table: dict[str, Emit], *names: str) -> Callable[[Emit], Emit]:
    """Enters an emitter of primitives into a table."""

    def register(emit: Emit) -> Emit:
        table.update(dict.fromkeys(names, emit))
        return emit

    return register


def flat(indices: Sequence[str], shape: Sequence[int]) -> str:
    """The number of the entry with these indices, row by row."""
    text = "0"
    for i, n in zip(indices, shape, strict=True):
        text = i if text == "0" else (f"{text} * {n}" if i == "0" else f"({text} * {n} + {i})")
    return text


def cell(primitive: str, given: Sequence[str], dtype: Any) -> str:
    """An expression of two entries of one type."""
    return ELEMENTWISE[primitive](Cell(given, [np.dtype(dtype)] * len(given), np.dtype(dtype), {}))


def copy(body: Writer, target: Value, source: Value) -> None:
    """Assigns a scalar or all entries of an array, if they are not the same one."""
    if target.text == source.text:
        return
    if not target.kind.shape:
        body.line(f"{target.text} = {source.text};")
    elif source.known is not None and is_uniform(source.known):
        with body.loops((target.kind.size,)) as (i,):  # no table of equal numbers
            body.line(f"{target.at(i)} = {number(source.known.ravel()[0], source.kind.dtype)};")
    elif target.kind.size:
        body.line(f"memcpy({target.text}, {source.text}, {target.kind.size} * sizeof *{target.text});")


def affine(i: str, stride: int, begin: int) -> str:
    text = i if stride == 1 else ("0" if i == "0" else f"{i} * {stride}")
    if begin == 0:
        return text
    return str(begin) if text == "0" else f"({text} + {begin})"


def inside(text: str, last: int) -> str:
    return f"{text} < 0 ? 0 : {text} > {last} ? {last} : {text}"
