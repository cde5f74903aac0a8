"""Whether records held all steps of their runs: told to the program that goes back over them.

A record has room for some hundred steps. Of a longer run it holds the last ones, and the derivative takes the others
again, from points kept on the way: the steps stand in its program a second time for that. Outside of jit, this program
is compiled when the run is done. If its record is whole, nothing is left to be taken again: half of the program.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MARK = jnp.uint16  # the type of `flag`, by which it is found among what a pullback needs; nothing else has it
# True while a program is traced that goes back over whole records. JAX's caches know it.
RECORDS_ARE_WHOLE: Any = jax.make_user_context(False)


def flag(is_whole: Any) -> Any:
    """What a solve hands to its derivative, so that `are_whole` finds it."""
    return is_whole.astype(MARK)


def are_whole(leaves: Sequence[Any]) -> bool:
    """True if the known arrays that a pullback needs have such flags, and all of them are set."""
    flags = [np.asarray(leaf) for leaf in leaves if leaf.dtype == MARK]
    return bool(flags) and all(np.all(one == 1) for one in flags)
