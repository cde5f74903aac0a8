"""Left null vectors of sparse matrices by elimination: of fractions, of numbers with their roundings, of functions.

Coefficients of highest derivatives are mostly small numbers, ±1 in connections and differences. There nothing needs to
be judged: a row that becomes empty is a combination of others, whatever the size of the block. Rows and columns with
few entries are eliminated first (Markowitz 1957), so a ring or a chain takes as many operations as it has equations.
In other units, coefficients are rounded: a number that may be zero is left out.
"""

import heapq
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

Row = dict[int, Any]  # of numbers of one field: Any, as no type says that two are of the same


def null_vectors(
    rows: Sequence[Row], one: Any = Fraction(1), is_weak: Callable[[Any], bool] = lambda value: False
) -> list[Row]:
    """Vectors w ≠ 0 with Σ wᵢ·rowᵢ = 0, by number of the row: those that the elimination finds, as many as there are
    redundant rows, fewest entries first.

    **Arguments:**

    - `rows`: entries other than zero by column. A field is what has +, −, ·, / and is false where it is zero.
    - `one`: that of the field.
    - `is_weak`: for numbers by which a division is best avoided.
    """
    empty, operations = _eliminated([dict(row) for row in rows], is_weak)
    found = [_combination(row, operations, one) for row in empty]
    return sorted(found, key=lambda w: (len(w), sorted(w)))


def _eliminated(rows: list[Row], is_weak: Callable[[Any], bool]) -> tuple[list[int], list[tuple[int, int, Any]]]:
    """The rows that become empty; and the operations row −= factor·pivot, as (row, pivot, factor), in order."""
    members: dict[int, set[int]] = {}
    for i, row in enumerate(rows):
        for c in row:
            members.setdefault(c, set()).add(i)
    shortest = [(len(row), i) for i, row in enumerate(rows)]
    heapq.heapify(shortest)
    empty, operations, done = [], [], [False] * len(rows)
    while shortest:
        length, i = heapq.heappop(shortest)
        if done[i] or length != len(rows[i]):
            continue  # it has changed since
        done[i] = True
        pivot = rows[i]
        if not pivot:
            empty.append(i)
            continue
        # The column with the fewest entries, so that little fills in, and the first among equals: weights must not
        # depend on the order of a set.
        column = min(pivot, key=lambda c: (is_weak(pivot[c]), len(members[c]), c))
        for c in pivot:
            members[c].discard(i)
        for k in sorted(members[column]):
            factor = rows[k][column] / pivot[column]
            operations.append((k, i, factor))
            for c, value in pivot.items():
                change = factor * value
                left = rows[k][c] - change if c in rows[k] else -change
                # The pivot's column is dropped by position, not by value: in numbers with roundings, something might be
                # left of it.
                if left and c != column:
                    rows[k][c] = left
                    members[c].add(k)
                else:
                    rows[k].pop(c, None)
                    members[c].discard(k)
            heapq.heappush(shortest, (len(rows[k]), k))
    return sorted(empty), operations


def _combination(row: int, operations: Sequence[tuple[int, int, Any]], one: Any) -> Row:
    """The weights of the original rows in a reduced row: undoes `operations`, the last one first."""
    weights: Row = {row: one}
    for k, i, factor in reversed(operations):
        if k in weights:
            change = factor * weights[k]
            weights[i] = weights[i] - change if i in weights else -change
    return {i: w for i, w in weights.items() if w}
