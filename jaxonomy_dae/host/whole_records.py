"""Which records held all steps of their runs: told to the program that goes back over them.

A record has room for some hundred steps. Of a longer run it holds the last ones, and the derivative takes the others
again, from points kept on the way: the steps stand in its program a second time for that. Outside of jit, this program
is compiled when the run is done. Where a record is whole, nothing is left to be taken again: half of the program.

The solves of a program are numbered as they are traced. A solve hands on a flag whose length is its number, so that
what is said of one solve is not taken for another: under `jax.checkpoint`, a solve has no flag at all.
"""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MARK = jnp.uint16  # the type of flags, by which they are found among what a pullback needs
SET = 0xA5C3  # a flag that is set; any number will do that no array of a user's consists of
# While a program is traced that goes back: the numbers of the solves whose records are whole. JAX's caches know it.
WHOLE: Any = jax.make_user_context(())
_NUMBERS: ContextVar[Iterator[int]] = ContextVar("numbers of the solves")


@contextmanager
def numbered() -> Iterator[None]:
    """Numbers the solves that are traced within it, from 1 on."""
    token = _NUMBERS.set(itertools.count(1))
    try:
        yield
    finally:
        _NUMBERS.reset(token)


def flag(is_whole: Any) -> Any:
    """What a solve hands to its derivative, so that `whole_records` finds it."""
    number = next(_NUMBERS.get(iter((1,))))
    return jnp.where(is_whole, jnp.full((number,), SET, MARK), jnp.zeros((number,), MARK))


def whole_records(leaves: Sequence[Any]) -> tuple[int, ...]:
    """The solves whose flags are among the known arrays that a pullback needs, and are all set."""
    flags = [np.asarray(leaf) for leaf in leaves if leaf.dtype == MARK and leaf.ndim]
    unset = {one.shape[-1] for one in flags if not np.all(one == SET)}
    return tuple(sorted({one.shape[-1] for one in flags} - unset))


def is_known_to_be_whole(flag: Any) -> bool:
    """True if the program that is traced was told that the solve with this flag has a whole record."""
    return flag.shape[-1] in WHOLE.value
