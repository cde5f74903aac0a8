"""The demo's pendulum: the closed form of its drag, found in the network's place, over seeds of noise.

python benchmarks/learning/discovery.py [noise in metre] [first seed] [last seed]
"""

import sys
import time

import jax
from pendulum import demo, experiment

from jaxonomy_dae import learning


def main(noise, seeds):
    model = demo.pendulum(demo.HIGH_RELEASE, demo.Drag(jax.random.key(0)))
    first, true = experiment(seeds[0], noise)
    run = demo.follow(demo.pendulum(demo.HIGH_RELEASE), demo.SAMPLES)
    without = demo.rms(demo.angle(run) - demo.angle(true))
    problem = learning.Problem(model, first)
    begun, right = None, 0
    for seed in seeds:
        start = time.perf_counter(), time.process_time()
        data, _ = experiment(seed, noise)
        fit = problem.fit(data, adam=0 if begun else 40, start=begun)
        begun = fit.system  # the next search begins here: the networks' fits are not what is measured
        between = time.perf_counter(), time.process_time()
        found = fit.discover("drag", learning.powers(4))
        end = time.perf_counter(), time.process_time()
        single = next(c for c in found.candidates if c.terms == ("[vx, vy]*|[vx, vy]|",))
        is_right = found.chosen is single
        right += is_right
        angle = demo.rms(demo.angle(demo.follow(found.system, demo.SAMPLES)) - demo.angle(true))
        c = -float(single.law.coefficients[0])
        others = [k.bic - single.bic for k in found.candidates if k is not single]
        print(
            f"seed {seed}: {found.chosen!r}{'' if is_right else ' WRONG'}, c off by {100 * (c / demo.DRAG - 1):+.4f} %",
            f"factor {without / angle:,.0f}, next form {min(others):+.2f}, lack of fit {found.lack_of_fit:.2g}",
            f"network {between[0] - start[0]:.2f} s, discovery {end[0] - between[0]:.2f} s",
            f"{end[1] - between[1]:.2f} s CPU for {len(found.candidates)} forms",
            sep=", ",
            flush=True,
        )
    print(f"right form in {right} of {len(seeds)}")


if __name__ == "__main__":
    level = float(sys.argv[1]) if len(sys.argv) > 1 else 1e-3
    low, high = (int(k) for k in sys.argv[2:4]) if len(sys.argv) > 3 else (1, 20)
    main(level, range(low, high + 1))
