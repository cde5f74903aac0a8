"""Matplotlib axes for figures of data, fits and what is known of them (extra `plot`)."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from ..base.errors import ModelError, nearest
from ..base.optional import Axes, pyplot

AxesGiven: TypeAlias = Axes | Sequence[Axes] | np.ndarray | None  # an array of axes, or None: new ones

LEGEND = 8  # up to this many entries, a legend is drawn


def grid_of_axes(axes: AxesGiven, rows: int, columns: int, what: str, share: str = "col") -> np.ndarray:
    """Axes of shape (rows, columns): those given, or new ones that share their times."""
    if axes is None:
        size = (min(3.2 * columns + 3.0, 14.0), 2.3 * rows + 0.9)
        return pyplot().subplots(rows, columns, figsize=size, sharex=share, squeeze=False, layout="constrained")[1]
    found = np.asarray(axes, object)
    if found.size != rows * columns:
        raise ModelError(f"{what} needs {rows} × {columns} axes; got {found.size}")
    return found.reshape(rows, columns)


def chosen_names(given: str | Sequence[str] | None, known: Sequence[str], what: str) -> list[str]:
    """The names that were given, or all of those known."""
    if given is None:
        return list(known)
    chosen = [given] if isinstance(given, str) else list(given)
    for name in chosen:
        if name not in known:
            raise ModelError(f"plot: there are no {what} '{name}': " + nearest(name, known))
    return chosen
