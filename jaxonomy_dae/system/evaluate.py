"""Evaluation: steps become gathers, vectorised kernels and chunks of results.

The traced program grows with the number of steps, not of the equations in them.

Nonlinear blocks are solved from the values their unknowns have in the state array. What is returned fulfils their
equations,

    |r| ≤ c Σ|terms of r| + c' eps Σ |∂r/∂s| size(s) + c'' Σ |∂r/∂s| δs      over all that stands in an equation,

where size(s) is what a slot usually is, beside which zero is judged, and δs is what rounding may have left in what was
eliminated; or is not-a-number: an iteration that diverged, cycles, or rests where |r| is smallest but not zero.
"""

import copy
import enum
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from ..linear.dense import solve_dense
from ..linear.torn import solve_torn
from ..linear.whole import solve_whole
from ..linear.written_out import UNROLLED, solve
from ..lowering.gather import FEW, Chunk, Gather, entries, take, times
from ..lowering.program import (
    AbstractEvaluation,
    PlannedEquation,
    PlannedLoop,
    PlannedSparse,
    PlannedStep,
    Program,
)
from ..model.linear_template import LinearTemplate, scaled
from ..model.networks import Networks
from ..model.tables import ZERO
from ..tolerances import NOISE, ZERO_WITHIN, solved, spacing

UNROLLED_REPETITIONS = 4  # of a loop, written out in each of its iterations
LONG_SUM = 16  # linear equations with more terms are one gather and one sum
NEWTON_STEPS = 120  # to the root of a nonlinear block, at most, halvings included; a double root takes 27
SURE = 1e-6  # residuals so small, relative to their terms at the start, need not fall: rounding has a part in them
ROUGH = 1e-2  # residual of an equation relative to its terms, where one Newton correction is made


class Refinement(enum.Enum):
    """The treatment of the unknowns of nonlinear blocks before they are used."""

    NONE = "none"  # they are read from the state as they are
    ONCE = "once"  # one Newton correction, for states that are nearly right
    ROOT = "root"  # Newton's method until the equations hold to rounding


