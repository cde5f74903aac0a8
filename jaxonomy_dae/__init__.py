"""Differentiable acausal modeling: components and equations in, one Equinox module out."""

from .analysis import FrequencyResponse as FrequencyResponse
from .analysis import OperatingPoint as OperatingPoint
from .analysis import StateSpace as StateSpace
from .analysis import Sweep as Sweep
from .analysis import frequency_response as frequency_response
from .analysis import linearize as linearize
from .analysis import steady_state as steady_state
from .analysis import sweep as sweep
from .errors import InitializationError as InitializationError
from .errors import ModelError as ModelError
from .errors import SimulationError as SimulationError
from .errors import SteadyStateError as SteadyStateError
from .errors import StructuralError as StructuralError
from .errors import UnitError as UnitError
from .modeling import AcausalDiagram as AcausalDiagram
from .modeling import Component as Component
from .modeling import Domain as Domain
from .modeling import Electrical as Electrical
from .modeling import EqnEnv as EqnEnv
from .modeling import Hydraulic as Hydraulic
from .modeling import Interval as Interval
from .modeling import NeuralDAEBlock as NeuralDAEBlock
from .modeling import Planar as Planar
from .modeling import Rotational as Rotational
from .modeling import Thermal as Thermal
from .modeling import Translational as Translational
from .modeling import assign as assign
from .modeling import der as der
from .modeling import pre as pre
from .modeling import reinit as reinit
from .modeling import smooth as smooth
from .modeling import terminate as terminate
from .simulation.simulate import simulate as simulate
from .simulation.solution import Solution as Solution
from .system.acausal_compiler import AcausalCompiler as AcausalCompiler
from .system.system import AcausalSystem as AcausalSystem

__version__ = "0.1.0"
