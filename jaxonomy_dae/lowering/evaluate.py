"""Evaluation: steps become gathers, vectorised kernels and chunks of results.

The traced program grows with the number of steps, not of the equations in them. Chunk 0 is the state (an array, or a
tuple of scalars for small systems), chunk 1 the inputs' quantities; every step appends one chunk for each of its
local unknowns.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..compiler.numeric import Networks
from ..compiler.tables import ZERO
from ..solvers.small_linear import UNROLLED, solve
from .gather import Chunk, Gather, take
from .schedule import Step, StepEquation

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
class Program:
    """Planned steps and the layout of all they compute."""

    steps: tuple[PlannedStep, ...]
    layout: Layout


def plan(
    steps: Sequence[Step], states: np.ndarray, inputs: np.ndarray, n_quantities: int, carried: np.ndarray
) -> Program:
    """Plans the evaluation of `steps`; the state array holds `states`, then `carried`."""
    chunk = np.full(n_quantities, -2, np.int64)
    offset = np.zeros(n_quantities, np.int64)
    chunk[states], offset[states] = 0, np.arange(len(states))
    chunk[inputs], offset[inputs] = 1, np.arange(len(inputs))
    place = {int(q): len(states) + k for k, q in enumerate(carried)}
    next_chunk = 2
    planned = []
    for step in steps:
        layout = Layout(chunk, offset)
        equations = []
        for equation in step.equations:
            sources, signs = [], []
            for slot in equation.slots:
                sources.append(-1 - slot.local if slot.local >= 0 else layout.gather(slot.quantity, slot.sign))
                signs.append(_uniform(slot.sign))
            equations.append(_PlannedEquation(equation, tuple(sources), tuple(signs)))
        guess = []
        if step.carried:
            for u in step.tearing.tearing:
                where = np.array([place[int(q)] for q in step.unknown[u]])
                guess.append(Gather(np.zeros(step.n, np.int64), where, np.ones(step.n, np.int64)))
        planned.append(PlannedStep(step, tuple(equations), tuple(guess)))
        for quantities in step.unknown:
            chunk[quantities], offset[quantities] = next_chunk, np.arange(step.n)
            next_chunk += 1
    return Program(tuple(planned), Layout(chunk, offset))


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
