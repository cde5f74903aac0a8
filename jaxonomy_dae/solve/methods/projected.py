"""Projection after every step, for any Diffrax solver."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from diffrax import AbstractSolver
from diffrax import AbstractWrappedSolver as _Wrapped

from ...base.aliases import Args, Numeric, State, Time
from ...base.errors import ModelError
from ...base.private_names import unwrapped
from .choice_guard import ChoiceGuard
from .wrapped import WrappedSolver

Projection = Callable[[Time, State, Args], State]


class Projected(WrappedSolver):
    """Wraps a Diffrax solver: after every step, y₁ is moved onto a manifold.

    The standard projection method (Hairer, Lubich & Wanner 2006, Geometric Numerical Integration, Algorithm IV.4.2):
    the step, its error estimate and its dense output are those of the wrapped solver, and the projection changes y₁ by
    no more than the step's error, so the order is kept. Between the ends of steps, the dense output lies on the
    manifold to its own accuracy; `jaxonomy_dae.simulate` projects saved values too.

    **Arguments:**

    - `solver`: any Diffrax solver.
    - `projection`: a function `(t, y, args) -> y` such as `system.project`; `simulate` fills it in if left out.
    - `strict`: whether the distance moved counts as an error of the step. A step that slips to another branch of an
        implicit function is then rejected, even if its own error estimate is small.
    - `guard`: ends the run with `RESULTS.singular` if a minimal set of states becomes singular. `simulate` fills it in.
    """

    solver: AbstractSolver
    projection: Projection | None = None
    strict: bool = eqx.field(static=True, default=False)
    guard: ChoiceGuard | None = None

    def __check_init__(self):
        if isinstance(self.solver, Projected):
            raise ModelError("the solver is wrapped in Projected already")

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_compatible_contr_kwargs

    def init(self, terms, t0, t1, y0, args):
        state = self.solver.init(terms, t0, t1, y0, args)
        if self.guard is None:
            return state
        return state, self.guard.measure(t0 * unwrapped(terms)[1], y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        if self.projection is None:
            raise ModelError("Projected needs a projection outside simulate(): Projected(solver, system.project)")
        largest: Numeric = None
        if self.guard is not None:
            solver_state, largest = solver_state
        y1, y_error, dense_info, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump
        )
        # A run backwards goes forwards in −t.
        _, direction = unwrapped(terms)
        projected = self.projection(t1 * direction, y1, args)
        # To the error that the solver estimates, since either alone may be small: a step onto another branch has a
        # small error and a long way back.
        if self.strict and y_error is not None:
            moved = jax.tree.map(lambda a, b: jnp.abs(a - b), projected, y1)
            y_error = jax.tree.map(lambda e, m: jnp.abs(e) + m, y_error, moved)
        if self.guard is not None:
            if made_jump is not False:
                # Behind a jump the state may be on another branch, where the determinant has another size and sign.
                largest = jnp.where(made_jump, self.guard.measure(t0 * direction, y0, args), largest)
            verdict = self.guard.judge(largest, t1 * direction, projected, args)
            if y_error is not None:
                y_error = jax.tree.map(lambda e: jnp.where(verdict.allowed, e, jnp.inf), y_error)
            solver_state, result = (solver_state, verdict.largest), verdict.result(result)
        return projected, y_error, dense_info, solver_state, result

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


def with_projection(
    solver: AbstractSolver, projection: Projection, strict: bool, guard: ChoiceGuard | None = None
) -> Projected:
    """The solver wrapped, or its own wrapper filled in."""
    if isinstance(solver, _Wrapped) and isinstance(getattr(solver, "projection", None), Callable):
        return solver  # type: ignore[return-value]
    if type(solver) is Projected:
        return Projected(solver.solver, projection, solver.strict, guard)
    return Projected(solver, projection, strict, guard)
