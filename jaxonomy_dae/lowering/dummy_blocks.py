"""Where a minimal set of states determines the other variables through nonlinear equations."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from .schedule import AnyStep, Step


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
            found.extend(_blocks_of(step, start, holds))
        start += sum(len(quantities) for quantities in step.guessed)
    return tuple(found)


def _blocks_of(step: AnyStep, start: int, holds: np.ndarray) -> Iterator[DummyBlocks]:
    if isinstance(step, Step):
        # Residuals and unknowns lie one after the other, each for all instances.
        places = start + np.arange(len(step.torn) * step.n).reshape(-1, step.n).T
        places = places[holds.reshape(-1, step.n).any(axis=0)]
        yield DummyBlocks(places, places)
        return
    equation_block = np.concatenate(step.equation_block)
    for block in np.unique(step.block[holds]):
        rows, columns = np.flatnonzero(equation_block == block), np.flatnonzero(step.block == block)
        yield DummyBlocks(start + rows[None], start + columns[None])
