"""Tearing: which unknowns of a simultaneous block must be guessed so that the others follow one by one.

Given, for each equation of a block, the unknowns it contains and those it can safely be solved for, returns the order
in which equations give unknowns, the tearing variables, and the equations that remain as residuals: a greedy choice in
the manner of Cellier & Kofman (2006).

A sequence of assignments can lose what a solution of the whole block would keep: along a chain of resistors it marches
through an elliptic problem, and errors grow with every link. Given the sizes of the entries, an assignment is
therefore taken only while the growth of what is known stays bounded.
"""

import dataclasses
import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

# An error in a tearing variable may grow so much along the sequence, in equilibrated units.
GROWTH = 100.0
# An unknown may follow by so many links whose growth depends on parameters or on the state. These may change after the
# choice was made.
LINKS = 1
EQUILIBRATIONS = 4  # passes: entries need only be alike to a factor that is small beside GROWTH


class Tearing(NamedTuple):
    """`sequence` lists (equation, unknown) in order; residuals are as many as tearing variables."""

    sequence: tuple[tuple[int, int], ...]
    tearing: tuple[int, ...]
    residuals: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class BlockSizes:
    """The sizes of the entries of blocks of one pattern, by (equation, unknown), over the blocks: shape (blocks,).

    Those in `numbers` are plain numbers, the same in all blocks and for all parameters.
    """

    entries: Mapping[tuple[int, int], np.ndarray]
    numbers: frozenset[tuple[int, int]]

    def equilibrated(self) -> "BlockSizes":
        """Rows and columns scaled to a largest entry near 1 (Ruiz 2001)."""
        places = list(self.entries)
        size = np.stack([self.entries[place] for place in places])
        rows, columns = (np.array(index) for index in zip(*places, strict=True))
        for k in range(EQUILIBRATIONS):
            # The first pass scales fully, rows and then columns: blocks that differ in units alone come out nearly
            # equal. The square root of the others keeps rows and columns from undoing each other (Ruiz 2001).
            power = 1.0 if k == 0 else 0.5
            for index in (rows, columns):
                largest = np.zeros((int(index.max()) + 1, size.shape[1]))
                np.maximum.at(largest, index, size)
                size = size / np.where(largest > 0, largest, 1.0)[index] ** power
        return BlockSizes(dict(zip(places, size, strict=True)), self.numbers)


class _Growth:
    """Bounds of the unknowns of a sequence relative to the tearing variables, and the number of links between them."""

    def __init__(self, sizes: BlockSizes):
        self.raw, self.scaled = sizes.entries, sizes.equilibrated().entries
        self.numbers = sizes.numbers
        blocks = next(iter(self.raw.values())).shape
        self.one = np.ones(blocks)
        self.growth: dict[int, np.ndarray] = {}
        self.links: dict[int, int] = {}

    def allows(self, e: int, u: int, known: Iterable[int]) -> bool:
        """True if equation e may give the unknown u; its growth and links are then kept."""
        pivot = self.scaled[e, u]
        total, links = 0.0 * self.one, 0
        for v in known:
            total = total + self.scaled[e, v] * self.growth.get(v, self.one)
            links = max(links, self.links.get(v, 0) + self._depends(e, v, u))
        with np.errstate(divide="ignore", invalid="ignore"):
            # An unknown is as far off as its terms are together, and never less than a tearing variable: growth that
            # shrinks along one branch may not pay for a pivot that is too small on the next.
            growth = np.maximum(total / pivot, 1.0)
        if not (growth <= GROWTH).all() or links > LINKS:
            return False
        self.growth[u], self.links[u] = growth, links
        return True

    def _depends(self, e: int, v: int, u: int) -> bool:
        # A ratio of plain numbers up to one cannot grow errors, whatever the parameters become. Every other link may:
        # the order of elimination is chosen once, and a ladder of 1 Ω resistors may get values over eight decades
        # afterwards.
        fixed = (e, v) in self.numbers and (e, u) in self.numbers
        return not (fixed and (self.raw[e, v] <= self.raw[e, u]).all())


def tear(
    contains: Sequence[frozenset[int]], solvable: Sequence[frozenset[int]], sizes: BlockSizes | None = None
) -> Tearing:
    """Tears one block, or blocks of one pattern; with `sizes`, growth is bounded."""
    n = len(contains)
    growing = None if sizes is None else _Growth(sizes)
    left: list[set[int]] = [set(c) for c in contains]
    solvable = list(solvable)
    equations_of: list[list[int]] = [[] for _ in range(n)]
    for e, unknowns in enumerate(contains):
        for u in sorted(unknowns):
            equations_of[u].append(e)
    is_open = [True] * n
    is_unknown = [True] * n
    count = [len(e) for e in equations_of]  # open equations that contain an unknown …
    opened = [0] * n  # … and those of them that it would leave with one solvable unknown
    ready = [e for e in range(n) if _is_ready(left[e], solvable[e])]  # a heap
    # Entries that are out of date stay in the heap and are skipped when they come up. To look at all unknowns for each
    # tearing variable would take quadratic time.
    best: list[tuple[int, int, int]] = []  # a heap of (−opened, −count, unknown), some out of date
    sequence: list[tuple[int, int]] = []
    tearing: list[int] = []

    def tally(e: int, change: int):
        """Adds or takes away what equation e contributes to `opened`."""
        if is_open[e] and len(left[e]) == 2:
            a, b = left[e]
            opened[a] += change * (b in solvable[e])
            opened[b] += change * (a in solvable[e])

    def rank(unknowns: Iterable[int]):
        for u in unknowns:
            if is_unknown[u]:
                heapq.heappush(best, (-opened[u], -count[u], u))

    def settle(u: int, closed: int | None):
        """u is known from now on; `closed` is the equation that gave it."""
        is_unknown[u] = False
        touched: set[int] = set()
        for e in equations_of[u]:
            tally(e, -1)
            left[e].discard(u)
            if e == closed:
                is_open[e] = False
            elif is_open[e]:
                tally(e, 1)
                if len(left[e]) <= 2:
                    touched |= left[e]
                if _is_ready(left[e], solvable[e]):
                    heapq.heappush(ready, e)
        rank(touched)

    for e in range(n):
        tally(e, 1)
    rank(range(n))
    remaining = n
    while remaining:
        closed = None
        if ready:
            e = heapq.heappop(ready)
            if not is_open[e] or not _is_ready(left[e], solvable[e]):
                continue
            (u,) = left[e]
            if growing is not None and not growing.allows(e, u, contains[e] - {u}):
                # The equation is not used for this unknown any more and becomes a residual, unless another unknown is
                # left in it.
                solvable[e] = solvable[e] - {u}
                continue
            closed = e
            sequence.append((e, u))
        else:
            lost, seen, u = heapq.heappop(best)
            if not is_unknown[u] or (-lost, -seen) != (opened[u], count[u]):
                continue
            tearing.append(u)
        settle(u, closed)
        remaining -= 1
    return Tearing(tuple(sequence), tuple(tearing), tuple(e for e in range(n) if is_open[e]))


def _is_ready(left: set[int], solvable: frozenset[int]) -> bool:
    return len(left) == 1 and next(iter(left)) in solvable
