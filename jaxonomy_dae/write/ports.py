"""Ports: where components meet.

A domain names the quantities that are equal at a junction (across) and those that sum to zero (through), counted
positive into the component. Its streams are quantities that the flow carries: what leaves a component has the value
that the component says, what enters it has the mixture of what leaves the others (Modelica Language Specification 3.6,
chapter 15).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import sympy

from ..base.errors import ModelError, UnknownAttribute


@dataclasses.dataclass(frozen=True)
class Overdetermined:
    """Across quantities that are more than their degrees of freedom, as the nine entries of a rotation are.

    They are equal along connections that make a tree, which begins at a root: a port whose component determines them. A
    connection that closes a loop demands less (Modelica Language Specification 3.6, section 9.4).

    **Arguments:**

    - `names`: the quantities, in the order of `across`.
    - `residues`: what is zero where a connection closes a loop, from the quantities of its two ends.
    """

    names: tuple[str, ...]
    residues: Callable[[Mapping[str, sympy.Symbol], Mapping[str, sympy.Symbol]], Sequence[sympy.Expr]]


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
    - `streams`: pairs (name, unit) of the quantities that the one through quantity carries. `port.h` is what leaves the
        component, `in_stream(port.h)` what would enter it.
    - `overdetermined`: those of the across quantities that are more than their degrees of freedom.

    **Raises:**

    - `ModelError` for streams without exactly one through quantity.
    """

    name: str
    across: tuple[tuple[str, str], ...]
    through: tuple[tuple[str, str], ...]
    streams: tuple[tuple[str, str], ...] = ()
    overdetermined: Overdetermined | None = None

    def __post_init__(self):
        if self.streams and len(self.through) != 1:
            raise ModelError(
                f"the domain '{self.name}' has {len(self.through)} through quantities: streams are carried by one"
            )

    @property
    def variables(self) -> tuple[tuple[str, str], ...]:
        """Pairs (name, unit) of all variables of a port."""
        return self.across + self.through + self.streams + tuple((inflow(n), unit) for n, unit in self.streams)


def inflow(stream: str) -> str:
    """The name of what a stream would bring into the component; the port comes first, as in `a.in_stream(h)`."""
    name, bracket, place = stream.partition("[")
    return f"in_stream({name}){bracket}{place}"


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


# For tests, which check types where they run.
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

    # Symbols are made when they are asked for: their path depends on which component is being written.
    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        domain = self.domain
        known = [n for n, _ in (*domain.across, *domain.through, *domain.streams)]
        if name not in known:
            raise UnknownAttribute(
                f"the {domain.name} port '{self.component.name}.{self.name}' has no '{name}': it has {', '.join(known)}"
            )
        return self.component.symbol(f"{self.name}.{name}")

    def __repr__(self):
        return f"{self.component.path}.{self.name}: {self.domain.name} port"