class Evaluation(AbstractEvaluation):
    """One pass over a program's steps at one point."""

    def __init__(self, state: Chunk, inputs: Chunk, parameters: Any, t: Any, networks: Networks, typical: Any):
        """`typical` are the sizes of all quantities, by which nonlinear blocks are judged."""
        self.typical = typical
        self.chunks: list[Chunk] = [state, inputs]
        self.parameters = parameters
        self._scalars: dict[str, list[Any]] = {}
        self.dtype = parameters.dtype
        self.t = t
        self.networks = networks
        self.residuals: list[Any] = []  # of carried steps, if nothing is refined

    def frozen(self) -> "Evaluation":
        """A copy in which all arrays are constant under differentiation."""
        parts = self.chunks, self.parameters, self.t, self.networks.weights
        chunks, parameters, t, weights = jax.tree.map(
            lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf, parts
        )
        other = Evaluation((), (), parameters, t, Networks(weights), self.typical)
        other.chunks = chunks
        return other

    def run(self, program: Program, refine: Refinement):
        """Evaluates all steps."""
        for planned in program.steps:
            self.chunks.extend(planned.evaluate(self, refine))
        return self

    def parameter(self, k: int) -> Any:
        """A parameter, a scalar."""
        return self._entry("parameters", k)

    def _entry(self, name: str, k: int) -> Any:
        """An entry of the parameters or of the typical sizes, a scalar."""
        array = getattr(self, name)
        if array.shape[0] > FEW:
            return array[k]
        if name not in self._scalars:
            self._scalars[name] = entries(array)
        return self._scalars[name][k]

    def read(self, gather: Gather) -> Any:
        """Gathered values: a scalar, or an array."""
        return gather.read(self.chunks, self.dtype)

    def _arguments(self, planned: PlannedEquation, local: list[Any]):
        slots = []
        for source, factor in zip(planned.sources, planned.factors, strict=True):
            if isinstance(source, Gather):
                slots.append(self.read(source))
            else:
                slots.append(scaled_by(factor, local[-1 - source], self.dtype))
        equation = planned.equation
        n = equation.parameter.shape[0]
        if n == 1:
            parameters = [self.parameter(int(k)) for k in equation.parameter[0]]
            coefficients: list[Any] = [float(c) for c in equation.coefficient[0]]
        else:
            parameters = [
                self.parameter(int(column[0])) if (column == column[0]).all() else take(self.parameters, column)
                for column in equation.parameter.T
            ]
            coefficients = [float(c[0]) if (c == c[0]).all() else c for c in equation.coefficient.T]
        return slots, parameters, coefficients, self.t, self.networks

    def _residual(self, planned: PlannedEquation, local: list[Any]) -> Any:
        return planned.equation.template.residual(*self._arguments(planned, local))

    def _solved(self, planned: PlannedEquation, unknown: int, local: list[Any]) -> Any:
        """The local unknown for which the equation, affine in it, holds."""
        equation = planned.equation
        positions = [k for k, u in enumerate(equation.local) if u == unknown]
        outside = [k for k in range(len(equation.local)) if k != positions[0]]
        is_long = isinstance(equation.template, LinearTemplate) and len(outside) >= LONG_SUM
        if is_long and all(isinstance(planned.sources[k], Gather) for k in outside):
            weights = -equation.coefficient[:, outside] / equation.coefficient[:, [positions[0]]]
            return scaled_by(1 / planned.factors[positions[0]], self._long_sum(planned, outside, weights), self.dtype)
        local = list(local)
        local[unknown] = 0.0
        arguments = self._arguments(planned, local)
        if len(positions) == 1:
            value = equation.template.solve(positions[0], *arguments)
            return scaled_by(1 / planned.factors[positions[0]], value, self.dtype)
        rest = equation.template.residual(*arguments)
        partials = equation.template.partial_values(*arguments)
        slope = sum(scaled_by(planned.factors[k], partials[k], self.dtype) for k in positions)
        return -rest / slope

    def _long_sum(self, planned: PlannedEquation, positions: Sequence[int], weights: np.ndarray) -> Any:
        """Σ weight·slot over slots that are gathered."""
        n = len(weights)
        sources = [planned.sources[k] for k in positions]
        joined = Gather(*(np.concatenate([getattr(s, f) for s in sources]) for f in ("chunk", "offset", "factor")))
        values = joined.read(self.chunks, self.dtype)
        values = jnp.reshape(jnp.broadcast_to(values, (len(positions) * n,)), (len(positions), n))
        total = jnp.sum(values * jnp.asarray(weights.T, self.dtype), axis=0)
        return total[0] if n == 1 else total

    def step(self, planned: PlannedStep, refine: Refinement) -> list[Any]:
        step = planned.step
        shape = () if step.n == 1 else (step.n,)
        if not step.tearing.tearing:
            return self._follow(planned, [])
        if not step.carried:
            return self._linear_block(planned, shape)
        z = [self._filled(self.read(g), shape) for g in planned.guess]
        if refine is Refinement.NONE:
            self.residuals.extend(self._residuals(planned, z))
            return self._follow(planned, z)
        if refine is Refinement.ONCE:
            local = self._follow(planned, self._corrected(planned, z))
            holds = self._holds(planned, local, ROUGH)
        else:
            still, tolerated = self.frozen(), solved(self.dtype)
            z, holds = find_root(
                lambda z: still._holds(planned, still._follow(planned, z), tolerated),
                lambda z: newton_step(functools.partial(still._residuals, planned), z),
                functools.partial(self._corrected, planned),
                still._sizes_of_rows(planned, z),
                z,
            )
            local = self._follow(planned, z)
        nan = jnp.full(shape, jnp.nan, self.dtype)
        return [jax.lax.select(holds, u, nan) for u in local]

    def _sizes_of_rows(self, planned: PlannedStep, z: list[Any]) -> list[Any]:
        """How large the terms of the residual equations are."""
        local = self._follow(planned, z)
        equations = [planned.equations[e] for e in planned.step.tearing.residuals]
        return [self._filled(self._magnitude(equation, local), z[0].shape) for equation in equations]

    def _corrected(self, planned: PlannedStep, z: list[Any]) -> list[Any]:
        """The tearing variables after one Newton step."""
        return newton(functools.partial(self._residuals, planned), z)

    def _follow(self, planned: PlannedStep, z: list[Any]) -> list[Any]:
        """All unknowns of a step, from its tearing variables."""
        step = planned.step
        shape = () if step.n == 1 else (step.n,)
        local: list[Any] = [None] * len(step.unknown)
        for u, value in zip(step.tearing.tearing, z, strict=True):
            local[u] = value
        for e, u in step.tearing.sequence:
            local[u] = self._filled(self._solved(planned.equations[e], u, local), shape)
        return local

    def _residuals(self, planned: PlannedStep, z: list[Any]) -> list[Any]:
        """The residuals of the equations that the tearing variables must fulfil."""
        local = self._follow(planned, z)
        like = z[0]
        equations = [planned.equations[e] for e in planned.step.tearing.residuals]
        return [self._filled(self._residual(equation, local), like.shape) for equation in equations]

    def _holds(self, planned: PlannedStep, local: list[Any], tolerated: float) -> Any:
        """True for each of the step's blocks whose residual equations hold."""
        noise = self._noise(planned, local)
        verdicts = []
        for e in planned.step.tearing.residuals:
            equation = planned.equations[e]
            residual, slots, partials = self._terms(equation, local)
            terms = self._magnitude(equation, local)
            noise_of = self._of_slots(equation, noise)
            verdicts.append(is_small(residual, terms, partials, self._typical(equation), tolerated, noise_of))
        return functools.reduce(jnp.logical_and, verdicts)

    def _magnitude(self, planned: PlannedEquation, local: list[Any]) -> Any:
        """The magnitude of an equation's terms, not differentiated."""
        arguments: Any = self._still_arguments(planned, local)
        return planned.equation.template.magnitude([jnp.abs(s) for s in arguments[0]], *arguments)

    def _typical(self, planned: PlannedEquation) -> list[Any]:
        """The typical sizes of an equation's slots; the constant zero has none."""
        out: list[Any] = []
        for quantity, factor in zip(planned.equation.quantity.T, planned.equation.factor.T, strict=True):
            if len(quantity) == 1:
                k = int(quantity[0])
                out.append(0.0 if k == ZERO else times(abs(float(factor[0])), self._entry("typical", k)))
            else:
                factors = np.where(quantity == ZERO, 0.0, np.abs(factor))
                out.append(jnp.asarray(factors, self.dtype) * take(self.typical, np.maximum(quantity, 0)))
        return out

    def _still_arguments(self, planned: PlannedEquation, local: list[Any]):
        """The arguments of an equation's template, not differentiated."""
        slots, parameters, *rest = self._arguments(planned, local)
        return *jax.lax.stop_gradient((slots, parameters)), *rest

    def _noise(self, planned: PlannedStep, local: list[Any]) -> list[Any]:
        """The part that rounding may have left in each unknown that follows from others (a running error analysis,
        Wilkinson 1963): a difference of pressures is not known to its own digits, but to theirs."""
        noise: list[Any] = [0.0] * len(local)
        eps = spacing(self.dtype)
        for e, u in planned.step.tearing.sequence:
            equation = planned.equations[e]
            _, slots, partials = self._terms(equation, local)
            places = equation.equation.local
            before = self._of_slots(equation, noise)
            slope, total = 0.0, eps * self._magnitude(equation, local)
            for place, factor, s, p, n in zip(places, equation.factors, slots, partials, before, strict=False):
                if place == u:
                    slope = slope + scaled_by(factor, p, self.dtype)
                else:
                    total = total + jnp.abs(p) * (eps * jnp.abs(s) + n)
            noise[u] = total / jnp.abs(slope)
        return noise

    def _of_slots(self, planned: PlannedEquation, noise: list[Any]) -> list[Any]:
        """The noise of an equation's slots."""
        pairs = zip(planned.equation.local, planned.factors, strict=True)
        return [0.0 if u < 0 else scaled_by(abs(f), noise[u], self.dtype) for u, f in pairs]

    def _terms(self, planned: PlannedEquation, local: list[Any]) -> tuple[Any, list[Any], Sequence[Any]]:
        """An equation's residual, slots and partial derivatives, not differentiated; of a network's output, y − N(u),
        those of y alone."""
        template = planned.equation.template
        arguments: Any = self._still_arguments(planned, local)
        slots = arguments[0]
        residual = template.residual(*arguments)
        if template.opaque is not None:
            return residual, slots[:1], (1.0,)
        return residual, slots, template.partial_values(*arguments)

    def loop(self, planned: PlannedLoop) -> list[Any]:
        """The unknowns of all repetitions, each of shape (count · n,)."""

        def read(gather: Gather | None) -> Any:
            if gather is None:
                return jnp.zeros(0, self.dtype)
            return self._filled(self.read(gather), (len(gather.chunk),))

        def repetition(carried, given):
            outside, parameters = given
            inner = Evaluation(carried, outside, parameters, self.t, Networks(self.networks.weights), self.typical)
            for step in planned.body:
                inner.chunks.extend(inner.step(step, Refinement.NONE))
            if planned.following is not None:
                carried = self._filled(inner.read(planned.following), carried.shape)
            return carried, tuple(inner.chunks[2:])

        count = planned.count
        parameters = self.parameters[planned.parameters.ravel()].reshape(planned.parameters.shape)
        given = jnp.reshape(read(planned.outside), (count, -1)), parameters
        _, chunks = jax.lax.scan(repetition, read(planned.first), given, unroll=UNROLLED_REPETITIONS)
        return [jnp.reshape(c, (-1,)) for c in chunks]

    def sparse_step(self, planned: PlannedSparse, refine: Refinement) -> list[Any]:
        return [self._whole_unknowns(planned, refine)]

    def _whole_unknowns(self, planned: PlannedSparse, refine: Refinement) -> Any:
        """The unknowns of large blocks, shape (n,)."""
        if planned.guess is None:
            return self._whole_corrected(planned, jnp.zeros(planned.step.n, self.dtype))
        u = self.read(planned.guess)
        if refine is Refinement.NONE:
            there = self._beside(u)
            self.residuals.extend(
                self._filled(there._residual(equation, []), (len(equation.equation.equation),))
                for equation in planned.equations
            )
            return u
        if refine is Refinement.ONCE:
            u = self._whole_corrected(planned, u)
            holds = self._whole_holds(planned, u, ROUGH)
        else:
            still, tolerated = self.frozen(), solved(self.dtype)
            (u,), holds = find_root(
                lambda z: still._whole_holds(planned, z[0], tolerated),
                lambda z: still._whole_step(planned, z),
                lambda z: [self._whole_corrected(planned, z[0])],
                [still._whole_sizes(planned, u)],
                [u],
            )
        return jnp.where(holds, u, jnp.nan)

    def _whole_corrected(self, planned: PlannedSparse, u: Any) -> Any:
        """The unknowns of large blocks after one Newton step, which is exact if the equations are affine."""
        return u + self._whole_step(planned, [u])[1][0]

    def _whole_step(self, planned: PlannedSparse, z: list[Any]) -> tuple[list[Any], list[Any]]:
        """(The residuals, a Newton step) of large blocks."""
        (u,) = z
        equations = self._whole(planned, u)
        residual = jnp.concatenate([r for r, _ in equations])
        matrix, checked = self._entries(planned, equations), planned.guess is None
        step = solve_whole(planned.pattern, matrix, residual, checked=checked, solver=planned.linear_solver)
        return [residual], [-step]

    def _whole_sizes(self, planned: PlannedSparse, u: Any) -> Any:
        """How large the terms of the equations of large blocks are."""
        there = self._beside(u)
        return jnp.concatenate(
            [self._filled(there._magnitude(e, []), (len(e.equation.equation),)) for e in planned.equations]
        )

    def _entries(self, planned: PlannedSparse, equations: list[tuple[Any, Sequence[Any]]]) -> Any:
        """The entries of the matrix of large blocks, from the residuals and partial derivatives of their equations."""
        values = [
            scaled_by(factor, take(self._filled(partials[k], r.shape), instances), self.dtype)
            for (r, partials), entries in zip(equations, planned.entries, strict=True)
            for k, instances, factor in entries
        ]
        return jnp.concatenate(values)

    def _whole_holds(self, planned: PlannedSparse, u: Any, tolerated: float) -> Any:
        """True if all equations of large blocks hold."""
        there = self._beside(u)
        holds = jnp.asarray(True)
        for equation, (residual, partials) in zip(planned.equations, self._whole(planned, u), strict=True):
            terms = there._magnitude(equation, [])
            holds &= jnp.all(is_small(residual, terms, partials, self._typical(equation), tolerated))
        return holds

    def _whole(self, planned: PlannedSparse, u: Any) -> list[tuple[Any, Sequence[Any]]]:
        """The residuals and partial derivatives of a sparse step's equations at its unknowns u."""
        there = self._beside(u)
        out = []
        for equation in planned.equations:
            template = equation.equation.template
            shape = (len(equation.equation.equation),)
            arguments: Any = there._arguments(equation, [])
            slots, rest = arguments[0], arguments[1:]

            def residual(*slots, template=template, rest=rest, shape=shape):
                return self._filled(template.residual(list(slots), *rest), shape)

            if template.opaque is not None:
                slots = [self._filled(s, shape) for s in slots]
                partials: Sequence[Any] = [_slope(residual, slots, k) for k in range(len(slots))]
            else:
                partials = template.partial_values(slots, *rest)
            out.append((residual(*slots), partials))
        return out

    def _beside(self, u: Any) -> Self:
        """A copy with one more chunk."""
        there = copy.copy(self)
        there.chunks = [*self.chunks, u]
        return there

    def _linear_block(self, planned: PlannedStep, shape: tuple[int, ...]) -> list[Any]:
        """The unknowns of linear blocks of one shape."""
        matrix: dict[tuple[int, int], Any] = {}
        right = []
        blank = [0.0] * len(planned.step.unknown)
        for e, equation in enumerate(planned.equations):
            rest, slopes = self._affine_parts(equation, blank)
            right.append(self._filled(-rest, shape))
            for u, slope in slopes:
                matrix[e, u] = matrix[e, u] + slope if (e, u) in matrix else slope
        return solve_torn(planned.step.tearing, matrix, right)

    def _affine_parts(self, planned: PlannedEquation, blank: list[Any]) -> tuple[Any, list[tuple[int, Any]]]:
        """The residual where all local unknowns are zero, and its slopes as (local unknown, slope)."""
        equation = planned.equation
        template = equation.template
        inside = equation.inside
        arguments = self._arguments(planned, blank)
        if isinstance(template, LinearTemplate):
            coefficients = arguments[2]
            outside = [k for k in range(len(equation.local)) if k not in inside]
            partials: Any = {k: self._constant(coefficients[k]) for k in inside}
            if len(outside) > LONG_SUM:
                rest = self._long_sum(planned, outside, equation.coefficient[:, outside])
            else:
                terms = [scaled(coefficients[k], arguments[0][k]) for k in outside]
                rest = functools.reduce(operator.add, terms) if terms else 0.0
        else:
            rest = template.residual(*arguments)
            # A network's output stands alone, its inputs are outside.
            partials = {inside[0]: 1.0} if template.opaque is not None else template.partial_values(*arguments)
        return rest, [(equation.local[k], scaled_by(planned.factors[k], partials[k], self.dtype)) for k in inside]

    def _constant(self, value: Any) -> Any:
        return value if isinstance(value, float) else jnp.asarray(value, self.dtype)

    def _filled(self, value: Any, shape: tuple[int, ...]) -> Any:
        return jnp.broadcast_to(jnp.asarray(value, self.dtype), shape)


