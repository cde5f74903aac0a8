"""Fixed starts that repeat or contradict each other.

A fixed start is an equation that holds at the initial time. Too many of them do no harm as long as they agree, and
whether they do usually depends on parameters, so that initialization decides. What certainly contradicts (plain
numbers) is an error here; what must agree is noted in the report.
"""

import numpy as np

from ...base.errors import StructuralError
from ...base.tolerances import MEANT_EQUAL
from ...graph.structure.dulmage_mendelsohn import dulmage_mendelsohn
from ...graph.structure.incidence import Incidence, compress
from ...graph.structure.integers import equal_rows
from ...graph.structure.matching import maximum_matching
from ..model.declared import leading_starts
from ..model.linear_template import LinearTemplate
from ..model.quantities import ReducedModel
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel
from .wording import counted, listed


def check_equal_starts(flat: FlatModel, groups: tuple[EquationGroup, ...], alias: AliasTable) -> tuple[str, ...]:
    """Compares the fixed starts of variables that are one quantity, and of those in linear equations with numbers.

    Returns notes on starts that must agree.

    **Raises:**

    - `StructuralError` if starts that are plain numbers contradict each other, or a start is fixed of what an input
        gives.
    """
    table = flat.variables
    fixed = np.flatnonzero(table.fixed)
    values = table.start.values(flat.declares.values)
    quantity = alias.root[fixed] * (1 + alias.order.max(initial=0)) + alias.order[fixed]
    _, which, count = np.unique(quantity, return_inverse=True, return_counts=True)
    special = (count[which] > 1) | (alias.root[fixed] == ZERO) | table.is_input[alias.root[fixed]]
    notes: list[str] = []
    first: dict[tuple[int, int], int] = {}
    numbers: dict[tuple[int, int], tuple[int, float]] = {}
    for v in fixed[special].tolist():
        name, start = table.names[v], table.start[v]
        assert start is not None
        # Two numbers contradict each other whatever else holds. What depends on parameters may agree, and is left to
        # the start.
        number = None if start.parameters else float(values[v])
        key, factor = (int(alias.root[v]), int(alias.order[v])), float(alias.factor[v])
        if key[0] == ZERO:
            if number:
                raise StructuralError(
                    f"the start of '{name}' is fixed at {number:g}, but the equations say that it is always zero. Free "
                    "the start (fixed=False)."
                )
            continue
        if table.is_input[key[0]]:
            raise StructuralError(
                f"the start of '{name}' is fixed, but its value comes from the input '{table.names[key[0]]}'. Free the "
                "start (fixed=False)."
            )
        if number is not None and key in numbers and not _equal(numbers[key][1], number / factor):
            w, other = numbers[key]
            ratio = factor / float(alias.factor[w])
            relation = {1.0: "are equal", -1.0: "are equal but for the sign"}.get(
                ratio, f"differ by the factor {ratio:g}"
            )
            raise StructuralError(
                f"'{table.names[w]}' and '{name}' {relation}, but their starts are fixed at "
                f"{other * float(alias.factor[w]):g} and {number:g}. Free one of them (fixed=False)."
            )
        if number is not None:
            numbers.setdefault(key, (v, number / factor))
        if key in first:
            w = first[key]
            same = factor == alias.factor[w] and table.start[w] == start
            settled = same or (key in numbers and numbers[key][0] == w and number is not None)
            pair = " and ".join(sorted((f"'{table.names[w]}'", f"'{name}'")))
            notes.append(
                f"{pair} are one quantity, and both starts are fixed: "
                + ("they agree, so one of them is enough" if settled else "they must agree; one of them is enough")
            )
        first.setdefault(key, v)
    alone = fixed[~special & table.start.is_number[fixed]]
    started = np.concatenate([alone, np.array([v for v, _ in numbers.values()], np.int64)])
    _check_linear(flat, groups, alias, started, values[started] / alias.factor[started])
    return tuple(notes)


def _equal(a: float, b: float) -> bool:
    return abs(a - b) <= MEANT_EQUAL * max(abs(a), abs(b))


