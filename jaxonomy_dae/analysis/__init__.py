"""What can be said of a model without a run: where it rests, how it answers small changes, how results depend on
parameters."""

from .frequency import frequency_response as frequency_response
from .linearize import linearize as linearize
from .operating_point import OperatingPoint as OperatingPoint
from .response import FrequencyResponse as FrequencyResponse
from .state_space import StateSpace as StateSpace
from .steady_state import steady_state as steady_state
from .sweep import Sweep as Sweep
from .sweep import sweep as sweep
