"""Where an equation comes from, as data: passes ask it, messages print it."""

from collections.abc import Sequence
from typing import NamedTuple

SOURCES = 4  # equations named


class Provenance(NamedTuple):
    """The component or network that wrote an equation, and what the equation says; `str` puts both together.

    `component` is empty for connections and for what passes made; `sources` are the equations as written that a pass
    combined.
    """

    statement: str
    component: str = ""
    sources: "tuple[Provenance, ...]" = ()

    @property
    def is_written(self) -> bool:
        """Whether a component or a network wrote the equation."""
        return bool(self.component)

    def __str__(self):
        return f"{self.component}: {self.statement}" if self.component else self.statement


def combination(equations: Sequence[Provenance]) -> Provenance:
    """The provenance of a linear combination of equations, which may be combinations themselves."""
    sources = tuple(dict.fromkeys(s for e in equations for s in e.sources or (e,)))
    shown = [*map(str, sources[:SOURCES]), *(["…"] if len(sources) > SOURCES else [])]
    return Provenance(f"combination of {'; '.join(shown)}", sources=sources)


def differentiated(provenance: Provenance, times: int) -> str:
    """The text of an equation that was differentiated."""
    return str(provenance) + (f", differentiated {times}×" if times else "")
