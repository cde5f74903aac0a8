"""What an operation needs of the function in which it is written."""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from .straight import Kind


@dataclasses.dataclass(frozen=True)
class Value:
    """A value in C: an expression for a scalar, the name of a pointer for an array; and its entries, if they are
    known."""

    text: str
    kind: Kind
    known: np.ndarray | None = dataclasses.field(default=None, compare=False)

    def at(self, index: str) -> str:
        """The entry with this number."""
        return f"{self.text}[{index}]" if self.kind.shape else self.text

    @property
    def pointer(self) -> str:
        return self.text if self.kind.shape else f"&{self.text}"


class Writer(Protocol):
    """The lines of a function in C that is being written."""

    def line(self, text: str) -> None:
        """Adds a line."""

    def name(self) -> str:
        """A name that is new in this function."""
        ...

    def block(self, head: str) -> contextlib.AbstractContextManager[None]:
        """A block of lines in braces."""
        ...

    def loops(self, shape: Sequence[int]) -> contextlib.AbstractContextManager[list[str]]:
        """Nested loops over the indices of a shape."""
        ...

    def scratch(self, kind: Kind) -> Value:
        """An array, or a scalar that can be assigned, for use on the way."""
        ...

    def lent(self, kind: Kind) -> contextlib.AbstractContextManager[Value]:
        """An array whose place is free again afterwards."""
        ...

    def apply_closed(self, program: Any, given: Sequence[Value], results: Sequence[Value]) -> None:
        """Calls a closed program with values."""
