"""Which modes change along with an event after which equations are singular, as where a switch closes onto a diode that
conducts: discrete values, 0 or 1, that conditions choose, are flipped until equations are regular.

Where they are singular no condition can be asked, so that sets of values are tried: what is wrong with each is
counted, the set with the least is kept, and sets are tried from there, until none is better. Parts that do not know of
each other are mended one after another. What is regular but does not hold as its conditions say goes on by events.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

# Sets that are tried from one base: each of 127 values, each pair of 15, or each triple of 9.
MOST_SETS = 128
SINGULAR = 1e6  # how much worse one value that is not finite is than conditions that do not hold


def sets_to_flip(choices: tuple[int, ...], n: int) -> np.ndarray:
    """Sets of discrete values to flip, shape (sets, n): none, each of `choices`, each pair, and so on."""
    up_to = (itertools.combinations(choices, size) for size in range(len(choices) + 1))
    sets = list(itertools.islice(itertools.chain.from_iterable(up_to), MOST_SETS))
    rows = np.zeros((len(sets), n), bool)
    for row, chosen in zip(rows, sets, strict=True):
        row[list(chosen)] = True
    return rows


class Search(NamedTuple):
    """The state of the search.

    - `tried`: the number of the set that is tried from `base`, shape (n,), the values flipped so far.
    - `wrong`: what is wrong with `base`; `best` and `least`: the best values flipped from there, and what is wrong.
    - `ends`: True if no set is better than `base`, which is looked at once more.
    """

    tried: Array
    base: Array
    wrong: Array
    best: Array
    least: Array
    ends: Array

    @classmethod
    def begin(cls, n: int, dtype: DTypeLike) -> "Search":
        none, infinite = jnp.zeros((n,), bool), jnp.full((), jnp.inf, dtype)
        return cls(jnp.array(0), none, infinite, none, infinite, jnp.array(False))

    def flipped(self, sets: Array) -> Array:
        """The values to flip in what is tried now."""
        return self.base ^ sets[self.tried]

    def after(self, sets: Array, slope: Array, guards: Array, violated: Array) -> tuple["Search", Array]:
        """(the search after the slope and the guards of what was tried, whether it has found its values: `base`)."""
        dtype = self.wrong.dtype
        # Not whether, but how many: each part that becomes regular is progress, though others are still singular.
        lost = jnp.sum(~jnp.isfinite(slope), dtype=dtype) + jnp.sum(~jnp.isfinite(guards), dtype=dtype)
        wrong = SINGULAR * lost + jnp.sum(violated, dtype=dtype)
        first, now = self.tried == 0, self.flipped(sets)
        found = jnp.where(first, (lost == 0) | self.ends, wrong == 0)
        better = wrong < self.least
        best, least = jnp.where(better, now, self.best), jnp.where(better, wrong, self.least)
        last = self.tried == len(sets) - 1
        improved = last & ~first & (least < self.wrong)
        base = jnp.where(improved | (found & ~first), jnp.where(found, now, best), self.base)
        none_better = last & ~improved
        # Set 0 flips nothing. After a better base was found it is left out, since that base has been looked at.
        tried = jnp.where(improved, min(1, len(sets) - 1), jnp.where(none_better, 0, self.tried + 1))
        infinite = jnp.full_like(least, jnp.inf)
        on = Search(
            jnp.where(found, 0, tried), base, jnp.where(first, wrong, jnp.where(improved, least, self.wrong)), best,
            jnp.where(first | improved, infinite, least), self.ends | none_better,
        )  # fmt: skip
        return on, found
