"""The package's errors. Every message speaks in user names and says what to do."""

from typing import Any

from .page import PAGE, entry_for


class JaxonomyDaeError(Exception):
    """The base class of all errors that this package raises. Python shows below the message where the page of errors
    explains it, if it does; `explanation` is what the page says."""

    def __init__(self, *args: Any):
        super().__init__(*args)
        entry = entry_for(str(self))
        if entry is not None:
            self.add_note(f"Explained in {PAGE}#{entry.anchor}")

    @property
    def explanation(self) -> str:
        """What the page of errors says of this error; "" if it is not there."""
        entry = entry_for(str(self))
        return "" if entry is None else f"{entry.meaning} Fix: {entry.fix}"


class ModelError(JaxonomyDaeError, ValueError):
    """The model as written is not well formed: a name, a port, a value, a shape."""


class StructuralError(ModelError):
    """The equations and the unknowns do not fit together, whatever their values."""


class UnitError(ModelError):
    """Units do not fit together, or a text is not a unit."""


class UnknownAttribute(ModelError, AttributeError):
    """A component or a port has no attribute of this name."""

    def __init__(self, *args: Any):
        Exception.__init__(self, *args)  # no entry is looked for: `hasattr` raises it, too


class MissingPackage(JaxonomyDaeError, ImportError):
    """A feature needs a package that is not installed."""


class InitializationError(JaxonomyDaeError, RuntimeError):
    """No consistent initial point was found."""


class SteadyStateError(JaxonomyDaeError, RuntimeError):
    """No equilibrium was found, or one that does not determine all states."""


class SimulationError(JaxonomyDaeError, RuntimeError):
    """The integration stopped before its end."""
