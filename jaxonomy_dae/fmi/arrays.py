"""Variables of arrays of components as arrays of FMI 3: `cell[0].c.v`, `cell[1].c.v`, … become `cell.c.v`."""

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from .description import Variable

_INDEX = re.compile(r"\[(\d+(?:,\d+)*)\]")


def as_arrays(variables: Sequence[Variable]) -> tuple[list[Variable], np.ndarray]:
    """Puts neighbours together that are the entries of one array, row by row, and alike in all but their values.

    **Returns:**

    (The variables, the place among them of each of those given.)
    """
    out: list[Variable] = []
    new = np.zeros(len(variables), int)
    begin = 0
    while begin < len(variables):
        end, shape = _run(variables, begin, new)
        new[begin:end] = len(out)
        first = variables[begin]
        if first.derivative is not None:
            first = dataclasses.replace(first, derivative=int(new[first.derivative]))
        out.append(first if not shape else _array(first, variables[begin:end], shape))
        begin = end
    return out, new


def entries_together(names: Sequence[str]) -> list[str]:
    """Names in their order, but the entries of an array where its first one stands."""
    first: dict[str, int] = {}
    for name in names:
        first.setdefault(_entry(name)[0], len(first))
    return sorted(names, key=lambda name: first[_entry(name)[0]])


def _entry(name: str) -> tuple[str, tuple[int, ...]]:
    """The name of an array, and the indices of its entry."""
    indices = tuple(int(k) for found in _INDEX.findall(name) for k in found.split(","))
    return _INDEX.sub("", name), indices


def _run(variables: Sequence[Variable], begin: int, new: np.ndarray) -> tuple[int, tuple[int, ...]]:
    """The end of an array that begins here, and its shape; of a variable alone, without one."""
    first = variables[begin]
    name, index = _entry(first.name)
    if not index or any(index) or first.c.size != 1 or first.name.startswith("'"):
        return begin + 1, ()
    indices = [index]
    step = variables[begin + 1].c.place - first.c.place if begin + 1 < len(variables) else 1
    while begin + len(indices) < len(variables):
        other = variables[begin + len(indices)]
        other_name, index = _entry(other.name)
        if other_name != name or not _alike(first, other, len(indices) * step, new):
            break
        indices.append(index)
    shape = tuple(max(column) + 1 for column in zip(*indices, strict=True))
    whole = indices == list(np.ndindex(*shape)) and len(indices) > 1
    return (begin + len(indices), shape) if whole else (begin + 1, ())


def _alike(first: Variable, other: Variable, distance: int, new: np.ndarray) -> bool:
    """True for variables that differ in their places, by `distance`, in their starts, and in typical sizes."""
    c = dataclasses.replace(
        first.c, name=other.c.name, place=first.c.place + distance,
        start=first.c.start if first.c.start < 0 else first.c.start + distance,
    )  # fmt: skip
    if c != other.c or (first.start is None) != (other.start is None):
        return False
    if (first.derivative is None) != (other.derivative is None):
        return False
    if first.derivative is not None and new[first.derivative] != new[other.derivative]:
        return False
    own = dataclasses.replace(first, c=other.c, name=other.name, start=other.start, derivative=other.derivative)
    own = dataclasses.replace(own, nominal=other.nominal)
    return all(getattr(own, f.name) is getattr(other, f.name) or getattr(own, f.name) == getattr(other, f.name)
               for f in dataclasses.fields(own))  # fmt: skip


def _array(first: Variable, entries: Sequence[Variable], shape: tuple[int, ...]) -> Variable:
    name, _ = _entry(first.name)
    starts = (
        None if first.start is None else np.reshape([float(v.start) for v in entries if v.start is not None], shape)
    )
    step = entries[1].c.place - entries[0].c.place
    c = dataclasses.replace(first.c, name=name, size=len(entries), step=step)
    nominal = max(v.nominal for v in entries)
    return dataclasses.replace(first, name=name, c=c, start=starts, nominal=nominal, shape=shape)
