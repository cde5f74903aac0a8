"""Maximum bipartite matching of rows with columns.

Given a sparse pattern, returns for every row the column it is matched with, −1 if none: the greedy rule of Karp and
Sipser (1981), then augmenting paths by depth-first search with look-ahead (Duff 1981). Near-linear on models,
where SciPy's Hopcroft–Karp can take exponential time (a grid of 50 × 50 heat capacitors). Deterministic: ties go to the
first.
"""

import dataclasses

import numpy as np

from .integers import ranges

# Pairs that a round of array operations must find: it takes 0.1 ms, in which 50 are found one by one. In small patterns
# all are.
MANY = 1000


def maximum_matching(pointer: np.ndarray, columns: np.ndarray, n_columns: int) -> np.ndarray:
    """The matched column of every row of a pattern in compressed rows."""
    n_rows = len(pointer) - 1
    row_match, taken = np.full(n_rows, -1, np.int64), np.zeros(n_columns, bool)
    # In a model most pairs are forced, since most equations name or connect something. Array operations take these in
    # rounds. The search one by one, in lists, is for what they leave.
    if n_rows >= MANY:
        _match_forced(pointer, columns, row_match, taken)
    left, open_ = np.flatnonzero(row_match < 0), np.flatnonzero(~taken)
    if len(left) == n_rows:
        return _one_by_one(pointer, columns, n_columns)
    if len(left):
        place, number = ranges(pointer[left], np.diff(pointer)[left]), np.cumsum(~taken) - 1
        row = np.repeat(np.arange(len(left)), np.diff(pointer)[left])
        free = ~taken[columns[place]]
        start = np.append(0, np.cumsum(np.bincount(row[free], minlength=len(left))))
        found = _one_by_one(start, number[columns[place[free]]], len(open_))
        row_match[left[found >= 0]] = open_[found[found >= 0]]
    return row_match


