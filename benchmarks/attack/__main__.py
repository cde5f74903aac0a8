"""Counts: `python -m benchmarks.attack --family resistors --count 100 --seed 0`."""

import argparse
import collections
import importlib
import os
import time

# Every model is run once, so compiling takes most of the time.
FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}"

import jax  # noqa: E402  (it reads XLA_FLAGS)

FAMILIES = ("resistors", "circuits", "rods", "gears", "thermal", "pipes", "mechanisms", "descriptors", "events", "gradients")


def attack(family: str, count: int, seed: int, moving: int = 0, show: int = 5, units: str = ""):
    """Judges `count` models of a family from `seed` on; every `moving`-th is integrated as well. With `units`, the
    models are written in other units first. Returns the outcomes by seed."""
    from . import rescaled
    from .judge import judged

    make = importlib.import_module(f".{family}", __package__).make
    if units:
        make = rescaled.family(make, units)
    outcomes = {}
    cases = ((s, make(s)) for s in range(seed, seed + count))
    for s, case, outcome in judged(cases, lambda s: bool(moving) and s % moving == 0):
        outcomes[s] = outcome
        if outcome.kind not in ("right", "refused") and show > 0:
            show -= 1
            text = outcomes[s].text
            print(f"  {family} {s} ({case.note}): {outcomes[s].kind}: {text[:400]}", flush=True)
    return outcomes


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--family", default="all", help=f"all, or one of {', '.join(FAMILIES)}")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--moving", type=int, default=0, help="integrate every so many-th model too (0: none)")
    parser.add_argument("--show", type=int, default=5, help="how many failures of a family are printed")
    parser.add_argument("--units", default="", help="rescale: equations, parameters, units or all")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    families = FAMILIES if given.family == "all" else given.family.split(",")
    kinds = ("right", "refused", "untrue", "crashed", "late", "wrong")
    print(f"{'family':<12}" + "".join(f"{k:>9}" for k in kinds) + "   worst error    ms each   slowest", flush=True)
    for family in families:
        start = time.perf_counter()
        outcomes = attack(family, given.count, given.seed, given.moving, given.show, given.units)
        seconds = time.perf_counter() - start
        tally = collections.Counter(o.kind for o in outcomes.values())
        worst = max((o.error for o in outcomes.values() if o.kind == "right"), default=0.0)
        row = "".join(f"{tally[k]:>9}" for k in kinds)
        slowest = max(outcomes, key=lambda s: outcomes[s].seconds)
        print(
            f"{family:<12}{row}{worst * 1e-8:>14.1e}{1e3 * seconds / max(1, given.count):>11.0f}"
            f"   seed {slowest} in {outcomes[slowest].seconds:.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
