"""Starts that follow by substitution.

Where every unknown of the initial equations is alone in a row that is linear in it, with a number as its coefficient,
once those before it are known, no search is needed, whatever the values: w ← w − F(w)/coefficient sets one level of
unknowns right after the other. A pendulum whose angle is given is an example, and every mechanism that hangs from given
coordinates. All other rows follow, or contradict them, which the last steps of initialization check.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.program import PlannedStep
from ...compile.lowering.remembered import remembered
from ...compile.lowering.schedule import Step
from .rows import InitialRows


class Substitution(NamedTuple):
    """For each unknown, the row that it follows from, and its coefficient there; the number of levels of unknowns that
    do not begin at their values."""

    row: Int[np.ndarray, " n"]
    coefficient: Float[np.ndarray, " n"]
    levels: int


@remembered
def substitution(plan: SystemPlan, rows: InitialRows) -> Substitution | None:
    """The order in which unknowns follow from each other; None if they do not."""
    # Tearing variables follow from nonlinear equations, which need a search.
    if len(plan.carried):
        return None
    known = {int(q): {k: 1.0} for k, q in enumerate(plan.states)}
    started = np.array([row.quantity for row in rows.kept], np.int64)
    steps = [*plan.constraint_program.steps, *plan.reading(started).steps]
    if not all(isinstance(planned, PlannedStep) for planned in steps):
        return None
    for planned in steps:
        assert isinstance(planned, PlannedStep)
        _follow(planned.step, known)
    equations = [_sum(*terms, known) for planned in plan.constraints for terms in _terms(planned.equation)]
    starts = len(equations)
    equations += [_sum([row.quantity], [row.factor], known) for row in rows.kept]
    n = len(plan.states)
    row, coefficient, level = np.full(n, -1), np.ones(n), np.zeros(n, np.int64)
    place = {int(q): k for k, q in enumerate(plan.states)}
    for k, start in enumerate(rows.kept):
        unknown = place.get(start.quantity)
        # The first row of a state counts: values given stand before fixed starts, and these before guesses. Later ones
        # are checked like all other rows.
        if unknown is not None and row[unknown] < 0:
            row[unknown], coefficient[unknown] = starts + k, start.factor
            level[unknown] = int(rows.guess[unknown] != start)  # the search begins at guesses
    waiting, found = list(range(len(equations))), True
    while found and (row < 0).any():
        found = False
        for k in list(waiting):
            open_ = [u for u in equations[k] if row[u] < 0]
            if len(open_) > 1:
                continue
            # A row whose coefficient is zero or unknown goes too: it does not determine its unknown later either.
            waiting.remove(k)
            if open_ and np.isfinite(equations[k][open_[0]]) and equations[k][open_[0]] != 0.0:
                (u,) = open_
                row[u], coefficient[u], found = k, equations[k][u], True
                level[u] = 1 + max((int(level[v]) for v in equations[k] if v != u), default=0)
    return None if (row < 0).any() else Substitution(row, coefficient, int(level.max(initial=0)))


def _terms(group: Any) -> Iterator[tuple[list[int], list[float]]]:
    """For each instance, the quantities in its slots, and its coefficients, not-a-number where they are no numbers."""
    numbers = group.template.numbers(group.coefficient) * group.factor
    return zip(group.quantity.tolist(), numbers.tolist(), strict=True)


def _sum(quantities: list[int], numbers: list[float], known: dict[int, dict[int, float]]) -> dict[int, float]:
    """The coefficients of Σ number·quantity by unknowns."""
    found: dict[int, float] = {}
    for q, number in zip(quantities, numbers, strict=True):
        for u, c in known.get(q, {}).items():
            found[u] = found.get(u, 0.0) + number * c
    return found


def _follow(step: Step, known: dict[int, dict[int, float]]):
    """Adds how the unknowns of a step depend on those of the start."""
    for instance in range(step.n):
        own = [int(quantities[instance]) for quantities in step.unknown]
        terms = [list(_terms(equation))[instance] for equation in step.equations]
        if len(own) == 1 and len(terms) == 1:
            quantities, numbers = terms[0]
            slope = sum(c for q, c in zip(quantities, numbers, strict=True) if q == own[0])
            others = [
                (q, c / -slope if slope else np.nan) for q, c in zip(quantities, numbers, strict=True) if q != own[0]
            ]
            known[own[0]] = _sum([q for q, _ in others], [c for _, c in others], known)
        else:
            read = {u for quantities, _ in terms for q in quantities for u in known.get(q, {})}
            # A block determines its unknowns by numbers that are not known here, so a row that reads one of them gives
            # nothing.
            known |= {q: dict.fromkeys(read, np.nan) for q in own}
