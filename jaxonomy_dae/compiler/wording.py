"""Words for messages: lists of names, and what a user of each physical domain calls things."""

import dataclasses
from collections.abc import Iterable, Sequence

SHOWN = 6


@dataclasses.dataclass(frozen=True)
class DomainWords:
    """How errors speak of one domain: its across and through quantities, what carries a level, what mends a loop."""

    across: str
    through: str
    floating: str  # a sentence with {names}
    mend: str
    bridge: str


WORDS = {
    "Electrical": DomainWords(
        "voltage",
        "current",
        "the circuit of {names} has no ground, so nothing determines its potentials",
        "Connect a Ground to one of its nodes",
        "a resistor",
    ),
    "Translational": DomainWords(
        "position",
        "force",
        "nothing holds {names}: no mass and no fixed position is connected",
        "Connect a Mass or a FixedPosition",
        "a spring",
    ),
    "Thermal": DomainWords(
        "temperature",
        "heat flow",
        "nothing determines the temperatures of {names}: no heat capacitor and no fixed temperature is connected",
        "Connect a HeatCapacitor or a FixedTemperature",
        "a thermal conductor",
    ),
}


def words(domain: str, across: str = "potential", through: str = "flow") -> DomainWords:
    """The words of a domain; for a user's own domain, the names of its variables."""
    if domain in WORDS:
        return WORDS[domain]
    return DomainWords(
        across,
        through,
        f"nothing determines the level of '{across}' at the {domain} ports of {{names}}: only its differences matter",
        f"Connect a component that fixes '{across}'",
        "a component",
    )


def listed(names: Iterable[str], shown: int = SHOWN, joint: str = "and") -> str:
    """'a', 'b' and 'c'; long lists are cut, and the rest counted."""
    names = [f"'{n}'" for n in dict.fromkeys(names)]
    if len(names) > shown + 1:
        return f"{', '.join(names[:shown])} {joint} {len(names) - shown} more"
    return f" {joint} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


def counted(n: int, what: str) -> str:
    """1 equation, 2 equations."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def itemised(items: Sequence[tuple[str, str]], shown: int = SHOWN) -> list[str]:
    """Indented lines of (component, equation), those of one component together; long lists are cut."""
    items = list(dict.fromkeys(items))
    lines = [f"  {text}" for _, text in items[:shown]]
    rest = items[shown:]
    if rest:
        owners = list(dict.fromkeys(owner for owner, _ in rest if owner))
        lines.append(f"  … and {len(rest)} more" + (f", of {listed(owners, 4)}" if owners else ""))
    return lines
