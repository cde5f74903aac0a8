"""The static plan of a compiled system."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import lineax as lx
import numpy as np
from jaxtyping import Bool

from ...base.errors import ModelError, nearest
from ...graph.structure.integers import distinct
from ...solve.linear.sparse import SparsePattern
from ..model.array_names import inner_name, one_by_one
from ..model.extended import Extended
from ..model.identity import Identity
from ..model.opaque import OpaqueFunction
from ..model.provenance import differentiated
from ..model.quantities import QuantityMap, QuantityNames, ReducedModel
from ..model.tables import ZERO, FlatModel, provenance_of
from ..passes.order_blocks import Blocks
from ..passes.select_states import StateSelection
from . import pattern
from .gather import Gather
from .plan_delays import DelayPlan
from .plan_events import EventPlan, HeldPlan
from .plan_waves import WaveGroup
from .program import PlannedEquation, Program, plan
from .schedule import TORN, AnyStep, needed


class DummyBlocks(NamedTuple):
    """n nonlinear blocks of m equations that determine dummy derivatives.

    `rows` and `columns`, shape (n, m), are places in the residuals g of all nonlinear blocks and in their unknowns z.
    """

    rows: np.ndarray
    columns: np.ndarray


def nonlinear_blocks(
    steps: Sequence[AnyStep], holds: Callable[[AnyStep], Bool[np.ndarray, " unknowns"]]
) -> tuple[DummyBlocks, ...]:
    """The nonlinear blocks with an unknown for which `holds` is true, over all unknowns of a step."""
    found: list[DummyBlocks] = []
    start = 0
    for step in steps:
        # Other steps compute their unknowns exactly where they stand: they have no places in g and z.
        if not step.carried:
            continue
        chosen = holds(step)
        if chosen.any():
            found.extend(DummyBlocks(start + rows, start + columns) for rows, columns in step.blocks_of(chosen))
        start += sum(len(quantities) for quantities in step.guessed)
    return tuple(found)


@dataclasses.dataclass(frozen=True)
class PlannedRow:
    """A correction added to finished rows of the right-hand side."""

    opaque: OpaqueFunction
    rows: tuple[int, ...]
    inputs: tuple[Gather, ...]
    factor: tuple[float, ...]
    quantities: np.ndarray  # of the inputs


@dataclasses.dataclass(frozen=True)
class InputTable:
    """The model's inputs, and the variables that they are; quantities are derivatives of an order of an input."""

    names: list[str]
    defaults: list[float | None]
    variables: np.ndarray
    owner: np.ndarray  # the input of each quantity
    order: np.ndarray

    @functools.cached_property
    def place(self) -> dict[str, int]:
        """The position of each input in `names`."""
        return {name: k for k, name in enumerate(self.names)}

    def highest(self, places: np.ndarray) -> int:
        """The highest order to which the model differentiates one of these inputs."""
        return int(np.max(self.order[np.isin(self.owner, places)], initial=0))


