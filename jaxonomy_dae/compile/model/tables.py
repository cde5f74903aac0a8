"""The tables passes read and write: integers and templates, no user symbols.

A variable is an integer; a *quantity* is one of its derivatives, order 0 included. An equation is a template and rows
of integers. After alias elimination a slot also has a factor, and variable −1 stands for the constant zero.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool

from ...base.aliases import Numeric
from ...write.interval import Interval
from .array_names import ArrayNames
from .delays import NO_DELAYS, DelayTable
from .events import NO_EVENTS, NONE_HELD, EventTable, HeldTable
from .group import Group
from .names import Names, Paths
from .opaque import OpaqueFunction
from .provenance import Provenance, Provenances
from .starts import Formulas, Starts
from .template import AbstractTemplate

E = TypeVar("E", bound="EquationGroup")
ZERO = -1  # stands for a variable, or quantity, that is identically zero


@dataclasses.dataclass(frozen=True)
class VariableTable:
    """The declarations of all variables, by id."""

    names: Names
    is_input: np.ndarray
    is_port: np.ndarray
    start: Starts
    fixed: np.ndarray
    nominal: np.ndarray  # typical sizes, 0 where none is declared
    bounds: np.ndarray  # (n, 2)
    unit: list[str]
    default: list[float | None]
    owner: np.ndarray  # the component, −1 for variables of neural blocks
    port: np.ndarray  # the port it belongs to, −1 if none
    potential: np.ndarray  # of across variables of ports, the place in `potentials`; else −1
    potentials: tuple[tuple[str, str], ...]  # (domain, name)
    is_internal: np.ndarray  # made by the compiler, and not to be read by users

    @property
    def is_across(self) -> np.ndarray:
        """True for across variables of ports."""
        return self.potential >= 0

    @property
    def index(self) -> Mapping[str, int]:
        """The number of every variable by name."""
        return self.names.number

    def __len__(self):
        return len(self.names)


@dataclasses.dataclass(frozen=True)
class PortTable:
    """The ports of the model, by id: full names, domains, and whether they are connected from outside and inside."""

    names: Names
    domains: list[str]
    owner: np.ndarray  # the component
    is_loose: np.ndarray
    has_inside: np.ndarray

    def count(self, component: int) -> int:
        """The number of ports of a component."""
        return int((self.owner == component).sum())


@dataclasses.dataclass(frozen=True)
class ParameterTable:
    """The declarations of all parameters, by id."""

    names: Names
    units: list[str]
    bounds: list[Interval]
    dependents: tuple[Formulas, ...]  # each reads only what those before it have computed
    expressions: dict[int, str]  # of the dependent ones, in full names
    discrete: np.ndarray  # those that events assign, relations that are events last
    n_shown: int  # the first so many of them are not hidden
    relation_starts: np.ndarray  # of the hidden ones, which follow what was declared

    def __len__(self):
        return len(self.names)

    @property
    def n_relations(self) -> int:
        """The number of hidden ones; what `discrete` was before an event comes after them."""
        return len(self.relation_starts)

    def starts_of(self, relations: np.ndarray) -> np.ndarray:
        """The starts of hidden discrete variables, given their ids."""
        return self.relation_starts[relations - self.n_declared]

    def everything(self, declared: np.ndarray) -> np.ndarray:
        """The values of all parameters, given those that were declared, (n_declared,)."""
        values = np.concatenate([declared, self.relation_starts])
        # Before the first event, what discrete variables were is what they are.
        return np.concatenate([values, values[self.discrete]])

    @property
    def follow_events(self) -> tuple[Formulas, ...]:
        """The expressions that read what events assign, directly or through others."""
        # One pass finds all of them, since a group reads only what those before it have computed.
        moved, found = self._assigned, []
        for group in self.dependents:
            rows = moved[group.parameter].any(axis=1) & ~moved[group.target]
            if rows.any():
                moved[group.target[rows]] = True
                found.append(group.take(rows))
        return tuple(found)

    @property
    def changed_by_events(self) -> Bool[np.ndarray, " parameters"]:
        """The parameters that change at events: those that are assigned, and those that follow them."""
        changed = self._assigned
        for group in self.follow_events:
            changed[group.target] = True
        return changed

    @property
    def _assigned(self) -> Bool[np.ndarray, " parameters"]:
        assigned = np.zeros(len(self), bool)
        assigned[self.discrete] = True
        return assigned

    @property
    def n_declared(self) -> int:
        """The number of parameters that were declared."""
        return len(self.names) - len(self.discrete) - self.n_relations


@dataclasses.dataclass(frozen=True)
class EquationGroup(Group):
    """Equations in variables: instance i's slot k is factor[i, k]·(variable[i, k])^(order[i, k])."""

    variable: np.ndarray
    order: np.ndarray
    provenance: Provenances

    @classmethod
    def of(
        cls: type[E], template: AbstractTemplate, variable: Any, order: Any, provenance: Provenances, *,
        parameter: Any = None, coefficient: Any = None, **more: Any,
    ) -> E:  # fmt: skip
        """A group without factors. Parameters and coefficients are left out where the template has none."""
        n = len(provenance)
        parameter, coefficient = (np.zeros((n, 0)) if given is None else given for given in (parameter, coefficient))
        variable, order = (np.asarray(given, np.int64).reshape(n, -1) for given in (variable, order))
        return cls(
            template=template,
            factor=np.ones(variable.shape),
            parameter=np.asarray(parameter, np.int64).reshape(n, template.n_parameters),
            coefficient=np.asarray(coefficient, float).reshape(n, template.n_coefficients),
            variable=variable,
            order=order,
            provenance=provenance,
            **more,
        )


