"""Experiments divided among devices, and among processes: here devices that XLA makes of one CPU, in processes of their
own."""

import json
import os
import socket
import subprocess
import sys

import numpy as np
import pytest
from problems import environment

from jaxonomy_dae import ModelError
from jaxonomy_dae.learning.devices import check_mesh

PROGRAM = """
import json, sys
import jax, jax.numpy as jnp, numpy as np, optax
jax.config.update("jax_enable_x64", True)
port, rank, count, what = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
if count > 1:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{port}", count, rank)
assert len(jax.devices()) == 2
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.write import POSITIVE, Component, Eq, der


class Tank(Component):
    def __init__(self, ev, name="c"):
        super().__init__(ev, name)
        k, u = self.parameter("k", 1.0, bounds=POSITIVE), self.input("u", default=0.0)
        x = self.variable("x", start=2.0)
        self.add_equations(Eq(der(x), u - k * x))


ev, diagram = EqnEnv(), AcausalDiagram()
diagram.add(Tank(ev))
system = AcausalCompiler(ev, diagram)()


def record(seed):
    ts, rng = np.linspace(0.0, 3.0, 9 + seed)[1:], np.random.default_rng(seed)
    u, start = 0.2 * seed, 1.0 + seed
    x = u / 0.7 + (start - u / 0.7) * np.exp(-0.7 * ts) + 0.05 * rng.standard_normal(len(ts))
    return learning.Experiment(
        ts, {"c.x": x}, sigma=0.05 if seed else "estimate", inputs={"c.u": u}, initial={"c.x": learning.Unknown(2.0)}
    )


data = learning.Data(*map(record, range(3)))
ways = {
    "single": "single", "shooting": learning.Shooting(4), "filter": learning.Filter({"c.x": 0.1}),
}


def numbers(fit):
    return [*fit.values.values(), *fit.spread, fit.chi2, *fit.sigma.values(), *fit.predict("c.x").spread["c.x"]]


def all_numbers(mesh):
    out = {}
    for name in what.split(","):
        problem = learning.Problem(system, data, train="c.k", method=ways[name], mesh=mesh)
        out[name] = numbers(problem.fit())
        if name == "single" and count == 1:
            again = problem.fit(data, bounds={"c.k": (0.1, 0.65)})
            out["bounded"] = numbers(again)
            how = learning.GradientSteps(optax.adam(0.05), steps=5, batch=2)
            out["trained"] = list(problem.train(how).values.values())

            def cost(k):
                found = problem.residuals(system.with_parameters({"c.k": k}))
                return sum(jnp.sum(r["c.x"] ** 2) for r in found.values())

            out["gradient"] = [float(v) for v in jax.value_and_grad(cost)(0.8)]
    return jax.tree.map(float, out)


mesh = jax.make_mesh((2,), ("experiments",))
out = {"on two": all_numbers(mesh)}
if count == 1:
    out["on one"] = all_numbers(None)
print(json.dumps(out), flush=True)
"""


def start(port, rank, count, what, devices):
    env = environment() | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}",
        "JAX_PLATFORMS": "cpu",
    }  # fmt: skip
    command = [sys.executable, "-c", PROGRAM, str(port), str(rank), str(count), what]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def outcome(process):
    try:
        out, errors = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    return json.loads(next(line for line in out.splitlines() if line.startswith("{")))


def assert_close(found, expected):
    assert found.keys() == expected.keys()
    for name, numbers in expected.items():
        np.testing.assert_allclose(found[name], numbers, rtol=1e-7, atol=1e-10, err_msg=name)


@pytest.fixture(scope="module")
def found():
    return outcome(start(0, 0, 1, "single,shooting,filter", 2))


@pytest.mark.slow
def test_two_devices_give_the_numbers_of_one(found):
    """By every method; three experiments, so that one is repeated."""
    assert len(found["on one"]) == 6
    assert_close(found["on two"], found["on one"])


@pytest.mark.slow
def test_two_processes_give_the_numbers_of_one(found):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = [start(port, rank, 2, "single", 1) for rank in (0, 1)]
    first, second = (outcome(one) for one in both)
    assert first == second  # bit for bit
    assert_close(first["on two"], {"single": found["on one"]["single"]})


def test_what_is_no_mesh():
    with pytest.raises(ModelError, match=r"mesh is a mesh of devices, jax.make_mesh\(.*; got int"):
        check_mesh(2)
