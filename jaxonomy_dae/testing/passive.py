"""Whether a law only takes energy out."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from ..base.aliases import PyTree
from ..base.errors import ModelError, whole_number
from ..learning.laws import AbstractPassive, PortHamiltonian
from .certificate import Certificate

DECADES = 3.0  # above and below what is typical, as far as sampled inputs reach
ROUNDING = 1e3  # units in the last place, relative to the products that a power is summed of
CLIMBS = 3  # from so many of the samples with the largest share of power that comes in, and with the largest rate


def assert_passive(
    law: Callable[[Any], Any], size: int | None = None, *, inputs: Any = None, rtol: float | None = None,
    weights: int = 0, count: int = 4096, seed: int = 0,
) -> Certificate:  # fmt: skip
    """Asserts that a law N brings no energy in: N(u)·v ≤ 0, where v is the first `size` of its inputs u.

    Inputs are sampled over six decades around their typical sizes. From the worst of them, quasi-Newton steps increase
    N·v/|v|² further, to find small regions in which the law is active. For a `PortHamiltonian`, dH/dt ≤ 0 is checked.

    **Arguments:**

    - `law`: `law(u) -> (size,)`: one of `learning`'s passive laws, or any function that JAX can trace.
    - `size`: the number of inputs that are efforts; a law of `AbstractPassive` knows it.
    - `inputs`: typical sizes of the inputs, one number or one for each; laws of `learning` know theirs. For other
        functions, they also define the number of inputs.
    - `rtol`: the allowed power, relative to Σ |N_i v_i|; default: a thousand units in the last place, a bound of
        rounding errors.
    - `weights`: the number of random sets of weights to check, too, from a tenth to ten times as large as the given
        ones. A law that is passive by structure is passive with all of them.
    - `count`: the number of inputs that are sampled for each set of weights.

    **Returns:**

    A `Certificate`. Sampling is not a proof: only the structure of a law can guarantee passivity for all inputs.

    **Raises:**

    - `AssertionError` with the input and the power that comes in.
    - `ModelError` for a law whose size or inputs are not known, and for outputs that do not fit.
    """
    typical, size = _typical(law, size, inputs)
    weights, count = whole_number(weights, "assert_passive: weights", 0), whole_number(count, "assert_passive: count")
    dtype = jnp.asarray(typical).dtype
    allowed = ROUNDING * float(jnp.finfo(dtype).eps) if rtol is None else float(rtol)
    rng = np.random.default_rng(seed)
    samples = _samples(rng, count, typical)
    arrays, static = eqx.partition(law, eqx.is_inexact_array)

    @jax.jit
    def gained(arrays: PyTree, u: Float[Array, "n inputs"]) -> Float[Array, " n"]:
        return jax.vmap(lambda one: _share(eqx.combine(arrays, static), one, size))(u)

    rate = jax.jit(jax.vmap(lambda u: _rate(law, u, size)))
    slope = jax.jit(jax.value_and_grad(lambda z, unit: -_rate(law, z * unit, size)))
    shape = jax.eval_shape(law, jax.ShapeDtypeStruct((len(typical),), dtype)).shape
    if shape != (size,):
        raise ModelError(f"assert_passive: with size={size}, the law must return shape ({size},); got {shape}")
    worst, place, drawn = -np.inf, samples[0], 0
    for k in range(weights + 1):
        here = arrays if k == 0 else _drawn(arrays, rng)
        found = np.asarray(gained(here, jnp.asarray(samples, dtype)), float)
        if not np.isfinite(found).all():
            bad = np.array2string(samples[int(np.argmin(np.isfinite(found)))], precision=4)
            raise AssertionError(f"the law has no finite value at u = {bad}: give smaller inputs= if none are as large")
        order = np.argsort(-found)
        value, u = float(found[order[0]]), samples[order[0]]
        # Only if samples have found nothing, and for the weights given: each climb is a minimization of its own.
        if k == 0 and value <= allowed:
            # By both measures: the share finds where losses nearly vanish, the rate where a law is strongest.
            highest = np.argsort(-np.asarray(rate(jnp.asarray(samples, dtype)), float))
            reached = [_climb(slope, samples[n], dtype) for n in (*order[:CLIMBS], *highest[:CLIMBS])]
            shares = np.asarray(gained(here, jnp.asarray(np.array(reached), dtype)), float)
            best = int(np.argmax(np.where(np.isfinite(shares), shares, -np.inf)))
            value, u = max((value, u), (float(shares[best]), reached[best]), key=lambda pair: pair[0])
        if value > worst:
            worst, place, drawn = value, u, k
    sets = "" if not weights else f", for the weights given and {weights} sets drawn at random"
    return Certificate(
        "H only falls, dH/dt ≤ 0" if isinstance(law, PortHamiltonian) else "the law brings no energy in, N·v ≤ 0",
        f"{count} inputs from {10**-DECADES:g} to {10**DECADES:g} times what is typical{sets}",
        max(worst, 0.0),
        allowed,
        f"relative to Σ |N_i v_i|, at u = {np.array2string(np.asarray(place), precision=4)}"
        + (f" with set {drawn} of weights" if drawn else ""),
        (f"the nearest to zero: {worst:.3g}",) if worst <= 0 else (),
    ).asserted()


def _typical(law: Callable, size: int | None, inputs: object) -> tuple[np.ndarray, int]:
    """(typical sizes of the law's inputs, shape (inputs,), and the number of efforts among them)."""
    own = getattr(law, "size", None) if isinstance(law, AbstractPassive | PortHamiltonian) else None
    if not callable(law):
        raise ModelError(f"assert_passive takes a law, a function of its inputs; got {law!r}")
    if own is not None and size is not None and size != own:
        raise ModelError(f"assert_passive: this law has size {own}; leave size={size} out")
    size = own if size is None else size
    if size is not None:
        whole_number(size, "assert_passive: size")
    given = getattr(law, "inputs", None) if inputs is None and own is not None else inputs
    if given is None and own is not None:
        given = 1.0
    if size is None and given is not None:
        size = len(np.atleast_1d(np.asarray(given, float)))
    if given is None and size is not None:
        given = np.ones(size)
    if given is None or size is None:
        raise ModelError(
            "assert_passive: how many inputs has the law, and how large are they? Give size=2, or inputs=[1.0, 0.5]"
        )
    values = np.asarray(given, float)
    values = np.broadcast_to(values, (size,)) if values.ndim == 0 else values
    if values.ndim != 1 or len(values) < size or not (np.isfinite(values) & (values > 0)).all():
        raise ModelError(f"assert_passive: inputs are typical sizes > 0, at least {size} of them; got {given!r}")
    return values, size


def _samples(rng: np.random.Generator, count: int, typical: np.ndarray) -> np.ndarray:
    """Inputs of all directions and sizes; a tenth of them has single entries at zero."""
    # Normal entries have no preferred direction.
    directions = rng.standard_normal((count, len(typical)))
    sizes = 10.0 ** rng.uniform(-DECADES, DECADES, (count, 1))
    found = directions / np.linalg.norm(directions, axis=1, keepdims=True) * sizes * typical
    half = count // 2  # of these, each entry has a size of its own
    found[:half] = np.sign(directions[:half]) * typical * 10.0 ** rng.uniform(-DECADES, DECADES, (half, len(typical)))
    # A law may be wrong only where one of its inputs rests.
    if len(typical) > 1:
        found[np.arange(0, count, 10), rng.integers(len(typical), size=len(found[::10]))] = 0.0
    return found


def _share(law: Callable, u: Array, size: int) -> Array:
    """The power that comes in, as a share of Σ |N_i v_i|; zero if no power flows at all."""
    v = jax.grad(law.energy)(u) if isinstance(law, PortHamiltonian) else u[:size]
    terms = law(u) * v
    total = jnp.sum(jnp.abs(terms))
    return jnp.where(total == 0, 0.0, jnp.sum(terms) / jnp.where(total == 0, 1.0, total))  # NaN stays


def _rate(law: Callable, u: Array, size: int) -> Array:
    """N·v/|v|²."""
    v = jax.grad(law.energy)(u) if isinstance(law, PortHamiltonian) else u[:size]
    square = jnp.sum(v**2)
    return jnp.where(square == 0, 0.0, jnp.sum(law(u) * v) / jnp.where(square == 0, 1.0, square))


def _drawn(arrays: PyTree, rng: np.random.Generator) -> PyTree:
    """Random weights in place of `arrays`: each array normal, 0.1 to 10 times as large as at present."""
    factor = 10.0 ** rng.uniform(-1, 1)

    def other(leaf: PyTree) -> PyTree:
        size = float(jnp.sqrt(jnp.mean(leaf**2))) or 1.0
        return jnp.asarray(factor * size * rng.standard_normal(leaf.shape), leaf.dtype)

    return jax.tree.map(other, arrays)


def _climb(slope: Callable, start: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """Follows the rate to a local maximum, from a start point and in units of it."""
    # In units of the start, of which entries may be six decades apart: L-BFGS-B assumes that all are alike.
    unit = np.where(start != 0, np.abs(start), np.abs(start).max() or 1.0)
    size = abs(float(slope(jnp.asarray(start / unit, dtype), jnp.asarray(unit, dtype))[0])) or 1.0

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = slope(jnp.asarray(z, dtype), jnp.asarray(unit, dtype))
        value, gradient = float(value) / size, np.asarray(gradient, float) / size
        # A high cost, not NaN, which would end the line search.
        return (value, gradient) if np.isfinite(value) and np.isfinite(gradient).all() else (1e10, np.zeros_like(z))

    found = scipy.optimize.minimize(cost, start / unit, jac=True, method="L-BFGS-B", options={"maxiter": 30})
    return np.asarray(found.x) * unit
