"""Full names, made when they are asked for: a large model has millions, of which few are read."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np

BLOCK = 4096  # names made at a time: whoever looks at the first few does not wait for a million


class Paths(Sequence[str]):
    """The paths of all components, by number."""

    def __init__(self, paths: list[str]):
        self._paths = paths

    @functools.cached_property
    def number(self) -> dict[str, int]:
        """The number of each component by its path."""
        return {path: k for k, path in enumerate(self._paths)}

    def __len__(self):
        return len(self._paths)

    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    @overload
    def __getitem__(self, index: Any) -> str: ...
    def __getitem__(self, index):
        return self._paths[index]

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)


@dataclasses.dataclass(frozen=True, eq=False)
class Names(Sequence[str]):
    """The names of all variables, parameters or ports, by id, and `more` names after those.

    Those of a component follow each other, in the order of the components. Name k is `pieces[piece[k]]`, a text before
    and one after the path of component `owner[k]`.
    """

    paths: Paths
    owner: np.ndarray
    piece: np.ndarray
    pieces: tuple[tuple[str, str], ...]
    more: tuple[str, ...] = ()

    def followed_by(self, more: Sequence[str]) -> "Names":
        """The names with more of them."""
        return dataclasses.replace(self, more=(*self.more, *more))

    def __len__(self):
        return len(self.owner) + len(self.more)

    @overload
    def __getitem__(self, index: slice) -> "Names": ...
    @overload
    def __getitem__(self, index: Any) -> str: ...
    def __getitem__(self, index):
        n = len(self.owner)
        if isinstance(index, slice):
            start, stop, step = index.indices(len(self))
            assert step == 1
            more = self.more[max(start - n, 0) : max(stop - n, 0)]
            return dataclasses.replace(self, owner=self.owner[start:stop], piece=self.piece[start:stop], more=more)
        index = range(len(self))[index]
        if index >= n:
            return self.more[index - n]
        before, after = self.pieces[self.piece[index]]
        return before + self.paths[self.owner[index]] + after

    def __iter__(self) -> Iterator[str]:
        paths, pieces = self.paths, self.pieces
        for start in range(0, len(self.owner), BLOCK):
            here = slice(start, start + BLOCK)
            for c, k in zip(self.owner[here].tolist(), self.piece[here].tolist(), strict=True):
                yield pieces[k][0] + paths[c] + pieces[k][1]
        yield from self.more

    @functools.cached_property
    def number(self) -> "Numbers":
        """The number of each name."""
        return Numbers(self)

    def __contains__(self, name: object) -> bool:
        return name in self.number

    def index(self, value: str, *_) -> int:
        if value not in self.number:
            raise ValueError(f"{value!r} is not one of these names")
        return self.number[value]


class Numbers(Mapping[str, int]):
    """The number of each name, found by the component that it begins with."""

    def __init__(self, names: Names):
        self._names = names
        self._more = {name: len(names.owner) + k for k, name in enumerate(names.more)}
        self._piece = {piece: k for k, piece in enumerate(names.pieces)}
        self._before = tuple(dict.fromkeys(before for before, _ in names.pieces))

    def __getitem__(self, name: str) -> int:
        if name in self._more:
            return self._more[name]
        owner, number = self._names.owner, self._names.paths.number
        # Without a dictionary of all names, of which a large model has millions: a name is found by its component,
        # whose path may have points itself.
        for before in self._before if isinstance(name, str) else ():
            inner = name.removeprefix(before)
            cut = inner.find(".") if len(inner) + len(before) == len(name) else -1
            while cut >= 0:
                piece, component = self._piece.get((before, inner[cut:])), number.get(inner[:cut])
                if piece is not None and component is not None:
                    first, last = np.searchsorted(owner, [component, component + 1]).tolist()
                    found = np.flatnonzero(self._names.piece[first:last] == piece)
                    if len(found):
                        return first + int(found[0])
                cut = inner.find(".", cut + 1)
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self):
        return len(self._names)
