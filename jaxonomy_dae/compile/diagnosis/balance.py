"""Components that wrote too few or too many equations, and equations that are meant to set the input of a child.

A component without children owes one equation for each of its variables and one for each flow (through quantity) at
its ports: the connections give the others.
"""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from ..model.provenance import Provenance
from ..model.tables import FlatModel
from .wording import counted, itemised, listed


@dataclasses.dataclass(frozen=True)
class Balance:
    """The equations of a component, and what they must determine."""

    component: str
    line: str
    equations: int
    variables: int
    ports: int
    flows: int

    @property
    def surplus(self) -> int:
        """How many equations there are too many; negative for too few."""
        return self.equations - self.variables - self.flows

    def __str__(self):
        ports = counted(self.ports, "port") if self.ports == self.flows else f"{self.flows} flows at its ports"
        parts = [counted(self.variables, "variable")] * bool(self.variables) + [ports] * bool(self.flows)
        where = f" ({self.line})" if self.line else ""
        return (
            f"component '{self.component}'{where} has {counted(self.equations, 'equation')}, but needs "
            f"{self.variables + self.flows}, for its {' and '.join(parts)}."
        )


def balances(flat: FlatModel, components: Iterable[str]) -> list[Balance]:
    """The balances of those of the components that neither have children or networks nor connect their own ports."""
    v = flat.variables
    number = {name: k for k, name in enumerate(flat.components)}
    found: dict[str, list[Provenance]] = {name: [] for name in components if name in number}
    within: set[str] = set()
    for group in flat.groups:
        for provenance in group.provenance:
            if provenance.component in found:
                found[provenance.component].append(provenance)
            within.update(name for name in found if provenance.component.startswith(f"{name}."))
    out = []
    for name, written in found.items():
        own = v.owner == number[name]
        ports = flat.ports.owner == number[name]
        # What children owe and what connections inside give cannot be counted from outside.
        if name in within or flat.ports.has_inside[ports].any():
            continue
        hidden = int((own & v.is_internal).sum())  # what events compute: a variable and an equation each
        variables = int((own & ~v.is_input & ~v.is_port & ~v.is_internal).sum())
        flows = int((own & v.is_port & ~v.is_across).sum())
        line = next((p.line for p in written if p.line), "")
        out.append(Balance(name, line, len(written) - hidden, variables, int(ports.sum()), flows))
    return out


def short_of_equations(flat: FlatModel, concerned: np.ndarray, names: Sequence[str]) -> str:
    """Names a component that wrote too few equations, among the owners of the ports that are concerned; "" if there is
    none."""
    v = flat.variables
    owners = [flat.components[k] for k in np.unique(v.owner[concerned & v.is_port]).tolist()]
    for found in balances(flat, owners):
        if found.surplus < 0:
            # What is missing determines a variable of the component, if any of the undetermined ones is.
            own = [n for n in names if n.startswith(f"{found.component}.")] or names
            return f"{found} Probably missing is one for {listed(own, joint='or')}."
    return ""


def more_than_owed(flat: FlatModel, equations: Sequence[Provenance]) -> str:
    """Names the components that wrote too many equations, with those among `equations`; "" if there is none."""
    texts = []
    for found in balances(flat, dict.fromkeys(e.component for e in equations if e.is_written)):
        if found.surplus > 0:
            remove = "one" if found.surplus == 1 else str(found.surplus)
            own = [e for e in equations if e.component == found.component]
            texts.append("\n".join([f"{found} Remove {remove} of:", *itemised(own)]))
    return "\n".join(texts)


def sets_input_of_child(flat: FlatModel, equations: Sequence[Provenance]) -> str:
    """Says how to drive the input of a child that one of these equations sets in vain; "" if none does."""
    v, wanted = flat.variables, set(equations)
    for group in flat.groups:
        if not group.variable.shape[1]:
            continue
        for row in np.flatnonzero(v.is_input[group.variable].any(axis=1)).tolist():
            provenance = group.provenance[row]
            if provenance not in wanted:
                continue
            inside = f"{provenance.component}."
            read = [(k, v.names[k].removeprefix(inside)) for k in dict.fromkeys(group.variable[row].tolist())]
            for k, name in read:
                if v.is_input[k] and flat.components[v.owner[k]].startswith(inside):
                    others = [other for j, other in read if j != k]
                    source = others[0] if len(others) == 1 else "y"
                    declare = "" if len(others) == 1 else ", where y is a variable that equals it"
                    return (
                        f"'{v.names[k]}' is an input, which no equation outside of '{flat.components[v.owner[k]]}' can "
                        f"set: {provenance.located}. Write self.connect({source}, {name}) in place of this "
                        f"equation{declare}."
                    )
    return ""
