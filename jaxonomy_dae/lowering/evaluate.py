"""Evaluation: steps become gathers, vectorised kernels and chunks of results.

The traced program grows with the number of steps, not of the equations in them. Chunk 0 is the state (an array, or a
tuple of scalars for small systems), chunk 1 the inputs' quantities; every step appends one chunk for each of its
local unknowns.
"""

import copy
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..compiler.numeric import Networks
from ..compiler.tables import ZERO
from ..errors import ModelError
from ..solvers import sparse
from ..solvers.small_linear import UNROLLED, solve
from ..solvers.sparse import SparsePattern, solve_sparse
from .gather import Chunk, Gather, take
from .merge import merge_thin
from .repeat import Repeat, find_repeats
from .schedule import AnyStep, SparseStep, Step, StepEquation

DENSE = 1000  # simultaneous equations that dense elimination may solve if there is no sparse solver: about 20 ms
UNROLLED_REPETITIONS = 4  # of a loop, written out in each of its iterations
LONG_SUM = 16  # linear equations with more terms are one gather and one sum


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where every quantity lies: chunk −1 is the constant zero, −2 not computed."""

    chunk: np.ndarray
    offset: np.ndarray

    def gather(self, quantity: np.ndarray, sign: np.ndarray | None = None) -> Gather:
        quantity = np.atleast_1d(quantity)
        zero = quantity == ZERO
        sign = np.ones(len(quantity), np.int64) if sign is None else np.where(sign == 0, 1, np.atleast_1d(sign))
        chunk = np.where(zero, -1, self.chunk[quantity])
        if (chunk == -2).any():
            raise AssertionError("a quantity is read before it is computed")
        return Gather(chunk, np.where(zero, 0, self.offset[quantity]), sign)


@dataclasses.dataclass(frozen=True)
class _PlannedEquation:
    equation: StepEquation
    sources: tuple[Gather | int, ...]  # a gather, or −1 − u for the local unknown u
    signs: tuple[Any, ...]  # of local slots


@dataclasses.dataclass(frozen=True)
class PlannedStep:
    """A step with its gathers planned; `guess` reads its tearing variables from the state if they are carried."""

    step: Step
    equations: tuple[_PlannedEquation, ...]
    guess: tuple[Gather, ...]


@dataclasses.dataclass(frozen=True)
class PlannedSparse:
    """A sparse step: its equations read its own unknowns as a chunk that follows all others. `entries` lists, for each
    equation, (slot, instances, signs) of the slots that are unknowns; in this order their partial derivatives are the
    values of the matrix at the places of `pattern`."""

    step: SparseStep
    equations: tuple[_PlannedEquation, ...]
    entries: tuple[tuple[tuple[int, np.ndarray, Any], ...], ...]
    pattern: SparsePattern
    guess: Gather | None


@dataclasses.dataclass(frozen=True)
class PlannedRepeat:
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


@dataclasses.dataclass(frozen=True)
class Program:
    """Planned steps and the layout of all they compute."""

    steps: tuple[PlannedStep | PlannedSparse | PlannedRepeat, ...]
    layout: Layout


def plan(
    steps: Sequence[AnyStep], states: np.ndarray, inputs: np.ndarray, n_quantities: int, carried: np.ndarray
) -> Program:
    """Plans the evaluation of `steps`; the state array holds `states`, then `carried`."""
    chunk = np.full(n_quantities, -2, np.int64)
    offset = np.zeros(n_quantities, np.int64)
    chunk[states], offset[states] = 0, np.arange(len(states))
    chunk[inputs], offset[inputs] = 1, np.arange(len(inputs))
    place = np.zeros(n_quantities, np.int64)
    place[carried] = len(states) + np.arange(len(carried))
    next_chunk = 2
    planned = []
    for step in merge_thin(find_repeats(steps, n_quantities), n_quantities, DENSE):
        layout = Layout(chunk, offset)
        if isinstance(step, Repeat):
            planned.append(_plan_repeat(step, layout))
            unknown = [quantities.ravel() for each in step.unknown for quantities in each]
        elif isinstance(step, SparseStep):
            unknown = step.unknown
            chunk[unknown[0]], offset[unknown[0]] = next_chunk, np.arange(step.n)
            planned.append(_plan_sparse(step, layout, place))
        else:
            unknown = step.unknown
            equations = tuple(_plan_equation(e, layout) for e in step.equations)
            guess = tuple(_from_state(place[quantities]) for quantities in step.guessed)
            planned.append(PlannedStep(step, equations, guess))
        for quantities in unknown:
            chunk[quantities], offset[quantities] = next_chunk, np.arange(len(quantities))
            next_chunk += 1
    return Program(tuple(planned), Layout(chunk, offset))


def _plan_equation(equation: StepEquation, layout: Layout) -> _PlannedEquation:
    sources = [-1 - s.local if s.local >= 0 else layout.gather(s.quantity, s.sign) for s in equation.slots]
    return _PlannedEquation(equation, tuple(sources), tuple(_uniform(s.sign) for s in equation.slots))


def _plan_repeat(repeat: Repeat, layout: Layout) -> PlannedRepeat:
    """Plans a loop; `layout` is that of what lies before it."""
    chunk_of = {}  # of (step of the body, unknown), within the loop
    for p, step in enumerate(repeat.body):
        for u in range(len(step.unknown)):
            chunk_of[p, u] = 2 + len(chunk_of)
    # A register holds a value of `back` repetitions ago; it is filled from the register of one less.
    registers: dict[tuple[int, int, int, int], int] = {}
    first: list[int] = []
    for read in np.flatnonzero(repeat.back > 0).tolist():
        for back in range(1, int(repeat.back[read]) + 1):
            key = (back, *repeat.source[read].tolist())
            if key not in registers:
                registers[key] = len(registers)
                first.append(int(repeat.reads[repeat.back[read] - back, read]))
    handed = [
        (chunk_of[p, u], instance) if back == 1 else (0, registers[back - 1, p, u, instance])
        for back, p, u, instance in registers
    ]
    outside = np.flatnonzero((repeat.back < 0) & (repeat.reads[0] != ZERO))
    chunk = np.full(len(repeat.back), -1, np.int64)
    offset = np.zeros(len(repeat.back), np.int64)
    chunk[outside], offset[outside] = 1, np.arange(len(outside))
    for read in np.flatnonzero(repeat.back >= 0).tolist():
        back, (p, u, instance) = int(repeat.back[read]), repeat.source[read].tolist()
        chunk[read] = 0 if back else chunk_of[p, u]
        offset[read] = registers[back, p, u, instance] if back else instance

    body, read, parameter = [], 0, 0
    for step in repeat.body:
        equations = []
        for equation in step.equations:
            sources: list[Gather | int] = []
            for slot in equation.slots:
                if slot.local >= 0:
                    sources.append(-1 - slot.local)
                    continue
                here = slice(read, read + step.n)
                sources.append(Gather(chunk[here], offset[here], np.where(slot.sign == 0, 1, slot.sign)))
                read += step.n
            size = equation.parameter.size
            numbers = parameter + np.arange(size).reshape(equation.parameter.shape)
            parameter += size
            renumbered = dataclasses.replace(equation, parameter=numbers)
            equations.append(
                _PlannedEquation(renumbered, tuple(sources), tuple(_uniform(s.sign) for s in equation.slots))
            )
        body.append(PlannedStep(step, tuple(equations), ()))
    return PlannedRepeat(
        repeat.count,
        tuple(body),
        layout.gather(np.array(first)) if first else None,
        Gather(*np.array(handed).T, np.ones(len(handed), np.int64)) if first else None,
        layout.gather(repeat.reads[:, outside].ravel()) if len(outside) else None,
        repeat.parameters,
    )


def _plan_sparse(step: SparseStep, layout: Layout, place: np.ndarray) -> PlannedSparse:
    """Plans a sparse step; `layout` has its unknowns already."""
    local = np.full(len(place) + 1, -1, np.int64)  # the last entry is the constant zero
    local[step.unknown[0]] = np.arange(step.n)
    equations, entries, rows, cols = [], [], [], []
    first = 0
    for equation in step.equations:
        sources = tuple(layout.gather(slot.quantity, slot.sign) for slot in equation.slots)
        equations.append(_PlannedEquation(equation, sources, (1,) * len(sources)))
        here = []
        for k, slot in enumerate(equation.slots):
            instances = np.flatnonzero(local[slot.quantity] >= 0)
            if len(instances):
                here.append((k, instances, _uniform(slot.sign[instances])))
                rows.append(first + instances)
                cols.append(local[slot.quantity[instances]])
        entries.append(tuple(here))
        first += len(equation.equation)
    pattern = SparsePattern(np.concatenate(rows), np.concatenate(cols), step.n)
    guess = _from_state(place[step.unknown[0]]) if step.carried else None
    return PlannedSparse(step, tuple(equations), tuple(entries), pattern, guess)


def _from_state(place: np.ndarray) -> Gather:
    return Gather(np.zeros(len(place), np.int64), place, np.ones(len(place), np.int64))


def _uniform(sign: np.ndarray) -> Any:
    return int(sign[0]) if (sign == sign[0]).all() else sign


class Evaluation:
    """One pass over a program's steps at one point."""

    def __init__(self, state: Chunk, inputs: Chunk, parameters: Any, t: Any, networks: Networks):
        self.chunks: list[Chunk] = [state, inputs]
        self.parameters = parameters
        self.dtype = parameters.dtype
        self.t = t
        self.networks = networks
        self.residuals: list[Any] = []  # of carried steps, if nothing is refined

    def run(self, program: Program, refine: int):
        """Evaluates all steps; the tearing variables of carried steps get `refine` Newton corrections."""
        for planned in program.steps:
            if isinstance(planned, PlannedRepeat):
                self.chunks.extend(self._repeat(planned))
            elif isinstance(planned, PlannedSparse):
                self.chunks.append(self._sparse_step(planned, refine))
            else:
                self.chunks.extend(self._step(planned, refine))
        return self

    def read(self, gather: Gather) -> Any:
        """Gathered values: a scalar, or an array."""
        return gather.read(self.chunks, self.dtype)

    def _arguments(self, planned: _PlannedEquation, local: list[Any]):
        slots = []
        for source, sign in zip(planned.sources, planned.signs, strict=True):
            if isinstance(source, Gather):
                slots.append(self.read(source))
            else:
                slots.append(_signed(sign, local[-1 - source], self.dtype))
        equation = planned.equation
        n = equation.parameter.shape[0]
        if n == 1:
            parameters = [self.parameters[int(k)] for k in equation.parameter[0]]
            coefficients: list[Any] = [float(c) for c in equation.coefficient[0]]
        else:
            parameters = [
                self.parameters[int(column[0])] if (column == column[0]).all() else take(self.parameters, column)
                for column in equation.parameter.T
            ]
            coefficients = [float(c[0]) if (c == c[0]).all() else c for c in equation.coefficient.T]
        return slots, parameters, coefficients, self.t, self.networks

    def _residual(self, planned: _PlannedEquation, local: list[Any]) -> Any:
        return planned.equation.template.residual(*self._arguments(planned, local))

    def _solved(self, planned: _PlannedEquation, unknown: int, local: list[Any]) -> Any:
        """The local unknown for which the equation, affine in it, holds."""
        equation = planned.equation
        positions = [k for k, s in enumerate(equation.slots) if s.local == unknown]
        if equation.template.n_coefficients > LONG_SUM:
            return self._solved_long_sum(planned, positions[0])
        local = list(local)
        local[unknown] = 0.0
        arguments = self._arguments(planned, local)
        if len(positions) == 1:
            value = equation.template.solve(positions[0], *arguments)
            return _signed(planned.signs[positions[0]], value, self.dtype)
        rest = equation.template.residual(*arguments)
        partials = equation.template.partial_values(*arguments)
        slope = sum(_signed(planned.signs[k], partials[k], self.dtype) for k in positions)
        return -rest / slope

    def _solved_long_sum(self, planned: _PlannedEquation, position: int) -> Any:
        equation = planned.equation
        n = equation.coefficient.shape[0]
        others = [k for k in range(len(equation.slots)) if k != position]
        sources = [planned.sources[k] for k in others]
        joined = Gather(*(np.concatenate([getattr(s, f) for s in sources]) for f in ("chunk", "offset", "sign")))
        values = joined.read(self.chunks, self.dtype)
        values = jnp.reshape(jnp.broadcast_to(values, (len(others) * n,)), (len(others), n))
        weights = -equation.coefficient[:, others] / equation.coefficient[:, [position]]
        total = jnp.sum(values * jnp.asarray(weights.T, self.dtype), axis=0)
        return _signed(planned.signs[position], total[0] if n == 1 else total, self.dtype)

    def _step(self, planned: PlannedStep, refine: int) -> list[Any]:
        step = planned.step
        tearing = step.tearing
        shape = () if step.n == 1 else (step.n,)
        blank: list[Any] = [None] * len(step.unknown)

        def follow(z: list[Any]) -> list[Any]:
            local = list(blank)
            for u, value in zip(tearing.tearing, z, strict=True):
                local[u] = value
            for e, u in tearing.sequence:
                local[u] = self._filled(self._solved(planned.equations[e], u, local), shape)
            return local

        def residuals(z: list[Any]) -> list[Any]:
            local = follow(z)
            return [self._filled(self._residual(planned.equations[e], local), shape) for e in tearing.residuals]

        if not tearing.tearing:
            return follow([])
        if not step.carried:
            return self._affine(follow, residuals, len(tearing.tearing), shape)
        z = [self._filled(self.read(g), shape) for g in planned.guess]
        if refine == 0:
            self.residuals.extend(residuals(z))
        for _ in range(refine):
            z = newton(residuals, z)
        return follow(z)

    def _repeat(self, planned: PlannedRepeat) -> list[Any]:
        """The unknowns of all repetitions, each of shape (count · n,)."""

        def read(gather: Gather | None) -> Any:
            if gather is None:
                return jnp.zeros(0, self.dtype)
            return self._filled(self.read(gather), (len(gather.chunk),))

        def repetition(carried, given):
            outside, parameters = given
            inner = Evaluation(carried, outside, parameters, self.t, Networks(self.networks.weights))
            for step in planned.body:
                inner.chunks.extend(inner._step(step, refine=0))
            if planned.following is not None:
                carried = self._filled(inner.read(planned.following), carried.shape)
            return carried, tuple(inner.chunks[2:])

        count = planned.count
        parameters = self.parameters[planned.parameters.ravel()].reshape(planned.parameters.shape)
        given = jnp.reshape(read(planned.outside), (count, -1)), parameters
        _, chunks = jax.lax.scan(repetition, read(planned.first), given, unroll=UNROLLED_REPETITIONS)
        return [jnp.reshape(c, (-1,)) for c in chunks]

    def _sparse_step(self, planned: PlannedSparse, refine: int) -> Any:
        """The unknowns of large blocks, shape (n,)."""

        def solved(u: Any) -> Any:
            """One Newton step, exact if the equations are affine."""
            residual, values = self._whole(planned, u, partials=True)
            return u - solve_block(planned.pattern, values, residual)

        if planned.guess is None:
            return solved(jnp.zeros(planned.step.n, self.dtype))
        u = self.read(planned.guess)
        if refine == 0:
            self.residuals.append(self._whole(planned, u, partials=False)[0])
        for _ in range(refine):
            u = solved(u)
        return u

    def _whole(self, planned: PlannedSparse, u: Any, partials: bool) -> tuple[Any, Any]:
        """The residuals of a sparse step's equations at its unknowns u, and the values of their matrix."""
        there = copy.copy(self)
        there.chunks = [*self.chunks, u]
        residuals, values = [], []
        for equation, entries in zip(planned.equations, planned.entries, strict=True):
            template = equation.equation.template
            shape = (len(equation.equation.equation),)
            slots, *rest = there._arguments(equation, [])

            def residual(*slots, template=template, rest=rest, shape=shape):
                return self._filled(template.residual(list(slots), *rest), shape)

            residuals.append(residual(*slots))
            if not partials:
                continue
            if template.opaque is not None:
                slots = [self._filled(s, shape) for s in slots]
                slopes = [_slope(residual, slots, k) for k in range(len(slots))]
            else:
                slopes = template.partial_values(slots, *rest)
            for k, instances, sign in entries:
                values.append(_signed(sign, take(self._filled(slopes[k], shape), instances), self.dtype))
        return jnp.concatenate(residuals), jnp.concatenate(values) if partials else None

    def _affine(self, follow, residuals, m: int, shape: tuple[int, ...]) -> list[Any]:
        """The local unknowns of a linear block: affine in its tearing variables, as the residuals are."""
        zero = [jnp.zeros(shape, self.dtype)] * m
        if m > UNROLLED:
            return follow(newton(residuals, zero))
        (r, base), push = jax.linearize(lambda z: (residuals(z), follow(z)), zero)
        one = jnp.ones(shape, self.dtype)
        columns = [push([one if j == k else zero[0] for j in range(m)]) for k in range(m)]
        z = solve([[column[0][e] for column in columns] for e in range(m)], [-v for v in r])
        return [
            functools.reduce(lambda total, pair: total + pair[0] * pair[1][1][u], zip(z, columns, strict=True), value)
            for u, value in enumerate(base)
        ]

    def _filled(self, value: Any, shape: tuple[int, ...]) -> Any:
        return jnp.broadcast_to(jnp.asarray(value, self.dtype), shape)


