"""BDF: variable order, variable step, fixed leading coefficient."""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ...base.aliases import Numeric, PyTree, State, Time
from ...base.errors import ModelError
from ..linear.choice import check_linear_solver, choose
from .bdf_coefficients import Coefficients, coefficients, interpolate
from .choice_guard import ChoiceGuard
from .dae_term import FlatProblem
from .index_one import consistent_point, consistent_slope
from .newton import Equation, Known, Tolerances, implicit_step
from .projected import Projection
from .step_control import encoded

ROWS = 6  # differences of orders 0 … 5
CAUTION = 4.0  # local errors are kept this much below the tolerance: those of a multistep method add up


class BDFInterpolation(diffrax.AbstractLocalInterpolation):
    """The polynomial that the method itself integrates, of the step's order."""

    t0: Time
    t1: Time
    y0: State
    phi: State
    psi: Numeric
    order: Numeric

    def evaluate(self, t0: Time, t1: Time = None, left: bool = True) -> State:
        """The solution at t0, or its increment from t0 to t1."""
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        weight = interpolate(t0 - self.t1, self.psi, self.order)
        return jax.tree.map(lambda phi: jnp.tensordot(weight.astype(phi.dtype), phi, axes=1), self.phi)


class _History(eqx.Module):
    """History of the integration that the next step reads; names as in Brenan, Campbell & Petzold (1996)."""

    phi: Float[Array, "rows n"]  # scaled divided differences
    psi: Float[Array, " rows"]  # sums of past step sizes
    order: Int[Array, ""]  # of the step to come
    last_order: Int[Array, ""]
    steady: Int[Array, ""]  # steps taken with the same size and order
    last_step: Float[Array, ""]
    planned: Float[Array, ""]  # the next step's size, as proposed
    starting: Numeric  # whether order and size still double and rise
    factor: PyTree
    factor_cj: Float[Array, ""]  # the coefficient the factorisation was made with
    last_cj: Float[Array, ""]
    contraction: Float[Array, ""]  # ρ/(1−ρ) of the last Newton iterations
    counts: Int[Array, "2"]  # Jacobians (and factorisations), Newton iterations
    largest: Numeric  # of the determinants measured, each; None if there are none


class _Tried(NamedTuple):
    """An attempted step: differences, the change from the prediction, its size and order, whether order and size still
    rise, whether it was rejected before, and whether Newton's method converged where it may go."""

    phi: Float[Array, "rows n"]
    e: Float[Array, " n"]
    h: Float[Array, ""]
    order: Int[Array, ""]
    starting: Bool[Array, ""]
    retried: Bool[Array, ""]
    converged: Bool[Array, ""]


class _Ahead(NamedTuple):
    """Whether the step is accepted; order and size of the next one, the size as a factor of this one's."""

    accepted: Bool[Array, ""]
    order: Int[Array, ""]
    steady: Int[Array, ""]
    starting: Bool[Array, ""]
    factor: Float[Array, ""]


