"""A double pendulum over twelve seconds, in which a disturbance grows a millionfold: its second rod and the damping of
its second pin from noisy angles, by single shooting, growing horizons and multiple shooting.

The truth comes from Lagrange's equations in the angles, integrated by SciPy.

python benchmarks/learning/double_pendulum.py [seeds of noise, 1-20] [single,growing,multiple]
"""

import sys
import time

import jax
import numpy as np
import scipy.integrate

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.library import rotational
from jaxonomy_dae.library.planar import MassiveLink, Revolute, World

TRUTH = {"b.m": 1.3, "b.rx": 0.8, "brake.d": 0.01}
GUESS = {"b.m": 1.0, "b.rx": 1.0, "brake.d": 0.03}
START = {"a.body.phi": 0.5, "b.body.phi": 0.5, "a.body.omega": 0.5, "b.body.omega": -0.3}
TIMES, SIGMA, GRAVITY = np.linspace(0.0, 12.0, 301), 0.01, 9.81
METHODS = {"single": "single", "growing": "growing", "multiple": learning.Shooting(nodes=30)}


def pendulum(m=GUESS["b.m"], length=GUESS["b.rx"], d=GUESS["brake.d"]):
    """Two uniform rods, the first of one kilogram and one metre; states are the angles from the x axis."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    world = World(ev, name="world")
    first, second = (Revolute(ev, name=f"j{k}", initial_angle=0.5, initial_speed=0.0) for k in (1, 2))
    upper, lower = MassiveLink(ev, "a", 1.0), MassiveLink(ev, "b", length, m=m)
    brake, still = rotational.Damper(ev, "brake", d), rotational.FixedAngle(ev, "still")
    for one, other in (
        (world.frame, first.frame_a), (first.frame_b, upper.frame_a), (upper.frame_b, second.frame_a),
        (second.frame_b, lower.frame_a), (still.flange, brake.flange_a), (brake.flange_b, second.flange),
    ):  # fmt: skip
        diagram.connect(one, other)
    return AcausalCompiler(ev, diagram, state_selection="dummy_derivatives", prefer_states=list(START))()


def run(start, times, m=TRUTH["b.m"], length=TRUTH["b.rx"], d=TRUTH["brake.d"]):
    """(angle, angle, speed, speed) by Lagrange's equations of two uniform rods."""
    j1, j2, arm = 1 / 3 + m, m * length**2 / 3, m * length / 2

    def slopes(t, state):
        p, q, u, v = state
        mass = [[j1, arm * np.cos(p - q)], [arm * np.cos(p - q), j2]]
        force = [
            -arm * np.sin(p - q) * v * v - (0.5 + m) * GRAVITY * np.cos(p) + d * (v - u),
            arm * np.sin(p - q) * u * u - m * GRAVITY * length / 2 * np.cos(q) - d * (v - u),
        ]
        return [u, v, *np.linalg.solve(mass, force)]

    found = scipy.integrate.solve_ivp(
        slopes, (times[0], times[-1]), start, "DOP853", t_eval=times, rtol=1e-12, atol=1e-12
    )
    return found.y


def record(seed, times=TIMES, sigma=SIGMA):
    """Both angles with noise; how the pendulum starts is unknown, and its speeds are taken for zero at first."""
    rng = np.random.default_rng(seed)
    angles = run(list(START.values()), times)[:2] + sigma * rng.standard_normal((2, len(times)))
    names = list(START)
    guesses = {names[0]: angles[0, 0], names[1]: angles[1, 0], names[2]: 0.0, names[3]: 0.0}
    initial = {name: learning.Unknown(float(value)) for name, value in guesses.items()}
    return learning.Experiment(times, dict(zip(names, angles, strict=False)), sigma=sigma, initial=initial)


def growth(times=TIMES, step=1e-9):
    """How much a disturbance of the first angle is amplified, at most."""
    start = np.array(list(START.values()))
    change = run(start + [step, 0, 0, 0], times) - run(start, times)
    return np.abs(change).max() / step


def deviations(fit):
    """How far the parameters found are from the truth, in standard deviations that the fit gives."""
    c = fit.objective.coordinates
    place = [c.names.index(name) for name in TRUTH]
    truth = c.scaled(np.array([TRUTH.get(name, value) for name, value in fit.values.items()]))
    return ((fit.point - truth) / fit.spread)[place]


def main(seeds, methods):
    print(f"a disturbance grows by {growth():.2g}")
    start = time.perf_counter()
    system = pendulum()
    print(f"compiled in {time.perf_counter() - start:.1f} s")
    for method in methods:
        found = []
        problem = learning.Problem(system, record(seeds[0]), train=list(TRUTH), method=METHODS[method])
        for seed in seeds:
            start, cpu = time.perf_counter(), time.process_time()
            fit = problem.fit(record(seed))
            took = time.perf_counter() - start, time.process_time() - cpu
            off = deviations(fit)
            good = bool(fit.chi2 < 1.3 * fit.freedom and (np.abs(off) < 4).all())
            found.append(good)
            values = ", ".join(f"{fit.values[name]:.5f}" for name in TRUTH)
            print(
                f"{method} seed {seed}: {'found' if good else 'NOT found'}, {values}",
                "off by " + ", ".join(f"{o:+.1f}" for o in off) + " σ",
                f"χ²/f {fit.chi2 / fit.freedom:.3f}, {took[0]:.1f} s, {took[1]:.1f} s CPU",
                f"{fit.minimum.evaluations} evaluations, {fit.message}",
                sep=", ",
                flush=True,
            )
        print(f"{method}: {sum(found)} of {len(found)}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    first, last = (int(k) for k in (sys.argv[1] if len(sys.argv) > 1 else "1-20").split("-"))
    chosen = sys.argv[2].split(",") if len(sys.argv) > 2 else list(METHODS)
    main(list(range(first, last + 1)), chosen)
