"""Functions in C that have been written."""

import dataclasses
from collections.abc import Sequence

from .c_types import c_type
from .straight import Kind


@dataclasses.dataclass(frozen=True)
class CFunction:
    """A function that has been written: its name, its arguments and results, and the bytes that it needs in `w`."""

    name: str
    arguments: tuple[Kind, ...]
    results: tuple[Kind, ...]
    work: int

    @property
    def prototype(self) -> str:
        return f"static void {self.name}({', '.join(parameters(self.arguments, self.results))})"


def parameters(arguments: Sequence[Kind], results: Sequence[Kind]) -> list[str]:
    given = [
        f"const {c_type(k.dtype)} *restrict a{n}" if k.shape else f"{c_type(k.dtype)} a{n}"
        for n, k in enumerate(arguments)
    ]
    return [*given, *(f"{c_type(k.dtype)} *restrict o{n}" for n, k in enumerate(results)), "char *restrict w"]
