"""Pairs of models or runs in which only something changed that must not matter.

No right answer needs to be known. `judged(seed)` draws the model number `seed // len(LETTERS)`, and compares what is
said of it by one of the letters:

- a, process: alone in a fresh process, or after a twin that differs in one argument of one declaration;
- b, mode: eager, jit, vmap, a loop, inside a gradient, members of a batch that fail included;
- c, order: declarations and connections in any order, other names;
- d, continuation: a run that goes on from a saved state;
- e, units: all in other units, sizes from 1e-18 to 1e12;
- f, records: how they are cut, padded, repeated, ordered and put together, of linear models of their own;
- g, where the search began: values, intervals and verdicts of fits, of these models;
- h, what else is asked: an output, a derivative, an unused parameter, an unused component;
- i, solver: explicit and implicit ones, saved times, events at the ends, at saved times and at other events.
"""

from collections.abc import Callable

from ..outcome import Outcome
from . import connections, continuation, modes, points, process, records, solvers
from .said import Pairs

MOVING = 5  # every so many-th model is run, where a point would do
LETTERS: dict[str, Callable[[int], Pairs]] = {
    "a": process.process,
    "b": modes.modes,
    "c": lambda number: (
        connections.connections(number) if number % 4 == 3 else points.order(number, number % MOVING == 0)
    ),
    "d": continuation.continuation,
    "e": lambda number: points.units(number, number % MOVING == 1),
    "f": records.written,
    "g": records.begun,
    "h": lambda number: points.questions(number, number % MOVING == 2),
    "i": solvers.solvers,
}


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """What model it is, and the outcome of each pair."""
    letter = list(LETTERS)[seed % len(LETTERS)]
    pairs = LETTERS[letter](seed // len(LETTERS))
    return f"{letter}: {pairs.note}", pairs.outcomes