def _slope(function, slots: list[Any], k: int) -> Any:
    """∂f/∂slot k of a function that acts on every instance alone."""
    return jax.jvp(lambda s: function(*slots[:k], s, *slots[k + 1 :]), (slots[k],), (jnp.ones_like(slots[k]),))[1]


def is_small(
    residual: Any,
    terms: Any,
    partials: Sequence[Any],
    typical: Sequence[Any],
    tolerated: float,
    noise: Sequence[Any] = (),
) -> Any:
    """True if a residual is small beside its terms, or beside the rounding of what it is computed from.

    **Arguments:**

    - `terms`: how large its terms are.
    - `partials`, `typical`, `noise`: its partial derivatives by slots; the typical sizes of these; and what rounding
        may have left in them beyond their own.
    """
    eps = spacing(jnp.result_type(residual))
    pairs = list(zip(partials, typical, strict=False))  # of a network, its output alone
    floor = _weighed([(p, s) for p, s in pairs if not _is_nothing(s)])
    left = _weighed([(p, n) for p, n in zip(partials, noise, strict=False) if not _is_nothing(n)])
    allowed = tolerated * terms + ZERO_WITHIN * eps * floor + NOISE * left
    # Where a slope is infinite, as that of a root at zero, the equation holds exactly or not at all.
    return (jnp.abs(residual) <= allowed) & ((allowed < jnp.inf) | (residual == 0))