class BDF(diffrax.AbstractImplicitSolver, diffrax.AbstractAdaptiveSolver):
    """Backward differentiation formulas of order 1 to 5 for M dy/dt = F(t, y), index 1, and stiff ordinary equations.

    Variable step, fixed leading coefficient: the formulas, the error estimates and the choice of order are those of
    Brenan, Campbell & Petzold (1996), Numerical Solution of Initial-Value Problems in Differential-Algebraic Equations,
    chapter 5, with the step-size rules of SUNDIALS IDA (Hindmarsh et al. 2005, ACM TOMS 31:363). The corrector is a
    modified Newton iteration that keeps its factorization over steps. The factorization is renewed, within the step, if
    the leading coefficient has changed too much or the iteration fails.

    Gradients are those of the implicit equations, linearized at their solution. They do not depend on the Newton
    iteration and its Jacobian.

    **Arguments:**

    - `max_order`: 1 to 5.
    - `fixed_order`: stay at `max_order` once it is reached; for convergence studies.
    - `linear_solver`: any Lineax solver, such as `lineax.GMRES(rtol, atol)`, or one of `jaxonomy_dae.linear`; None
        chooses by size. It receives a `SparseLinearOperator` where the term has a pattern.
    - `algebraic_errors`: whether the error test includes algebraic unknowns. Without them there are fewer steps (often
        far fewer if M is not diagonal), and their ends are as accurate. But then nothing checks the dense output of an
        algebraic unknown that varies faster than the rest. None counts it where M is diagonal, except in `simulate`,
        which solves the algebraic equations again at saved times.
    - `rtol`, `atol`, `norm`: give them only if the step-size controller has none.
    - `projection`: `(t, y, args) -> y`, onto hidden constraints: applied inside the step, before the history is
        updated. `simulate` fills it in.
    - `guard`: as in `Projected`.

    Takes a `DAETerm` or a `diffrax.ODETerm`. Its step-size controller is `StepControl(rtol, atol, steered=True)`;
    `diffrax.PIDController(rtol, atol)` works too.
    """

    max_order: int = eqx.field(static=True, default=5)
    fixed_order: bool = eqx.field(static=True, default=False)
    linear_solver: lx.AbstractLinearSolver | None = None
    algebraic_errors: bool | None = eqx.field(static=True, default=None)
    projection: Projection | None = None
    guard: ChoiceGuard | None = None
    root_finder: Tolerances = Tolerances()
    root_find_max_steps: int = eqx.field(static=True, default=4)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = BDFInterpolation

    def __check_init__(self):
        if self.max_order not in range(1, 6):
            raise ModelError(f"max_order must be 1, 2, 3, 4 or 5; got {self.max_order}")
        if self.linear_solver is not None:
            check_linear_solver(self.linear_solver)

    def order(self, terms):
        return self.max_order

    def error_order(self, terms):
        return 1  # how the error estimate answers to the step size: it carries the next size, see `encoded`

    def func(self, terms, t0, y0, args):
        """dy/dt of the solution through a consistent point."""
        problem = FlatProblem(terms, y0, args)
        return problem.unravel(consistent_slope(problem, self.linear_solver, t0, problem.flat))

    def init(self, terms, t0, t1, y0, args):
        problem = FlatProblem(terms, y0, args)
        y = problem.flat
        linear = choose(self.linear_solver, y.shape[0], problem.pattern, problem.mass)
        slope = consistent_slope(problem, self.linear_solver, t0, y)
        return self._fresh(
            y,
            slope,
            t1 - t0,
            linear.empty(y.shape[0], y.dtype),
            jnp.zeros((2,), jnp.int32),
            self._measured(problem, t0, y0),
        )

    def _measured(self, problem, t, y):
        return None if self.guard is None else self.guard.measure(t * problem.direction, y, problem.args)

    def _fresh(self, y, slope, h, factor, counts, largest) -> _History:
        """The history of order 1 with one derivative known."""
        h = jnp.asarray(h)
        one, zero = jnp.array(1, jnp.int32), jnp.array(0, jnp.int32)
        phi = jnp.zeros((ROWS, y.shape[0]), y.dtype).at[0].set(y).at[1].set(h.astype(y.dtype) * slope)
        still = jax.lax.stop_gradient(h)
        return _History(
            phi=phi, psi=h * jnp.arange(1, ROWS + 1, dtype=h.dtype), order=one, last_order=zero, steady=zero,
            last_step=jnp.zeros_like(still), planned=still, starting=jnp.array(True), factor=factor,
            factor_cj=jnp.zeros_like(still), last_cj=jnp.zeros_like(still), contraction=jnp.full((), 20.0, h.dtype),
            counts=counts, largest=largest,
        )  # fmt: skip

    def step(self, terms, t0, t1, y0, args, solver_state: _History, made_jump):
        """One step with its error estimate and dense output; see `diffrax.AbstractSolver.step`."""
        problem = FlatProblem(terms, y0, args)
        y = problem.flat
        linear = choose(self.linear_solver, y.shape[0], problem.pattern, problem.mass)
        h = jnp.asarray(t1 - t0)
        state = solver_state
        if made_jump is not False:

            def restart():
                # Differences from before a jump predict nothing behind it, so the history begins anew with order 1.
                moved, _ = consistent_point(problem, self.linear_solver, t0, y)  # algebraic unknowns jump too
                slope = consistent_slope(problem, self.linear_solver, t0, moved)
                largest = self._measured(problem, t0, problem.unravel(moved))
                return moved, self._fresh(moved, slope, h, state.factor, state.counts, largest)

            y, state = jax.lax.cond(made_jump, restart, lambda: (y, state))
        rtol, atol, norm = self.root_finder.values(y.dtype)
        weight = jax.lax.stop_gradient(CAUTION / (atol + rtol * jnp.abs(y)))

        # After rejections the step is shorter than it was planned to be. As in IDA, the attempt after the third
        # rejection is made with order 1: by then the step is at most 0.9·0.25·0.25 = 0.056 of what was planned.
        ratio = jax.lax.stop_gradient(h) / state.planned
        retried = ratio < 0.95
        order = jnp.where(retried & (ratio < 0.07) & (not self.fixed_order), 1, state.order)
        starting = state.starting & ~retried
        c: Coefficients = coefficients(h, state.psi, order)
        phi = c.beta.astype(y.dtype)[:, None] * state.phi
        predicted = jnp.tensordot(c.upto.astype(y.dtype), phi, axes=1)
        slope = jnp.tensordot(c.gamma.astype(y.dtype), phi, axes=1)
        cj = c.leading
        equation = Equation(t1, predicted, slope, cj)
        known = Known(state.factor, state.factor_cj, state.last_cj, state.contraction, weight)
        solved = implicit_step(problem, linear, equation, known, norm, self.root_find_max_steps)
        y1 = solved.y
        if self.projection is not None:
            # Inside the step rather than around the solver, as for other methods: the projected value enters the
            # history. Differences of values beside the constraints would lead off them.
            moved = ravel_like(self.projection(t1 * problem.direction, problem.unravel(y1), args))
            y1 = jnp.where(solved.converged, moved, y1)
        e = y1 - predicted
        allowed, largest, result = True, state.largest, diffrax.RESULTS.successful
        if self.guard is not None:
            verdict = self.guard.judge(largest, t1 * problem.direction, problem.unravel(y1), args)
            allowed, largest, result = verdict.allowed, verdict.largest, verdict.result(result)

        still = jax.lax.stop_gradient
        count_all = problem.mass.is_diagonal if self.algebraic_errors is None else self.algebraic_errors

        # Algebraic unknowns left out of the error test are those of `algebraic_errors=False`: they are solved for, and
        # have no error of their own at the ends of steps.
        def size(v):
            return norm(weight * (v if count_all else problem.mass.differential_part(v)))

        tried = _Tried(still(phi), still(e), still(h), order, starting, retried, solved.converged & allowed)
        ahead = self._ahead(state, c, tried, size)

        updated = _advance(phi, e, order, self.max_order)
        h_ = still(h)
        new_state = _History(
            phi=updated, psi=c.psi, order=ahead.order, last_order=order, steady=ahead.steady, last_step=h_,
            planned=h_ * ahead.factor.astype(h_.dtype), starting=ahead.starting, factor=solved.factor,
            factor_cj=solved.factor_cj, last_cj=still(cj), contraction=solved.contraction,
            counts=state.counts + jnp.stack([solved.factorisations, solved.iterations]), largest=largest,
        )  # fmt: skip
        # The controller divides the error by the same scale, which must be finite where y1 is not.
        value = jnp.where(jnp.isfinite(y1), y1, y)
        scale = atol + jnp.maximum(jnp.abs(y), jnp.abs(value)) * rtol
        y_error = encoded(ahead.factor, ahead.accepted) * still(jnp.broadcast_to(scale, y.shape))
        # Diffrax fills unused rows with infinity, which integers do not have.
        dense = dict(y0=y0, phi=jax.vmap(problem.unravel)(updated), psi=c.psi, order=order.astype(c.psi.dtype))
        return problem.unravel(y1), problem.unravel(y_error), dense, new_state, result

    def _ahead(self, state: _History, c: Coefficients, tried: _Tried, size: Callable[[Array], Array]) -> _Ahead:
        """Accepts or rejects the step and chooses order and size of the next one, by error estimates at this order and
        its neighbours (Brenan, Campbell & Petzold, eq. 5.2.31 ff)."""
        phi_, e_, k, dtype = tried.phi, tried.e, tried.order, tried.phi.dtype

        def row(j):
            return phi_[jnp.clip(j, 0, ROWS - 1)]

        def sigma(j):
            return c.sigma[jnp.clip(j, 0, ROWS - 1)].astype(dtype)

        e_norm = size(e_)
        lower = row(k) + e_
        lowest = lower + row(k - 1)
        err = sigma(k) * e_norm
        err_1 = sigma(k - 1) * size(lower)
        err_2 = sigma(k - 2) * size(lowest)
        kf = k.astype(dtype)
        total, total_1, total_2 = (kf + 1) * err, kf * err_1, (kf - 1) * err_2
        fall = jnp.where(k > 2, jnp.maximum(total_1, total_2) <= total, (k == 2) & (total_1 <= 0.5 * total))
        # Where nothing moves all estimates are zero. The order then rises all the same: the run may be differentiated,
        # and the motion after a small push, which the derivative is, needs a high order.
        fall = fall & (total > 0)
        accepted = tried.converged & (c.test.astype(dtype) * e_norm < 1.0)

        # Lengths of steps are differences of times, which are rounded.
        same = jnp.abs(tried.h - state.last_step) <= 1e-6 * state.last_step
        steady = jnp.where(same & (k == state.last_order), state.steady, 0)
        steady = jnp.minimum(steady + 1, state.last_order + 2)
        # At first, order and size rise with every step until an estimate says that a lower order would do.
        starting = tried.starting & ~fall & (k < self.max_order)
        err_up = size(e_ - row(k + 1)) / (kf + 2)
        total_up = (kf + 2) * err_up
        stay = (k == self.max_order) | (k + 1 >= steady) | (k - state.last_order == 1)
        best_below = (k > 1) & (total > 0) & (total_1 <= jnp.minimum(total, total_up))
        up = ~stay & ~fall & ~best_below & (jnp.where(k == 1, total_up < 0.5 * total, total_up < total) | (total == 0))
        down = fall | (~stay & best_below)
        change = jnp.where(up, 1, jnp.where(down, -1, 0))
        estimate = jnp.where(up, err_up, jnp.where(down, err_1, err))
        first = state.last_order == 0
        if self.fixed_order:
            change = jnp.where(k < self.max_order, jnp.where(first, 0, 1), 0)
            estimate = err
        next_order = jnp.where(starting, jnp.where(first, k, k + 1), k + change).astype(jnp.int32)
        next_order = jnp.clip(next_order, 1, self.max_order)
        # IDA's rule: the step stays, so that its factorisation does, unless it may double or must shrink. The estimate
        # is doubled for safety, and 1e-4 keeps the quotient finite where nothing moves.
        wish = (2 * estimate + 1e-4) ** (-1 / (next_order.astype(dtype) + 1))
        factor = jnp.where(wish >= 2, 2.0, jnp.where(wish <= 1, jnp.clip(wish, 0.5, 0.9), 1.0))
        factor = jnp.where(starting, jnp.where(first, 1.0, 2.0), factor)
        again = 0.9 * (2 * err + 1e-4) ** (-1 / (kf + 1))
        again = jnp.where(tried.converged & ~tried.retried, jnp.clip(again, 0.25, 0.9), 0.25)
        factor = jnp.where(accepted, factor, jnp.where(jnp.isfinite(again), again, 0.25))
        return _Ahead(accepted, next_order, steady.astype(jnp.int32), starting, factor)


def ravel_like(y: State) -> Float[Array, " n"]:
    """A solution as one vector."""
    return ravel_pytree(y)[0]


def _advance(
    phi: Float[Array, "rows n"], e: Float[Array, " n"], order: Int[Array, ""], max_order: int
) -> Float[Array, "rows n"]:
    """The differences after a step: φ*_k + e, and below it sums; e itself is kept where order k + 1 would read it."""
    rows = jnp.arange(ROWS, dtype=order.dtype)[:, None]
    inside = jnp.where(rows <= order, phi, 0) + jnp.where(rows == order, 1, 0) * e[None, :]
    sums = jnp.cumsum(inside[::-1], axis=0)[::-1]
    out = jnp.where(rows <= order, sums, phi)
    return jnp.where((rows == order + 1) & (order < max_order), e[None, :], out)
