"""What is true of an event beside its condition and its actions."""

import enum


class EventFlag(enum.Flag):
    """Kinds of events; an event may be of several.

    - `LISTED`: it is counted and listed; one that is not only says that equations change.
    - `AT_START`: it happens at the initial time, too, if its condition holds there.
    - `REVOCABLE`: another event at the same instant may make its condition false before it happens; it does not happen
      then.
    - `RELATION`: it says what the relation of a hidden discrete variable is, from the initial time on.
    - `KINK`: equations go on with the same values where it happens; only their derivatives jump.
    - `STRICT`: its condition is false where its guard is zero.
    - `STRIKE`: it closes a contact, at once with others that close at the same instant.
    """

    LISTED = enum.auto()
    AT_START = enum.auto()
    REVOCABLE = enum.auto()
    RELATION = enum.auto()
    KINK = enum.auto()
    STRICT = enum.auto()
    STRIKE = enum.auto()


NO_FLAG = EventFlag(0)
