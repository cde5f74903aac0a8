"""Networks and functions of the user's: their numbers as arrays, how many outputs they have, of which kind they are;
and why JAX cannot trace one."""

import types
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import PyTree
from ..base.errors import ModelError


def as_weights(theta: PyTree) -> PyTree:
    """Weights as arrays: Python and NumPy numbers become JAX arrays, everything else stays."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf) if eqx.is_inexact_array_like(leaf) else leaf, theta)


def count_outputs(network: Callable, inputs: int, where: str, theta: PyTree = None, noun: str = "network") -> int:
    """The number of outputs of `network(u)` or `network(t, u, theta)`, found without computing anything; `noun` is what
    errors call it."""
    # Inputs in the precision of the weights, as when the model calls it: strict promotion refuses a mixture.
    dtypes = [leaf.dtype for leaf in jax.tree.leaves((network, theta)) if eqx.is_inexact_array(leaf)]
    dtype = dtypes[0] if dtypes else jnp.result_type(float)
    u = jax.ShapeDtypeStruct((inputs,), dtype)
    try:
        if theta is None:
            out = eqx.filter_eval_shape(network, u)
        else:
            out = eqx.filter_eval_shape(network, jax.ShapeDtypeStruct((), dtype), u, theta)
    # Whatever a user's function raises: its text is all that says what is wrong.
    except Exception as error:
        if noun == "function":
            why = why_untraceable(error, "its input" if inputs == 1 else f"its {inputs} inputs", "x")
            raise ModelError(f"{where} {why}") from error
        signature = "network(u)" if theta is None else "network(t, u, theta)"
        why = why_untraceable(error, "its inputs", "u[0]")
        raise ModelError(f"{where}: calling {signature} with u of shape ({inputs},) failed: it {why}") from error
    if not (hasattr(out, "shape") and len(out.shape) == 1):
        found = getattr(out, "shape", type(out).__name__)
        scalar = "a scalar or " if noun == "function" else ""
        raise ModelError(f"{where}: the {noun} must return {scalar}a vector of shape (outputs,); got shape {found}")
    if jnp.issubdtype(out.dtype, jnp.complexfloating):
        raise ModelError(
            f"{where}: the {noun} must return real numbers; got {out.dtype}: return jnp.real(…) and jnp.imag(…) as two "
            "outputs"
        )
    if not jnp.issubdtype(out.dtype, jnp.floating):
        raise ModelError(
            f"{where}: the {noun} must return floating-point numbers, which have derivatives; got {out.dtype}: write "
            "jnp.where(…, 1.0, 0.0), or jnp.asarray(…, float)"
        )
    return out.shape[0]


def check_kind(network: object, kind: Any, where: str) -> None:
    """Refuses a network that is not of a kind: a class, or a tuple of classes.

    **Raises:**

    - `ModelError` if it is not, naming the component, what was found, and what the kind promises.
    """
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not kinds or not all(isinstance(k, type) for k in kinds):
        raise ModelError(f"{where}: kind is a class such as learning.AbstractPassive, or a tuple of them; got {kind!r}")
    if isinstance(network, kinds):
        return
    names = " or ".join(k.__name__ for k in kinds)
    promise = " ".join((kinds[0].__doc__ or "").split("\n\n")[0].split())
    found = network.__name__ if isinstance(network, type) else type(network).__name__
    raise ModelError(
        f"{where}: only a law of kind {names} may stand here; got {found}, which promises nothing of it."
        + (f" {kinds[0].__name__}: {promise}" if promise else "")
    )


def _on_device(leaf: PyTree) -> PyTree:
    """A NumPy array as one of JAX; with its type, for which `asarray` compiles no program."""
    return jnp.asarray(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype)) if isinstance(leaf, np.ndarray) else leaf


class OfScalars(eqx.Module):
    """A function of scalars as a function of one vector, u ↦ (outputs,); the arrays it holds are leaves."""

    function: Callable

    def __call__(self, u: Array) -> Array:
        return jnp.atleast_1d(jnp.asarray(self.function(*u)))


def of_scalars(function: Callable) -> OfScalars:
    """`function(x, y, …) -> scalar or (outputs,)` as a module; NumPy arrays in it become JAX arrays."""
    return OfScalars(jax.tree.map(lambda leaf: _compared_as_object(_on_device(leaf)), function))


class OneObject:
    """A callable object that is equal to itself alone. JAX compares what is static, and an object that says itself what
    it is equal to, as a dataclass does, may have no hash, or leave out what its calls depend on."""

    def __init__(self, function: Callable):
        self.function = function

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)

    def __repr__(self) -> str:
        return repr(self.function)


def _compared_as_object(leaf: PyTree) -> PyTree:
    # Methods are left: Python compares them by their object's identity and their function.
    own = callable(leaf) and not eqx.is_array(leaf) and type(leaf).__eq__ is not object.__eq__
    return OneObject(leaf) if own and not isinstance(leaf, types.MethodType) else leaf


def uses_numpy(error: Exception) -> bool:
    """True if JAX raised the error because the function computes with NumPy or math."""
    numbers_wanted = jax.errors.TracerArrayConversionError | jax.errors.ConcretizationTypeError
    # JAX's errors of truth values are a kind of ConcretizationTypeError, and have another remedy.
    return isinstance(error, numbers_wanted) and not isinstance(error, jax.errors.TracerBoolConversionError)


def why_untraceable(error: Exception, of: str, example: str) -> str:
    """The rest of the sentence "the function …": the mistake that made JAX raise this error.

    **Arguments:**

    - `of`: the function's argument in words, such as "the time"; `example` is how it is written, such as "t".
    """
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return f"decides by {of} with a Python `if`, `and` or `min`: use jnp.where({example} < …, a, b)"
    if uses_numpy(error):
        return (
            "computes with NumPy or math, which JAX cannot trace: use jax.numpy (jnp.sin for math.sin, jnp.interp for "
            "np.interp)"
        )
    first = str(error).split("\n")[0]
    return f"failed when called with {of}: {type(error).__name__}" + (f": {first}" if first else "")
