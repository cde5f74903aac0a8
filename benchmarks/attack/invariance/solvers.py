"""Letter i: Tsit5, Rodas5P, BDF; other saved times; events at the start, at the end, at saved times, at others."""

from typing import Any

import diffrax
import numpy as np

from jaxonomy_dae import simulate
from jaxonomy_dae.solvers import BDF, Rodas5P

from .rewrite import numbers
from .said import ALONG, TOLERANCES, Pairs, Said, said, times
from .sketch import Sketch
from .subject import Subject, subject

SOLVERS = {"Tsit5": diffrax.Tsit5, "Rodas5P": Rodas5P, "BDF": BDF}
LOOSE = 1e-4  # of a variable's size: what a solver of low order may be off
BESIDE = 1e-9  # of the end: a time that is as good as another


def solvers(number: int) -> Pairs:
    """Letter i."""
    s, rng = subject(number)
    pairs = Pairs("i", s.note)
    ts = times(rng, s.end)

    def run(ts, end=s.end, values=s.values[0], **options):
        system = s.system.with_parameters(values) if values else s.system
        return simulate(system, end, ts=ts, initial=s.initial, inputs=s.inputs, **TOLERANCES, **options)

    def read(solution) -> dict[str, np.ndarray]:
        return {name: np.asarray(solution[full]) for name, full in s.names.items()}

    logged: list[float] = []

    def first():
        solution = run(ts)
        if s.system.plan.events is not None:
            found = np.asarray(solution.events.ts)
            logged.extend(found[np.isfinite(found)].tolist())
        return read(solution)

    reference = said(first)
    for name in rng.permutation(list(SOLVERS))[: 1 if number % 2 else 2]:

        def pair(name=name):
            found = said(lambda: read(run(ts, solver=SOLVERS[str(name)]())))
            pairs.compare(str(name), reference, found, LOOSE if name == "BDF" else 10 * ALONG, sizes=s.sizes)

        pairs.attempt(str(name), pair)
    if reference.refusal:
        return pairs
    _saved_times(pairs, s, rng, ts, reference, logged, run, read)
    if s.sketch is not None:
        _placed(pairs, s, s.sketch, ts, logged, run, read)
    return pairs


def _rows(values: Said, rows: Any) -> Said:
    return Said({name: v[rows] for name, v in values.values.items()})


def _saved_times(pairs: Pairs, s: Subject, rng, ts, reference: Said, logged, run, read) -> None:
    """Other times among those that stay, and times at which something happens."""
    keep = [1, 3, 5]
    others = ts.copy()
    others[[0, 2, 4]] = [rng.uniform(0, ts[1]), rng.uniform(ts[1], ts[3]), rng.uniform(ts[3], ts[5])]

    def moved():
        found = said(lambda: read(run(others)))
        pairs.compare("other saved times", _rows(reference, keep), _rows(found, keep), ALONG, sizes=s.sizes)

    def ends():
        # The first and the last instant are saved as well, and one is saved twice.
        given = np.array([0.0, ts[1], ts[1], ts[3], ts[3] * (1 + 1e-15), s.end])
        found = said(lambda: read(run(given)))
        pairs.compare("saved at both ends, and twice", _rows(reference, [1, 1, 3, 5]),
                      _rows(found, [1, 2, 3, 5]), ALONG, sizes=s.sizes)  # fmt: skip

    pairs.attempt("other saved times", moved)
    pairs.attempt("saved at both ends", ends)
    inner = [t for t in logged if 0 < t < s.end][:3]
    if inner and "ends" not in s.note:  # at the instant that ends a run, a row is there or not
        on = np.sort(np.concatenate([inner, ts[len(inner) :]]))
        after = np.where(np.isin(on, inner), on + BESIDE * s.end, on)

        def at_events():
            a, b = said(lambda: read(run(on))), said(lambda: read(run(after)))
            pairs.compare("saved at events", b, a, 10 * ALONG, sizes=s.sizes)
            rows = np.flatnonzero(np.isin(on, ts))
            original = _rows(reference, np.flatnonzero(np.isin(ts, on)))
            pairs.compare("others saved at events", original, _rows(a, rows), ALONG, sizes=s.sizes)

        pairs.attempt("saved at events", at_events)
        first = inner[-1]

        def ends_at_event():
            given = np.minimum(ts, first)
            given[-1] = first
            a = said(lambda: read(run(given, end=first)))
            b = said(lambda: read(run(np.append(given[:-1], first), end=s.end)))
            pairs.compare("ends at an event", _rows(b, slice(-1)), _rows(a, slice(-1)), ALONG, sizes=s.sizes)

        pairs.attempt("ends at an event", ends_at_event)


def _placed(pairs: Pairs, s: Subject, sketch: Sketch, ts, logged, run, read) -> None:
    """A dose at a given time, put where something else is."""
    full = sketch.names()
    for name in (n for n in numbers(sketch) if n.startswith("te")):
        _dose(pairs, s, full[name], numbers(sketch)[name], ts, logged, run, read)


def _dose(pairs: Pairs, s: Subject, name: str, own: float, ts, logged, run, read) -> None:
    def at(te: float) -> Said:
        return said(lambda: read(run(ts, values={**s.values[0], name: te})))

    others = [t for t in logged if abs(t - own) > 1e-6 * s.end]
    places = {"a saved time": ts[2], "the end": s.end, **({"another event": others[0]} if others else {})}
    for what, te in places.items():

        def pair(what=what, te=te):
            beside = te - BESIDE * s.end if what != "another event" else te + BESIDE * s.end
            pairs.compare(f"an event at {what}", at(beside), at(te), 10 * ALONG, sizes=s.sizes)

        pairs.attempt(f"an event at {what}", pair)
    # At the start, `>=` holds already: nothing happens, as where the time has passed.
    pairs.attempt(
        "an event at the start",
        lambda: pairs.compare("an event at the start", at(-1.0), at(0.0), ALONG, sizes=s.sizes),
    )
