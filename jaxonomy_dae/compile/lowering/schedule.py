"""The schedule: blocks of one shape and level become one step.

Given the extended system and its BLT order, returns steps in the order of their evaluation. A step solves `n` blocks of
the same shape at once: the same templates, slots filled in the same pattern. Most blocks are a single equation solved
for its unknown. Small simultaneous blocks are torn, their equations written out one after another. Large ones stay
whole: their equations are grouped by template, and their matrix is sparse.
"""

import abc
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...graph.structure.integers import distinct, equal_rows
from ...graph.structure.tearing import BlockSizes, Tearing, tear
from ..model.extended import Extended, ExtendedGroup
from ..model.group import QuantityGroup
from ..model.tables import ZERO
from ..passes.order_blocks import Blocks
from .entry_sizes import EntrySizes

# A block stays whole, its matrix sparse, if it has more tearing variables than TORN: dense elimination then takes more
# than KLU (30 unknowns: 0.2 ms and 0.09 ms; 200: 0.8 and 0.12). Or if it is longer than WRITTEN_OUT, because XLA's time
# grows with every equation written out: the gradient of a linear block of 34 takes 3.7 s of compilation, and 1.1 s
# whole, at equal run times. A nonlinear one may be longer, for all unknowns of a block that stays whole lie in the
# state array.
TORN = 32
WRITTEN_OUT = {True: 20, False: 200}  # by whether the block is linear


@dataclasses.dataclass(frozen=True)
class StepEquation(QuantityGroup):
    """One equation of each of a step's n blocks."""

    local: tuple[int, ...]  # the local unknown in each slot; −1: quantities from outside

    @property
    def outside(self) -> np.ndarray:
        """The quantities that are known before, shape (n, slots from outside)."""
        return self.quantity[:, [u < 0 for u in self.local]]

    @property
    def inside(self) -> list[int]:
        """The slots of local unknowns."""
        return _inside(self.local)


