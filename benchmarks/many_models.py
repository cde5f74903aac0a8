"""Many different small models in one process: value and gradient of each, called as they are and in a jitted function.

Prints how many memory mappings and how much memory the process holds, and what the models took. A process that keeps
every program dies after some 35 to 90 of them; here programs go when they take half of what the system allows.

    COUNT=500 EVERY=25 python benchmarks/many_models.py
    LIMIT=8000 COUNT=30 python benchmarks/many_models.py       # as if the system allowed fewer mappings
"""

import os
import tempfile
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.host import machine
from jaxonomy_dae.host.cache import PROGRAMS

LAWS = (lambda x: x, sympy.sin, sympy.tanh, lambda x: x**3, lambda x: x / (1 + x**2), lambda x: x * sympy.exp(-x))
COLUMNS = ("models", "mappings", "rss MB", "programs kept", "CPU s", "wall s", "cleared")


class Chain(Component):
    """der(x_k) = law_k(x_(k-1)) − p·x_k, a chain of one to three states; the laws are the digits of `number`."""

    def __init__(self, ev, name, number):
        super().__init__(ev, name)
        p = self.parameter("p", 1.0 + 0.001 * number)
        digits, rest = [], number
        while rest or not digits:
            rest, digit = divmod(rest, len(LAWS))
            digits.append(digit)
        x = [self.variable(f"x{k}", start=0.5, fixed=True) for k in range(len(digits))]
        before = [1.0 + 0.1 * x[-1], *x]
        for k, digit in enumerate(digits):
            self.add_equations(sympy.Eq(der(x[k]), LAWS[digit](before[k]) - p * x[k]))


def run(number: int) -> None:
    """Value and gradient of one model, four ways; the derivatives must agree."""
    ev = EqnEnv()
    system = AcausalCompiler(ev, AcausalDiagram().add(Chain(ev, "c", number)))()

    def loss(p):
        return simulate(system.with_parameters({"c.p": p}), 1.0, ts=jnp.array([0.5, 1.0]))["c.x0"][-1]

    p = jnp.asarray(system.parameters["c.p"])
    value, slope = loss(p), jax.grad(loss)(p)
    jitted = eqx.filter_jit(jax.value_and_grad(loss))(p)  # what no one frees but jax.clear_caches
    np.testing.assert_allclose([value, slope], jitted, rtol=1e-5)  # ten times the tolerance of the run


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    count, every = int(os.environ.get("COUNT", 20)), int(os.environ.get("EVERY", 5))
    if "LIMIT" in os.environ:
        machine.ALLOWED = Path(tempfile.mkdtemp()) / "max_map_count"
        machine.ALLOWED.write_text(os.environ["LIMIT"])
    cleared = []
    clear = jax.clear_caches
    jax.clear_caches = lambda: (cleared.append(1), clear())  # counted
    warnings.simplefilter("always")
    print("  ".join(f"{c:>13}" for c in COLUMNS), flush=True)
    start = time.perf_counter()
    for k in range(1, count + 1):
        run(k)
        if k % every == 0 or k == count:
            used, held = machine.mappings(), machine.memory()
            row = (
                k, used.used if used else 0, round(held.used / 1e6) if held else 0, len(PROGRAMS),
                round(time.process_time()), round(time.perf_counter() - start), len(cleared),
            )  # fmt: skip
            print("  ".join(f"{c:>13}" for c in row), flush=True)


if __name__ == "__main__":
    main()
