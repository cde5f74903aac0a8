"""Networks that cannot break physics: what they promise holds for all weights and all inputs, by how they are built."""

from .energy import AbstractPassive as AbstractPassive
from .energy import Conservative as Conservative
from .energy import Dissipation as Dissipation
from .energy import IsotropicPassive as IsotropicPassive
from .energy import Passive as Passive
from .energy import PortHamiltonian as PortHamiltonian
from .shapes import Bounded as Bounded
from .shapes import Monotone as Monotone
from .shapes import Odd as Odd
from .shapes import Positive as Positive
