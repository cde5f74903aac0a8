"""The events of a flattened model, and the constraints that come and go with them."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from ...write.events import EventFlag
from .starts import Start


@dataclasses.dataclass(frozen=True)
class Write:
    """What one action of an event writes: the variable `state`, or the discrete variable at the place `discrete` among
    them; the other one is −1. The value is that of the variable `value`, or the number `constant` if that is −1."""

    state: int
    discrete: int
    value: int
    constant: float


@dataclasses.dataclass(frozen=True)
class Event:
    """One event: it happens where the variable `guard` falls through zero, or, with a clock (period, offset), at
    instants that are known; `guard` is −1 then. A period of None is that of an event that happens once.

    `owner` is the component that declares it, `condition` what the user wrote, `message` that with which it ends the
    run.
    """

    owner: str
    condition: str
    guard: int
    clock: tuple[Start | None, Start] | None
    message: str | None
    flags: EventFlag
    writes: tuple[Write, ...]

    @property
    def text(self) -> str:
        """The event as messages name it."""
        return f"{self.owner}: when({self.condition})"


@dataclasses.dataclass(frozen=True)
class EventTable:
    """The events of a model, sampled ones first. What they write has one row for each action: `event`, `state`,
    `discrete`, `value` and `constant` are columns of all actions."""

    events: tuple[Event, ...] = ()
    left_alone: tuple[str, ...] = ()  # the parts of equations with relations that are no events

    def __len__(self):
        return len(self.events)

    def take(self, events: Sequence[int]) -> "EventTable":
        """The table with these events, in this order, sampled ones first."""
        return EventTable(tuple(self.events[e] for e in events), self.left_alone)

    def are(self, kinds: EventFlag) -> np.ndarray:
        """Which events are of a kind, or of one of several; shape (events,)."""
        return np.array([bool(kinds & event.flags) for event in self.events], bool)

    @functools.cached_property
    def n_clocks(self) -> int:
        """How many events are sampled."""
        return sum(event.clock is not None for event in self.events)

    @property
    def ends(self) -> np.ndarray:
        """Which events end the run, shape (events,)."""
        return np.array([event.message is not None for event in self.events], bool)

    @functools.cached_property
    def text(self) -> tuple[str, ...]:
        """The events as messages name them."""
        return tuple(event.text for event in self.events)

    @functools.cached_property
    def guard(self) -> np.ndarray:
        """The variable of each event that falls through zero, −1 for sampled ones; shape (events,)."""
        return np.array([event.guard for event in self.events], np.int64)

    @functools.cached_property
    def _writes(self) -> list[Write]:
        return [write for event in self.events for write in event.writes]

    @functools.cached_property
    def event(self) -> np.ndarray:
        """The event of each action, shape (actions,)."""
        return np.repeat(np.arange(len(self)), [len(event.writes) for event in self.events]).astype(np.int64)

    @functools.cached_property
    def state(self) -> np.ndarray:
        """The variable that each action starts anew, or −1; shape (actions,)."""
        return np.array([write.state for write in self._writes], np.int64)

    @functools.cached_property
    def discrete(self) -> np.ndarray:
        """The place, among the discrete variables, of the one that each action assigns, or −1; shape (actions,)."""
        return np.array([write.discrete for write in self._writes], np.int64)

    @functools.cached_property
    def value(self) -> np.ndarray:
        """The variable that has the value of each action, −1 where it is a number; shape (actions,)."""
        return np.array([write.value for write in self._writes], np.int64)

    @functools.cached_property
    def constant(self) -> np.ndarray:
        """The number that each action writes, where it writes one; shape (actions,)."""
        return np.array([write.constant for write in self._writes], float)


NO_EVENTS = EventTable()


@dataclasses.dataclass(frozen=True)
class HeldTable:
    """The branches of `either` that are differentiated: constraints that come and go with modes."""

    text: tuple[str, ...]  # of each
    active: np.ndarray  # (held,): the variable that is 1 while it holds, and 0 otherwise
    impulse: np.ndarray  # (held,): index of the discrete variable that is 1 while the impulse acts
    rate: np.ndarray  # (held,): index of the discrete variable that is added to its highest derivative: zero
    force: np.ndarray  # (held,): the variable that is never negative, or −1
    closed: np.ndarray  # (held,): the place among the discrete variables of the one that lets go at 0, or −1
    level: np.ndarray  # (levels,): the variables that are zero while they hold …
    owner: np.ndarray  # (levels,): … each with its constraint, the highest derivative of a constraint last

    def __len__(self):
        return len(self.text)


NONE_HELD = HeldTable((), *(np.zeros(0, np.int64),) * 7)
