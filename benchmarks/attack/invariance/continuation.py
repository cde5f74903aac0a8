"""Letter d: a run in one piece, and one that goes on from a saved state."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from sympy import Symbol, sympify

from jaxonomy_dae import simulate

from .rewrite import numbers
from .said import ALONG, TOLERANCES, Pairs, Said, said, times
from .sketch import Sketch
from .subject import Subject, subject


def continuation(number: int) -> Pairs:
    """Letter d."""
    s, rng = subject(number)
    pairs = Pairs("d", s.note)
    ts = times(rng, s.end)
    names = list(s.names.values())

    def run(ts, end=s.end, initial: Any = s.initial):
        return simulate(s.system, end, ts=ts, initial=initial, inputs=s.inputs, **TOLERANCES)

    def read(solution) -> dict[str, np.ndarray]:
        return {name: np.asarray(solution[full]) for name, full in s.names.items()}

    state: dict = {}

    def first():
        state["whole"] = run(ts)
        return read(state["whole"])

    reference = said(first)
    if reference.refusal:
        # From a start of its own, the run is refused again.
        pairs.compare("refused", reference, said(first), ALONG)
        return pairs
    if s.sketch is not None and "ends" in s.note:
        return pairs  # a run that has ended does not go on
    whole = state["whole"]

    def rows(k: int) -> Said:
        return Said({n: v[k:] for n, v in reference.values.items()})

    def compare(what: str, k: int, go) -> None:
        def pair():
            found = said(lambda: {n: v[-(len(ts) - k) :] for n, v in read(go()).items()})
            pairs.compare(what, rows(k), found, 5 * ALONG, sizes=s.sizes)

        pairs.attempt(what, pair)

    def padded(k: int, t: float) -> np.ndarray:
        """The times from number `k` on, and as many before as there are in all."""
        return np.concatenate([np.full(k, t), ts[k:]])

    for k in (1, 3):
        compare(f"from row {k}", k, lambda k=k: run(padded(k, ts[k]), initial=whole.at(k)))
    places = [("the middle of the run", 0.5 * s.end)]
    if s.system.plan.events is not None:
        happened = np.asarray(whole.events.ts)
        inner = [float(t) for t in happened[np.isfinite(happened)] if 0 < t < ts[4]]
        if inner:
            places.append(("an event", inner[int(rng.integers(len(inner)))]))
    ticks = [] if s.sketch is None else ticks_of(s.sketch)
    if ticks:
        places.append(("a tick", ticks[int(rng.integers(len(ticks)))]))
    if s.inputs:
        places.append(("a sample", 0.5 * s.end))
    for what, t in places:
        k = int(np.searchsorted(ts, t))

        def go(t=t, k=k):
            half = run(np.append(np.minimum(ts[:-1], t), t), end=t)
            return run(padded(k, t), initial=half.at(-1))

        compare(f"a run to {what}, and on", k, go)
    if number % 3 == 0:
        _in_a_loop(pairs, s, ts, names, reference)
    return pairs


def ticks_of(sketch: Sketch) -> list[float]:
    """Instants inside a run at which clocks tick."""
    values = {Symbol(n): v for n, v in numbers(sketch).items()}
    found = []
    for event in (e for part in sketch.parts for e in part.events if e.period is not None):
        period, offset = (float(sympify(v).xreplace(values)) for v in (event.period, event.offset))
        found += (offset + period * np.arange(1, int((sketch.end - offset) / period))).tolist()
    return found


def _in_a_loop(pairs: Pairs, s: Subject, ts: np.ndarray, names: list[str], reference: Said) -> None:
    """From saved time to saved time, in a scan that carries the state."""

    def pair():
        def step(state, end):
            solution = simulate(s.system, end, ts=jnp.stack([end]), initial=state, inputs=s.inputs, **TOLERANCES)
            return solution.at(-1), jnp.stack([solution[n][-1] for n in names])

        @jax.jit
        def run(ts):
            begin = simulate(s.system, ts[0], ts=ts[:1], initial=s.initial, inputs=s.inputs, **TOLERANCES).at(-1)
            return jax.lax.scan(step, begin, ts[1:])[1]

        rows = np.asarray(run(jnp.asarray(ts))).T
        there = Said({n: v[1:] for n, v in reference.values.items()})
        pairs.compare("in a scan", there, Said(dict(zip(s.names, rows, strict=True))), 5 * ALONG, sizes=s.sizes)

    pairs.attempt("in a scan", pair)