@dataclasses.dataclass(frozen=True)
class SystemPlan:
    """All that is static about a compiled system, and no value that may be another later.

    Plans are equal if all that they consist of is equal: programs that were compiled for one serve the other.
    """

    model: ReducedModel
    leading: np.ndarray  # the variables whose starts count, one for each quantity that has any
    selection: StateSelection
    steps: tuple[AnyStep, ...]
    blocks: Blocks
    mode: str

    states: np.ndarray  # quantities in the state array …
    carried: np.ndarray  # … followed by the tearing variables of nonlinear blocks
    nominal: np.ndarray  # of the state array
    inputs: InputTable
    derivative: Program
    next_derivative: Gather
    carried_rates: Gather | None  # where the model itself has the derivatives of all `carried`
    carried_residuals: Program
    constraint_program: Program
    constraints: tuple[PlannedEquation, ...]
    constraint_pattern: tuple[frozenset[int], ...] | None
    rows: tuple[PlannedRow, ...]
    network_names: tuple[str, ...]
    linear_solver: lx.AbstractLinearSolver | None  # of blocks that stay whole
    events: EventPlan | None
    held: HeldPlan | None  # constraints that come and go with modes
    waves: tuple[WaveGroup, ...]  # that states, conditions and constraints depend on
    delays: DelayPlan | None  # of what is delayed

    def __eq__(self, other):
        return self is other or (isinstance(other, SystemPlan) and self._identity == other._identity)

    def __hash__(self):
        return hash(self._identity)

    @functools.cached_property
    def _identity(self) -> Identity:
        return Identity.of(self)

    @property
    def digest(self) -> str:
        """A digest of the structure, the same in every process; functions in it are told apart by names alone."""
        return self._identity.digest

    def __content__(self) -> tuple[str, tuple[Callable, ...]]:
        """For `host/content.py`: the digest, which leaves out what functions in the plan compute, and these
        functions."""
        return self._identity.digest, self._identity.functions

    @property
    def some_events(self) -> EventPlan:
        """The plan of events, of a model that has some."""
        assert self.events is not None
        return self.events

    def refuse_delays(self, why: str) -> None:
        """Raises a `ModelError` if something is delayed."""
        if self.delays is not None:
            raise ModelError(f"'{self.delays.table.text[0]}' is delayed, and {why}")

    @property
    def flat(self) -> FlatModel:
        """The model as flattened."""
        return self.model.flat

    @property
    def variable_map(self) -> QuantityMap:
        """Which quantity each variable is."""
        return self.model.variables

    @property
    def extended(self) -> Extended:
        """The equations with their derivatives."""
        return self.model.extended

    @property
    def quantity_name(self) -> QuantityNames:
        """A user's name for every quantity."""
        return self.model.names

    @property
    def variable_index(self) -> Mapping[str, int]:
        """The number of every variable by name."""
        return self.flat.variables.index

    @functools.cached_property
    def state_names(self) -> tuple[str, ...]:
        """The names of the states. Loops ask for them again and again; 1,000 take 2 ms to be put together."""
        return tuple(self.quantity_name[q] for q in self.states)

    @functools.cached_property
    def digest_of_states(self) -> str:
        """A digest of what the entries of a whole state mean: the names of states and of discrete variables."""
        names = [*self.state_names, *(self.quantity_name[q] for q in self.carried)]
        known = self.flat.parameters.names
        discrete = [] if self.events is None else [known[int(k)] for k in self.events.discrete]
        return hashlib.sha256(repr((names, discrete)).encode()).hexdigest()

    @property
    def n_state(self) -> int:
        return len(self.states) + len(self.carried)

    @property
    def n_constraints(self) -> int:
        return len(self.selection.constraints)

    @property
    def n_projected(self) -> int:
        """The number of residuals onto which states are projected: the hidden constraints, and those that modes
        bring."""
        return self.n_constraints + (0 if self.held is None else len(self.held.table.level))

    @property
    def _scheduled(self) -> pattern.Scheduled:
        rows = [(row.rows, row.quantities) for row in self.rows]
        return pattern.Scheduled(self.extended.quantities.n, self.states, self.carried, self.steps, rows)

    @functools.cached_property
    def jacobian_pattern(self) -> SparsePattern | None:
        """The places of ∂(vector field)/∂(state) that can be nonzero at a consistent state, shape (n_state, n_state);
        None if it has too many places to list."""
        return pattern.field_pattern(self._scheduled)

    @functools.cached_property
    def dae_pattern(self) -> SparsePattern | None:
        """The places that can be nonzero in the Jacobian of [f(t, x, z); g(t, x, z)] with respect to the state array
        [x, z]: the states' derivatives with z read from the array, not refined, then the residuals of the nonlinear
        blocks. Sorted by row, each place once; None if there are too many to list."""
        return pattern.dae_pattern(self._scheduled)

    @functools.cached_property
    def carried_pattern(self) -> SparsePattern | None:
        """The places of ∂g/∂z that can be nonzero, if there are so many algebraic unknowns z that it matters; else
        None."""
        if len(self.carried) <= TORN or self.dae_pattern is None:
            return None
        n, found = len(self.states), self.dae_pattern
        inside = (found.rows >= n) & (found.cols >= n)
        return SparsePattern(found.rows[inside] - n, found.cols[inside] - n, len(self.carried))

    @functools.cached_property
    def written_blocks(self) -> tuple[DummyBlocks, ...]:
        """All nonlinear blocks that are written out, not factorised as one sparse system."""
        return nonlinear_blocks(self.steps, lambda step: np.full(sum(map(len, step.unknown)), not step.whole))

    @functools.cached_property
    def dummy_blocks(self) -> tuple[DummyBlocks, ...]:
        """The nonlinear blocks whose unknowns were dropped from the candidates for states."""
        dummies = self.selection.dummies
        return nonlinear_blocks(self.steps, lambda step: np.isin(np.concatenate(step.unknown), dummies))

    def reading(self, quantities: np.ndarray) -> Program:
        """The program that computes these quantities and nothing else."""
        wanted = distinct(quantities)
        key = wanted.tobytes()
        if key not in self._programs:
            n, n_unknown = self.extended.quantities.n, self.extended.quantities.n_unknown
            inputs, steps = np.arange(n_unknown, n), needed(self.steps, wanted, n)
            self._programs[key] = plan(steps, self.states, inputs, n, self.carried, self.linear_solver)
        return self._programs[key]

    def width(self, quantities: np.ndarray) -> int:
        """The number of values that `reading` these quantities has at hand, states and inputs included."""
        return int((self.reading(quantities).layout.chunk >= 0).sum())

    def owners(self, quantities: np.ndarray) -> tuple[int, ...]:
        """The numbers of the steps that compute these quantities; −1 stands for states, inputs and zero."""
        return tuple(distinct(self._owner[quantities[quantities != ZERO]]).tolist()) or (-1,)

    def owned(self, owners: Sequence[int]) -> np.ndarray:
        """All quantities that have these `owners`, ascending."""
        return np.flatnonzero(np.isin(self._owner, owners))

    @functools.cached_property
    def _owner(self) -> np.ndarray:
        owner = np.full(self.extended.quantities.n, -1)
        for k, step in enumerate(self.steps):
            for quantities in step.unknown:
                owner[quantities] = k
        return owner

    @functools.cached_property
    # No field, since programs follow from the others, and equal plans may have been asked for different ones.
    def _programs(self) -> dict[bytes, Program]:
        return {}

    def quantity_of(self, variable: int) -> tuple[int, float]:
        """(quantity, factor) of a variable; quantity ZERO if it is identically zero."""
        return self.variable_map[variable]

    def describe(self, equation: int) -> str:
        """The text of an extended equation."""
        base, level = int(self.extended.base[equation]), int(self.extended.level[equation])
        return differentiated(provenance_of(self.model.groups, base), level)

    def locate(self, equation: int) -> str:
        """The text of an extended equation with the line of the user's code, for errors."""
        line = provenance_of(self.model.groups, int(self.extended.base[equation])).line
        return self.describe(equation) + (f"  ({line})" if line else "")

    @property
    def visible_variables(self) -> list[str]:
        """The names a user may read: all but those made for corrected derivatives."""
        table = self.flat.variables
        return [n for n, is_internal in zip(table.names, table.is_internal.tolist(), strict=True) if not is_internal]

    def is_visible(self, quantity: int) -> bool:
        """True if a quantity equals a variable that a user may read, or is a derivative of one."""
        quantities, table = self.extended.quantities, self.flat.variables
        lowest = int(quantities.first[quantities.owner[quantity]])
        return bool(np.isin(self.variable_map.quantity[~table.is_internal], (quantity, lowest)).any())

    def entries(self, name: str) -> tuple[list[str], tuple[int, ...]] | None:
        """The names of the entries of an array of variables, discrete ones too, and its shape; None if the name is not
        that of one."""
        order, inner = inner_name(name)
        if inner in self.variable_index:
            return None
        parameters = self.flat.parameters
        ids = self.flat.arrays.parameters(name)
        if ids is not None and np.isin(ids, parameters.discrete).all():
            return [parameters.names[p] for p in ids.ravel().tolist()], ids.shape
        ids = self.flat.arrays.variables(inner)
        if ids is None:
            return None
        names = self.flat.variables.names
        return [f"{'der(' * order}{names[v]}{')' * order}" for v in ids.ravel().tolist()], ids.shape

    def entry_names(self, names: Iterable[str]) -> list[str]:
        """Names, with those of the entries in place of an array's."""
        return [one for name in names for one in (self.entries(name) or ([name],))[0]]

    def one_by_one(self, initial: object) -> Any:
        """Initial values by name, with those of arrays under the names of their entries."""
        return one_by_one(self.flat.arrays, self.flat.variables.names, initial)

    def input_places(self, name: Any) -> np.ndarray | None:
        """The position of an input in the table, shape (), or of the inputs of an array in its shape; None if the name
        is neither."""
        table = self.inputs
        if name in table.place:
            return np.array(table.place[name])
        ids = self.flat.arrays.variables(name) if isinstance(name, str) and len(table.names) else None
        if ids is None:
            return None
        order = np.argsort(table.variables)
        found = order[np.minimum(np.searchsorted(table.variables, ids, sorter=order), len(order) - 1)]
        # The search gives a place for any id. An array of variables that are no inputs is told by what stands there.
        return found if np.array_equal(table.variables[found], ids) else None

    def resolve(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """(quantities, factors) of variables by name; `"der(name)"` is accepted where the model has that derivative."""
        quantity, factor = [], []
        for name in names:
            order, inner = inner_name(name)
            if inner not in self.variable_index:
                ids = self.flat.arrays.variables(inner)
                if ids is not None:
                    first = self.flat.variables.names[int(ids.ravel()[0])]
                    raise ModelError(f"'{name}' is an array of shape {ids.shape}: name one of its entries, '{first}'")
                raise ModelError(f"'{name}' is not a variable: " + nearest(inner, self.visible_variables))
            q, s = self.quantity_of(self.variable_index[inner])
            if q != ZERO and order:
                quantities = self.extended.quantities
                if quantities.order[q] + order > quantities.highest[quantities.owner[q]]:
                    raise ModelError(f"'{name}' occurs nowhere in the model: only '{inner}' does")
            quantity.append(q if q == ZERO else q + order)
            factor.append(s)
        return np.array(quantity, np.int64), np.array(factor, float)
