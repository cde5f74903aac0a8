"""What is wrong with a start, and why an integration stopped: found once, said by name."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, Result, State, Terms, Time, Tolerance
from ...base.tolerances import KNOWN, KNOWN_ROUNDINGS, SLIGHT, spacing
from ...graph.judgement.rank import DECOMPOSED_UPTO
from .causes import cause_of, first_bad_row
from .dae_term import FlatProblem
from .index_one import algebraic_part, consistent_slope, index_matrix

SHOWN = 4  # names in a sentence


INDEX = (
    "the index is above 1, or the equations are {} at the start: they do not determine {}. Differentiate the "
    "constraints, or write the model as a Component: jaxonomy_dae.AcausalCompiler reduces the index"
)


class StartCheck(eqx.Module):
    """The numbers by which a start is judged; read by `explain_start`.

    - `right`: F at the start, shape (n,).
    - `residual`, `rounding`: the residual of the algebraic equations, and the part of it that rounding may leave, shape
        (n,).
    - `shift`: the step that would make them hold, in units of the tolerance, shape (n,).
    - `matrix`: the matrix that is regular if the index is 1, shape (n, n), or None.
    """

    right: Array
    residual: Array
    rounding: Array
    shift: Array
    matrix: Any

    @property
    def is_fine(self) -> Array:
        """True if the equations are finite at the start and the algebraic ones hold to the tolerance."""
        return jnp.all(jnp.isfinite(self.right)) & (jnp.max(jnp.abs(self.shift), initial=0.0) <= 1)

    def error_if(self, ys: State) -> State:
        """Adds run-time errors to `ys` for a start that is traced and turns out to be bad."""
        ys = eqx.error_if(ys, ~jnp.all(jnp.isfinite(self.right)), "the equations are not finite at the start")
        return eqx.error_if(ys, ~self.is_fine, "inconsistent start: see jaxonomy_dae.solvers.consistent_start")


def start_check(problem: FlatProblem, t: Time, rtol: Tolerance, atol: Tolerance) -> StartCheck:
    """Evaluates the equations at the start, for `explain_start`."""
    problem_y = jax.lax.stop_gradient(problem.flat)
    if not problem.mass.is_singular:
        empty = jnp.zeros((0,), problem_y.dtype)
        return StartCheck(problem.right(t, problem_y), empty, empty, empty, None)
    chosen, right, jacobian, matrix = index_matrix(problem, None, t, problem_y)
    residual = algebraic_part(problem, right)
    weight = rtol * jnp.abs(problem_y) + _flat(atol, problem_y)
    shift = chosen.apply(chosen.factor(matrix), matrix, residual) / weight
    rounding = KNOWN_ROUNDINGS * spacing(problem_y.dtype) * chosen.row_sizes(jacobian, problem_y)
    if not problem.mass.is_diagonal:
        rounding = jnp.abs(jnp.asarray(problem.mass.algebraic, problem_y.dtype)) @ rounding
    looked_at = chosen.materialise(matrix) if problem_y.shape[0] <= DECOMPOSED_UPTO else None
    return jax.lax.stop_gradient(StartCheck(right, residual, rounding, shift, looked_at))


def _flat(atol: Tolerance, like: State) -> Array:
    parts = [jnp.ravel(jnp.asarray(leaf, like.dtype)) for leaf in jax.tree.leaves(atol)]
    joined = jnp.concatenate(parts)
    return joined if joined.shape == like.shape else joined[0]


def explain_start(check: StartCheck, names: Sequence[str]) -> str:
    """The reason, in a sentence, why a start cannot be used; "" if it can."""
    right = np.asarray(check.right)
    if not np.isfinite(right).all():
        rows = np.flatnonzero(~np.isfinite(right))[:SHOWN]
        return (
            f"the equations are not finite at the start: row {', '.join(map(str, rows))} of F is {right[rows[0]]}. "
            "Start elsewhere"
        )
    if check.matrix is not None:
        found = null_names(np.asarray(check.matrix), names)
        # Singular before inconsistent: with a singular matrix the shift is not finite, whatever the residual.
        if found:
            return INDEX.format("singular", found)
    shift = np.abs(np.asarray(check.shift))
    if shift.size and not shift.max(initial=0.0) <= 1:
        residual = np.abs(np.asarray(check.residual))
        if (residual <= np.asarray(check.rounding)).all():  # they hold: what is wrong is the matrix
            worst = np.argsort(-np.where(np.isfinite(shift), shift, np.inf))[:SHOWN]
            return INDEX.format("nearly singular", ", ".join(f"'{names[k]}'" for k in worst))
        rows = [k for k in np.argsort(-residual)[:SHOWN] if residual[k] > 0]
        moved = [k for k in np.argsort(-np.where(np.isfinite(shift), shift, np.inf))[:SHOWN] if not shift[k] <= 1]
        return (
            "inconsistent start, the algebraic equations do not hold: "
            + ", ".join(f"row {k} of F is off by {residual[k]:.3g}" for k in rows)
            + f". To mend it {', '.join(repr(str(names[k])) for k in moved)} must move: "
            "y0 = jaxonomy_dae.solvers.consistent_start(term, y0), or system.initialize() for a compiled model"
        )
    return ""


def null_names(matrix: np.ndarray, names: Sequence[str]) -> str:
    """The names of unknowns that a singular matrix leaves undetermined; "" if it is regular."""
    if not np.isfinite(matrix).all():
        return ""
    # Rows and columns have their own units. An equation in pascals beside one in metres would make a regular matrix
    # look singular.
    rows = np.abs(matrix).max(axis=1)
    columns = np.abs(matrix / np.where(rows == 0, 1, rows)[:, None]).max(axis=0)
    scaled = matrix / np.where(rows == 0, 1, rows)[:, None] / np.where(columns == 0, 1, columns)[None, :]
    _, s, v = np.linalg.svd(scaled)
    if s.size and s[-1] > KNOWN * len(s) * s[0]:
        return ""
    null = np.abs(v[-1])
    return ", ".join(f"'{names[k]}'" for k in np.argsort(-null)[:SHOWN] if null[k] > SLIGHT)


def how_it_stopped(result: Result, t: Time, max_steps: int) -> str:
    """The first sentence of an explanation."""
    if result == diffrax.RESULTS.max_steps_reached:
        reason = f"max_steps={max_steps} was reached"
    elif result == diffrax.RESULTS.dt_min_reached:
        reason = "no step was short enough to be accepted"
    else:
        reason = f"the solver gave up ({diffrax.RESULTS[result].rstrip('.')})"
    return f"the integration stopped at t={float(t):g}: {reason}. "


class Stopped(NamedTuple):
    """An integration from t0 to t1 that stopped at its last accepted point (t, y)."""

    t: Time
    y: State
    result: Result
    t0: Time
    t1: Time
    max_steps: int
    rtol: Tolerance
    atol: Tolerance


def explain_failure(term: Terms, args: Args, names: Sequence[str], at: Stopped, explicit: bool = False) -> str:
    """The reason, in a sentence, why an integration stopped, and what to write instead."""
    problem = FlatProblem(term, at.y, args)
    t, flat, time = at.t, problem.flat, jnp.asarray(at.t)
    many = at.result == diffrax.RESULTS.max_steps_reached
    start = how_it_stopped(at.result, t, at.max_steps)
    right = np.asarray(problem.right(time, flat))
    if not np.isfinite(right).all():
        value = right[~np.isfinite(right)][0]
        where = "at the start. Start elsewhere, or look" if float(t) == float(at.t0) else "there. Look"
        return start + (
            f"The equations are not finite: {first_bad_row(problem, right, names)} is {value} {where} for a division "
            "by zero, or a root or logarithm without a value."
        )
    if flat.shape[0] <= DECOMPOSED_UPTO and problem.mass.is_singular:
        chosen, _, _, matrix = index_matrix(problem, None, time, flat)
        found = null_names(np.asarray(chosen.materialise(matrix)), names)
        if found:
            return start + (
                f"Newton's matrix is singular there: the equations do not determine {found} (a bifurcation, or an "
                "index above 1)."
            )
    weight = np.asarray(at.rtol * jnp.abs(flat) + _flat(at.atol, flat))
    cause = cause_of(problem, time, flat, jnp.asarray(at.t1), weight, names, at.max_steps, explicit)
    if cause:
        return f"{start}{cause}."
    slope = np.abs(np.asarray(consistent_slope(problem, None, time, flat))) / weight
    worst = [k for k in np.argsort(-np.where(np.isfinite(slope), slope, np.inf))[:SHOWN] if not slope[k] == 0]
    fastest = ", ".join(f"'{names[k]}' = {float(flat[k]):.6g}" for k in worst)
    mend = (
        f"Raise max_steps, loosen rtol={float(at.rtol):g} and atol, or look for a jump or a pole: jump_ts= names times "
        "of jumps"
        if many
        else "Look for a pole, a turning point, a jump (jump_ts= names their times), or a root or logarithm without a "
        "value just beyond"
    )
    return f"{start}Changing fastest there: {fastest}. {mend}."
