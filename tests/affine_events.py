"""Problems with events written by hand, in which all is affine: numbers alone tell one from another.

One compiled program runs them all, for they have one shape: w = (x, q, q before the instant, 1) with unused places
zero, the rate of each state, each guard and what each event writes a row of numbers times w.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae.solve.adjoint.ends import ending
from jaxonomy_dae.solve.adjoint.late_times import Integration
from jaxonomy_dae.solve.events.control import AtEvents
from jaxonomy_dae.solve.events.facts import EventFacts
from jaxonomy_dae.solve.events.problem import AbstractHybridProblem, HybridTerm
from jaxonomy_dae.solve.events.solver import WithEvents
from jaxonomy_dae.solve.events.start import start
from jaxonomy_dae.solve.methods.drive import integrate
from jaxonomy_dae.write.events import NO_FLAG, EventFlag

STATES, DISCRETES, CLOCKS = 4, 4, 3
ORDINARY, ENDING, IMMEDIATE = 3, 3, 4  # how many guards have no property; the places of the two that have one
RELATION = 5  # the first of two guards of one relation, the second one of what is opposite
GUARDS = 7
EVENTS = CLOCKS + GUARDS
NEVER = 1e9  # s: the period and the offset of a clock that does not tick
MAX_EVENTS = 64
Row = Mapping[str, float]  # numbers times states, discrete values, "pre …" and "1"


class Numbers(NamedTuple):
    """Everything that tells a problem from another; leaves may be differentiated."""

    x: Any  # (STATES,)
    q: Any  # (DISCRETES,)
    rates: Any  # (STATES, w)
    guards: Any  # (GUARDS, w)
    waves: Any  # (GUARDS, 3): amplitude, rad/s and phase of a sine of time that is added to a guard
    writes: Any  # (EVENTS, STATES + DISCRETES, w)
    clocks: Any  # (2, CLOCKS): periods and offsets

    def place(self, of: "Names", event: int, target: str, factor: str) -> tuple[int, int, int]:
        """Where in `writes` stands what an event adds to `target` for each unit of `factor`."""
        return event, of.targets.index(target), of.columns.index(factor)


class Names(NamedTuple):
    """What rows and columns are called."""

    targets: list[str]
    columns: list[str]


class Event(NamedTuple):
    """A guard that falls through zero, or a clock, and what it writes."""

    writes: Mapping[str, Row]
    guard: Row = {"1": 1.0}
    clock: tuple[float, float] | None = None
    wave: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ends: bool = False
    immediate: bool = False


class Relation(NamedTuple):
    """Two guards, each the other's negative: what it writes where the guard falls, and where it rises."""

    falls: Mapping[str, Row]
    rises: Mapping[str, Row]
    guard: Row


def affine(
    rates: Mapping[str, Row],
    events: Sequence[Event],
    *,
    at: Row | None = None,
    discrete: Row | None = None,
    relation: Relation | None = None,
) -> tuple[Numbers, Names]:
    """A problem from rates of states by name, events in order, and what is not zero at the start."""
    states, q = list(rates), list(discrete or {})
    x_names = states + [f"x{k}" for k in range(len(states), STATES)]
    q_names = q + [f"q{k}" for k in range(len(q), DISCRETES)]
    names = Names(x_names + q_names, [*x_names, *q_names, *(f"pre {n}" for n in q_names), "1"])
    width = len(names.columns)

    def row(numbers):
        out = np.zeros(width)
        for name, value in numbers.items():
            out[names.columns.index(name)] = value
        return out

    guards = np.stack([row({"1": 1.0})] * GUARDS)
    waves = np.zeros((GUARDS, 3))
    kept = np.stack([row({name: 1.0}) for name in names.targets])
    writes = np.stack([kept] * EVENTS)
    clocks = np.full((2, CLOCKS), NEVER)
    ticking = 0
    ordinary = 0
    for event in events:
        if event.clock is not None:
            place, ticking = ticking, ticking + 1
            clocks[:, place] = event.clock
        else:
            if event.ends or event.immediate:
                k = ENDING if event.ends else IMMEDIATE
            else:
                k, ordinary = ordinary, ordinary + 1
                assert k < ORDINARY
            guards[k], waves[k], place = row(event.guard), event.wave, CLOCKS + k
        for target, numbers in event.writes.items():
            writes[place, names.targets.index(target)] = row(numbers)
    if relation is not None:
        for k, sign, wrote in ((RELATION, 1, relation.falls), (RELATION + 1, -1, relation.rises)):
            guards[k] = sign * row(relation.guard)
            for target, numbers in wrote.items():
                writes[CLOCKS + k, names.targets.index(target)] = row(numbers)
    x = row(at or {})[:STATES]
    start_q = row(discrete or {})[STATES : STATES + DISCRETES]
    slopes = np.stack([row(rates.get(name, {})) for name in x_names])
    return Numbers(x, start_q, slopes, guards, waves, writes, clocks), names


