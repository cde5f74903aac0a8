"""Electrical components.

Conventions: potential `v` in volt, current `i` in ampere counted positive into a pin. A two-pin component has
`v = p.v − n.v`, and `i` flows from `p` to `n`.
"""

from .ideal import Ground as Ground
from .ideal import Gyrator as Gyrator
from .ideal import IdealOpAmp as IdealOpAmp
from .ideal import IdealTransformer as IdealTransformer
from .machines import EMF as EMF
from .machines import DCMotor as DCMotor
from .passive import Capacitor as Capacitor
from .passive import Diode as Diode
from .passive import HeatedResistor as HeatedResistor
from .passive import Inductor as Inductor
from .passive import Memristor as Memristor
from .passive import MutualInductor as MutualInductor
from .passive import Potentiometer as Potentiometer
from .passive import Resistor as Resistor
from .sensors import CurrentSensor as CurrentSensor
from .sensors import PowerSensor as PowerSensor
from .sensors import VoltageSensor as VoltageSensor
from .sources import CurrentControlledCurrent as CurrentControlledCurrent
from .sources import CurrentControlledVoltage as CurrentControlledVoltage
from .sources import CurrentSource as CurrentSource
from .sources import PulseCurrent as PulseCurrent
from .sources import PulseVoltage as PulseVoltage
from .sources import SignalCurrent as SignalCurrent
from .sources import SignalVoltage as SignalVoltage
from .sources import SineCurrent as SineCurrent
from .sources import SineVoltage as SineVoltage
from .sources import StepCurrent as StepCurrent
from .sources import StepVoltage as StepVoltage
from .sources import VoltageControlledCurrent as VoltageControlledCurrent
from .sources import VoltageControlledVoltage as VoltageControlledVoltage
from .sources import VoltageSource as VoltageSource
from .switching import IdealDiode as IdealDiode
from .switching import IdealThyristor as IdealThyristor
from .switching import JoiningSwitch as JoiningSwitch
from .switching import Switch as Switch
from .switching import TimedSwitch as TimedSwitch
