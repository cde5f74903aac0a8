"""Whether derivatives are right: backwards beside forwards, and both beside differences."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..base.aliases import PyTree
from ..base.errors import ModelError, whole_number
from ..solve.adjoint.stored_adjoint import forward_mode
from .certificate import Certificate

EACH = 16  # up to this many numbers, each is a direction of its own
FIRST = 0.05, 0.0431  # the largest steps, relative to the size of what is moved
SHRINK = 1.4  # of the step, from one to the next (Ridders)
LEVELS = 10
WORSE = 2.0  # than the best so far: then smaller steps are rounding


def assert_gradient(
    f: Callable[[Any], Any], at: PyTree, *, rtol: float = 1e-3, directions: int = 8, seed: int = 0
) -> Certificate:
    """Asserts that reverse-mode derivatives agree with forward-mode ones, and with central differences.

    Differences are extrapolated to step zero from a sequence of steps, which also estimates their error (Ridders 1982,
    Advances in Engineering Software 4:75). If this error is larger than the allowed deviation, the check fails, too,
    and says so.

    **Arguments:**

    - `f`: `f(at)` returns a number, or arrays (of which a random combination is taken). A `simulate` inside gets the
        adjoint that each mode needs, unless `f` gives one.
    - `at`: a pytree, such as an array, a dictionary of numbers, or what `system.partition` returns; its floating-point
        numbers are moved, each by its size.
    - `rtol`: the largest deviation, relative to the largest derivative, each in units of the size of its number. At
        `rtol=1e-6`, derivatives and differences of a run are accurate to about 1e-4.
    - `directions`: the number of random directions that are checked if `at` has more than 16 numbers. Otherwise each
        number is checked by itself.

    **Returns:**

    A `Certificate`.

    **Raises:**

    - `AssertionError` with the largest deviation and where it is; if differences are too coarse to tell; if values or
        derivatives are not finite.
    - `ModelError` inside jit, for an `at` without numbers, and for an `f` that cannot be differentiated forwards.
    """
    directions = whole_number(directions, "assert_gradient: directions")
    at = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, at)
    moving, rest = eqx.partition(at, eqx.is_inexact_array)
    x, unravel = ravel_pytree(moving)
    if isinstance(x, Tracer):
        raise ModelError("assert_gradient needs numbers: call it outside jit, grad and vmap")
    if not x.size:
        raise ModelError("assert_gradient: there are no floating-point numbers in `at` to differentiate by")

    def flat(x: Array) -> Array:
        found = ravel_pytree(f(eqx.combine(unravel(x), rest)))[0]
        if not jnp.issubdtype(found.dtype, jnp.floating):
            raise ModelError(f"assert_gradient: f must return floating-point numbers; got {found.dtype}")
        return found

    size = jax.eval_shape(flat, x).shape[0]
    rng = np.random.default_rng(seed)
    # Of several outputs one number is made. Signs, not normal numbers, so that none is nearly left out.
    weights = jnp.asarray(rng.choice([-1.0, 1.0], size) if size > 1 else np.ones(size), x.dtype)

    def value(x: Array) -> Array:
        return jnp.vdot(weights, flat(x).astype(x.dtype))

    moves, labels = _directions(moving, np.asarray(x, float), directions, rng)
    gradient = np.asarray(jax.jit(jax.grad(value))(x), float)
    backwards = moves @ gradient
    forwards = _forwards(value, x, moves)
    run = jax.jit(value)
    pairs = [_difference(lambda s, u=u: float(run(x + jnp.asarray(s * u, x.dtype)))) for u in moves]
    differences, errors = np.array(pairs).T
    if not np.isfinite(backwards).all() or not np.isfinite(forwards).all():
        k = int(np.argmax(~np.isfinite(backwards + forwards)))
        raise AssertionError(
            f"the derivative by {labels[k]} is not finite: {backwards[k]} backwards, {forwards[k]} forwards"
        )
    # Relative to the largest of all directions: a derivative that is zero has no digits of its own to agree in.
    scale = max(float(np.abs(a).max()) for a in (backwards, forwards, differences))
    scale = scale if scale > 0 else 1.0
    # Differences that are worse than what they should tell prove nothing: to pass would be to pass anything.
    blind = errors > rtol * scale
    if blind.any() or not np.isfinite(differences).all():
        k = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
        raise AssertionError(
            f"differences along {labels[k]} are good to {errors[k] / scale:.2g} only, relative to the largest "
            f"derivative, where {rtol:g} is to be told: nothing can be said. Tighten the tolerances of the run inside, "
            "or allow a larger rtol"
        )
    looked_at = f"{len(moves)} random directions of {x.size} numbers"
    if x.size <= EACH:
        looked_at = f"each of {x.size} numbers" if x.size > 1 else "1 number"
    apart = np.abs(backwards - forwards) / scale, np.abs(backwards - differences) / scale
    worst = np.maximum(*apart)
    k = int(np.argmax(worst))
    return Certificate(
        "derivatives backwards, forwards and by differences agree",
        f"{looked_at}, relative to the largest derivative, {scale:.4g}",
        float(worst[k]),
        rtol,
        f"along {labels[k]}: {backwards[k]:.8g} backwards, {forwards[k]:.8g} forwards, {differences[k]:.8g} by "
        f"differences",
        (
            f"backwards and forwards differ by {apart[0].max():.2g}, backwards and differences by {apart[1].max():.2g}",
            f"the differences' own error is estimated as {errors.max() / scale:.2g}",
        ),
    ).asserted()


def _directions(moving: PyTree, x: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, list[str]]:
    """Returns (directions, shape (k, n), their names). Entries have the size of each number, or where that is zero, of
    its array."""
    sizes, names = [], []
    for path, leaf in jax.tree_util.tree_leaves_with_path(moving):
        flat = np.abs(np.ravel(np.asarray(leaf, float)))
        typical = float(np.sqrt(np.mean(flat**2))) if flat.size else 0.0
        sizes.append(np.where(flat > 0, flat, typical or 1.0))
        own = jax.tree_util.keystr(path) or "the argument"
        names += [own] if leaf.ndim == 0 else [f"{own}, entry {k}" for k in range(flat.size)]
    size = np.concatenate(sizes)
    if len(x) <= EACH:
        return np.diag(size), names
    # Of unit length on average, so that a step moves the numbers together as far as one of them alone.
    drawn = rng.standard_normal((count, len(x))) / np.sqrt(len(x))
    return drawn * size, [f"direction {k}" for k in range(count)]


def _forwards(value: Callable, x: Array, moves: np.ndarray) -> np.ndarray:
    with forward_mode():
        # Traced in here, as another function than the one that was traced for the gradient.
        run = jax.jit(lambda x, u: jax.jvp(lambda y: value(y), (x,), (u,))[1])
        try:
            return np.array([float(run(x, jnp.asarray(u, x.dtype))) for u in moves])
        except TypeError as error:
            if "forward-mode" not in str(error):
                raise
            raise ModelError(
                "assert_gradient: f cannot be differentiated forwards, as a simulation inside was given another "
                "adjoint, or was traced before: leave `adjoint` out"
            ) from error


def _difference(value: Callable[[float], float]) -> tuple[float, float]:
    """Returns (derivative at zero, estimate of its error), from two extrapolations with unrelated steps: for a function
    with noise, a single one finds, by chance, steps that seem to agree."""
    (one, error), (other, its) = (_extrapolated(value, first) for first in FIRST)
    return one if error <= its else other, max(error, its, abs(one - other))


def _extrapolated(value: Callable[[float], float], step: float) -> tuple[float, float]:
    """(derivative, estimate of its error) by Richardson extrapolation of central differences at shrinking steps."""
    # A large step may leave the domain of a root or logarithm.
    while not np.isfinite(value(step) - value(-step)):
        step /= 10
        if step < 1e-9:
            return float("nan"), float("inf")
    best, error, above = float("nan"), float("inf"), []
    for level in range(LEVELS):
        row = [(value(step) - value(-step)) / (2 * step)]
        for k, previous in enumerate(above):
            # Errors of central differences have even powers of the step only.
            factor = SHRINK ** (2 * (k + 1))
            row.append((factor * row[k] - previous) / (factor - 1))
            change = max(abs(row[-1] - row[-2]), abs(row[-1] - previous))
            # Ridders: the entry that differs least from its two neighbours in the tableau is the best one.
            if change <= error:
                best, error = row[-1], change
        if level and abs(row[-1] - above[-1]) >= WORSE * error:
            break
        above, step = row, step / SHRINK
    return best, error
