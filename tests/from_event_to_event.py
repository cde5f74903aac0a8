"""Plants beside SciPy's solution from event to event: values, and gradients beside differences of that solution."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.optimize

from jaxonomy_dae import AcausalSystem, simulate

TIGHT = dict(rtol=1e-10, atol=1e-10)


def followed(slopes: Callable, y: Sequence[float], begin: float, end: float, meets: Callable | None = None):
    """The time and the state at the end, or where `meets(t, y)` falls through zero."""

    def falls(t, y):
        return meets(t, y)

    falls.terminal, falls.direction = True, -1
    run = scipy.integrate.solve_ivp(
        slopes, (begin, end), y, events=meets and falls, method="DOP853", rtol=1e-12, atol=1e-13,
        max_step=(end - begin) / 50,
    )  # fmt: skip
    return run.t[-1], run.y[:, -1]


def root(f: Callable[[float], float], low: float, high: float) -> float:
    """The solution of f(x) = 0 between two bounds."""
    return scipy.optimize.brentq(f, low, high, xtol=1e-15, rtol=1e-15)


def differences(f: Callable[[np.ndarray], float], p: np.ndarray, part: float = 1e-3) -> np.ndarray:
    """The derivatives of f by the entries of p, by differences of fourth order."""
    steps = np.diag(part * np.abs(p))
    return np.array([(8 * (f(p + d) - f(p - d)) - (f(p + 2 * d) - f(p - 2 * d))) / (12 * d.sum()) for d in steps])


def compare(
    system: AcausalSystem, names: Sequence[str], values: Sequence[float], read: str, known: Callable, end: float,
    inputs: dict[str, Any] | None = None, part: float = 1e-3,
):  # fmt: skip
    """The variable `read` at the end and its derivatives by the parameters, against the function `known` of these, of
    which differences are taken over such parts of them."""

    def last(p):
        given = system.with_parameters(dict(zip(names, p, strict=True)))
        return simulate(given, end, ts=jnp.array([end]), inputs=inputs, **TIGHT)[read][-1]

    value, slopes = jax.value_and_grad(last)(jnp.array(values))
    p = np.array(values)
    np.testing.assert_allclose(value, known(p), rtol=1e-9)
    expected = differences(known, p, part)
    np.testing.assert_allclose(slopes * p, expected * p, rtol=0, atol=1e-7 * np.max(np.abs(expected * p)))
