"""What programs are made for: the platform at hand, and products of matrices in full precision."""

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from problems import pendulum

from jaxonomy_dae import simulate
from jaxonomy_dae.host.platform import platform, precisely
from jaxonomy_dae.solvers import Rodas5P


def test_the_platform_is_that_of_the_default_device():
    """Kind: `jax.default_backend()` asked where programs are made for another device."""
    assert platform() == jax.default_backend()
    with jax.default_device(jax.devices("cpu")[0]):
        assert platform() == "cpu"


@pytest.mark.parametrize("platforms", [["cuda"], ["cpu", "cuda"]])
def test_programs_can_be_exported_for_other_platforms(platforms):
    """Kind: the processor at hand instead of the one a program is made for. What is chosen by it may cost time on the
    other one, and nothing else."""
    system = pendulum()
    x = jnp.asarray([0.6, 0.0, -0.8, 0.0])
    field = jax.jit(lambda x: system.vector_field(0.0, x))
    exported = jax.export.export(field, platforms=platforms)(x)
    if "cpu" in platforms:
        np.testing.assert_allclose(exported.call(x), field(x), rtol=1e-14, atol=1e-14)


def test_products_of_matrices_are_in_full_precision():
    """Kind: a result that hangs on the processor. GPUs round the factors of products in single precision to ten bits
    by default, so that Newton's method rests at 1e-3. A precision that the user chose stays."""
    product = precisely(lambda a: a @ a)
    assert "HIGHEST" in jax.jit(product).lower(jnp.ones((2, 2), jnp.float32)).as_text()
    with jax.default_matmul_precision("bfloat16"):
        assert "HIGHEST" not in jax.jit(product).lower(jnp.ones((2, 2), jnp.float32)).as_text()


@pytest.mark.slow
def test_runs_are_in_full_precision():
    system = pendulum()

    def last(m):
        return simulate(system.with_parameters({"pend.m": m}), 1.0, ts=jnp.ones(1), solver=Rodas5P())["pend.x"][0]

    text = jax.jit(jax.grad(last)).lower(1.0).as_text()
    dots = [line for line in text.splitlines() if "dot_general" in line]
    assert dots and all("HIGHEST" in line for line in dots)
