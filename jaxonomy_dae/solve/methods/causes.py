"""Why steps become many or small at a point: a jump, a finite escape, stiffness, values that do not exist beyond."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Args, State, Terms, Time
from ...base.tolerances import TINY
from ...graph.judgement.rank import DECOMPOSED_UPTO
from .dae_term import FlatProblem
from .index_one import consistent_slope

NEAR = 10.0 ** np.arange(-15, -5)  # parts of the interval
HALVINGS = 20  # of an interval in which a jump is looked for: across a millionth of it, what is smooth is the same
Slope = Callable[[Time, Array], Float[Array, " n"]]


def cause_of(
    problem: FlatProblem,
    t: Time,
    y: State,
    t1: Time,
    weight: np.ndarray,
    names: Sequence[str],
    steps: int,
    explicit: bool,
) -> str:
    """A sentence on the cause that stops an integration at its last accepted point (t, y), and what to write instead;
    "" if none is recognised."""

    @jax.jit
    # Compiled once: a jump is looked for with some twenty evaluations.
    def slope(t, y):
        return consistent_slope(problem, None, t, y)

    here = np.asarray(slope(t, y))
    if not np.isfinite(here).all() or not len(here):
        return ""
    return (
        _end_of_domain(problem, here, t, y, t1, names)
        or _jump(slope, here, t, y, weight, names)
        or _escape(here, y, float(t), float(t1), weight, names)
        or (_stiffness(slope, t, y, t1, steps) if explicit else "")
    )


def first_bad_row(problem: FlatProblem, right: np.ndarray, names: Sequence[str]) -> str:
    """Names the first row that is not finite, by the unknown whose derivative it gives, if there is one."""
    k = int(np.flatnonzero(~np.isfinite(right))[0])
    own = problem.mass.is_diagonal and problem.mass.array[k] != 0
    return f"the derivative of '{names[k]}' (row {k} of F)" if own else f"row {k} of F"


def _end_of_domain(
    problem: FlatProblem, here: np.ndarray, t: Time, y: State, t1: Time, names: Sequence[str]
) -> str:  # fmt: skip
    """Says which row of the equations is not finite a short way beyond the point, along the slope `here`; "" if none
    is."""
    right = jax.jit(problem.right)
    span = float(t1 - t)
    for part in NEAR:
        dt = jnp.asarray(part * span, jnp.asarray(t).dtype)
        ahead = np.asarray(right(t + dt, y + dt.astype(y.dtype) * here))
        if not np.isfinite(ahead).all():
            return (
                f"Just beyond, {first_bad_row(problem, ahead, names)} is not finite: a root or logarithm leaves its "
                "domain, or a denominator vanishes. Keep the argument positive in the equation (sympy.Max, or another "
                "law there), or end the run earlier"
            )
    return ""


def _jump(slope: Slope, here: np.ndarray, t: Time, y: State, weight: np.ndarray, names: Sequence[str]) -> str:
    """Says which derivative jumps across the point in the direction of motion, as under sign(x) at x = 0; "" if none
    does."""
    size = np.asarray(weight) / np.maximum(np.abs(here), np.finfo(here.dtype).tiny)
    h = float(np.min(size))  # in which the fastest unknown moves by its tolerance

    def at(place: float) -> np.ndarray:
        return np.asarray(slope(t, y + jnp.asarray(place * here, y.dtype)))

    # Steps chatter within some tolerances of the jump. Halving finds it there: the gap across a jump stays, what is
    # smooth, however steep, falls with the interval, and a pole rises.
    low, high = -1e2 * h, 1e2 * h
    below, above = at(low), at(high)
    wide = np.abs(above - below)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        between = at(middle)
        if not np.isfinite((below, between, above)).all():
            return ""
        if np.max(np.abs(between - below) / weight) > np.max(np.abs(above - between) / weight):
            high, above = middle, between
        else:
            low, below = middle, between
    narrow = np.abs(above - below)
    jumps = (narrow > 0.3 * wide) & (narrow < 3.0 * wide) & (narrow > 0.1 * np.max(np.abs(here)))
    if not jumps.any():
        return ""
    k = int(np.argmax(np.where(jumps, narrow / weight, 0)))
    return (
        f"The derivative of '{names[k]}' jumps by {narrow[k]:.3g} there (sign, Piecewise, Max, Heaviside …), and the "
        "solution stays at the jump: steps chatter back and forth across it. Smooth the law (sympy.tanh(x/small) for "
        "sign(x)), or, if the jump depends on time alone, name the times with jump_ts="
    )


def _escape(here: np.ndarray, y: State, t: float, t1: float, weight: np.ndarray, names: Sequence[str]) -> str:
    """Says which unknown grows so fast that it becomes infinite before t1; "" if none does."""
    value = np.asarray(y)
    growing = value * here > 0
    with np.errstate(over="ignore"):  # what hardly grows needs for ever
        rest = np.where(growing, np.abs(value) / np.maximum(np.abs(here), np.finfo(here.dtype).tiny), np.inf)
    large = np.abs(value) > 1e4 * np.minimum(weight / np.maximum(np.abs(value), TINY) * 1e6, 1.0)
    k = int(np.argmin(np.where(large, rest, np.inf)))
    if not (large[k] and rest[k] < 1e-3 * (t1 - t)):
        return ""
    return (
        f"'{names[k]}' is {value[k]:.3g} and grows by its own size within {rest[k]:.2g}: it becomes infinite near "
        f"t={t + rest[k]:.6g}, and no solution continues beyond that. End the run earlier, or check the signs in its "
        "equation"
    )


def decay_at(term: Terms, args: Args, t: Time, y: State) -> float:
    """The largest −Re λ of the eigenvalues at a point; 0 if there is none, or there are many unknowns."""
    problem = FlatProblem(term, y, args)
    return _decay(lambda t, y: consistent_slope(problem, None, t, y), t, problem.flat)


def _decay(slope: Slope, t: Time, y: State) -> float:
    if not 0 < y.shape[0] <= DECOMPOSED_UPTO:
        return 0.0
    matrix = np.asarray(jax.jit(jax.jacfwd(lambda v: slope(t, v)))(y))
    return max(float(-np.linalg.eigvals(matrix).real.min()), 0.0) if np.isfinite(matrix).all() else 0.0


def is_stiff(decay: float, duration: float, steps: int) -> bool:
    """True if stability limits explicit steps, not accuracy: the fastest decay (1/s) times the duration (s) is more
    than 0.3 for each step taken."""
    return decay * duration > 0.3 * steps


def _stiffness(slope: Slope, t: Time, y: State, t1: Time, steps: int) -> str:
    decay = _decay(slope, t, y)
    if not is_stiff(decay, float(t1 - t), steps):
        return ""
    return (
        f"The system is stiff: something decays within {1 / decay:.2g}, which explicit steps must follow to the end. "
        "Write solver=jaxonomy_dae.solvers.Rodas5P(), BDF() for many unknowns, or leave solver= out"
    )