def _weighed(pairs: Sequence[tuple[Any, Any]]) -> Any:
    """Σ |a|·b."""
    return functools.reduce(operator.add, [abs(a) * b for a, b in pairs], 0.0)


def _is_nothing(value: Any) -> bool:
    """True if a value is the Python number 0.0, known while a program is traced."""
    return isinstance(value, float) and value == 0.0


def find_root(
    holds: Callable[[list[Any]], Any],
    stepped: Callable[[list[Any]], tuple[list[Any], list[Any]]],
    differentiable: Callable[[list[Any]], list[Any]],
    sizes: list[Any],
    z: list[Any],
) -> tuple[list[Any], Any]:
    """Newton's method from z until all `holds`, one verdict for each of a batch of problems; and the verdicts.

    `stepped` gives the residuals and the step. A step is halved until the largest residual falls, relative to the
    `sizes` of their terms at the start: whole steps go back and forth between the branches of a law with a kink.

    The search is not differentiated. Two more steps of the `differentiable` correction follow: by the implicit function
    theorem the first carries first derivatives and the second one second derivatives.
    """

    def going(carry):
        *_, found, count = carry
        return ~jnp.all(found) & (count < NEWTON_STEPS)

    def body(carry):
        trial, z, step, part, least, found, count = carry
        residuals, new_step = stepped(trial)
        off = [jnp.abs(r) / jnp.where(s > 0, s, 1) for r, s in zip(residuals, sizes, strict=True)]
        largest = functools.reduce(jnp.maximum, off)
        largest = jnp.max(largest) if jnp.ndim(found) < jnp.ndim(largest) else largest
        falls = (largest <= (1 - part / 4) * least) | (least <= SURE)
        part = jnp.where(falls, jnp.minimum(2 * part, 1), part / 2)
        least = jnp.where(falls, largest, least)
        z = [jnp.where(falls, a, b) for a, b in zip(trial, z, strict=True)]
        step = [jnp.where(falls, a, b) for a, b in zip(new_step, step, strict=True)]
        trial = [jnp.where(found, t, a + part * d) for t, a, d in zip(trial, z, step, strict=True)]
        return trial, z, step, part, least, holds(trial), count + 1

    z, sizes = jax.lax.stop_gradient((z, sizes))
    found = holds(z)
    one = jnp.ones(jnp.shape(found), z[0].dtype)
    begin = z, z, [jnp.zeros_like(a) for a in z], one, jnp.inf * one, found, 0
    z, *_, found, _ = jax.lax.while_loop(going, body, begin)
    z = jax.lax.stop_gradient(z)
    for _ in range(2):
        z = differentiable(z)
    return z, found