def _check_linear(flat: FlatModel, groups, alias: AliasTable, started: np.ndarray, numbers: np.ndarray):
    """Equations with numeric coefficients, all of whose quantities start at fixed numbers: of the variables `started`,
    one for each quantity."""
    if len(started) < 2:
        return
    highest = 1 + alias.order[started].max()
    value, variable = np.full((len(flat.variables), highest), np.nan), np.zeros((len(flat.variables), highest), int)
    place = alias.root[started], alias.order[started]
    # By quantity, so that each equation is judged by a look-up, however many starts there are.
    value[place], variable[place] = numbers, started
    for group in groups:
        if not isinstance(group.template, LinearTemplate) or not group.variable.shape[1]:
            continue
        inside = group.order < highest
        here = np.where(inside, value[group.variable, np.where(inside, group.order, 0)], np.nan)
        terms = group.coefficient * here
        wrong = np.abs(terms.sum(axis=1)) > MEANT_EQUAL * np.abs(terms).max(axis=1)  # False for NaN
        if wrong.any():
            k = int(np.argmax(wrong))
            names = [flat.variables.names[v] for v in variable[group.variable[k], group.order[k]].tolist()]
            raise StructuralError(
                f"the fixed starts of {listed(names)} contradict the equation {group.provenance[k].located}. Free one "
                "of them (fixed=False), or give values that agree."
            )


def note_several_guesses(model: ReducedModel) -> tuple[str, ...]:
    """Notes on guesses of one quantity that differ: one of them counts, and the user should know which."""
    variables, table = model.variables, model.flat.variables
    v = np.flatnonzero(table.start.is_given & (variables.quantity >= 0))
    parameters = model.flat.declares.values
    value = table.start.values(parameters)[v] / variables.factor[v]
    repeated = np.flatnonzero(np.bincount(variables.quantity[v])[variables.quantity[v]] > 1)
    several = [repeated[members].tolist() for members in equal_rows([variables.quantity[v[repeated]]])]
    leading = set(leading_starts(model, parameters).tolist())
    notes = []
    for places in several:
        if table.fixed[v[places]].any():
            continue
        first = next(k for k in places if int(v[k]) in leading)
        others = [k for k in places if not _equal(float(value[k]), float(value[first]))]
        if others:
            guesses = [f"{table.names[v[k]]} = {value[k] * variables.factor[v[k]]:g}" for k in (first, *others)]
            notes.append(f"guesses for one quantity differ, {listed(guesses)}: the first is taken")
    return tuple(notes)


def dependent_starts(model: ReducedModel) -> tuple[str, ...]:
    """Notes on fixed starts that outnumber what they can choose: they must agree.

    The fixed starts join the extended system as equations; they depend on each other where its Dulmage–Mendelsohn
    decomposition is over-determined.
    """
    flat, extended, quantities = model.flat, model.extended, model.extended.quantities
    # One start for each quantity: those of aliases have been compared before.
    pins: dict[int, int] = {}
    for v in np.flatnonzero(flat.variables.fixed).tolist():
        q, _ = model.variables[v]
        if 0 <= q < quantities.n_unknown:
            pins.setdefault(q, v)
    pinned = np.array(list(pins), np.int64)
    owner = quantities.owner[pinned]
    if not len(pins) or (not extended.level.any() and (quantities.order[pinned] < quantities.highest[owner]).all()):
        return ()  # every fixed quantity is free to choose
    n, m = extended.n_equations, quantities.n_unknown
    wanted = np.zeros(quantities.n, bool)
    wanted[:m] = True
    pointer, columns = extended.incidence(wanted)
    rows = np.concatenate([np.repeat(np.arange(n), np.diff(pointer)), n + np.arange(len(pinned))])
    columns = np.concatenate([columns, pinned])
    pattern = Incidence(*compress(rows, columns, np.zeros_like(rows), n + len(pinned)), m)
    matched = maximum_matching(pattern.pointer, pattern.variable, m)
    over, _ = dulmage_mendelsohn(pattern, matched)
    notes = []
    for equations, inside in over:
        started = [pins[int(pinned[k - n])] for k in equations if k >= n]
        names = [flat.variables.names[v] for v in started]
        surplus = len(equations) - len(inside)
        if len(names) > 1 and len(set(flat.variables.owner[started].tolist())) == 1:
            continue  # one component's own affair: its author fixed what its author made agree
        if len(names) == 1:
            notes.append(
                f"the start of '{names[0]}' is fixed, but the equations determine it: both must agree; if not, free "
                "the start"
            )
        elif names:
            free = counted(max(len(names) - surplus, 0), "degree") + " of freedom"
            notes.append(
                f"{len(names)} starts are fixed for {free}, those of {listed(names)}: they must agree; if not, free "
                f"{surplus} of them"
            )
    return tuple(notes)
