"""Causal blocks: signals in, signals out.

Conventions: inputs are `u`, outputs `y`; `connect(a.y, b.u)` lets the output of one block drive the input of another,
or the input of any component, and any variable of a component may drive a block. An input that nothing drives is given
to `simulate(inputs={...})`. Loops without memory are solved as the equations they are.
"""

from .algebra import DeadZone as DeadZone
from .algebra import Gain as Gain
from .algebra import Product as Product
from .algebra import Saturation as Saturation
from .algebra import Sum as Sum
from .control import PI as PI
from .control import PID as PID
from .discrete import Counter as Counter
from .discrete import DiscretePI as DiscretePI
from .discrete import DiscreteTransferFunction as DiscreteTransferFunction
from .discrete import Hysteresis as Hysteresis
from .discrete import PulseWidth as PulseWidth
from .discrete import SampledDelay as SampledDelay
from .discrete import SampleHold as SampleHold
from .dynamics import DerivativeFilter as DerivativeFilter
from .dynamics import FirstOrder as FirstOrder
from .dynamics import Integrator as Integrator
from .dynamics import PadeDelay as PadeDelay
from .dynamics import SecondOrder as SecondOrder
from .dynamics import StateSpace as StateSpace
from .dynamics import TransferFunction as TransferFunction
from .sources import Constant as Constant
from .sources import Noise as Noise
from .sources import Pulse as Pulse
from .sources import Ramp as Ramp
from .sources import Sine as Sine
from .sources import Step as Step
from .tables import Table1D as Table1D
from .tables import Table2D as Table2D
