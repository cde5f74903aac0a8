"""The package's errors: their classes, and the words that messages share."""

from .keywords import check_handed_on as check_handed_on
from .keywords import explained as explained
from .keywords import explained_keywords as explained_keywords
from .keywords import keywords_of as keywords_of
from .keywords import wrong_keyword as wrong_keyword
from .kinds import InitializationError as InitializationError
from .kinds import JaxonomyDaeError as JaxonomyDaeError
from .kinds import MissingPackage as MissingPackage
from .kinds import ModelError as ModelError
from .kinds import SimulationError as SimulationError
from .kinds import SteadyStateError as SteadyStateError
from .kinds import StructuralError as StructuralError
from .kinds import UnitError as UnitError
from .kinds import UnknownAttribute as UnknownAttribute
from .wrong_values import by_name as by_name
from .wrong_values import nearest as nearest
from .wrong_values import whole_number as whole_number
