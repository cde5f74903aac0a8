"""`StoredAdjoint` on several devices: here two that XLA makes of one CPU, in a process of their own."""

import json
import subprocess
import sys

import numpy as np
import pytest
from problems import environment

PROGRAM = """
import json
import jax, jax.numpy as jnp, diffrax
import numpy as np
from jax.sharding import Mesh, PartitionSpec as P
jax.config.update("jax_enable_x64", True)
from jaxonomy_dae.solvers import DAETerm, Rodas5P, StoredAdjoint, Tsit5, solve_dae

assert len(jax.devices()) == 2
mesh, ks = Mesh(np.array(jax.devices()), ("b",)), jnp.linspace(1.0, 3.0, 4)


def explicit(k):
    term = diffrax.ODETerm(lambda t, y, k: -k * y)
    control = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    saveat = diffrax.SaveAt(ts=jnp.array([0.5, 1.0]))
    return diffrax.diffeqsolve(
        term, Tsit5(), 0.0, 1.0, 0.01, jnp.ones(()), k, saveat=saveat, stepsize_controller=control,
        adjoint=StoredAdjoint(), throw=False,
    ).ys[-1]


def implicit(k):
    term = DAETerm(lambda t, x, z, k: -k * z, lambda t, x, z, k: z - x)
    start = jnp.ones(1), jnp.ones(1)
    return solve_dae(term, 1.0, start, solver=Rodas5P(), args=k, rtol=1e-9, atol=1e-11, throw=False).ys[0][0, 0]


out = {}
for name, f in (("explicit", explicit), ("implicit", implicit)):
    both = jax.vmap(jax.value_and_grad(f))
    shared = jax.shard_map(both, mesh=mesh, in_specs=P("b"), out_specs=P("b"), check_vma=False)
    out[name + " shard_map"] = jax.tree.map(lambda v: v.tolist(), jax.jit(shared)(ks))
    out[name + " pmap"] = jax.tree.map(lambda v: v.ravel().tolist(), jax.pmap(both)(ks.reshape(2, 2)))
    spread = jax.device_put(ks, jax.sharding.NamedSharding(mesh, P("b")))
    out[name + " jit"] = jax.tree.map(lambda v: v.tolist(), jax.jit(both)(spread))
print(json.dumps(out))
"""


@pytest.mark.slow
def test_gradients_on_two_devices():
    """exp(−k) and its derivative, for k on two devices."""
    env = environment() | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    out = json.loads(done.stdout.splitlines()[-1])
    exact = np.exp(-np.linspace(1.0, 3.0, 4))
    assert len(out) == 6
    for name, (value, gradient) in out.items():
        np.testing.assert_allclose(value, exact, rtol=1e-7, err_msg=name)
        np.testing.assert_allclose(gradient, -exact, rtol=1e-7, err_msg=name)
