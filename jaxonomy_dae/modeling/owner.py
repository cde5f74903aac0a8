"""The part of a component's interface that its ports read."""

from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Owner(Protocol):
    """A component, as its ports see it. Ports are parts of components, and so cannot import their class."""

    name: str

    @property
    def path(self) -> str:
        """The component's full name."""
        ...

    @property
    def parent(self) -> "Owner | None":
        """The component that contains it."""
        ...

    def symbol(self, name: str) -> Any:
        """The symbol of a declared variable or parameter, as the component now being written sees it."""
        ...
