"""`solve_dae`: a differential-algebraic equation of the user's own, solved and checked."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import DTypeLike

from ...base.aliases import Args, Controller, PyTree, Result, Solver, State, Time, Times, Tolerance
from ...base.errors import InitializationError, ModelError, SimulationError, explained_keywords
from ...host.cache import PROGRAMS, compiled
from ...host.members import is_batched, say_of_members
from ...host.platform import precisely
from ...host.staging import as_array, is_staged, is_traced
from ..adjoint.late_times import Integration
from ..adjoint.stored_adjoint import default_adjoint
from .bdf import BDF
from .dae_term import DAETerm, FlatProblem
from .drive import integrate, is_multistep, right_between_steps
from .failures import SHOWN, StartCheck, Stopped, explain_failure, explain_start, start_check
from .index_one import consistent_point, consistent_shift
from .rodas5p import Rodas5P
from .rows import not_a_number
from .solve_arguments import check_longest_step, check_prescribed_steps, check_times, jump_times, tolerance_of
from .step_control import StepControl

# Newton steps by which algebraic unknowns are solved for at saved times. Dense output starts them within some
# tolerances of the root, and each step squares that error.
SAVED_ITERATIONS = 4
SMALL = 30  # up to this many unknowns a factorisation costs less than the steps that a multistep method saves


@explained_keywords()
def solve_dae(
    term: diffrax.AbstractTerm,
    t1: Time,
    y0: State,
    *,
    t0: Time = 0.0,
    ts: Times | None = None,
    solver: diffrax.AbstractSolver[Any] | None = None,
    rtol: Tolerance | None = None,
    atol: Tolerance | None = None,
    args: Args | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController[Any, Any] | None = None,
    jump_ts: Times | None = None,
    dtmax: Time | None = None,
    max_steps: int = 16384,
    names: Sequence[str] | None = None,
    throw: bool | None = None,
) -> diffrax.Solution:
    """Solves M dy/dt = F(t, y, args), or dx/dt = f, 0 = g, from a consistent start.

    **Arguments:**

    - `term`: a `DAETerm` (or a `diffrax.ODETerm`).
    - `t0`, `t1`: the interval.
    - `y0`: a consistent start, see `consistent_start`. It is the pair `(x, z)` for `DAETerm(f, g)`.
    - `ts`: when to save; None saves the end alone.
    - `solver`: default `Rodas5P` up to 30 unknowns, `BDF` beyond.
    - `rtol`, `atol`: of the local error, by default 1e-6 and 1e-8 (1e-4 and 1e-6 in single precision); `atol` may look
        like y.
    - `args`: the last argument of the functions. It can be differentiated.
    - `adjoint`: how to differentiate. The default is `StoredAdjoint()`, and `diffrax.ForwardMode()` under `jax.jvp` and
        `jax.jacfwd`. Give `diffrax.ForwardMode()` yourself if a function is jitted before it is differentiated in
        forward mode.
    - `stepsize_controller`, `max_steps`: of Diffrax.
    - `jump_ts`: times at which F jumps, a number or shape (n,). Steps end there, and the method restarts.
    - `dtmax`: the longest step.
    - `names`: of the unknowns, in order, for error messages.
    - `throw`: whether to raise an error if the start is inconsistent or the integration fails. With False,
        `solution.result` has a code, and rows that were not reached are NaN, with their derivatives. None raises
        outside jit and vmap; `jax.vmap` outside of jit warns and names the members that failed. Inside jit, True puts
        callbacks to the host into the program, and JAX's persistent cache does not keep such programs.

    **Returns:**

    A `diffrax.Solution`; `stats` counts steps, and Jacobians (each factorised once).

    **Raises:**

    - `ModelError` for functions and matrices of the wrong shape and tolerances out of reach;
    - `InitializationError` for an inconsistent start, or an index above 1;
    - `SimulationError` if the integration fails; the text gives the time and the worst unknowns.
    """
    y0 = jax.tree.map(_inexact, y0)
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    if jnp.issubdtype(dtype, jnp.complexfloating):
        raise ModelError("y0 must be real: make the real and the imaginary parts unknowns of their own")
    ts = ts if ts is None or hasattr(ts, "ndim") else as_array(ts)
    if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
        raise ModelError(f"max_steps must be a positive integer that is known beforehand; got {max_steps!r}")
    check_times(t0, t1, ts)
    check_longest_step(dtmax)
    check_prescribed_steps(t0, t1, stepsize_controller)
    rtol, atol = default_tolerances(rtol, atol, dtype)
    check_tolerances(rtol, atol, dtype)
    # Numbers become arrays, so that another value is not another program.
    rtol, atol = jnp.asarray(rtol, dtype), jax.tree.map(_inexact, tolerance_of(atol, y0))
    n = sum(leaf.size for leaf in jax.tree.leaves(y0))
    if names is not None and len(names) != n:
        raise ModelError(f"names must name every unknown: {n} of them; got {len(names)}")
    if solver is None:
        solver = default_solver(n)
    if stepsize_controller is None:
        jumps = jump_times(jump_ts, dtype)
        longest = None if dtmax is None else jnp.asarray(dtmax, dtype)
        stepsize_controller = step_control(solver, rtol, atol, jumps, longest)
    elif jump_ts is not None or dtmax is not None:
        given = "dtmax" if jump_ts is None else "jump_ts"
        raise ModelError(
            f"{given} and stepsize_controller both say how long steps are: leave one out, or put {given} into the "
            "controller (StepControl(..., dtmax=...), diffrax.ClipStepSizeController(..., jump_ts=...))"
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ModelError(BACKSOLVE)
    t0, t1 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
    ts = None if ts is None else jnp.asarray(ts, dtype)
    if adjoint is None:
        adjoint = default_adjoint((term, t0, t1, y0, ts, args))
    of = _Given(term, t0, t1, y0, ts, args, (rtol, atol), solver, adjoint, stepsize_controller, max_steps)
    staged = is_staged(of)
    if staged:
        PROGRAMS.make_room()
        check, solution, last = _solve(of, checked=throw is True)
    else:
        check, solution, last = _compiled(of)
    known = list(names) if names is not None else [f"y[{k}]" for k in range(n)]
    outcome = (check, solution.result)
    if is_traced(outcome):
        if is_batched(outcome) and not staged:
            say_of_members(
                *_codes(check, solution.result, max_steps), "integrations that stopped", "", throw, stacklevel=3
            )
        elif throw is True or throw is None and not staged:
            ys = check.error_if(solution.ys)
            solution = eqx.tree_at(lambda s: s.ys, solution, solution.result.error_if(ys, solution.result != OK))
        return solution
    if throw is not False:
        message = explain_start(check, known)
        if message:
            raise InitializationError(message)
        if solution.result != OK:
            stopped = Stopped(*last, solution.result, t0, t1, max_steps, rtol, atol)
            raise SimulationError(explain_failure(term, args, known, stopped))
    return solution


def _codes(check: StartCheck, result: Result, max_steps: int) -> tuple[Array, list[str]]:
    """A number for the reason by which an integration failed, 0 if it did not; and what the numbers from 1 on mean."""
    codes = diffrax.RESULTS
    number = jnp.where(result == OK, 0, 4)
    number = jnp.where(result == codes.max_steps_reached, 1, number)
    number = jnp.where(result == codes.dt_min_reached, 2, number)
    number = jnp.where(check.is_fine, number, 3)
    texts = [f"max_steps={max_steps} was reached", "no step was short enough to be accepted"]
    return number, [*texts, "the start is not consistent", "it failed"]


def _inexact(leaf: PyTree) -> PyTree:
    """The array in floating point; integers become the default type."""
    array = jnp.asarray(leaf)
    return array if jnp.issubdtype(array.dtype, jnp.inexact) else array.astype(jnp.result_type(float))


OK = diffrax.RESULTS.successful
BACKSOLVE = (
    "adjoint=BacksolveAdjoint() is wrong for differential-algebraic equations: integrated backwards, the state leaves "
    "its constraints. Use the default, or diffrax.ForwardMode() for few parameters"
)


def default_solver(n: int) -> diffrax.AbstractSolver:
    """The solver for n stiff or algebraic unknowns."""
    return Rodas5P() if n <= SMALL else BDF()


def step_control(
    solver: Solver, rtol: Tolerance, atol: Tolerance, jump_ts: Times | None = None, dtmax: Time | None = None
) -> diffrax.AbstractStepSizeController:
    """The step-size controller for one of our solvers."""
    control: Any = StepControl(rtol, atol, steered=is_multistep(solver), dtmax=dtmax)
    return control if jump_ts is None else diffrax.ClipStepSizeController(control, jump_ts=jump_ts)


def default_tolerances(rtol: Tolerance, atol: Tolerance, dtype: DTypeLike) -> tuple[Tolerance, Tolerance]:
    """The tolerances, where they are not given by precision."""
    single = dtype == jnp.float32
    return (1e-4 if single else 1e-6) if rtol is None else rtol, (1e-6 if single else 1e-8) if atol is None else atol


def check_tolerances(rtol: Tolerance, atol: Tolerance, dtype: DTypeLike):
    """Refuses tolerances that are not numbers or that the precision cannot reach."""
    for name, value in (("rtol", rtol), ("atol", atol)):
        leaves = jax.tree.leaves(value)
        if name == "rtol" and (len(leaves) != 1 or np.shape(leaves[0]) != ()):
            raise ModelError(
                f"rtol must be one number; got {value}. Where unknowns differ, give atol in the shape of y"
            )
        for leaf in leaves:
            if is_traced(leaf):
                continue
            if isinstance(leaf, str):
                raise ModelError(f"{name} must be a number ≥ 0; got the string {leaf!r}: leave the quotes out")
            number = np.asarray(leaf, float)
            if not (np.isfinite(number).all() and (number >= 0).all()):
                raise ModelError(f"{name} must be a number ≥ 0; got {value}")
    if is_traced(rtol):
        return
    eps = float(jnp.finfo(dtype).eps)
    # A step adds rounding errors of some eps to its result, which no step size brings down.
    if float(rtol) < 10 * eps:
        least = f"rtol ≥ {_rounded_up(10 * eps):.0e}."
        mend = f"Use {least}"
        if dtype == jnp.float32:
            switch = 'jax.config.update("jax_enable_x64", True)'
            mend = f"Switch to double precision with {switch} before the model is compiled, or use {least}"
        raise ModelError(f"rtol={float(rtol):g} cannot be reached in {dtype} (eps {eps:.1e}). {mend}")


def _rounded_up(value: float) -> float:
    """The next number above with one significant digit."""
    unit = 10.0 ** math.floor(math.log10(value))
    return math.ceil(value / unit) * unit


class _Given(NamedTuple):
    """What `solve_dae` was given, as it was checked."""

    term: Any
    t0: Time
    t1: Time
    y0: State
    ts: Times | None
    args: Args
    tolerances: tuple[Tolerance, Tolerance]
    solver: Solver
    adjoint: diffrax.AbstractAdjoint
    controller: Controller
    max_steps: int


@precisely
def _solve(of: _Given, checked: bool = False):
    term, t0, t1, y0, ts, args = of[:6]
    check: StartCheck = start_check(FlatProblem(term, y0, args), t0, *of.tolerances)
    save = diffrax.SubSaveAt(t1=True) if ts is None else diffrax.SubSaveAt(ts=ts)
    solver = of.solver if ts is None else right_between_steps(of.solver)
    integration = Integration(term, solver, t0, t1, None, y0, args, save, of.controller, of.adjoint, of.max_steps)
    run = integrate(integration, checked=checked)
    reached = jnp.isfinite(run.ts) & check.is_fine
    # The end of the last step is on the constraints already: the methods are stiffly accurate.
    saved = run.ys if ts is None else _on_constraints(term, args, run.ts, run.ys, (t0, y0))
    saved = jax.tree.map(lambda y: not_a_number(y, reached, y0, args), saved)
    # Diffrax has no code of its own for an inconsistent start.
    failure: Result = diffrax.RESULTS.nonlinear_divergence
    result = diffrax.RESULTS.where(check.is_fine, run.result, failure)
    out = diffrax.Solution(
        t0=t0, t1=t1, ts=run.ts if ts is None else ts, ys=saved, interpolation=None, stats=run.stats, result=result,
        solver_state=None, controller_state=None, made_jump=None, event_mask=None,
    )  # fmt: skip
    return check, out, run.last


def _on_constraints(term: diffrax.AbstractTerm, args: Args, ts: Times, ys: State, start: tuple[Time, State]) -> State:
    """Saved values with their algebraic unknowns solved for: dense output interpolates those, and no error estimate
    covers how fast they vary within a step."""
    t0, y0 = start

    def one(t, y):
        problem = FlatProblem(term, y, args)
        if not problem.mass.is_singular:
            return y
        filled = jnp.all(jnp.isfinite(problem.flat))
        # Rows that were not reached are solved for at the start, so that their derivatives are finite, and left out
        # after.
        safe = jnp.where(filled, problem.flat, ravel_pytree(y0)[0])
        moved, _ = consistent_point(problem, None, jnp.where(filled, t, t0), safe, SAVED_ITERATIONS)
        kept = filled & jnp.all(jnp.isfinite(moved))
        return problem.unravel(jnp.where(kept, moved, problem.flat))

    return jax.vmap(one)(ts, ys)


_compiled = compiled(_solve)


def consistent_start(
    term: DAETerm, y0: State, *, t0: Time = 0.0, args: Args | None = None, max_steps: int = 50,
    names: Sequence[str] | None = None, throw: bool | None = None,
) -> Any:  # fmt: skip
    """A consistent start near y0. It keeps the differentiated unknowns (M y) and solves for the algebraic ones.

    **Arguments:**

    - `term`, `y0`, `t0`, `args`, `names`: as in `solve_dae`.
    - `max_steps`: bounds the iterations of Newton's method.
    - `throw`: whether to raise an error if there is none. With False, the result and its derivatives are then
        not-a-number. None: raise outside jit, grad and vmap only. Inside jit, True puts a callback to the host into the
        program.

    **Raises:**

    - `InitializationError` if Newton's method does not converge; the text names the unknowns that still change.

    Differentiable with respect to `args` and y0.
    """
    y0 = jax.tree.map(_inexact, y0)
    problem = FlatProblem(term, y0, args)
    t = jnp.asarray(t0, problem.flat.dtype)
    y, size = consistent_point(problem, None, t, problem.flat, max_steps)
    eps = float(jnp.finfo(y.dtype).eps)
    # Newton's method converges quadratically: after a step of √ε the error is some ε. Negated, so that a size that is
    # not a number counts as failed.
    failed = ~(size <= math.sqrt(eps))
    traced = is_traced(failed)
    if throw is False or (traced and throw is None):
        y = not_a_number(y[None], ~failed[None], y0, args, t)[0]
    elif traced:
        y = eqx.error_if(y, failed, "no consistent start: Newton's method did not converge")
    elif bool(failed):
        moving = np.abs(np.asarray(consistent_shift(problem, None, t, y, problem.flat)))
        known = list(names) if names is not None else [f"y[{k}]" for k in range(moving.shape[0])]
        order = np.argsort(-np.where(np.isfinite(moving), moving, np.inf))[:SHOWN]
        worst = [f"'{known[k]}'" for k in order if moving[k] != 0]
        raise InitializationError(
            f"no consistent start was found near y0; still moving: {', '.join(worst)}. Give a better y0, and check "
            "that the algebraic equations determine the algebraic unknowns (index 1)"
        )
    return problem.unravel(y)
