"""Tearing: which unknowns of a simultaneous block must be guessed so that the others follow one by one.

Given, for each equation of a block, the unknowns it contains and those it can safely be solved for, returns the order
in which equations give unknowns, the tearing variables, and the equations that remain as residuals: a greedy choice in
the manner of Cellier & Kofman (2006).
"""

import heapq
from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Tearing(NamedTuple):
    """`sequence` lists (equation, unknown) in order; residuals are as many as tearing variables."""

    sequence: tuple[tuple[int, int], ...]
    tearing: tuple[int, ...]
    residuals: tuple[int, ...]


def tear(contains: Sequence[frozenset[int]], solvable: Sequence[frozenset[int]]) -> Tearing:
    """Tears one block."""
    n = len(contains)
    left: list[set[int]] = [set(c) for c in contains]
    equations_of: list[list[int]] = [[] for _ in range(n)]
    for e, unknowns in enumerate(contains):
        for u in sorted(unknowns):
            equations_of[u].append(e)
    is_open = [True] * n
    is_unknown = [True] * n
    count = [len(e) for e in equations_of]  # open equations that contain an unknown …
    opened = [0] * n  # … and those of them that it would leave with one solvable unknown
    ready = [e for e in range(n) if _is_ready(left[e], solvable[e])]  # a heap
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
            closed = e
            (u,) = left[e]
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
