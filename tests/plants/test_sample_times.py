"""Derivatives by the times of an input's samples: x' = −x + u, u linear between samples, against the closed form."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from problems import compiled, component

from jaxonomy_dae import der, simulate
from jaxonomy_dae.write import Eq

END, SAVED = 2.0, 1.9


def lag(c, ev):
    x, u = c.variable("x", start=1.0, fixed=True), c.input("u")
    c.add_equations(Eq(der(x), -x + u))


def exact(times, values):
    """x(SAVED), as an integral over each interval between samples."""
    kinks = [0.0, *times[(times > 0) & (times < SAVED)], SAVED]
    parts = (
        scipy.integrate.quad(lambda s: np.exp(s - SAVED) * np.interp(s, times, values), a, b, epsabs=1e-14)[0]
        for a, b in zip(kinks[:-1], kinks[1:], strict=True)
    )
    return np.exp(-SAVED) + sum(parts)


@pytest.fixture(scope="module")
def system():
    return compiled(component(lag))


HOW = {
    "reverse": (jax.grad, None), "forward": (jax.jacfwd, None),
    "checkpoints": (jax.grad, diffrax.RecursiveCheckpointAdjoint()),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("how", HOW)
def test_gradients_by_sample_times(system, how):
    """A step that a sample cuts short is a small remainder. The next step is its multiple, and differentiated as such,
    all later steps stretched with the sample's time, by factors of 1e5, each times its local error: −9.6 came out for
    −0.038 at rtol = 1e-12. Where ends of steps do not move with the samples, 15 % are missing."""
    by, adjoint = HOW[how]

    @jax.jit
    @by
    def slope(times, values, rtol):
        inputs = {"c.u": (times, values)}
        run = simulate(system, END, ts=jnp.array([SAVED]), inputs=inputs, rtol=rtol, atol=rtol, adjoint=adjoint)
        return run["c.x"][0]

    rng = np.random.default_rng(1)
    for _ in range(5):
        times = np.r_[0.0, np.sort(rng.uniform(0.05, 1.95, 5)), END]
        values = rng.normal(size=7)
        h = 1e-5
        moved = h * np.eye(7)
        slopes = [(exact(times + d, values) - exact(times - d, values)) / (2 * h) for d in moved[1:-1]]
        for rtol, allowed in ((1e-8, 1e-5), (1e-10, 1e-6), (1e-12, 1e-7)):
            found = np.asarray(slope(jnp.asarray(times), jnp.asarray(values), rtol))[1:-1]
            np.testing.assert_allclose(found, slopes, atol=allowed * np.abs(slopes).max())
