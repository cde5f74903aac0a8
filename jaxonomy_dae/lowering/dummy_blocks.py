"""Where a minimal set of states determines the other variables through nonlinear equations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .schedule import AnyStep


class DummyBlocks(NamedTuple):
    """n nonlinear blocks of m equations that determine dummy derivatives.

    `rows` and `columns`, shape (n, m), are places in the residuals g of all nonlinear blocks and in their unknowns z.
    """

    rows: np.ndarray
    columns: np.ndarray


def dummy_blocks(steps: Sequence[AnyStep], dummies: np.ndarray) -> tuple[DummyBlocks, ...]:
    """The nonlinear blocks that determine `dummies`, quantities that a minimal set of states leaves out."""
    found: list[DummyBlocks] = []
    start = 0
    for step in steps:
        if not step.carried:
            continue
        holds = np.isin(np.concatenate(step.unknown), dummies)
        if holds.any():
            found.extend(DummyBlocks(start + rows, start + columns) for rows, columns in step.blocks_of(holds))
        start += sum(len(quantities) for quantities in step.guessed)
    return tuple(found)
