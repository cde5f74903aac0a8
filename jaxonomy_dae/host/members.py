"""Members of a batch: whether `jax.vmap` is at work, and outside of jit, where values can be read, members by
number."""

import math
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ..base.aliases import Numeric, PyTree
from ..base.errors import SimulationError
from .staging import layers, trace_of

SHOWN = 8  # members that a sentence lists


def is_batched(tree: PyTree) -> bool:
    """True if `jax.vmap` is at work on a leaf."""
    return any(hasattr(layer, "batch_dim") for leaf in jax.tree.leaves(tree) for layer in layers(leaf))


def batch_size(tree: PyTree) -> int:
    """How many members `jax.vmap` computes at once, as far as the leaves show it; 1 outside of batches.

    In `jax.vmap(jax.jit(f))` it cannot be seen from inside f.
    """
    # Of each `jax.vmap` once: in a grid by two of them, one leaf may show the one and another leaf the other.
    sizes = {trace_of(layer): _mapped(layer) for leaf in jax.tree.leaves(tree) for layer in layers(leaf)}
    return math.prod(sizes.values())


def _mapped(layer: Any) -> int:
    axis = getattr(layer, "batch_dim", None)  # of a BatchTracer
    return layer.val.shape[axis] if isinstance(axis, int) else 1


def values_of_members(leaf: Any) -> np.ndarray:
    """The values of a leaf without a shape of its own, one for each member: an axis for each `jax.vmap` around it, the
    outermost first."""
    *around, values = layers(leaf)
    # The last layer is of the outermost `jax.vmap`, and its axis counts among those of all others: it goes first.
    axes = [layer.batch_dim for layer in around if getattr(layer, "batch_dim", None) is not None]
    values = np.asarray(values)
    for place, axis in enumerate(reversed(axes)):
        values = np.moveaxis(values, place + axis, place)
    return values


def numbered(chosen: np.ndarray) -> str:
    """The numbers of the members for which `chosen` is true: "member 1", "members 0, 3 and 7 of 100"."""
    places = np.argwhere(chosen).tolist()
    shown = [str(p[0]) if len(p) == 1 else str(tuple(p)) for p in places[:SHOWN]]
    if len(places) > SHOWN:
        listed = ", ".join(shown) + f" and {len(places) - SHOWN} more"
    else:
        listed = ", ".join(shown[:-1]) + (" and " if len(shown) > 1 else "") + shown[-1]
    return f"member{'s' if len(places) > 1 else ''} {listed} of {' by '.join(map(str, chosen.shape))}"


def failed_members(codes: Numeric, texts: Sequence[str]) -> str:
    """The members of a batch for which `codes` is not zero, in sentences; "" if there is none. `texts` explains the
    codes 1, 2, …"""
    values = values_of_members(codes)
    found = [f"{numbered(values == k)}: {text}" for k, text in enumerate(texts, start=1) if (values == k).any()]
    if not found:
        return ""
    return f"under jax.vmap, {'; '.join(found)}"


def say_of_members(
    codes: Numeric, texts: Sequence[str], what: str, hint: str, throw: bool | None, stacklevel: int
) -> None:
    """Says which runs of a batch outside of jit failed (`what` they are): in an error if it is asked for, otherwise in
    a warning, none if `throw` is False."""
    found = "" if throw is False else failed_members(codes, texts)
    text = f"{what} {found}. Their rows are not-a-number{hint}"
    if found and throw:
        raise SimulationError(text)
    if found:
        warnings.warn(text, RuntimeWarning, stacklevel=stacklevel + 1)
