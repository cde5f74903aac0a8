"""The package's errors. Every message speaks in user names and says what to do."""

from .page import PAGE, entry_for


class JaxonomyDaeError(Exception):
    """The base class of all errors that this package raises. Below the message, Python shows where the page of errors
    explains it. `explanation` holds the text of that entry."""

    def __init__(self, *args: object):
        super().__init__(*args)
        entry = entry_for(str(self))
        if entry is not None:
            self.add_note(f"Explained in {PAGE}#{entry.anchor}")

    @property
    def explanation(self) -> str:
        """The text of this error's entry on the page of errors; "" if it has none."""
        entry = entry_for(str(self))
        return "" if entry is None else f"{entry.meaning} Fix: {entry.fix}"


class ModelError(JaxonomyDaeError, ValueError):
    """The model is not well formed: a name, a port, a value or a shape is wrong."""


class StructuralError(ModelError):
    """The equations and the unknowns do not fit together, whatever their values."""


class UnitError(ModelError):
    """Units do not fit together, or a text is not a unit."""


class UnknownAttribute(ModelError, AttributeError):
    """A component or a port has no attribute of this name."""

    def __init__(self, *args: object):
        Exception.__init__(self, *args)  # no entry is looked for: `hasattr` raises it, too


class MissingPackage(JaxonomyDaeError, ImportError):
    """A feature needs a package that is not installed."""


class InitializationError(JaxonomyDaeError, RuntimeError):
    """No consistent initial point was found."""


class SteadyStateError(JaxonomyDaeError, RuntimeError):
    """No equilibrium was found, or the equilibrium leaves some states undetermined."""


class SimulationError(JaxonomyDaeError, RuntimeError):
    """The integration stopped before its end."""