def _flags(guard: int) -> EventFlag:
    if guard >= RELATION:
        return EventFlag.RELATION | EventFlag.REVOCABLE
    return EventFlag.LISTED | (EventFlag.AT_START if guard == IMMEDIATE else NO_FLAG)


FACTS = EventFacts(
    flags=(NO_FLAG,) * CLOCKS + tuple(map(_flags, range(GUARDS))),
    n_clocks=CLOCKS,
    ends=tuple(k == CLOCKS + ENDING for k in range(EVENTS)),
    opposite=(-1,) * RELATION + (RELATION + 1, RELATION),
)


class Affine(AbstractHybridProblem):
    numbers: Numbers
    resolution: Any
    facts: EventFacts = eqx.field(static=True, default=FACTS)

    def term(self, q):
        return diffrax.ODETerm(lambda t, x, args: self.field(t, x, q, args))

    def prepared(self, solver, q):
        return solver

    def field(self, t, x, q, args):
        return self.numbers.rates @ jnp.concatenate([x, q, q, jnp.ones((1,))])

    def guards(self, t, x, q, args):
        height, rate, phase = self.numbers.waves.T
        return self.numbers.guards @ jnp.concatenate([x, q, q, jnp.ones((1,))]) + height * jnp.sin(rate * t + phase)

    def written(self, t, x, read, q, previous, events, args):
        new = self.numbers.writes[jnp.argmax(events)] @ jnp.concatenate([read, q, previous, jnp.ones((1,))])
        return x + (new[:STATES] - read), new[STATES:]

    def settled(self, t, x, q, events, args):
        new = (self.numbers.writes @ jnp.concatenate([x, q, q, jnp.ones((1,))]))[:, STATES:]
        changes = jnp.where(events[:, None], new - q, 0.0)
        return q + jnp.sum(changes, axis=0)  # of a relation, one event only is true

    def clocks(self):
        return self.numbers.clocks[0], self.numbers.clocks[1]


class Ran(NamedTuple):
    """States and discrete values at saved times, those at the end, times of events, and Diffrax' result."""

    x: Any
    q: Any
    last: Any
    times: Any
    count: Any
    result: Any


def run(numbers: Numbers, t1: Any, ts: Any, solver: Any, adjoint: Any) -> Ran:
    """From 0 to t1, at rtol = atol = 1e-10; no host callbacks, jit it."""
    numbers = jax.tree.map(jnp.asarray, numbers)
    t0, t1 = jnp.zeros(()), jnp.asarray(t1)
    problem = Affine(numbers, 32.0 * jnp.finfo(t1.dtype).eps * t1)
    done = integrate(Integration(
        HybridTerm(problem), WithEvents(solver, MAX_EVENTS, MAX_EVENTS), t0, t1, 0.01 * t1,
        start(problem, t0, numbers.x, numbers.q, None, MAX_EVENTS, False), None,
        save=diffrax.SubSaveAt(ts=ts, fn=lambda t, y, args: (y.x, y.q)),
        controller=ending(diffrax.PIDController(rtol=1e-10, atol=1e-10), AtEvents()),
        adjoint=adjoint, max_steps=2000,
    ))  # fmt: skip
    _, last = done.last
    return Ran(*done.ys, last.x, last.table.log[:, 0], last.count, done.result._value)
