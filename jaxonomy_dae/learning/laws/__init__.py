"""Networks that cannot break physics: what they promise holds for all weights and all inputs, by how they are built."""

from .bounded import Bounded as Bounded
from .conservative import Conservative as Conservative
from .dissipation import Dissipation as Dissipation
from .isotropic import IsotropicPassive as IsotropicPassive
from .monotone import Monotone as Monotone
from .odd import Odd as Odd
from .passive import AbstractPassive as AbstractPassive
from .passive import Passive as Passive
from .port_hamiltonian import PortHamiltonian as PortHamiltonian
from .positive import Positive as Positive
