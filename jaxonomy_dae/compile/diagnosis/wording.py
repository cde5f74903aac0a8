"""Words for messages: lists of names, and what a user of each physical domain calls things."""

import collections
import dataclasses
from collections.abc import Iterable, Sequence

from ..model.provenance import Provenance

SHOWN = 6  # names, or equations, of a list in a sentence


@dataclasses.dataclass(frozen=True)
class DomainWords:
    """The words in which errors speak of one domain: its across and through quantities, components that carry a level,
    those that mend a loop."""

    across: str
    between: str  # what a difference of two across quantities is called
    through: str
    floating: str  # a sentence with {names}
    mend: str
    bridge: str


WORDS = {
    "Electrical": DomainWords(
        "potential",
        "voltage",
        "current",
        "the circuit of {names} has no ground, so nothing determines its potentials",
        "Connect a Ground to one of its nodes",
        "a resistor",
    ),
    "Translational": DomainWords(
        "position",
        "distance",
        "force",
        "nothing holds {names}: no mass and no fixed position is connected",
        "Connect a Mass or a FixedPosition",
        "a spring",
    ),
    "Rotational": DomainWords(
        "angle",
        "difference of angles",
        "torque",
        "nothing holds {names}: no inertia and no fixed angle is connected",
        "Connect an Inertia or a FixedAngle",
        "a spring",
    ),
    "Thermal": DomainWords(
        "temperature",
        "temperature difference",
        "heat flow",
        "nothing determines the temperatures of {names}: no heat capacitor and no fixed temperature is connected",
        "Connect a HeatCapacitor or a FixedTemperature",
        "a thermal conductor",
    ),
    "Hydraulic": DomainWords(
        "pressure",
        "pressure difference",
        "mass flow",
        "nothing determines the pressures of {names}: no pressure source, tank or capacity is connected",
        "Connect a PressureSource, a Tank or a HydraulicCapacity",
        "a pipe",
    ),
}
# Of domains with several across quantities, which messages call by their names.
SEVERAL = {
    "Planar": ("nothing holds {names}: no body and no world is connected", "Connect a Body or a World", "a joint"),
}


def words(domain: str, across: Sequence[str] = ("potential",), through: str = "flow") -> DomainWords:
    """The words of a domain; for a domain of several quantities and a user's own, the names of its variables."""
    if domain in WORDS:
        return WORDS[domain]
    if domain in SEVERAL:
        floating, mend, bridge = SEVERAL[domain]
    else:
        floating = (
            f"nothing determines the level of {listed(across)} at the {domain} ports of {{names}}: only its differences"
        )
        floating, mend, bridge = f"{floating} matter", f"Connect a component that fixes {listed(across)}", "a component"
    return DomainWords(listed(across), f"difference of {listed(across)}", through, floating, mend, bridge)


def listed(names: Iterable[str], shown: int = SHOWN, joint: str = "and") -> str:
    """'a', 'b' and 'c'; long lists are cut, and the rest counted."""
    names = [f"'{n}'" for n in dict.fromkeys(names)]
    if len(names) > shown + 1:
        return f"{', '.join(names[:shown])} {joint} {len(names) - shown} more"
    return f" {joint} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


def quoted(names: Iterable[str], shown: int = SHOWN) -> str:
    """'a', 'b', 'c'; of long lists the beginning, and the rest counted."""
    names = [f"'{n}'" for n in names]
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")


def some(names: Sequence[str], shown: int = SHOWN) -> str:
    """a, b, c; of long lists the beginning."""
    return ", ".join(names[:shown]) + (", …" if len(names) > shown else "")


def alternatives(names: Sequence[str]) -> str:
    """a, b or c."""
    return ", ".join(names[:-1]) + (" or " if names[:-1] else "") + names[-1]


def counted(n: int, what: str) -> str:
    """1 equation, 2 equations."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def itemised(equations: Sequence[Provenance]) -> list[str]:
    """A line for each equation; long lists are cut, and the components of the rest named."""
    count = collections.Counter(equations)
    lines = [f"  {e.located}" + (f"  (written {n} times)" if n > 1 else "") for e, n in list(count.items())[:SHOWN]]
    rest = list(count)[SHOWN:]
    if rest:
        owners = [e.component for e in rest if e.is_written]
        lines.append(f"  … and {len(rest)} more" + (f", of {listed(owners, 4)}" if owners else ""))
    return lines
