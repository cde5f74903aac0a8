"""The demo's pendulum with the drag's form known: its coefficient, found again and again."""

import time

import jax.numpy as jnp
from pendulum import demo, experiment

from jaxonomy_dae import learning


def drag(t, v, theta):
    return -theta[0] * demo.speed(v) * v


def main():
    model = demo.pendulum(demo.HIGH_RELEASE, drag, jnp.array([0.1]))
    problem = learning.Problem(model, experiment(1)[0], train=["drag"], regularize=None)
    for seed in (1, 2, 3):
        data = experiment(seed)[0]
        start, cpu = time.perf_counter(), time.process_time()
        fit = problem.fit(data)
        took = time.perf_counter() - start, time.process_time() - cpu
        value, spread = fit.values["drag[0]"], fit.spread[0]
        print(f"seed {seed}: c = {value:.5f} ± {spread:.5f}, {took[0]:.3f} s, {took[1]:.3f} s CPU, {fit}", flush=True)


if __name__ == "__main__":
    main()
