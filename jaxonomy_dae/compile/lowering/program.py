"""Programs: steps with all their gathers planned.

Chunk 0 is the state (an array, or a tuple of scalars for small systems), chunk 1 the inputs' quantities; every step
appends one chunk for each of its local unknowns, a sparse step one for all, a loop one for each unknown of its body.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import lineax as lx
import numpy as np

from ...base.aliases import Numeric
from ...solve.linear.sparse import DENSE_UPTO, SparsePattern
from ..model.tables import ZERO
from .gather import Gather
from .loops import Loop, find_loops
from .merge import merge_thin
from .schedule import AnyStep, SparseStep, Step, StepEquation


@dataclasses.dataclass(frozen=True)
class Layout:
    """The place of every quantity among the chunks: chunk −1 is the constant zero, −2 not computed."""

    chunk: np.ndarray
    offset: np.ndarray

    def gather(self, quantity: np.ndarray, factor: np.ndarray | None = None) -> Gather:
        """A plan to read quantities, shape (n,), each times its factor."""
        factor = np.ones(len(quantity)) if factor is None else factor
        return self.gathers(quantity[None], factor[None])[0]

    def gathers(self, quantity: np.ndarray, factor: np.ndarray) -> list[Gather]:
        """Plans to read each row of quantities, shape (rows, n), with factors of that shape."""
        zero = quantity == ZERO
        chunk, offset = np.full_like(quantity, -1), np.zeros_like(quantity)
        chunk[~zero], offset[~zero] = self.chunk[quantity[~zero]], self.offset[quantity[~zero]]
        if (chunk == -2).any():
            raise AssertionError("a quantity is read before it is computed")
        # Zero is read as such, whatever the factor. A factor of one for all lets it be left out.
        factor = np.where(factor == 0, 1.0, factor)
        return [Gather(*row) for row in zip(chunk, offset, factor, strict=True)]


@dataclasses.dataclass(frozen=True)
class PlannedEquation:
    equation: StepEquation
    sources: tuple[Gather | int, ...]  # a gather, or −1 − u for the local unknown u
    factors: tuple[Numeric, ...]  # of local slots


@dataclasses.dataclass(frozen=True)
class PlannedStep:
    """A step with its gathers planned; `guess` reads its tearing variables from the state if they are carried."""

    step: Step
    equations: tuple[PlannedEquation, ...]
    guess: tuple[Gather, ...]

    @property
    def left(self) -> tuple[PlannedEquation, ...]:
        """The equations that tearing variables must fulfil."""
        return tuple(self.equations[e] for e in self.step.tearing.residuals)


@dataclasses.dataclass(frozen=True)
class PlannedSparse:
    """A sparse step: its equations read its own unknowns as a chunk that follows all others. `entries` lists, for each
    equation, (slot, instances, factors) of the slots that are unknowns; in this order their partial derivatives are the
    values of the matrix at the places of `pattern`."""

    step: SparseStep
    equations: tuple[PlannedEquation, ...]
    entries: tuple[tuple[tuple[int, np.ndarray, Numeric], ...], ...]
    pattern: SparsePattern
    guess: Gather | None
    linear_solver: lx.AbstractLinearSolver | None

    @property
    def left(self) -> tuple[PlannedEquation, ...]:
        """The equations that the unknowns must fulfil."""
        return self.equations


@dataclasses.dataclass(frozen=True)
class PlannedLoop:
    """A loop over the repetitions of a few steps.

    Within it, chunk 0 are the values carried over from the repetitions before, chunk 1 what each repetition reads from
    outside; the steps' unknowns follow. Parameters are numbered through as the steps list them.
    """

    count: int
    body: tuple[PlannedStep, ...]
    first: Gather | None  # what the first repetition carries
    following: Gather | None  # and each hands on, read within the loop
    outside: Gather | None  # (count · number,)
    parameters: np.ndarray  # (count, number)

    @property
    def equations(self) -> list[PlannedEquation]:
        """The equations of the first repetition."""
        return [equation for step in self.body for equation in step.equations]


Planned = PlannedStep | PlannedSparse | PlannedLoop


@dataclasses.dataclass(frozen=True)
class Program:
    """Planned steps and the layout of all they compute."""

    steps: tuple[Planned, ...]
    layout: Layout

    @property
    def reads_networks(self) -> bool:
        """True if a network or another function that SymPy does not see is evaluated."""
        return any(e.equation.template.opaque is not None for planned in self.steps for e in planned.equations)


def plan(
    steps: Sequence[AnyStep],
    states: np.ndarray,
    inputs: np.ndarray,
    n_quantities: int,
    carried: np.ndarray,
    linear_solver: lx.AbstractLinearSolver | None,
) -> Program:
    """Plans the evaluation of `steps`; the state array holds `states`, then `carried`. `linear_solver` is for sparse
    steps."""
    chunk = np.full(n_quantities, -2, np.int64)
    offset = np.zeros(n_quantities, np.int64)
    chunk[states], offset[states] = 0, np.arange(len(states))
    chunk[inputs], offset[inputs] = 1, np.arange(len(inputs))
    place = np.zeros(n_quantities, np.int64)
    place[carried] = len(states) + np.arange(len(carried))
    next_chunk = 2
    planned = []
    # Loops are found first: of a chain that has become one sparse system, repetitions can no longer be seen.
    for step in merge_thin(find_loops(steps, n_quantities), n_quantities, DENSE_UPTO):
        layout = Layout(chunk, offset)
        if isinstance(step, Loop):
            planned.append(_plan_loop(step, layout))
            unknown = [quantities.ravel() for each in step.unknown for quantities in each]
        elif isinstance(step, SparseStep):
            unknown = step.unknown
            # Before it is planned, since its equations read its own unknowns as a chunk.
            chunk[unknown[0]], offset[unknown[0]] = next_chunk, np.arange(step.n)
            planned.append(_plan_sparse(step, layout, place, linear_solver))
        else:
            unknown = step.unknown
            equations = tuple(plan_equation(e, layout) for e in step.equations)
            guess = tuple(_from_state(place[quantities]) for quantities in step.guessed)
            planned.append(PlannedStep(step, equations, guess))
        for quantities in unknown:
            chunk[quantities], offset[quantities] = next_chunk, np.arange(len(quantities))
            next_chunk += 1
    return Program(tuple(planned), Layout(chunk, offset))


def plan_equation(equation: StepEquation, layout: Layout) -> PlannedEquation:
    """Plans to read what an equation has from outside of its step."""
    outside = [k for k, u in enumerate(equation.local) if u < 0]
    gathers = iter(layout.gathers(equation.quantity[:, outside].T, equation.factor[:, outside].T) if outside else ())
    sources = tuple(-1 - u if u >= 0 else next(gathers) for u in equation.local)
    return PlannedEquation(equation, sources, tuple(_uniform(factor) for factor in equation.factor.T))


def _plan_loop(loop: Loop, layout: Layout) -> PlannedLoop:
    """Plans a loop; `layout` is that of what lies before it."""
    chunk_of = {}  # of (step of the body, unknown), within the loop
    for p, step in enumerate(loop.body):
        for u in range(len(step.unknown)):
            chunk_of[p, u] = 2 + len(chunk_of)
    # A scan hands on values of the last repetition only.
    # A register holds a value of `back` repetitions ago; it is filled from the register of one less.
    registers: dict[tuple[int, int, int, int], int] = {}
    first: list[int] = []
    for read in np.flatnonzero(loop.back > 0).tolist():
        for back in range(1, int(loop.back[read]) + 1):
            key = (back, *loop.source[read].tolist())
            if key not in registers:
                registers[key] = len(registers)
                first.append(int(loop.reads[loop.back[read] - back, read]))
    handed = [
        (chunk_of[p, u], instance) if back == 1 else (0, registers[back - 1, p, u, instance])
        for back, p, u, instance in registers
    ]
    outside = np.flatnonzero((loop.back < 0) & (loop.reads[0] != ZERO))
    chunk = np.full(len(loop.back), -1, np.int64)
    offset = np.zeros(len(loop.back), np.int64)
    chunk[outside], offset[outside] = 1, np.arange(len(outside))
    for read in np.flatnonzero(loop.back >= 0).tolist():
        back, (p, u, instance) = int(loop.back[read]), loop.source[read].tolist()
        chunk[read] = 0 if back else chunk_of[p, u]
        offset[read] = registers[back, p, u, instance] if back else instance

    body, read, parameter = [], 0, 0
    for step in loop.body:
        equations = []
        for equation in step.equations:
            sources: list[Gather | int] = []
            for local, factor in zip(equation.local, equation.factor.T, strict=True):
                if local >= 0:
                    sources.append(-1 - local)
                    continue
                here = slice(read, read + step.n)
                sources.append(Gather(chunk[here], offset[here], np.where(factor == 0, 1.0, factor)))
                read += step.n
            size = equation.parameter.size
            numbers = parameter + np.arange(size).reshape(equation.parameter.shape)
            parameter += size
            renumbered = dataclasses.replace(equation, parameter=numbers)
            factors = tuple(_uniform(factor) for factor in equation.factor.T)
            equations.append(PlannedEquation(renumbered, tuple(sources), factors))
        body.append(PlannedStep(step, tuple(equations), ()))
    return PlannedLoop(
        loop.count,
        tuple(body),
        layout.gather(np.array(first)) if first else None,
        Gather(np.array([c for c, _ in handed]), np.array([k for _, k in handed]), np.ones(len(handed)))
        if first
        else None,
        layout.gather(loop.reads[:, outside].ravel()) if len(outside) else None,
        loop.parameters,
    )


def _plan_sparse(step: SparseStep, layout: Layout, place: np.ndarray, linear_solver: Any) -> PlannedSparse:
    """Plans a sparse step; `layout` has its unknowns already."""
    local = np.full(len(place) + 1, -1, np.int64)  # the last entry is the constant zero
    local[step.unknown[0]] = np.arange(step.n)
    equations, entries, rows, cols = [], [], [], []
    first = 0
    for equation in step.equations:
        sources = tuple(layout.gathers(equation.quantity.T, equation.factor.T))
        equations.append(PlannedEquation(equation, sources, (1.0,) * len(sources)))
        here = []
        for k, quantity in enumerate(equation.quantity.T):
            instances = np.flatnonzero(local[quantity] >= 0)
            if len(instances):
                here.append((k, instances, _uniform(equation.factor[instances, k])))
                rows.append(first + instances)
                cols.append(local[quantity[instances]])
        entries.append(tuple(here))
        first += len(equation.equation)
    pattern = SparsePattern(np.concatenate(rows), np.concatenate(cols), step.n)
    guess = _from_state(place[step.unknown[0]]) if step.carried else None
    return PlannedSparse(step, tuple(equations), tuple(entries), pattern, guess, linear_solver)


def _from_state(place: np.ndarray) -> Gather:
    return Gather(np.zeros(len(place), np.int64), place, np.ones(len(place)))


def _uniform(factor: np.ndarray) -> Numeric:
    return float(factor[0]) if (factor == factor[0]).all() else factor
