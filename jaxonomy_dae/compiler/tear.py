"""Tearing: which unknowns of a simultaneous block must be guessed so that the others follow one by one.

Given, for each equation of a block, the unknowns it contains and those it can safely be solved for, returns the order
in which equations give unknowns, the tearing variables, and the equations that remain as residuals: a greedy choice in
the manner of Cellier & Kofman (2006).
"""

from collections.abc import Sequence
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
    open_equations = set(range(n))
    unknown = set(range(n))
    sequence: list[tuple[int, int]] = []
    tearing: list[int] = []

    def settle(u: int):
        unknown.discard(u)
        for remaining in left:
            remaining.discard(u)

    def next_assignment() -> tuple[int, int] | None:
        for e in sorted(open_equations):
            if len(left[e]) == 1:
                (u,) = left[e]
                if u in solvable[e]:
                    return e, u
        return None

    while unknown:
        found = next_assignment()
        if found is not None:
            e, u = found
            open_equations.discard(e)
            sequence.append((e, u))
            settle(u)
            continue

        def gain(u: int) -> tuple[int, int, int]:
            opened = sum(
                1 for e in open_equations if u in left[e] and len(left[e]) == 2 and left[e] - {u} <= solvable[e]
            )
            return opened, sum(1 for e in open_equations if u in left[e]), -u

        u = max(sorted(unknown), key=gain)
        tearing.append(u)
        settle(u)
    return Tearing(tuple(sequence), tuple(tearing), tuple(sorted(open_equations)))
