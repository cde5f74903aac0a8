"""Where an equation comes from, as data: passes ask it, messages print it."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, overload

import numpy as np

SOURCES = 4  # equations named


class Provenance(NamedTuple):
    """The component or network that wrote an equation, and what the equation says; `str` puts both together.

    `component` is empty for connections and for what passes made; `sources` are the equations as written that a pass
    combined; `line` is where in a user's code the equation was written, or the library's component made.
    """

    statement: str
    component: str = ""
    sources: "tuple[Provenance, ...]" = ()
    line: str = ""

    @property
    def is_written(self) -> bool:
        """True if a component or a network wrote the equation."""
        return bool(self.component)

    def __str__(self):
        return f"{self.component}: {self.statement}" if self.component else self.statement

    @property
    def located(self) -> str:
        """The text with the line of the user's code, for errors."""
        return f"{self}  ({self.line})" if self.line else str(self)


class Provenances(Sequence[Provenance]):
    """The provenance of each row of a group. An entry is made when it is asked for: a large model has millions, of
    which none is read.

    Row i is entry `item[i]` of source `source[i]`; a source is a list, or a function of such numbers.
    """

    __slots__ = ("_item", "_source", "_sources", "_written")

    def __init__(self, sources: Sequence["Source"], written: Sequence[bool], source: np.ndarray, item: np.ndarray):
        self._sources = tuple(sources)
        self._written = tuple(written)
        self._source = source
        self._item = item

    @classmethod
    def of(cls, entries: Sequence[Provenance]) -> "Provenances":
        """The provenances of a list."""
        entries = list(entries)
        written = np.array([p.is_written for p in entries], bool)
        # The same list twice: whether a row is written by a component is told by its source.
        return cls((entries.__getitem__,) * 2, (False, True), written.astype(np.int32), np.arange(len(entries)))

    @classmethod
    def made(cls, source: "Source", items: np.ndarray, is_written: bool) -> "Provenances":
        """The provenances that a function makes of numbers."""
        return cls((source,), (is_written,), np.zeros(len(items), np.int32), np.asarray(items, np.int64))

    @classmethod
    def joined(cls, parts: Sequence["Provenances"]) -> "Provenances":
        """The provenances of several groups, one after the other."""
        if len(parts) == 1:
            return parts[0]
        places: dict[tuple[int, bool], int] = {}
        sources: list[Source] = []
        source = []
        for part in parts:
            own = np.empty(len(part._sources), np.int32)
            for k, (function, written) in enumerate(zip(part._sources, part._written, strict=True)):
                own[k] = places.setdefault((id(function), written), len(sources))
                if own[k] == len(sources):
                    sources.append(function)
            source.append(own[part._source])
        item = np.concatenate([part._item for part in parts]) if parts else np.zeros(0, np.int64)
        written = [w for _, w in places]
        return cls(sources, written, np.concatenate(source) if parts else item, item)

    def take(self, rows: np.ndarray | list[int] | slice) -> "Provenances":
        """The provenances of some rows."""
        return Provenances(self._sources, self._written, self._source[rows], self._item[rows])

    @property
    def is_written(self) -> np.ndarray:
        """True for equations that a component or a network wrote."""
        return np.array(self._written, bool)[self._source]

    def __len__(self):
        return len(self._item)

    @overload
    def __getitem__(self, index: int) -> "Provenance": ...
    @overload
    def __getitem__(self, index: slice) -> "Provenances": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return self.take(np.arange(len(self))[index])
        return self._sources[self._source[index]](int(self._item[index]))

    def __iter__(self) -> Iterator["Provenance"]:
        for source, item in zip(self._source.tolist(), self._item.tolist(), strict=True):
            yield self._sources[source](item)


Source = Callable[[int], Provenance]


class Lines:
    """Lines of a user's code, by the numbers of components. Messages print them; they tell no two models apart."""

    def __init__(self, numbers: Sequence[np.ndarray], lines: Sequence[str]):
        self._numbers, self._lines = tuple(numbers), tuple(lines)

    def of(self, number: int) -> str:
        """The line of a component; "" if it is not known."""
        # By a search: only messages ask.
        places = zip(self._numbers, self._lines, strict=True)
        return next((line for numbers, line in places if number in numbers), "")


NO_LINES = Lines((), ())


class Written:
    """Source of provenances: one equation of many components, chosen by number."""

    def __init__(self, statement: str, components: Sequence[str], lines: Lines = NO_LINES):
        self.statement, self.components, self.lines = statement, components, lines

    def __call__(self, component: int) -> Provenance:
        return Provenance(self.statement, self.components[component], line=self.lines.of(component))


def combination(equations: Sequence[Provenance]) -> Provenance:
    """The provenance of a linear combination of equations, which may be combinations themselves."""
    sources = tuple(dict.fromkeys(s for e in equations for s in e.sources or (e,)))
    shown = [*map(str, sources[:SOURCES]), *(["…"] if len(sources) > SOURCES else [])]
    return Provenance(f"combination of {'; '.join(shown)}", sources=sources)


def differentiated(provenance: Provenance, times: int) -> str:
    """The text of an equation that was differentiated."""
    return str(provenance) + (f", differentiated {times}×" if times else "")