@dataclasses.dataclass(frozen=True)
class _Side:
    """The rows of a pattern, or its columns: where the neighbours of each begin, and, of those that are not matched,
    their number and the sum of their numbers."""

    start: np.ndarray
    neighbours: np.ndarray
    degree: np.ndarray
    total: np.ndarray

    @classmethod
    def of(cls, start: np.ndarray, neighbours: np.ndarray) -> "_Side":
        # The sum of the neighbours' numbers is kept because it is the last neighbour itself once the degree is one:
        # nothing has to be searched for.
        degree, running = np.diff(start), np.append(0, np.cumsum(neighbours))
        return cls(start, neighbours, degree, running[start[1:]] - running[start[:-1]])

    def lone(self, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Those of `near` that have one neighbour, and these neighbours, each once."""
        # Two vertices may have the same last neighbour. `np.unique` gives it to the first of them, so that ties do not
        # depend on chance.
        near = near[self.degree[near] == 1]
        neighbours, first = np.unique(self.total[near], return_index=True)
        return near[first], neighbours

    def without(self, gone: np.ndarray, other: "_Side") -> np.ndarray:
        """Takes vertices of the other side away, and returns their neighbours."""
        count = other.start[gone + 1] - other.start[gone]
        touched = other.neighbours[ranges(other.start[gone], count)]
        np.subtract.at(self.degree, touched, 1)
        np.subtract.at(self.total, touched, np.repeat(gone, count))
        return touched


def _match_forced(pointer: np.ndarray, columns: np.ndarray, row_match: np.ndarray, taken: np.ndarray):
    """Matches all rows and columns that have one neighbour left, in rounds, as long as many are found."""
    n_rows, n_columns = len(row_match), len(taken)
    by = np.argsort(columns, kind="stable")
    column_start = np.append(0, np.cumsum(np.bincount(columns, minlength=n_columns)))
    rows = _Side.of(pointer, columns)
    cols = _Side.of(column_start, np.repeat(np.arange(n_rows), np.diff(pointer))[by])
    near_rows, near_columns = np.arange(n_rows), np.arange(n_columns)
    while True:
        c, r = cols.lone(near_columns[~taken[near_columns]])
        row_match[r], taken[c], found = c, True, len(r)
        near_rows, near_columns = np.append(near_rows, rows.without(c, cols)), cols.without(r, rows)
        r, c = rows.lone(near_rows[row_match[near_rows] < 0])
        row_match[r], taken[c], found = c, True, found + len(r)
        near_rows, near_columns = rows.without(c, cols), np.append(near_columns, cols.without(r, rows))
        if found < MANY:
            return


def _one_by_one(pointer: np.ndarray, columns: np.ndarray, n_columns: int) -> np.ndarray:
    """As `maximum_matching`, in lists."""
    n_rows = len(pointer) - 1
    order = np.argsort(columns, kind="stable")
    rows_of_entries = np.repeat(np.arange(n_rows), np.diff(pointer))
    by_column = rows_of_entries[order].tolist()
    column_pointer = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=n_columns))]).tolist()
    start, column = pointer.tolist(), columns.tolist()
    row_match, column_match = [-1] * n_rows, [-1] * n_columns
    _karp_sipser(start, column, column_pointer, by_column, row_match, column_match)
    _augment_all(start, column, row_match, column_match)
    return np.array(row_match, np.int64)


def match_in_order(pointer: np.ndarray, columns: np.ndarray, n_columns: int, first: int) -> np.ndarray:
    """A matching with priorities: as many of the `first` rows as possible, then each later row, in order, that can be
    matched beside all before it. Returns the column of each row, −1 if unmatched."""
    row_match = np.full(len(pointer) - 1, -1)
    # An augmenting path never frees a row that is matched. So the rows that come first keep their places whatever is
    # matched after them.
    row_match[:first] = maximum_matching(pointer[: first + 1], columns[: pointer[first]], n_columns)
    matched = row_match >= 0
    column_match = np.full(n_columns, -1)
    column_match[row_match[matched]] = np.flatnonzero(matched)
    if matched.all():
        return row_match
    found, taken = row_match.tolist(), column_match.tolist()
    _augment_all(pointer.tolist(), columns.tolist(), found, taken)
    return np.array(found, np.int64)


def _karp_sipser(start, column, column_pointer, by_column, row_match, column_match):
    """Matches vertices of degree one first: such a pair is part of some maximum matching."""
    n_rows, n_columns = len(row_match), len(column_match)
    row_degree = [start[r + 1] - start[r] for r in range(n_rows)]
    column_degree = [column_pointer[c + 1] - column_pointer[c] for c in range(n_columns)]
    # A stack in reversed order, so that the first vertex is taken first.
    # Vertices of degree one: rows as they are, columns after them.
    ready = [n_rows + c for c in reversed(range(n_columns)) if column_degree[c] == 1]
    ready += [r for r in reversed(range(n_rows)) if row_degree[r] == 1]

    def settle(r: int, c: int):
        row_match[r], column_match[c] = c, r
        for k in range(start[r], start[r + 1]):
            other = column[k]
            column_degree[other] -= 1
            if column_degree[other] == 1 and column_match[other] == -1:
                ready.append(n_rows + other)
        for k in range(column_pointer[c], column_pointer[c + 1]):
            other = by_column[k]
            row_degree[other] -= 1
            if row_degree[other] == 1 and row_match[other] == -1:
                ready.append(other)

    following = 0
    while True:
        while ready:
            vertex = ready.pop()
            if vertex < n_rows:
                if row_match[vertex] == -1:
                    for k in range(start[vertex], start[vertex + 1]):
                        if column_match[column[k]] == -1:
                            settle(vertex, column[k])
                            break
            elif column_match[vertex - n_rows] == -1:
                c = vertex - n_rows
                for k in range(column_pointer[c], column_pointer[c + 1]):
                    if row_match[by_column[k]] == -1:
                        settle(by_column[k], c)
                        break
        while following < n_rows and row_match[following] != -1:
            following += 1
        if following == n_rows:
            return
        free = [column[k] for k in range(start[following], start[following + 1]) if column_match[column[k]] == -1]
        if free:
            settle(following, min(free, key=lambda c: (column_degree[c], c)))
        following += 1


def _augment_all(start, column, row_match, column_match):
    """Augmenting paths for the rows left over, without recursion."""
    seen = [False] * len(column_match)
    ahead = list(start[:-1])  # look-ahead: columns before this place have been matched
    for root in range(len(row_match)):
        if row_match[root] != -1:
            continue
        visited: list[int] = []
        came_from: dict[int, int] = {}
        stack = [root]
        place = {root: start[root]}
        found = -1
        while stack:
            r = stack[-1]
            while ahead[r] < start[r + 1] and column_match[column[ahead[r]]] != -1:
                ahead[r] += 1
            if ahead[r] < start[r + 1]:
                found = column[ahead[r]]
                came_from[found] = r
                break
            k, end = place[r], start[r + 1]
            while k < end and seen[column[k]]:
                k += 1
            if k == end:
                place[r] = end
                stack.pop()
                continue
            c = column[k]
            place[r] = k + 1
            seen[c] = True
            visited.append(c)
            came_from[c] = r
            following = column_match[c]
            place.setdefault(following, start[following])
            stack.append(following)
        if found == -1:
            continue  # what a failed search has seen stays seen: no path leads through it any more
        c = found
        while True:
            r = came_from[c]
            previous = row_match[r]
            row_match[r], column_match[c] = c, r
            if r == root:
                break
            c = previous
        for c in visited:
            seen[c] = False
