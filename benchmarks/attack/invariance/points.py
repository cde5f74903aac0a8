"""Letters c, e and h: order and names, units, and what else is asked for. Compared at a point, and sometimes along a
run."""

import numpy as np

from .rewrite import ASKED, asked, in_units, random_units, renamed, reordered
from .said import ALONG, POINT, Pairs, Said, along, at_start, compiled, inputs_of, said, times, variables_of
from .sketch import Sketch
from .stranger import drawn


def both(sketch: Sketch, names: dict[str, str], ts: np.ndarray | None, scale: float = 1.0) -> tuple[Said, Said]:
    """What is said of a sketch at its start and along a run, by names; the run's times divided by `scale`."""
    state: dict = {}

    def start():
        state["system"] = compiled(sketch)
        return at_start(state["system"], {n: f for n, f in names.items() if f in state["system"].variables})

    first = said(start)
    if ts is None or "system" not in state:
        return first, first
    return first, said(lambda: along(state["system"], names, ts / scale, sketch.end, inputs_of(sketch)))


def sketch_of(number: int) -> tuple[Sketch, np.random.Generator]:
    """The model of a number, and what draws go on from."""
    rng = np.random.default_rng([number, 21])
    return drawn(number, rng), rng


def order(number: int, moving: bool) -> Pairs:
    """Letter c."""
    sketch, rng = sketch_of(number)
    pairs = Pairs("c", sketch.note)
    ts = times(rng, sketch.end) if moving else None
    names = variables_of(sketch)
    start, run = both(sketch, names, ts)
    writings = {"reordered": (reordered(sketch, rng), {n: n for n in names})}
    writings["renamed"] = renamed(sketch, rng)
    again, to = renamed(reordered(sketch, rng), rng)
    writings["both"] = again, to
    for what, (other, to) in writings.items():

        def pair(what=what, other=other, to=to):
            full = variables_of(other)
            there, moved = both(other, {n: full[to[n]] for n in names}, ts)
            pairs.compare(f"{what}, start", start, there, POINT, sizes=sketch.sizes)
            if ts is not None and not start.refusal:
                pairs.compare(f"{what}, run", run, moved, ALONG, sizes=sketch.sizes)

        pairs.attempt(what, pair)
    return pairs


def units(number: int, moving: bool) -> Pairs:
    """Letter e."""
    sketch, rng = sketch_of(number)
    pairs = Pairs("e", sketch.note)
    ts = times(rng, sketch.end) if moving else None
    names = variables_of(sketch)
    start, run = both(sketch, names, ts)
    for what, low, high, nominal in (
        ("units, with nominal", -12, 9, True),
        ("units", -9, 9, False),
        ("small", 6, 18, False),  # values of 1e-18 to 1e-6
        ("small, with nominal", 6, 18, True),
        ("large", -12, -6, number % 2 == 0),
    ):

        def pair(what=what, low=low, high=high, nominal=nominal):
            chosen = random_units(rng, sketch, low, high, time=bool(rng.random() < 0.5))
            other = in_units(sketch, chosen, rng, nominal)
            scales = dict(chosen.factor) | {f"{n}'": chosen.factor[n] / chosen.time for n in names}
            there, moved = both(other, names, ts, chosen.time)
            pairs.compare(f"{what}, start", start, there, POINT, scales=scales, sizes=sketch.sizes)
            if ts is not None and not start.refusal and nominal:
                pairs.compare(f"{what}, run", run, moved, ALONG, scales=scales, sizes=sketch.sizes)

        pairs.attempt(what, pair)
    return pairs


def questions(number: int, moving: bool) -> Pairs:
    """Letter h."""
    sketch, rng = sketch_of(number)
    pairs = Pairs("h", sketch.note)
    ts = times(rng, sketch.end) if moving else None
    names = variables_of(sketch)
    start, run = both(sketch, names, ts)
    for what in ASKED:

        def pair(what=what):
            there, moved = both(asked(sketch, rng, what), names, ts)
            pairs.compare(f"{what}, start", start, there, POINT, sizes=sketch.sizes)
            if ts is not None and not start.refusal:
                pairs.compare(f"{what}, run", run, moved, ALONG, sizes=sketch.sizes)

        pairs.attempt(what, pair)
    return pairs
