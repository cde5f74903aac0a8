"""The delayed quantities of a flattened model."""

import dataclasses

import numpy as np

from .starts import Start


@dataclasses.dataclass(frozen=True)
class DelayTable:
    """The delayed quantities of a model, in the order of declaration.

    - `text`: their names; `source`: the variables that they repeat, `instant`: those that are the times at which they
        are read, shape (delays,).
    - `read`: the places among the discrete variables of those by which equations read the past, shape (delays, 5):
        `Delay.begins`, `base`, `value`, `rate`, `bend`.
    - `longest`: the longest delay of each, in parameters; `constant`: whether it is always that.
    """

    text: tuple[str, ...]
    source: np.ndarray
    instant: np.ndarray
    read: np.ndarray
    longest: tuple[Start, ...]
    constant: tuple[bool, ...]

    def __len__(self):
        return len(self.text)


_NONE = np.zeros(0, np.int64)
NO_DELAYS = DelayTable((), _NONE, _NONE, np.zeros((0, 5), np.int64), (), ())
