"""What a name without indices means in a model with arrays of components: `cell.v` is all of `cell[0].v`, …"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ...base.errors import ModelError
from ...host.staging import as_array


@dataclasses.dataclass(frozen=True)
class ArrayEntry:
    """A component that is in arrays: their shape, the level of the path at which each array stands, and how many
    dimensions it has; the ids of the first variable and the first parameter of each instance."""

    shape: tuple[int, ...]
    levels: tuple[tuple[int, int], ...]
    variable: np.ndarray
    parameter: np.ndarray
    variable_positions: dict[str, int]
    parameter_positions: dict[str, int]


@dataclasses.dataclass(frozen=True)
class ArrayNames:
    """All components that are in arrays, by their paths without indices."""

    entries: dict[str, ArrayEntry] = dataclasses.field(default_factory=dict)

    def variables(self, name: str) -> np.ndarray | None:
        """The ids behind the name of an array of variables, in its shape; None if it is not the name of one."""
        return self._find(name, True)

    def parameters(self, name: str) -> np.ndarray | None:
        """The ids behind the name of an array of parameters, in its shape; None if it is not the name of one."""
        return self._find(name, False)

    def dimensions(self, name: str) -> tuple[str, ...]:
        """Names of the dimensions of an array of variables: the paths of the arrays that the name leaves whole."""
        for entry, path, own in self._parts(name):
            if own in entry.variable_positions or own in entry.parameter_positions:
                bare = [piece.partition("[")[0] for piece in path]
                whole = [(".".join(bare[: level + 1]), n) for level, n in entry.levels if "[" not in path[level]]
                return tuple(p if n == 1 else f"{p}_{k}" for p, n in whole for k in range(n))
        return ()

    def _parts(self, name: str) -> Iterator[tuple[ArrayEntry, list[str], str]]:
        """The components that a name may begin with: (the component, its path in the name, what follows)."""
        pieces = name.split(".") if self.entries else []
        # Each cut is tried: an own name may have points too, as those of a port's variables have.
        for cut in range(len(pieces) - 1, 0, -1):
            entry = self.entries.get(".".join(p.partition("[")[0] for p in pieces[:cut]))
            if entry is not None:
                yield entry, pieces[:cut], ".".join(pieces[cut:])

    def _find(self, name: str, variables: bool) -> np.ndarray | None:
        for entry, path, own in self._parts(name):
            positions = entry.variable_positions if variables else entry.parameter_positions
            index = _index(entry, path)
            if own not in positions or index is None:
                continue
            ids = (entry.variable if variables else entry.parameter) + positions[own]
            try:
                found = ids.reshape(entry.shape)[index]
            except IndexError:
                continue
            # With all its indices it is the name of one variable, which the table of variables has.
            return found if found.ndim else None
        return None


def _index(entry: ArrayEntry, path: list[str]) -> tuple[int | slice, ...] | None:
    """The index that the brackets in a path stand for; None if they are not indices of its arrays."""
    dimensions = dict(entry.levels)
    index: list[int | slice] = []
    for level, piece in enumerate(path):
        _, bracket, inside = piece.partition("[")
        if not bracket:
            index.extend([slice(None)] * dimensions.get(level, 0))
            continue
        numbers = inside.removesuffix("]").split(",")
        if len(numbers) != dimensions.get(level, 0) or not all(n.isdecimal() for n in numbers):
            return None
        index.extend(int(n) for n in numbers)
    return tuple(index)


def inner_name(name: str) -> tuple[int, str]:
    """Returns (how often `der(…)` stands around a name, the name inside)."""
    order = 0
    while name.startswith("der(") and name.endswith(")"):
        order, name = order + 1, name[4:-1]
    return order, name


def one_by_one(arrays: ArrayNames, names: Sequence[str], initial: object) -> Any:
    """Initial values by name, with those of arrays of variables under the names of their entries: a number for all, or
    an array of the same shape.

    **Raises:**

    - `ModelError` for values of another shape.
    """
    if not isinstance(initial, Mapping) or not arrays.entries:
        return initial
    out: dict[object, object] = {}

    def put(values: dict[object, object]):
        twice = next((name for name in values if name in out), None)
        if twice is not None:
            raise ModelError(f"initial: '{twice}' is given twice, by its own name and as part of an array")
        out.update(values)

    for name, value in initial.items():
        order, inner = inner_name(name) if isinstance(name, str) else (0, "")
        ids = arrays.variables(inner)
        if ids is None:
            put({name: value})
            continue
        full = [f"{'der(' * order}{names[v]}{')' * order}" for v in ids.ravel().tolist()]
        shape = regular_shape(value)
        if shape == ():
            put(dict.fromkeys(full, value))
        elif shape == ids.shape:
            put(dict(zip(full, jnp.asarray(value).ravel(), strict=True)))
        else:
            raise ModelError(f"initial: {wrong_shape(name, ids.shape, value)}")
    return out


def wrong_shape(name: str, shape: tuple[int, ...], value: object) -> str:
    """The sentence that a value does not have the shape of an array of variables."""
    found = regular_shape(value)
    got = "rows of different lengths" if found is None else f"shape {found}"
    return f"'{name}' is an array of shape {shape}: give a number or an array of that shape; got {got}"


def regular_shape(value: object) -> tuple[int, ...] | None:
    """The shape of numbers, nested lists and arrays; None if they have none."""
    try:
        return np.shape(as_array(value))
    except (ValueError, TypeError):  # rows of different lengths
        return None
