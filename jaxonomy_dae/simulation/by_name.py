"""The part of a solution's interface that tables and figures read."""

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from ..system.system import AcausalSystem
from .event_log import EventLog, Events


@runtime_checkable
class ByName(Protocol):
    """A solution whose variables are read by name. Methods of `Solution` call tables and figures, which therefore
    cannot import its class."""

    @property
    def ts(self) -> Float[Array, "*batch n"]:
        """The saved times."""
        ...

    @property
    def system(self) -> AcausalSystem:
        """The system that was simulated."""
        ...

    @property
    def event_log(self) -> EventLog | None:
        """The events as arrays; None if the model has none."""
        ...

    @property
    def events(self) -> Events:
        """The events by name."""
        ...

    def __getitem__(self, name: Any) -> Any:
        """The values of a variable, or of several."""
        ...

    def __contains__(self, name: str) -> bool: ...

    def __iter__(self) -> Iterator[str]: ...