class AbstractStep(abc.ABC):
    """Blocks that are solved at once: written out, or whole with a sparse matrix."""

    level: int
    equations: tuple[StepEquation, ...]
    unknown: tuple[np.ndarray, ...]
    linear: bool
    whole: ClassVar[bool]  # whether one factorization of a sparse matrix solves it

    @property
    def n(self) -> int:
        """How many unknowns each array of `unknown` has."""
        return len(self.unknown[0])

    @property
    @abc.abstractmethod
    def elimination(self) -> Any:
        """How it is solved, with a `repr` that differs where that does."""

    @property
    def simultaneous(self) -> bool:
        """Whether it takes more to solve it than one division."""
        return self.whole or len(self.unknown) > 1 or not self.linear

    @property
    def carried(self) -> bool:
        """True if the unknowns are part of the state array, to be refined by Newton's method."""
        return not self.linear

    @property
    @abc.abstractmethod
    def torn(self) -> list[np.ndarray]:
        """The quantities of the tearing variables."""

    @property
    @abc.abstractmethod
    def guessed(self) -> list[np.ndarray]:
        """The quantities that lie in the state array."""

    @property
    @abc.abstractmethod
    def left(self) -> tuple[StepEquation, ...]:
        """The equations that have residuals where the unknowns in the state array are guesses."""

    @abc.abstractmethod
    def needs(self) -> np.ndarray:
        """The quantities that must be known before."""

    @abc.abstractmethod
    def behind(self, wanted: np.ndarray) -> list[tuple[StepEquation, np.ndarray]]:
        """The equations, and rows of them, that determine the quantities where `wanted` is true."""

    @abc.abstractmethod
    def own(self, equation: StepEquation, row: int) -> list[int]:
        """The unknowns among which those of an equation's block are."""

    @abc.abstractmethod
    def places(self, equation: StepEquation) -> np.ndarray:
        """Which slots hold unknowns of the step, shape (k, slots), each of k patterns once."""

    @abc.abstractmethod
    def blocks_of(self, holds: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The blocks that have an unknown where `holds`, over all unknowns one array after the other, is true: the
        places of their residuals among all that are `left`, and of their unknowns among all that are `guessed`, shapes
        (blocks, m). The step is nonlinear."""

    @abc.abstractmethod
    def listed(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """The blocks, alike ones once: (how many, the quantities of the unknowns, those of them that are torn)."""


@dataclasses.dataclass(frozen=True)
class Step(AbstractStep):
    """n blocks of one shape. `unknown[u]` are the quantities of the local unknown u, shape (n,)."""

    level: int
    equations: tuple[StepEquation, ...]
    unknown: tuple[np.ndarray, ...]
    tearing: Tearing
    linear: bool
    whole = False

    @property
    def elimination(self) -> Tearing:
        return self.tearing

    @property
    def torn(self) -> list[np.ndarray]:
        return [self.unknown[u] for u in self.tearing.tearing]

    @property
    def guessed(self) -> list[np.ndarray]:
        return self.torn if self.carried else []

    @property
    def left(self) -> tuple[StepEquation, ...]:
        return tuple(self.equations[e] for e in self.tearing.residuals)

    def needs(self) -> np.ndarray:
        return distinct(np.concatenate([e.outside.ravel() for e in self.equations]))

    def behind(self, wanted: np.ndarray) -> list[tuple[StepEquation, np.ndarray]]:
        rows = np.flatnonzero(np.any([wanted[unknown] for unknown in self.unknown], axis=0))
        return [(equation, rows) for equation in self.equations] if len(rows) else []

    def own(self, equation: StepEquation, row: int) -> list[int]:
        return [int(unknown[row]) for unknown in self.unknown]

    def places(self, equation: StepEquation) -> np.ndarray:
        return np.array([[u >= 0 for u in equation.local]])

    def blocks_of(self, holds: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        # Residuals and unknowns lie one after the other, each for all instances.
        places = np.arange(len(self.torn) * self.n).reshape(-1, self.n).T
        places = places[holds.reshape(-1, self.n).any(axis=0)]
        yield places, places

    def listed(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        yield self.n, np.array([u[0] for u in self.unknown]), np.array([u[0] for u in self.torn], np.int64)


@dataclasses.dataclass(frozen=True)
class SparseStep(AbstractStep):
    """Large blocks of one level, solved together as one sparse system.

    An equation here is a group of a template's instances, its slots given by quantity, those of the step's own unknowns
    too. The only array in `unknown` lists all unknowns. If the system is nonlinear all of them are carried.
    """

    level: int
    equations: tuple[StepEquation, ...]
    unknown: tuple[np.ndarray]
    block: np.ndarray  # of every unknown, the number of its block
    equation_block: tuple[np.ndarray, ...]  # of every equation
    linear: bool
    whole = True

    @property
    def elimination(self) -> str:
        return "whole"

    @property
    def torn(self) -> list[np.ndarray]:
        return []

    @property
    def guessed(self) -> list[np.ndarray]:
        return list(self.unknown) if self.carried else []

    @property
    def left(self) -> tuple[StepEquation, ...]:
        return self.equations

    def behind(self, wanted: np.ndarray) -> list[tuple[StepEquation, np.ndarray]]:
        if not wanted[self.unknown[0]].any():
            return []
        return [(equation, np.arange(len(equation))) for equation in self.equations]

    def own(self, equation: StepEquation, row: int) -> list[int]:
        read = equation.quantity[row]
        return read[np.isin(read, self.unknown[0])].tolist()

    def places(self, equation: StepEquation) -> np.ndarray:
        return np.unique(np.isin(equation.quantity, self.unknown[0]), axis=0)

    def blocks_of(self, holds: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        equation_block = np.concatenate(self.equation_block)
        for block in np.unique(self.block[holds]):
            yield np.flatnonzero(equation_block == block)[None], np.flatnonzero(self.block == block)[None]

    def listed(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        for block in range(int(self.block.max()) + 1):
            yield 1, self.unknown[0][self.block == block], np.zeros(0, np.int64)

    def needs(self) -> np.ndarray:
        read = distinct(np.concatenate([e.quantity.ravel() for e in self.equations]))
        return read[~np.isin(read, self.unknown[0])]


AnyStep = Step | SparseStep


def needed(steps: Sequence[AnyStep], targets: np.ndarray, n: int) -> tuple[AnyStep, ...]:
    """The steps on which the target quantities depend, in order."""
    wanted = np.zeros(n, bool)
    wanted[targets[targets != ZERO]] = True
    kept = []
    for step in reversed(steps):
        if any(wanted[q].any() for q in step.unknown):
            kept.append(step)
            needs = step.needs()
            wanted[needs[needs != ZERO]] = True
    return tuple(reversed(kept))


def build_schedule(extended: Extended, blocks: Blocks, entry_sizes: EntrySizes) -> tuple[AnyStep, ...]:
    """Groups the blocks into steps; `entry_sizes` are those of the Jacobian's entries, near the start."""
    group_of = np.empty(extended.n_equations, np.int64)
    row_of = np.empty(extended.n_equations, np.int64)
    for g, group in enumerate(extended.groups):
        group_of[group.equation] = g
        row_of[group.equation] = np.arange(len(group))

    sizes = np.diff(blocks.pointer)
    block_of_place = np.repeat(np.arange(len(blocks)), sizes)
    keyed: list[tuple[tuple, AnyStep]] = []
    single = sizes[block_of_place] == 1
    places = np.flatnonzero(single)
    for g, group in enumerate(extended.groups):
        here = places[group_of[blocks.equations[places]] == g]
        if len(here):
            keyed.extend(_single_steps(group, g, row_of, blocks, here, block_of_place))
    # Blocks of one shape share a step, and so one traced program, however many there are: a program grows with the
    # number of shapes.
    shapes: dict[tuple, list[_Block]] = {}
    for b in np.flatnonzero(sizes > 1).tolist():
        block = _block(extended, blocks, b, group_of, row_of)
        shapes.setdefault((int(blocks.level[b]), block.shape), []).append(block)
    # Linear and nonlinear blocks stay apart: unknowns of a nonlinear one lie in the state array, and need not of the
    # other.
    large: dict[tuple[int, bool], list[_Block]] = {}
    for (level, shape), alike in shapes.items():
        linear = all(extended.groups[g].template.is_affine_in(_inside(slots)) for g, slots in shape)
        step = _torn_step(extended, level, linear, alike, row_of, entry_sizes)
        if step is None:
            large.setdefault((level, linear), []).extend(alike)
        else:
            keyed.append(((level, 1, alike[0].equations[0]), step))
    for (level, linear), members in large.items():
        members = sorted(members, key=lambda block: block.number)
        step = _sparse_step(extended, level, linear, members, group_of, row_of)
        keyed.append(((level, 1, members[0].equations[0]), step))
    keyed.sort(key=lambda pair: pair[0])
    return tuple(step for _, step in keyed)


def _single_steps(group: ExtendedGroup, g: int, row_of, blocks: Blocks, places, block_of_place):
    rows = row_of[blocks.equations[places]]
    unknown = blocks.unknowns[places]
    level = blocks.level[block_of_place[places]]
    hit = group.quantity[rows] == unknown[:, None]
    # Where the unknown stands may differ from instance to instance: a resistor is solved for its current here and for
    # its voltage there.
    for members in equal_rows([level, *np.packbits(hit, axis=1).T]):
        r, lv = rows[members], int(level[members[0]])
        positions = np.flatnonzero(hit[members[0]])
        equation = equation_of(group, r, {int(p): 0 for p in positions})
        template = group.template
        linear = template.is_affine_in([int(p) for p in positions])
        torn = Tearing(((0, 0),), (), ()) if linear else Tearing((), (0,), (0,))
        yield (lv, 0, int(equation.equation[0])), Step(lv, (equation,), (unknown[members],), torn, linear)


def equation_of(group: ExtendedGroup, rows: np.ndarray, local: dict[int, int]) -> StepEquation:
    """Some instances of a group, whose slots hold these local unknowns."""
    columns = [getattr(group, f.name) for f in dataclasses.fields(QuantityGroup)]
    return StepEquation(*columns, local=tuple(local.get(k, -1) for k in range(group.quantity.shape[1]))).take(rows)


class _Block(NamedTuple):
    """A block of several equations, in the order of their templates, and as many unknowns. Its shape says for each
    equation the group that it is of, and the local unknown in each slot; −1: a quantity from outside."""

    number: int
    equations: list[int]
    unknowns: list[int]
    shape: tuple[tuple[int, tuple[int, ...]], ...]


def _inside(slots: tuple[int, ...]) -> list[int]:
    return [k for k, u in enumerate(slots) if u >= 0]


def _block(extended: Extended, blocks: Blocks, b: int, group_of: np.ndarray, row_of: np.ndarray) -> _Block:
    inside = slice(int(blocks.pointer[b]), int(blocks.pointer[b + 1]))
    # In the order of their templates, so that blocks that differ in the order of declaration alone have one shape.
    equations = sorted(blocks.equations[inside].tolist(), key=lambda e: (int(group_of[e]), e))
    unknowns = sorted(blocks.unknowns[inside].tolist())
    local = {q: u for u, q in enumerate(unknowns)}
    shape = tuple(
        (int(group_of[e]), tuple(local.get(q, -1) for q in extended.groups[group_of[e]].quantity[row_of[e]].tolist()))
        for e in equations
    )
    return _Block(b, equations, unknowns, shape)


def _torn_step(
    extended: Extended, level: int, linear: bool, alike: list[_Block], row_of: np.ndarray, entry_sizes: EntrySizes
) -> Step | None:
    """The step of blocks of one shape, torn and written out; None if they are to stay whole."""
    shape = alike[0].shape
    if len(shape) > WRITTEN_OUT[linear]:
        return None
    contains, solvable = [], []
    entries: dict[tuple[int, int], np.ndarray] = {}
    numbers = set()
    for e, (g, slots) in enumerate(shape):
        inside = _inside(slots)
        rows = row_of[[block.equations[e] for block in alike]]
        for k in inside:
            at = (e, slots[k])
            size = entry_sizes.of(g, k)[rows]
            entries[at] = np.maximum(entries[at], size) if at in entries else size
            if entry_sizes.is_number(g, k):
                numbers.add(at)
        contains.append(frozenset(slots[k] for k in inside))
        safe = set()
        for u in contains[-1]:
            where = [k for k in inside if slots[k] == u]
            # An unknown in two slots has the sum of two coefficients, which may cancel. What may vanish while the model
            # runs must not become a divisor.
            if len(where) == 1 and not entry_sizes.may_vanish(g, where[0], rows):
                safe.add(u)
        solvable.append(frozenset(safe))
    torn = tear(contains, solvable, BlockSizes(entries, frozenset(numbers)))
    if len(torn.tearing) > TORN:
        return None
    equations = []
    for e, (g, slots) in enumerate(shape):
        rows = row_of[[block.equations[e] for block in alike]]
        equations.append(equation_of(extended.groups[g], rows, {k: slots[k] for k in _inside(slots)}))
    unknown = tuple(np.array(column) for column in zip(*(block.unknowns for block in alike), strict=True))
    return Step(level, tuple(equations), unknown, torn, linear)


def _sparse_step(
    extended: Extended, level: int, linear: bool, members: list[_Block], group_of: np.ndarray, row_of: np.ndarray
) -> SparseStep:
    """The step of large blocks, whatever their shapes."""
    equation = np.concatenate([block.equations for block in members])
    unknown = np.concatenate([block.unknowns for block in members])
    block = np.repeat(np.arange(len(members)), [len(block.equations) for block in members])
    equations, equation_block = [], []
    for g in np.unique(group_of[equation]).tolist():
        here = np.flatnonzero(group_of[equation] == g)
        equations.append(equation_of(extended.groups[g], row_of[equation[here]], {}))
        equation_block.append(block[here])
    return SparseStep(level, tuple(equations), (unknown,), block, tuple(equation_block), linear)
