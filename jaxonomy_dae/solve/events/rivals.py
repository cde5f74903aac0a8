"""Events of one instant that write the same: nothing says which value counts, unless they agree."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from .facts import EventFacts


class Rivals(NamedTuple):
    """The places of (x, q) that several events write, and the events that write each, shape (events, places)."""

    places: tuple[int, ...]
    writers: np.ndarray

    @classmethod
    def of(cls, facts: EventFacts) -> "Rivals":
        """The rivals among the events."""
        places = tuple(dict.fromkeys(place for _, place in facts.contested))
        writers = np.zeros((len(facts.flags) + 1, len(places)), bool)  # the last row is that of no event
        for event, place in facts.contested:
            writers[event, places.index(place)] = True
        return cls(places, writers)

    @property
    def nobody(self) -> Array:
        """The state before any event: −1 for each place."""
        return jnp.full((len(self.places),), -1)

    def after(self, event: Array, before: Array, now: Array, wrote: Array) -> tuple[Array, Array]:
        """Returns (a number below −1 if the event wrote another value than one before it in the same round, otherwise
        −1; which event wrote each place last). `before` and `now` are (x, q) around the event.

        Values that agree in half of their digits are equal: states are projected onto constraints in between.
        """
        places = np.array(self.places)
        was, value = before[places], now[places]
        own = jnp.asarray(self.writers)[event]
        differ = jnp.abs(value - was) > jnp.sqrt(jnp.finfo(value.dtype).eps) * jnp.maximum(jnp.abs(value), jnp.abs(was))
        clash = own & (wrote >= 0) & differ
        first = wrote[jnp.argmax(clash)]
        return jnp.where(jnp.any(clash), number_of(first, event, len(self.writers)), -1), jnp.where(own, event, wrote)


def number_of(first: Array, second: Array, n: int) -> Array:
    """One number, below −1, for a pair of n events."""
    return -2 - (first * n + second)


def pair_of(number: int, n: int) -> tuple[int, int]:
    """The pair for which `number_of` stands."""
    return divmod(-2 - number, n)
