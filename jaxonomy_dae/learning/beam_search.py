"""Which subset scores best, by beam search.

All subsets of one; then, from the `width` best subsets of k, all of k + 1 that contain one of them; until none of a
size is better than the best of all smaller ones, or `most` are in.
"""

from collections.abc import Callable


def beam_search(
    score: Callable[[tuple[int, ...]], float], count: int, width: int, most: int
) -> dict[tuple[int, ...], float]:
    """The scores of all subsets that were looked at, ascending tuples of 0, …, count − 1; less is better."""
    found: dict[tuple[int, ...], float] = {}
    level: list[tuple[int, ...]] = [(k,) for k in range(count)]
    while level:
        best = min(found.values(), default=float("inf"))
        scores = {subset: score(subset) for subset in level}
        found |= scores
        if len(level[0]) >= most or not min(scores.values()) < best:
            break
        beam = sorted(scores, key=lambda s: (scores[s], s))[:width]
        level = sorted({tuple(sorted((*s, k))) for s in beam for k in range(count) if k not in s})
    return found