def _slope(function, slots: list[Any], k: int) -> Any:
    """∂f/∂slot k of a function that acts on every instance alone."""
    return jax.jvp(lambda s: function(*slots[:k], s, *slots[k + 1 :]), (slots[k],), (jnp.ones_like(slots[k]),))[1]


def solve_block(pattern: SparsePattern, values: Any, right: Any) -> Any:
    """A·x = b by KLU; by dense elimination where KLU is not available and A is not too large for that.

    **Raises:** `ModelError` where neither is possible.
    """
    if jax.config.jax_enable_x64 and sparse.available():
        return solve_sparse(pattern, values, right)
    check_solvable(pattern.n)
    if pattern.n > DENSE:
        raise ModelError(
            f"the model has {pattern.n} simultaneous equations; sparse solves compute in float64: call "
            "jax.config.update('jax_enable_x64', True) at the start"
        )
    return jnp.linalg.solve(pattern.dense(values), right)


def check_solvable(n: int):
    """**Raises:** `ModelError` if n simultaneous equations need a package that is not installed."""
    if n > DENSE and not sparse.available():
        raise ModelError(f"the model has {n} simultaneous equations, which need a sparse solver: {sparse.EXTRA}")


def newton(residuals, z: list[Any]) -> list[Any]:
    """One Newton step for r(z) = 0, lists of arrays of one shape (a batch of problems); exact if r is affine."""
    m = len(z)
    if m <= UNROLLED:
        value, push = jax.linearize(residuals, z)
        columns = [push([jnp.ones_like(a) if j == k else jnp.zeros_like(a) for j, a in enumerate(z)]) for k in range(m)]
        step = solve([[column[r] for column in columns] for r in range(m)], value)
        return [a - b for a, b in zip(z, step, strict=True)]
    stacked = jnp.stack(z)
    value, push = jax.linearize(lambda v: jnp.stack(residuals(list(v))), stacked)
    basis = jnp.eye(m, dtype=stacked.dtype).reshape(m, m, *([1] * z[0].ndim))
    columns = jax.vmap(push)(jnp.broadcast_to(basis, (m, *stacked.shape)))  # (unknown, equation, *batch)
    matrix = jnp.moveaxis(columns, (1, 0), (-2, -1))
    step = jnp.linalg.solve(matrix, jnp.moveaxis(value, 0, -1)[..., None])[..., 0]
    return list(stacked - jnp.moveaxis(step, -1, 0))


def _signed(sign: Any, value: Any, dtype) -> Any:
    if isinstance(sign, int):
        return value if sign > 0 else -value
    return value * jnp.asarray(sign, dtype)
