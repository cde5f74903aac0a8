"""What a user writes: environment, symbols, ports, components, diagrams, learned terms."""

from .automatic_events import smooth as smooth
from .component import Component as Component
from .declarations import Value as Value
from .diagram import AcausalDiagram as AcausalDiagram
from .environment import EqnEnv as EqnEnv
from .events import assign as assign
from .events import pre as pre
from .events import reinit as reinit
from .events import terminate as terminate
from .interval import NONNEGATIVE as NONNEGATIVE
from .interval import POSITIVE as POSITIVE
from .interval import Interval as Interval
from .neural import NeuralDAEBlock as NeuralDAEBlock
from .ports import Domain as Domain
from .ports import Electrical as Electrical
from .ports import Hydraulic as Hydraulic
from .ports import Overdetermined as Overdetermined
from .ports import Planar as Planar
from .ports import Rotational as Rotational
from .ports import Thermal as Thermal
from .ports import Translational as Translational
from .streams import actual_stream as actual_stream
from .streams import in_stream as in_stream
from .symbols import Eq as Eq
from .symbols import der as der
