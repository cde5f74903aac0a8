"""Ports: where components meet.

A domain names the quantities that are equal at a junction (across) and those that sum to zero (through), counted
positive into the component.
"""

import dataclasses
from typing import Protocol, runtime_checkable

import sympy

from ..base.errors import UnknownAttribute


@dataclasses.dataclass(frozen=True)
class Domain:
    """A physical domain: the quantities of its ports.

    ```python
    Magnetic = Domain("Magnetic", across=(("V_m", "A"),), through=(("Phi", "Wb"),))
    ```

    **Arguments:**

    - `name`: what messages call it.
    - `across`: pairs (name, unit) of the quantities that are equal at connected ports.
    - `through`: pairs (name, unit) of the quantities that sum to zero there. They count positive into the component.
    """

    name: str
    across: tuple[tuple[str, str], ...]
    through: tuple[tuple[str, str], ...]


Electrical = Domain("Electrical", across=(("v", "V"),), through=(("i", "A"),))
Translational = Domain("Translational", across=(("s", "m"),), through=(("f", "N"),))
Rotational = Domain("Rotational", across=(("phi", "rad"),), through=(("tau", "N*m"),))
Thermal = Domain("Thermal", across=(("T", "K"),), through=(("Q_flow", "W"),))
Planar = Domain(
    "Planar",
    across=(("x", "m"), ("y", "m"), ("phi", "rad")),
    through=(("fx", "N"), ("fy", "N"), ("tau", "N*m")),
)
Hydraulic = Domain("Hydraulic", across=(("p", "Pa"),), through=(("m_flow", "kg/s"),))


@runtime_checkable
class Owner(Protocol):
    """A component, as its ports see it. Ports are parts of components, and so cannot import their class."""

    name: str

    @property
    def path(self) -> str:
        """The component's full name."""
        ...

    @property
    def parent(self) -> "Owner | None":
        """The component that contains it."""
        ...

    def symbol(self, name: str) -> sympy.Symbol:
        """The symbol of a declared variable or parameter, as the component now being written sees it."""
        ...


class Port:
    """A port of a component; its variables are attributes: `self.p.v`, `self.p.i`."""

    def __init__(self, component: Owner, name: str, domain: Domain):
        self.component = component
        self.name = name
        self.domain = domain

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        domain = self.domain
        known = [n for n, _ in (*domain.across, *domain.through)]
        if name not in known:
            raise UnknownAttribute(
                f"the {domain.name} port '{self.component.name}.{self.name}' has no '{name}': it has {', '.join(known)}"
            )
        return self.component.symbol(f"{self.name}.{name}")

    def __repr__(self):
        return f"{self.component.path}.{self.name}: {self.domain.name} port"
