"""Repetitions in the schedule: a chain of assignments has as many levels as links, and its steps repeat.

Given the steps in order, finds runs in which the same few steps follow each other many times and read the same places
relative to themselves, or what was known before the run. Such a run is lowered to one loop (`jax.lax.scan`) over its
repetitions, so that the traced program does not grow with the length of the chain.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..model.tables import ZERO
from .schedule import AnyStep, Step

LEAST = 8  # repetitions
LONGEST = 64  # steps that repeat
BACK = 4  # repetitions that may be looked back
TRIAL = 32  # repetitions looked at before a whole run is


@dataclasses.dataclass(frozen=True)
class Loop:
    """A run of `count` repetitions of the steps in `body` (as they are in the first).

    A read is a place in the concatenation of all outside slots of the body, by step, equation, slot and instance.
    """

    body: tuple[Step, ...]
    count: int
    reads: np.ndarray  # (count, reads): quantities
    back: np.ndarray  # (reads,): how many repetitions back the quantity was computed; −1: known before the run
    source: np.ndarray  # (reads, 3): by which step of the body, as which unknown, in which instance
    parameters: np.ndarray  # (count, parameters)
    unknown: tuple[tuple[np.ndarray, ...], ...]  # of every step of the body, its unknowns, each (count, n)


def find_loops(steps: Sequence[AnyStep], n_quantities: int) -> list[AnyStep | Loop]:
    """The steps, with runs of repetitions in place of their steps."""
    n = len(steps)
    if n < 2 * LEAST:
        return list(steps)
    names: dict[tuple, int] = {}
    shape = np.array([names.setdefault(_shape(step, k), len(names)) for k, step in enumerate(steps)])
    if n - len(names) < LEAST:
        return list(steps)
    source = np.full((n_quantities + 1, 3), -1, np.int64)  # the last entry is the constant zero
    for k, step in enumerate(steps):
        for u, quantities in enumerate(step.unknown):
            source[quantities] = np.stack(np.broadcast_arrays(k, u, np.arange(len(quantities))), axis=1)
    runs = [_run_lengths(shape[:-p] == shape[p:]) for p in range(1, min(LONGEST, n // LEAST) + 1)]
    out: list[AnyStep | Loop] = []
    k = 0
    while k < n:
        found = None
        # The shortest period first: a repetition of two links is also one of four, with a body twice as long to
        # compile.
        for period, run in enumerate(runs, start=1):
            count = 1 + int(run[k]) // period if k < len(run) else 1
            if count >= LEAST:
                # A run of equal shapes need not be one of equal reads. To look at all of it for each period would take
                # quadratic time on a chain in which none fits.
                found = _loop(steps, k, period, min(count, TRIAL), source)
                if found is not None and count > TRIAL:
                    found = _loop(steps, k, period, count, source)
                if found is not None:
                    break
        out.append(steps[k] if found is None else found)
        k += 1 if found is None else found.count * len(found.body)
    return out


def _shape(step: AnyStep, number: int) -> tuple:
    """A key that is equal for steps that are repetitions of each other."""
    # Unknowns that are carried lie in the state array, each at a place of its own, and whole systems are loops already.
    if not isinstance(step, Step) or step.carried:
        return (number,)
    return (
        step.n,
        step.tearing,
        *(
            (e.template.key, e.local, e.factor.tobytes() + (e.quantity == ZERO).tobytes(), e.coefficient.tobytes())
            for e in step.equations
        ),
    )


def _run_lengths(true: np.ndarray) -> np.ndarray:
    """For each entry, the number of entries from it on that are true without a break."""
    n = len(true)
    last = np.where(true, n, np.arange(n))
    return np.minimum.accumulate(last[::-1])[::-1] - np.arange(n)


def _reads(step: Step) -> np.ndarray:
    return np.concatenate([e.outside.T.ravel() for e in step.equations])


def _loop(steps: Sequence[AnyStep], start: int, period: int, count: int, source: np.ndarray) -> Loop | None:
    """The longest run that begins at `start`, of at most `count` repetitions; None if there are too few."""
    own = steps[start : start + period * count]
    chosen: list[Step] = [s for s in own if isinstance(s, Step)]
    reads = np.stack([np.concatenate([_reads(s) for s in chosen[k * period : (k + 1) * period]]) for k in range(count)])
    if not reads.shape[1]:
        return None
    where = source[reads]  # (count, reads, 3)
    back = -((where[0, :, 0] - start) // period)
    follows = np.ones(reads.shape, bool)
    follows[1:] = (where[1:, :, 0] - where[:-1, :, 0] == period) & (where[1:, :, 1:] == where[:-1, :, 1:]).all(axis=2)
    follows = np.logical_and.accumulate(follows, axis=0) & (where[0, :, 0] >= 0) & (back <= BACK)
    known = np.logical_and.accumulate(where[:, :, 0] < start, axis=0)
    # Every read must either move along with the repetitions or have been known before the run: an array of inputs of
    # the scan holds those.
    holds = (follows | known).all(axis=1)
    count = count if holds.all() else int(np.argmin(holds))
    if count < LEAST:
        return None
    place = np.stack([(where[0, :, 0] - start) % period, where[0, :, 1], where[0, :, 2]], axis=1)
    repetitions = [chosen[k * period : (k + 1) * period] for k in range(count)]
    body = repetitions[0]
    parameters = np.stack([np.concatenate([e.parameter.ravel() for s in r for e in s.equations]) for r in repetitions])
    unknown = tuple(
        tuple(np.stack([r[p].unknown[u] for r in repetitions]) for u in range(len(step.unknown)))
        for p, step in enumerate(body)
    )
    back = np.where(follows[count - 1], back, -1)
    return Loop(tuple(body), count, reads[:count], back, place, parameters, unknown)
