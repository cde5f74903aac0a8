"""The package's errors."""

from .base.errors import InitializationError as InitializationError
from .base.errors import JaxonomyDaeError as JaxonomyDaeError
from .base.errors import MissingPackage as MissingPackage
from .base.errors import ModelError as ModelError
from .base.errors import SimulationError as SimulationError
from .base.errors import SteadyStateError as SteadyStateError
from .base.errors import StructuralError as StructuralError
from .base.errors import UnitError as UnitError
from .base.errors import UnknownAttribute as UnknownAttribute
