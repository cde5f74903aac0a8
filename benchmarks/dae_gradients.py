"""Gradients and batches of the DAE solvers, on the published problems.

For each problem and solver: the steady time of a solve, of its value and gradient with respect to all parameters, and
of the backward part alone as a multiple of the forward; reverse mode against forward mode. Then `vmap` over parameter
sets: the cost of a member against that of a single solve.

    python benchmarks/dae_gradients.py                 # all
    python benchmarks/dae_gradients.py --batch 100     # a smaller batch
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import equinox as eqx  # noqa: E402
from testset import PROBLEMS  # noqa: E402

from jaxonomy_dae import simulate  # noqa: E402
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, solve_dae  # noqa: E402

RTOL = 1e-6
END = {"robertson": 4e4, "transamp": 0.02}  # else the problem's own


def best(function, *args, seconds=1.0):
    """The least time of a call, after one that compiles."""
    jax.block_until_ready(function(*args))
    times, started = [], time.perf_counter()
    while len(times) < 3 or time.perf_counter() - started < seconds:
        begun = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - begun)
    return min(times)


def raw(name, solver):
    """The sum of scaled end values as a function of the parameters, by an adjoint."""
    problem = PROBLEMS[name]
    one = problem.index_one()
    term = DAETerm(one.F, mass=one.mass)
    scale = jnp.maximum(jnp.abs(jnp.asarray(one.y0)), 1e-3)
    end = END.get(name, problem.t1)
    tolerances = problem.tolerances(RTOL)

    def loss(parameters, adjoint=None):
        solution = solve_dae(
            term, end, jnp.asarray(one.y0), t0=problem.t0, solver=solver, args=parameters, adjoint=adjoint,
            throw=False, max_steps=50_000, **tolerances,
        )  # fmt: skip
        return jnp.sum(solution.ys[-1] / scale)

    return loss, one.args()


def model(name, solver):
    """The same of a compiled model."""
    problem = PROBLEMS[name]
    system = problem.compile()
    end = END.get(name, problem.t1)
    tolerances = problem.tolerances(RTOL)
    names = list(problem.reference)

    def loss(values, adjoint=None):
        changed = eqx.tree_at(lambda s: s.parameters.values, system, values)
        solution = simulate(
            changed, end, t0=problem.t0, ts=jnp.array([end]), solver=solver, adjoint=adjoint, throw=False,
            max_steps=50_000, **tolerances,
        )  # fmt: skip
        return sum(solution[n][-1] for n in names)

    return loss, system.parameters.values


def gradients():
    print(f"rtol {RTOL:g}; times in ms")
    print(f"{'problem':>16} {'form':>6} {'solver':>8} {'forward':>9} {'value+grad':>11} {'backward/forward':>17} "
          f"{'reverse − forward':>18}")  # fmt: skip
    cases = [("robertson", raw), ("chemakzo", raw), ("transamp", raw), ("pendulum_period2", model)]
    for name, build in cases:
        for solver in (Rodas5P(), BDF()):
            loss, parameters = build(name, solver)
            value = jax.jit(loss)
            both = jax.jit(jax.value_and_grad(loss))
            forward = jax.jit(jax.jacfwd(lambda p, loss=loss: loss(p, diffrax.ForwardMode())))
            t, g = best(value, parameters), best(both, parameters)
            a = np.concatenate([np.ravel(v) for v in jax.tree.leaves(both(parameters)[1])])
            b = np.concatenate([np.ravel(v) for v in jax.tree.leaves(forward(parameters))])
            apart = np.abs(a - b).max() / np.abs(b).max()
            print(f"{name:>16} {build.__name__:>6} {type(solver).__name__:>8} {t * 1e3:9.3f} {g * 1e3:11.3f} "
                  f"{(g - t) / t:17.2f} {apart:18.1e}", flush=True)  # fmt: skip


def batches(count):
    print(f"\nvmap over {count} parameter sets (rates; resistances and capacitances), ±10 %, rtol {RTOL:g}")
    print(f"{'problem':>16} {'solver':>8} {'one solve':>11} {'a member':>11} {'ratio':>7} {'batch − loop':>13}")
    for name in ("robertson", "transamp"):
        for solver in (Rodas5P(), BDF()):
            loss, parameters = raw(name, solver)
            factors = jnp.asarray(np.random.default_rng(0).uniform(0.9, 1.1, count))
            scaled = {k: v * (factors if k[0] in "pRC" else jnp.ones(count)) for k, v in parameters.items()}
            one, batch = jax.jit(loss), jax.jit(jax.vmap(loss))
            t, b = best(one, parameters), best(batch, scaled) / count
            every = max(1, count // 20)
            loop = [float(one(jax.tree.map(lambda v, k=k: v[k], scaled))) for k in range(0, count, every)]
            apart = np.abs(np.asarray(batch(scaled))[::every] / np.array(loop) - 1).max()
            print(f"{name:>16} {type(solver).__name__:>8} {t * 1e3:8.3f} ms {b * 1e3:8.3f} ms {b / t:7.2f} "
                  f"{apart:13.1e}", flush=True)  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=1000)
    options = parser.parse_args()
    gradients()
    batches(options.batch)
