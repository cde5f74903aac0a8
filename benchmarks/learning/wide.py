"""Plain `problem.fit()` of raw `equinox.nn.MLP`s over widths, depths, activations, noise and lengths of the record.

    python benchmarks/learning/wide.py [law] [first row] [last row]

Twenty-four rows: each of twelve shapes is fitted twice, with records of 6 and of 20 s, one of which has ten times the
noise. Which one alternates with the parity of depth and activation (half of a factorial design), and seeds of noise and
weights differ in each row.
"""

import itertools
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from plain_fits import PLANTS, SAMPLES, Learned, compared, truth

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning

ACTIVATIONS = {"tanh": jnp.tanh, "silu": jax.nn.silu}


def design():
    """(width, depth, activation, seconds, factor of the noise) of each row."""
    for k, (width, depth, act) in enumerate(itertools.product((8, 32, 64), (1, 2), ACTIVATIONS)):
        odd = (k // 2 + k + k // 4) % 2
        yield width, depth, act, 6.0, (1.0, 10.0)[odd]
        yield width, depth, act, 20.0, (10.0, 1.0)[odd]


def main(law, first, last):
    plant, shape, problem = PLANTS[law], None, None
    truths = {seconds: truth(plant, seconds) for seconds in (6.0, 20.0)}
    for k, (width, depth, act, seconds, factor) in enumerate(design()):
        if not first <= k <= last:
            continue
        begun = time.process_time()
        ts, states = truths[seconds]
        rng = np.random.default_rng(100 + k)
        sigma = {f"c.{x}": factor * level for x, level in plant.measured.items()}
        data = {x: states[x[2:]] + level * rng.standard_normal(SAMPLES) for x, level in sigma.items()}
        data = learning.Experiment(ts, data, sigma=sigma)
        net = eqx.nn.MLP(1, 1, width, depth, ACTIVATIONS[act], key=jax.random.key(k))
        ev, diagram = EqnEnv(), AcausalDiagram()
        diagram.add(Learned(ev, plant, dict.fromkeys(plant.laws, net)))
        if shape != (width, depth, act):
            system = AcausalCompiler(ev, diagram)()
            problem, shape = learning.Problem(system, data), (width, depth, act)
        assert problem is not None
        there = eqx.tree_at(lambda s: s.neural, problem.system, dict.fromkeys(problem.system.neural, net))
        fit = problem.beginning_at(there).fit(data, warn=False)
        took = time.process_time() - begun
        for name, (error, stated, covered) in compared(fit, plant, states).items():
            print(
                f"| {k} | {name} | {width}x{depth} {act} | {seconds:g} s | {factor:g} | {100 * error:.2f} | "
                f"{100 * stated:.2f} | {100 * covered:.0f} | {fit.chi2:.0f}/{fit.freedom:.0f} | "
                f"{len(fit.minimum.history) - 1} | {fit.minimum.evaluations} | {took:.0f} | {fit.ok} | "
                f"{'; '.join(fit.reasons)[:90]} |",
                flush=True,
            )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    given = [*sys.argv[1:], *[None] * 3][:3]
    main(given[0] or "drag", int(given[1] or 0), int(given[2] or 23))
