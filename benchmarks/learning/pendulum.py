"""The demo's pendulum: a drag law learned from noisy positions, over seeds of noise and of weights.

python benchmarks/learning/pendulum.py [noise seeds] [weight seeds]
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import neural_dae_pendulum_drag as demo  # noqa: E402

from jaxonomy_dae import learning  # noqa: E402

GRID = np.linspace(0.0, 5.4, 200)


def experiment(seed: int, noise: float = demo.NOISE, every: int = 1, outputs=("x", "y")):
    """A record of positions, and the true run."""
    true = demo.angle_equation(demo.HIGH_RELEASE, lambda v: -demo.DRAG * demo.speed(v) * v, demo.SAMPLES)
    clean = np.asarray(demo.positions(true))
    data = clean + noise * np.asarray(jax.random.normal(jax.random.key(seed), clean.shape))
    columns = {f"pend.{n}": data[::every, "xy".index(n)] for n in outputs}
    return learning.Experiment(np.asarray(demo.SAMPLES)[::every], columns, sigma=noise or demo.NOISE), true


def scored(estimate, true):
    """(error of the law, factor over no drag, share of the truth inside the band)."""
    speeds = np.hypot(np.asarray(true["pend.vx"]), np.asarray(true["pend.vy"]))
    low, high = np.percentile(speeds, [1, 99])
    grid = np.linspace(0.0, 1.25 * speeds.max(), 200)
    inside, law = (grid >= low) & (grid <= high), demo.DRAG * grid**2
    band = estimate.band("drag", grid, lambda net, s: net.rate(s) * s, along=speed)
    error = demo.rms((band.mean - law)[inside]) / demo.rms(law[inside])
    covered = ((band.low <= law) & (law <= band.high))[inside].mean()
    angle = demo.rms(demo.angle(demo.follow(estimate.system, demo.SAMPLES)) - demo.angle(true))
    return error, angle, covered


def speed(solution):
    return jnp.hypot(solution["pend.vx"], solution["pend.vy"])


def with_net(system, key):
    import equinox as eqx

    return eqx.tree_at(lambda s: s.neural["drag"], system, demo.Drag(jax.random.key(key)))


def main(noises, nets):
    start, cpu = time.perf_counter(), time.process_time()
    model = demo.pendulum(demo.HIGH_RELEASE, demo.Drag(jax.random.key(0)))
    ideal = demo.pendulum(demo.HIGH_RELEASE)
    first, true = experiment(noises[0])
    without = demo.rms(demo.angle(demo.follow(ideal, demo.SAMPLES)) - demo.angle(true))
    print(f"set up {time.perf_counter() - start:.1f} s, {time.process_time() - cpu:.1f} s CPU")
    start, cpu = time.perf_counter(), time.process_time()
    problem = learning.Problem(model, first)
    for seed in noises:
        data, _ = experiment(seed)
        for net in nets:
            start, cpu = time.perf_counter(), time.process_time()
            found = problem.fit(data, start=with_net(model, net), adam=40)
            took = time.perf_counter() - start, time.process_time() - cpu
            error, angle, covered = scored(found, true)
            print(
                f"noise {seed} net {net}: law {100 * error:.2f} %, factor {without / angle:,.0f}",
                f"covered {covered:.3f}, γ {found.effective['drag']:.1f}, χ²/n {found.chi2 / 400:.3f}",
                f"{took[0]:.2f} s, {took[1]:.2f} s CPU, {found.minimum.evaluations} evaluations, {found.message}",
                sep=", ",
                flush=True,
            )


if __name__ == "__main__":
    noise = [int(k) for k in (sys.argv[1] if len(sys.argv) > 1 else "1,2,3").split(",")]
    weights = [int(k) for k in (sys.argv[2] if len(sys.argv) > 2 else "0,1,2").split(",")]
    main(noise, weights)
