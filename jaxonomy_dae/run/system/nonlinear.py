"""Nonlinear blocks, solved from the values their unknowns have in the state array. What is returned fulfils their
equations,

    |r| ≤ c Σ|terms of r| + c' eps Σ |∂r/∂s| size(s) + c'' Σ |∂r/∂s| δs      over all that stands in an equation,

where size(s) is the typical size of a slot s, and δs bounds the rounding error of a variable that was eliminated; or it
is not-a-number: an iteration that diverged, cycles, or rests where |r| is smallest but not zero.
"""

import abc
import enum
import functools
from collections.abc import Sequence
from typing import ClassVar, Generic, NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ...base.tolerances import solved, spacing
from ...compile.lowering.program import PlannedSparse, PlannedStep
from ...solve.linear.arrays import Scalar
from ...solve.linear.whole import solve_whole
from .roots import Beside, find_root, newton_step
from .values import EquationAt, Values, filled

ROUGH = 1e-2  # residual of an equation relative to its terms, where one Newton correction is made
_P = TypeVar("_P", PlannedStep, PlannedSparse)


class Refinement(enum.Enum):
    """The treatment of the unknowns of nonlinear blocks before they are used."""

    NONE = "none"  # they are read from the state as they are
    ONCE = "once"  # one Newton correction, for states that are nearly right
    ROOT = "root"  # Newton's method until the equations hold to rounding


class Inside(NamedTuple):
    """Where the equations of a block are evaluated, and all unknowns of the step, a chunk each."""

    values: Values
    local: Sequence[Scalar]
    chunks: list[Array]


class AbstractBlock(abc.ABC, Generic[_P]):
    """The blocks of one step as functions of their unknowns z in the state array, arrays of one shape."""

    whole: ClassVar[bool]  # whether all instances are one problem, and derivatives of networks are at hand

    def __init__(self, values: Values, planned: _P):
        self.values = values
        self.planned = planned
        self.dtype = values.dtype

    @property
    def still(self) -> Self:
        """The same blocks, not differentiated. Each is a new one: what values remember while a loop is traced must not
        leave it."""
        return type(self)(self.values.frozen(), self.planned)

    @property
    @abc.abstractmethod
    def guess(self) -> list[Array]:
        """The unknowns in the state array."""

    @abc.abstractmethod
    def at(self, z: list[Array]) -> Inside:
        """The place where the unknowns are z."""

    @abc.abstractmethod
    def step(self, z: list[Array]) -> tuple[list[Array], list[Array]]:
        """The residuals, and a Newton step."""

    def noise(self, inside: Inside) -> list[Scalar]:
        """Bounds of the rounding errors of the local unknowns that follow from others."""
        return []

    def equations(self, inside: Inside, still: bool) -> list[EquationAt]:
        """The equations that z must fulfil, perhaps not to be differentiated."""
        at = inside.values.still_equation if still else inside.values.equation
        return [at(equation, inside.local) for equation in self.planned.left]

    def residuals(self, inside: Inside) -> list[Array]:
        """The residuals of these equations."""
        return [at.filled(at.residual()) for at in self.equations(inside, still=False)]

    def corrected(self, z: list[Array]) -> list[Array]:
        """The unknowns after one Newton step, which is exact if the equations are affine."""
        return [a + d for a, d in zip(z, self.step(z)[1], strict=True)]

    def beside(self, inside: Inside) -> list[tuple[EquationAt, Beside]]:
        """The equations that z must fulfil, not to be differentiated, and what their residuals count as zero beside."""
        noise, found = self.noise(inside), []
        for at in self.equations(inside, still=True):
            partials, typical = at.partials(through_networks=self.whole), inside.values.typical_of(at.planned)
            found.append((at, Beside.of(at.magnitude(), partials, typical, at.of_slots(noise))))
        return found

    def holds(self, beside: list[tuple[EquationAt, Beside]], tolerated: float) -> Array:
        """True where the equations hold, for each of the blocks or for all."""
        verdicts = [own.is_small(at.residual(), tolerated) for at, own in beside]
        return functools.reduce(jnp.logical_and, [jnp.all(v) for v in verdicts] if self.whole else verdicts)

    def judged(self, z: list[Array], tolerated: float, batch: tuple[int, ...]) -> tuple[Array, list[Array]]:
        """Whether the equations hold at z, and the sizes of their residuals, as these are given by `step`."""
        beside = self.beside(self.at(z))
        sizes = [at.filled(own.size) for at, own in beside]
        sizes = [jnp.concatenate([jnp.reshape(s, (-1,)) for s in sizes])] if self.whole else sizes
        return jnp.broadcast_to(self.holds(beside, tolerated), batch), sizes

    def unknowns(self, refine: Refinement) -> list[Array]:
        """The chunks of the step; not-a-number where equations do not hold."""
        z = self.guess
        if refine is Refinement.ONCE:
            inside = self.at(self.corrected(z))
            # One correction at a stage brings the unknowns to what a step needs. Rounding is asked for where values are
            # read and at saved times.
            holds = self.holds(self.beside(inside), ROUGH)
        else:
            tolerated, batch = solved(self.dtype), () if self.whole else jnp.shape(z[0])
            z, holds = find_root(
                lambda z: self.still.judged(z, tolerated, batch), lambda z: self.still.step(z), self.corrected, z, batch
            )
            inside = self.at(z)
        nan = jnp.full_like(inside.chunks[0], jnp.nan)
        # Not-a-number rather than the last iterate: a loud failure, which rejects the step, instead of a value that
        # looks like a solution.
        return [jax.lax.select(holds, u, nan) for u in inside.chunks]


class WrittenOut(AbstractBlock[PlannedStep]):
    """Blocks that are written out: z are their tearing variables, from which the other unknowns follow."""

    whole = False

    @property
    def guess(self) -> list[Array]:
        n = self.planned.step.n
        shape = () if n == 1 else (n,)
        return [filled(self.values.read(gather), shape, self.dtype) for gather in self.planned.guess]

    def at(self, z: list[Array]) -> Inside:
        local = self.values.follow(self.planned, z)
        return Inside(self.values, local, local)

    def step(self, z: list[Array]) -> tuple[list[Array], list[Array]]:
        return newton_step(lambda z: self.residuals(self.at(z)), z)

    def noise(self, inside: Inside) -> list[Scalar]:
        """A running error analysis (Wilkinson 1963): a difference of pressures is not known to its own digits, but to
        theirs."""
        eps = spacing(self.dtype)

        def of_rest(at: EquationAt, partials: Sequence[Scalar], noise: list[Scalar], unknown: int) -> Scalar:
            total = eps * at.magnitude()
            rows = zip(at.planned.equation.local, at.slots, partials, at.of_slots(noise), strict=False)
            for place, s, p, n in rows:
                if place != unknown:
                    total = total + jnp.abs(p) * (eps * jnp.abs(s) + n)
            return total

        return self.values.through(self.planned, list(inside.local), [0.0] * len(inside.local), of_rest)


class Whole(AbstractBlock[PlannedSparse]):
    """Blocks that stay whole: z is one array of all their unknowns."""

    whole = True

    @property
    def guess(self) -> list[Array]:
        assert self.planned.guess is not None
        return [self.values.read(self.planned.guess)]

    def at(self, z: list[Array]) -> Inside:
        return Inside(self.values.beside(z[0]), (), z)

    def step(self, z: list[Array]) -> tuple[list[Array], list[Array]]:
        residual, matrix = self.values.whole_system(self.planned, z[0])
        step = solve_whole(self.planned.pattern, matrix, residual, checked=False, solver=self.planned.linear_solver)
        return [residual], [-step]
