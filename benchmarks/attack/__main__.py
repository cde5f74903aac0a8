"""Draws models and counts what becomes of them.

python -m benchmarks.attack --minutes 10 --seed 7                    all families in turn, until the time is spent
python -m benchmarks.attack --family resistors --count 100           so many models of one family
"""

import argparse
import math
import os
import sys
import time

from .draws import FAMILIES, NETWORKS, PUBLISHED, SWITCHING, UNITS, Draw, draws
from .outcome import GOOD, HEAD, Outcome, row
from .timed import attack

# Every model is run once, so compiling takes most of the time.
FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)


def minutes(text: str) -> float:
    """A number of minutes."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"how many minutes? a positive number, such as 10; got '{text}'")
    return value


def families(text: str) -> tuple[str, ...]:
    """Names of families, or all of them."""
    if text == "all":
        return FAMILIES
    names = tuple(text.split(","))
    for name in names:
        if name not in (*FAMILIES, PUBLISHED):
            known = ", ".join((*FAMILIES, PUBLISHED))
            raise argparse.ArgumentTypeError(f"there is no family '{name}'; there are {known}, and all")
    return names


def natural(text: str) -> int:
    """A number that seeds a generator, or counts."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"a natural number is needed; got '{text}'")
    return int(text)


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """What is asked for. Exits with a message where that cannot be meant."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.attack")
    parser.add_argument("--minutes", type=minutes, help="draw from all families in turn, for so long")
    parser.add_argument("--family", type=families, help=f"all, or of {', '.join(FAMILIES)}")
    parser.add_argument("--seed", type=natural, help="default: from the clock, with --minutes; else 0")
    parser.add_argument("--processes", type=natural, default=2, help="with --minutes: so many, beside each other")
    parser.add_argument("--count", type=natural, default=100, help="models of each family, without --minutes")
    parser.add_argument("--moving", type=natural, default=0, help="integrate every so many-th model too (0: none)")
    parser.add_argument(
        "--variants", type=natural, default=0,
        help=f"of each model, so many with other numbers, by the same programs: {', '.join(SWITCHING)}",
    )  # fmt: skip
    parser.add_argument("--refusals", action="store_true", help="show what is refused, too")
    parser.add_argument("--units", choices=UNITS, default="", help="rescale the models first")
    out = parser.parse_args(given)
    if out.family is None or set(out.family) == set(FAMILIES):
        out.family = NETWORKS if out.units else FAMILIES
    if out.units and out.minutes is not None:
        parser.error("with --minutes, every family is rescaled, too: leave --units out")
    for name in out.family:
        if out.variants and (name not in SWITCHING or out.minutes is not None):
            parser.error(f"--variants is for {', '.join(SWITCHING)}, without --minutes")
        if out.units and name not in (*NETWORKS, PUBLISHED):
            parser.error(f"the family '{name}' cannot be rescaled")
    if out.seed is None:
        out.seed = 0 if out.minutes is None else int(time.time()) % 100_000
    if not out.processes:
        parser.error("at least 1 process is needed")
    if out.minutes is None and not out.count:
        parser.error("a count of at least 1 is needed")
    if PUBLISHED in out.family and out.minutes is None and not out.units:
        parser.error(f"the family '{PUBLISHED}' is its own reference: it needs --units")
    return out


def counted(family: str, given: argparse.Namespace) -> bool:
    """Judges `count` models from `seed` on, in this process. Returns whether all are right or truly refused."""
    from .judge import drop_programs
    from .timed import KEPT

    counts: dict[str, list[tuple[int, Outcome]]] = {}
    for k in range(given.count):
        seed = given.seed + k
        draw = Draw(family, seed, given.units, bool(given.moving) and seed % given.moving == 0, given.variants)
        note, found = draw.judged()
        for j, outcome in enumerate(found):
            counts.setdefault(draw.row_of(j, outcome), []).append((seed, outcome))
            if outcome.kind not in GOOD:
                which = f", variant {j}" if j and not outcome.part else ""
                print(f"  {outcome.kind}: {draw.row} {seed}{which} ({note}): {outcome.text[:400]}", flush=True)
            elif given.refusals and outcome.kind == "refused":
                print(f"  refused: {draw.row} {seed} ({note}): {outcome.text[:400]}", flush=True)
        if k % KEPT == KEPT - 1:
            drop_programs()
    for name, outcomes in sorted(counts.items()):
        print(row(name, outcomes), flush=True)
    return all(outcome.kind in GOOD for outcomes in counts.values() for _, outcome in outcomes)


def main() -> int:
    given = arguments()
    # Read by JAX when it starts: here, and in the processes that are started.
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}"
    os.environ["JAX_ENABLE_X64"] = "1"
    if given.minutes is not None:
        print(f"seed {given.seed}, {given.minutes:g} minutes", flush=True)
        drawn, tell = draws(given.family, given.seed), lambda text: print(text, flush=True)
        return 0 if attack(drawn, given.minutes, tell, given.processes, given.refusals) else 1
    print(HEAD, flush=True)
    return 0 if all([counted(family, given) for family in given.family]) else 1


if __name__ == "__main__":
    sys.exit(main())
