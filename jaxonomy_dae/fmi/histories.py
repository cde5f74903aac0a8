"""The discrete state of a foreign FMU as a number.

An FMU hides its discrete variables; it can only be led to where it was: started, and through the events that happened.
So its discrete state is a history: the one with which it begins, number 0, or an event at a point after another
history. Equal histories have equal numbers, so that a run that is evaluated anew, as a rejected step or a reverse sweep
does, comes to the same ones. States that FMUs save are a cache: without them, events are repeated from the start.

`Histories` brings instances of an FMU to a history. Members of a batch, and parameters that differences move, have
instances of their own, as many as are allowed.
"""

import collections
import dataclasses
from collections.abc import Callable

import numpy as np

from ..base.errors import ModelError
from .described import Described
from .instance import Instance

SAVED = 256  # states that an instance keeps
NUDGE = 32.0  # spacings of floating-point numbers at the time of an event: the first attempt to get beyond it
FARTHEST = 1e-3  # in units of the time: the last attempt

Parameters = tuple[float, ...]


@dataclasses.dataclass(eq=False)
class Event:
    """An event after the history `parent`, at a point: an indicator, by its number, gets a `sign`, true for positive;
    None at the start, and where its time has come. `aside` is a point beyond it, from which differences are taken: the
    event happens for all parameters and states next to those given, too."""

    parent: int
    parameters: Parameters
    t: float
    x: np.ndarray
    u: np.ndarray
    sign: tuple[int, bool] | None
    aside: tuple[float, np.ndarray] | None = None


class _Held:
    """An instance, the history it is at, and the states that it has saved, by parameters, history and kind."""

    def __init__(self, instance: Instance):
        self.instance = instance
        self.at: tuple[Parameters, int, bool] | None = None
        self.saved: collections.OrderedDict[tuple[Parameters, int, bool], tuple] = collections.OrderedDict()


class Histories:
    """The histories of an FMU, and at most `most` instances of it."""

    def __init__(self, described: Described, new: Callable[[], Instance], most: int):
        self._described, self._new, self._most = described, new, 1 if described.only_once else most
        self._events: list[Event | None] = [None]
        self._numbers: dict[tuple, int] = {}
        self._inputs = np.array([described.start(n) for n in described.inputs])
        self._held: list[_Held] = []  # the one used last comes last

    def number(self, event: Event) -> int:
        """The number of the history that ends with this event."""
        key = event.parent, event.parameters, event.t, event.x.tobytes(), event.u.tobytes(), event.sign
        if key not in self._numbers:
            self._numbers[key] = len(self._events)
            self._events.append(event)
        return self._numbers[key]

    def event(self, number: int) -> Event:
        """The last event of a history."""
        found = self._events[number] if number < len(self._events) else None
        if found is None:
            raise ModelError(
                f"{self._described.where}there is no event {number} of this FMU: a state that was saved is used with "
                "another component, or in another process"
            )
        return found

    def at(self, parameters: Parameters, number: int, aside: bool = False) -> Instance:
        """An instance with this history in continuous time. With `aside`, its events happened at the points aside."""
        key = parameters, number, aside
        for held in reversed(self._held):
            if held.at == key:
                return self._used(held)
        for held in reversed(self._held):
            if key in held.saved:
                held.instance.restore(held.saved[key])
                held.saved.move_to_end(key)
                held.at = key
                return self._used(held)
        held = next((h for h in self._held if h.at is not None and h.at[::2] == (parameters, aside)), None)
        if held is None and len(self._held) >= self._most:
            held = self._held[0]
        if held is None:
            held = _Held(self._new())
            self._held.append(held)
        self._lead(held, key)
        return self._used(held)

    def tried(self, parameters: Parameters, parent: int, t: float, x: np.ndarray, u: np.ndarray) -> Instance:
        """An instance after an event at this very point, which is not kept."""
        instance = self.at(parameters, parent, aside=True)
        instance.place(t, x, u)
        instance.happen()
        self._held[-1].at = None
        return instance

    def started(self, parameters: Parameters, t: float, u: np.ndarray) -> np.ndarray:
        """The states with which the FMU starts at t, with these inputs."""
        instance = self.at(parameters, 0)
        self._held[-1].at = None
        instance.start(parameters, t, u)
        return instance.after

    def forget_instances(self) -> None:
        """Takes new instances from now on: one that has failed must not be called again."""
        self._held.clear()

    def _used(self, held: _Held) -> Instance:
        self._held.remove(held)
        self._held.append(held)
        return held.instance

    def _lead(self, held: _Held, key: tuple[Parameters, int, bool]) -> None:
        """Leads an instance to a history, from the last one on the way to it that it is at or has saved."""
        parameters, number, aside = key
        way: list[int] = []
        while number:
            here = parameters, number, aside
            if held.at == here:
                break
            if here in held.saved:
                held.instance.restore(held.saved[here])
                break
            way.append(number)
            number = self.event(number).parent
        held.at = None  # until all has gone well
        if not number:
            first = self.event(way[-1]) if way else None
            t, u = (0.0, self._inputs) if first is None else (first.t, first.u)
            held.instance.start(parameters, t, u)
        for number in reversed(way):
            event = self.event(number)
            self._happen(held, event, (parameters, number, aside))
        held.at = key

    def _happen(self, held: _Held, event: Event, key: tuple[Parameters, int, bool]) -> None:
        instance = held.instance
        if not event.parent:
            t, x = event.t, event.x
        elif event.aside and key[-1]:
            t, x = event.aside
        else:
            t, x = beyond(instance, event, self.event(event.parent).t)
        instance.place(t, x, event.u)
        instance.happen()
        if self._described.saves_states:
            held.saved[key] = instance.save()
            if len(held.saved) > SAVED:
                instance.forget(held.saved.popitem(last=False)[1])


def signs(instance: Instance, t: float, x: np.ndarray, u: np.ndarray) -> tuple[bool, ...]:
    """Which indicators are positive at a point, and whether a time event is due."""
    instance.place(t, x, u)
    return (*map(bool, instance.indicators() > 0), instance.is_due(t))


def beyond(instance: Instance, event: Event, earliest: float) -> tuple[float, np.ndarray]:
    """The point of an event, or one on the way of the states beyond it, not before `earliest`. An FMU acts where it
    sees that an indicator has changed its sign, or that the time has come, and a run ends where rounding leaves this
    open."""
    t, x, due = event.t, event.x, instance.update.due
    instance.place(t, x, event.u)
    slope = instance.values()[: len(x)]
    step = max(earliest - t, 0.0)
    if event.sign is None:
        step = max(step, due - t) if due is not None and instance.is_due(t) else step
        return t + step, x + step * slope
    k, positive = event.sign
    least = NUDGE * np.finfo(float).eps * max(abs(t), np.finfo(float).eps)  # at t = 0, too, more than zero
    while step <= FARTHEST * max(abs(t), 1.0):
        there = t + step, x + step * slope
        if signs(instance, *there, event.u)[k] == positive:
            return there
        step = max(2 * step, least)
    return t, x  # where the map of events looks at what does not happen