def newton(residuals: Callable[[list[Any]], list[Any]], z: list[Any]) -> list[Any]:
    """z after a Newton step for r(z) = 0, lists of arrays of one shape (a batch of problems); exact if r is affine."""
    return [a + d for a, d in zip(z, newton_step(residuals, z)[1], strict=True)]


def newton_step(residuals: Callable[[list[Any]], list[Any]], z: list[Any]) -> tuple[list[Any], list[Any]]:
    """(r(z), a Newton step)."""
    m = len(z)
    if m <= UNROLLED:
        value, push = jax.linearize(residuals, z)
        columns = [push([jnp.ones_like(a) if j == k else jnp.zeros_like(a) for j, a in enumerate(z)]) for k in range(m)]
        step = solve([[column[r] for column in columns] for r in range(m)], value)
        return value, [-d for d in step]
    stacked = jnp.stack(z)
    value, push = jax.linearize(lambda v: jnp.stack(residuals(list(v))), stacked)
    basis = jnp.eye(m, dtype=stacked.dtype).reshape(m, m, *([1] * z[0].ndim))
    columns = jax.vmap(push)(jnp.broadcast_to(basis, (m, *stacked.shape)))  # (unknown, equation, *batch)
    matrix = jnp.moveaxis(columns, (1, 0), (-2, -1))
    step = solve_dense(matrix, jnp.moveaxis(value, 0, -1))
    return list(value), list(-jnp.moveaxis(step, -1, 0))


def scaled_by(factor: Any, value: Any, dtype) -> Any:
    return times(factor if isinstance(factor, float) else jnp.asarray(factor, dtype), value)
