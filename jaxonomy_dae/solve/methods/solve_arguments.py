"""What `solve_dae` accepts: checked before anything is compiled."""

import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from ...base.aliases import Controller, Numeric, State, Time, Times, Tolerance
from ...base.errors import ModelError
from ...host.staging import as_array, is_traced


def check_finite(**numbers: Numeric) -> None:
    """Refuses what is not a finite number, by the names of the arguments."""
    for name, value in numbers.items():
        if is_traced(value):
            continue
        if isinstance(value, str):
            raise ModelError(f"{name} must be a finite number; got the string {value!r}: leave the quotes out")
        if value is None or np.shape(value) != () or np.iscomplexobj(value) or not math.isfinite(value):
            raise ModelError(f"{name} must be a finite number; got {value}")


def check_longest_step(dtmax: Time) -> None:
    """Refuses a longest step that is not positive."""
    if dtmax is None or is_traced(dtmax) or (np.shape(dtmax) == () and dtmax == np.inf):
        return
    check_finite(dtmax=dtmax)
    if not dtmax > 0:
        raise ModelError(f"dtmax must be positive; got {dtmax}")


def check_times(t0: Time, t1: Time, ts: Times):
    """Refuses ends that are not finite, and times to save that are not between them, in order."""
    check_finite(t0=t0, t1=t1)
    if ts is None:
        return
    if np.ndim(ts) != 1 or not np.shape(ts)[0]:
        raise ModelError(f"ts must have shape (n,), n ≥ 1; got {np.shape(ts)}")
    if is_traced((t0, t1, ts)):
        return
    saved, a, b = np.asarray(ts, float), float(t0), float(t1)
    if not ((saved >= min(a, b)) & (saved <= max(a, b))).all():
        raise ModelError(
            f"ts must lie between t0={a:g} and t1={b:g}; they reach from {saved.min():g} to {saved.max():g}"
        )
    if (np.diff(saved) * (1 if a <= b else -1) < 0).any():
        raise ModelError("ts must be sorted in the direction of integration")


def check_prescribed_steps(t0: Time, t1: Time, controller: Controller) -> None:
    """Refuses a `diffrax.StepTo` whose times do not lead from t0 to t1."""
    if not isinstance(controller, diffrax.StepTo) or is_traced((t0, t1, controller.ts)):
        return
    steps = np.asarray(controller.ts)
    a, b = (np.asarray(t, steps.dtype) for t in (t0, t1))
    if steps[0] != a or steps[-1] != b or not (np.diff(steps) * (1 if a <= b else -1) > 0).all():
        raise ModelError(
            f"the times of StepTo must lead from t0={float(a):g} to t1={float(b):g}, each farther than the one before; "
            f"they lead from {float(steps[0]):g} to {float(steps[-1]):g}"
        )


def tolerance_of(atol: Tolerance, y: State) -> Tolerance:
    """An absolute tolerance as one number, or with the structure and shapes of y."""
    leaves = jax.tree.leaves(atol)
    if len(leaves) == 1 and np.shape(leaves[0]) == ():
        return leaves[0]
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(y)]
    found = [np.shape(leaf) for leaf in leaves]
    fits = all(given in ((), shape) for given, shape in zip(found, shapes, strict=False))
    if jax.tree.structure(atol) != jax.tree.structure(y) or not fits:
        raise ModelError(f"atol must be one number or look like y: expected shapes {shapes}, found {found}")
    return jax.tree.map(lambda a, v: jnp.broadcast_to(jnp.asarray(a, v.dtype), v.shape), atol, y)


def jump_times(jump_ts: Times, dtype: DTypeLike) -> Times:
    """Times of jumps, a number or shape (n,), as an array; None if there is none."""
    array = None if jump_ts is None else as_array(jump_ts)
    if array is None or array.shape == (0,):
        return None
    if array.ndim > 1 or array.dtype.kind not in "iuf":
        raise ModelError(f"jump_ts must be a number or shape (n,); got {array.dtype} of shape {array.shape}")
    if not is_traced(array) and not np.isfinite(array).all():
        raise ModelError("jump_ts must be finite")
    return jnp.atleast_1d(jnp.asarray(array, dtype))
