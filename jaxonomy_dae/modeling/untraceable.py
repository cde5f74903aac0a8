"""Why JAX cannot trace a function of the user's."""

import jax


def uses_numpy(error: Exception) -> bool:
    """True if JAX raised the error because the function computes with NumPy or math."""
    numbers_wanted = jax.errors.TracerArrayConversionError | jax.errors.ConcretizationTypeError
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
