"""What is known of a model's events before a run."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from ...write.events import EventFlag


@dataclasses.dataclass(frozen=True)
class DelayFacts:
    """What is known of delayed quantities before a run.

    - `clocks`: the number of the event of each, which happens where a break of the past comes out of the delay.
    - `begins`: the place of the discrete value that this event sets to zero: 1 while a break waits for it.
    - `constant`: whether each delay is constant.
    - `passes`: for each source, which delayed quantities it follows algebraically, so that a jump of them is one of it.
    """

    clocks: tuple[int, ...]
    begins: tuple[int, ...]
    constant: tuple[bool, ...]
    passes: tuple[tuple[bool, ...], ...]


@dataclasses.dataclass(frozen=True)
class EventFacts:
    """What is known of events before a run: sampled events come first, `n_clocks` of them, then those of conditions.

    - `flags`: the kinds of each event; `ends`: which events end the run.
    - `opposite`: for each guard of a relation, the number of the guard that turns it the other way; −1 for others.
    - `choices`: discrete values, 0 or 1, that are chosen by conditions, which hold while the guards `choice_guards` are
      not negative.
    - `only_kinks`: whether all events are relations at which neither dx/dt nor guards jump.
    - `contested`: (event, place) for each place that several events may write with different values; places are those
      of (x, q) in one array, those of q counted from its end, −1 the last.
    - `delays`: of the delayed quantities; None if there are none.
    """

    flags: tuple[EventFlag, ...]
    n_clocks: int
    ends: tuple[bool, ...]
    opposite: tuple[int, ...]
    choices: tuple[int, ...] = ()
    choice_guards: tuple[int, ...] = ()
    only_kinks: bool = False
    contested: tuple[tuple[int, int], ...] = ()
    delays: DelayFacts | None = None

    @property
    def n_guards(self) -> int:
        """How many events have a condition that is monitored."""
        return len(self.flags) - self.n_clocks

    def are(self, kinds: EventFlag) -> Bool[np.ndarray, " events"]:
        """Which events are of a kind, or of one of several."""
        return np.array([bool(kinds & flags) for flags in self.flags], bool)

    @property
    def true_at_zero(self) -> Bool[np.ndarray, " guards"]:
        """The guards whose conditions hold where they are zero: those that are not strict, but for those that choose a
        mode, of which two are zero at once."""
        strict, relations, revocable = map(self.are, (EventFlag.STRICT, EventFlag.RELATION, EventFlag.REVOCABLE))
        return (~strict & (relations | ~revocable))[self.n_clocks :]
