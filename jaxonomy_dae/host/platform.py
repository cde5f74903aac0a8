"""Which processor programs are made for, and how precisely it multiplies matrices."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")


def platform() -> str:
    """ "cpu", "gpu" or "tpu": that of `jax.default_device`, if it is set, else of JAX's default backend."""
    device: Any = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def precisely(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The function, with products of matrices in full precision, unless the user has chosen one with
    `jax_default_matmul_precision`. GPUs and TPUs round the factors of products in single precision to ten bits or fewer
    otherwise, and Newton's method comes to rest at 1e-3."""

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        if jax.config.jax_default_matmul_precision is not None:  # pyright: ignore[reportAttributeAccessIssue]
            return function(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return call