@dataclasses.dataclass(frozen=True)
class RowInjection:
    """A learned correction that is added to the finished right-hand side."""

    opaque: OpaqueFunction
    targets: tuple[int, ...]
    inputs: tuple[int, ...]  # variables, time left out


@dataclasses.dataclass(frozen=True)
class AccountGroup(EquationGroup):
    """Energies or powers that components declare, in place of residuals."""

    kind: str
    component: np.ndarray


@dataclasses.dataclass(frozen=True)
class Declared:
    """What components declare beside the structure of the model: numbers and networks that may be others later."""

    values: np.ndarray  # of all parameters
    networks: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class FlatModel:
    """A flattened model."""

    variables: VariableTable
    parameters: ParameterTable
    groups: tuple[EquationGroup, ...]
    declared: Declared | None  # None in a plan, which is structure alone
    network_names: tuple[str, ...]
    rows: tuple[RowInjection, ...]
    components: Paths  # full names, by id
    ports: PortTable
    name: str = ""  # of the diagram
    events: EventTable = NO_EVENTS
    held: HeldTable = NONE_HELD
    accounts: tuple[AccountGroup, ...] = ()
    arrays: ArrayNames = ArrayNames()
    delays: DelayTable = NO_DELAYS

    @property
    def declares(self) -> Declared:
        """What the compiler may read of declared numbers and networks."""
        assert self.declared is not None, "a plan holds no values"
        return self.declared

    @property
    def n_equations(self) -> int:
        return sum(len(g) for g in self.groups)


@dataclasses.dataclass(frozen=True)
class AliasTable:
    """Each variable as factor·(root)^(order): root ZERO with factor 0 for a variable that is identically zero."""

    root: np.ndarray
    order: np.ndarray
    factor: np.ndarray
    eliminated: Provenances  # of the equations the aliases came from
    replaced: np.ndarray  # the variable that each of these replaced


def equation_offsets(groups: Sequence[EquationGroup]) -> np.ndarray:
    """First equation id of each group, and the total."""
    return np.concatenate([[0], np.cumsum([len(g) for g in groups])]).astype(np.int64)


def locate(groups: Sequence[EquationGroup], equation: int) -> tuple[EquationGroup, int]:
    """The group of an equation, and its place there."""
    offsets = equation_offsets(groups)
    g = int(np.searchsorted(offsets, equation, side="right") - 1)
    return groups[g], equation - int(offsets[g])


def provenance_of(groups: Sequence[EquationGroup], equation: int) -> Provenance:
    """The provenance of an equation."""
    group, place = locate(groups, equation)
    return group.provenance[place]


def complete(dependents: Sequence[Formulas], array: Numeric) -> Numeric:
    """All parameters, shape (*batch, n), with the dependent ones computed from the others; NumPy or JAX."""
    # In NumPy `put` changes the array that it is given.
    array = array.copy() if isinstance(array, np.ndarray) else array
    for group in dependents:
        array = group.put(array, array)
    return array
