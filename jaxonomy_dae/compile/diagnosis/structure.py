"""Structural diagnosis: which part of a model has too many equations, and which too few.

What has a name is said by that name (`recognise`). For anything else, the Dulmage–Mendelsohn decomposition of the
incidence isolates the parts concerned: equations that compete for the same variables, and variables that share too few
equations.
"""

import numpy as np

from ...base.errors import StructuralError
from ...graph.structure.dulmage_mendelsohn import dulmage_mendelsohn
from ...graph.structure.incidence import Incidence
from ...graph.structure.matching import maximum_matching
from ..model.entries import incidence
from ..model.provenance import Provenance
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel, provenance_of
from .balance import more_than_owed, sets_input_of_child, short_of_equations
from .recognise import recognise
from .redundant_constraints import too_many
from .wording import counted, itemised, listed

PARTS = 4  # faults that an error explains


def check_structure(
    flat: FlatModel,
    groups: tuple[EquationGroup, ...],
    alias: AliasTable,
    pattern: Incidence,
    unknown: np.ndarray,
    matching: np.ndarray,
) -> None:
    """Raises a `StructuralError` in user names if the model is certainly singular.

    `groups` and `alias` are those after alias elimination; `unknown` lists the variable behind each column of the
    incidence `pattern`; `matching` gives some of the equations an unknown each, perhaps all. After the check, every
    equation can be matched with an unknown of its own.
    """
    # Faults that have a name first: the decomposition finds them, too, but can only list equations and variables.
    found = recognise(flat, groups, alias)
    if found.texts:
        raise StructuralError(_joined(found.texts, found.more))
    matched = matching
    if (matched < 0).any():
        matched = maximum_matching(pattern.pointer, pattern.variable, pattern.n_variables)
    taken = np.zeros(pattern.n_variables, bool)
    taken[matched[matched >= 0]] = True
    if (matched >= 0).all() and taken.all() and not found.equations:
        return
    over, under = dulmage_mendelsohn(pattern, matched)
    if found.equations:
        texts = []
        for rows, variables in found.equations:
            if not len(variables):
                text = provenance_of(flat.groups, int(rows[0]))
                texts.append(
                    f"this equation contains no unknown: {text.located}. Remove it, or declare its input as a variable."
                )
                continue
            names = [flat.variables.names[v] for v in variables if not flat.variables.is_port[v]]
            names = names or [flat.variables.names[v] for v in variables]
            texts.append(_too_many(flat, [provenance_of(flat.groups, int(r)) for r in rows], len(variables), names))
    else:
        texts = []
        for rows, columns in over:
            if not len(columns):
                continue
            mechanical = too_many(
                flat,
                alias,
                [provenance_of(groups, int(r)) for r in rows],
                np.flatnonzero(np.isin(alias.root, unknown[columns])),
            )
            if mechanical:
                texts.append(mechanical)
                # Flows that redundant constraints leave open are the same fault: they are not reported as missing
                # equations too.
                under = [one for one in under if not _only_through(flat, np.isin(alias.root, unknown[one[1]]))]
                continue
            # Columns are roots of alias classes, which may have a name that the user never wrote.
            best = _best(flat, alias, unknown, columns).tolist()
            texts.append(_too_many(flat, *_with_multiples(flat, alias, rows, groups, columns, best)))
        empty = [provenance_of(groups, int(rows[0])) for rows, columns in over if not len(columns)]
        texts += _repeated(flat, empty) if empty else []
    texts += [
        _too_few(flat, len(rows), _best(flat, alias, unknown, columns), np.isin(alias.root, unknown[columns]))
        for rows, columns in under
    ]
    raise StructuralError(_joined(texts, found.more))


# --- what to say -------------------------------------------------------------------------------------------------


def _joined(texts: list[str], unseen: int = 0) -> str:
    unseen += max(len(texts) - PARTS, 0)
    if len(texts) == 1 and not unseen:
        return texts[0]
    more = [f"- … and {unseen} more."] if unseen else []
    return "\n".join(["the equations do not fit together:", *(f"- {t}" for t in texts[:PARTS]), *more])


def _too_many(flat: FlatModel, equations: list[Provenance], n_unknowns: int, names: list[str]) -> str:
    known = sets_input_of_child(flat, equations) or more_than_owed(flat, equations)
    if known:
        return known
    n = len(equations)
    if n > n_unknowns:
        lines = [
            f"{counted(n, 'equation')} determine only {counted(n_unknowns, 'unknown')}, {listed(names)}. "
            f"Remove {counted(n - n_unknowns, 'equation') if n - n_unknowns > 1 else 'one'} of:"
        ]
    else:
        lines = ["one of these equations repeats or contradicts the others. Remove or change one of:"]
    return "\n".join(lines + itemised(sorted(equations, key=lambda e: not e.is_written)))


def _with_multiples(
    flat: FlatModel, alias: AliasTable, rows: np.ndarray, groups: tuple[EquationGroup, ...], columns, names: list[int]
) -> tuple[list[Provenance], int, list[str]]:
    """Equations that compete, the number of their unknowns, and the names of these: those included that say that a
    variable they read is a multiple of another."""
    equations = [provenance_of(groups, int(r)) for r in rows]
    chosen = set(equations)
    read = {
        v
        for group in flat.groups
        for provenance, variables in zip(group.provenance, group.variable.tolist(), strict=True)
        if provenance in chosen
        for v in variables
    }
    multiples = [
        (p, v)
        for p, v in zip(alias.eliminated, alias.replaced.tolist(), strict=True)
        if v in read and alias.root[v] != ZERO and abs(alias.factor[v]) != 1
    ]
    place = {p: k for k, p in enumerate(p for group in flat.groups for p in group.provenance)}
    equations = sorted([*equations, *(p for p, _ in multiples)], key=lambda p: place.get(p, len(place)))
    shown = dict.fromkeys([*names, *(v for _, v in multiples)])
    return equations, len(columns) + len(multiples), [flat.variables.names[v] for v in shown]


def _repeated(flat: FlatModel, empty: list[Provenance]) -> list[str]:
    """Sentences on equations in which alias elimination has left no variable."""
    column = np.cumsum(~flat.variables.is_input) - 1
    column[flat.variables.is_input] = -1
    unknown = np.flatnonzero(~flat.variables.is_input)
    # The equations as written: in those that alias elimination has emptied, nothing tells which others they repeat.
    whole = incidence(flat.groups, column, len(unknown))
    over, _ = dulmage_mendelsohn(whole, maximum_matching(whole.pointer, whole.variable, whole.n_variables))
    texts = []
    for rows, columns in over:
        equations = [provenance_of(flat.groups, int(r)) for r in rows]
        if not set(empty).isdisjoint(equations):
            empty = [e for e in empty if e not in equations]
            names = [flat.variables.names[v] for v in unknown[columns] if not flat.variables.is_port[v]]
            texts.append(
                _too_many(flat, equations, len(columns), names or [flat.variables.names[v] for v in unknown[columns]])
            )
    return texts + [f"this equation only repeats what others say: {e.located}. Remove it." for e in empty]


def _unused_inside(flat: FlatModel) -> np.ndarray:
    """Ports that no equation and no connection inside their component mentions."""
    unused = ~flat.ports.has_inside
    for group in flat.groups:
        if len(group) and group.variable.shape[1]:
            port = flat.variables.port[group.variable[group.provenance.is_written]]
            unused[port[port >= 0]] = False
    return unused


def _too_few(flat: FlatModel, n_equations: int, variables: np.ndarray, concerned: np.ndarray) -> str:
    names = [flat.variables.names[v] for v in variables.tolist()]
    missing = len(names) - n_equations
    unused = _unused_inside(flat)
    port = flat.variables.port[concerned & (flat.variables.port >= 0)]
    hollow = np.unique(port[unused[port]])
    owners = np.unique(flat.variables.owner[variables])
    near = np.flatnonzero(flat.ports.is_loose & np.isin(flat.ports.owner, owners))
    if n_equations == 0:
        text = f"nothing determines {listed(names, joint='or')}"
    else:
        text = f"only {counted(n_equations, 'equation')} for {counted(len(names), 'unknown')}, {listed(names)}"
    if len(hollow):
        inside = listed(flat.components[k] for k in flat.ports.owner[hollow])
        mend = "it there, or write its" if len(hollow) == 1 else "them there, or write their"
        return f"inside {inside} nothing uses {listed(flat.ports.names[p] for p in hollow)}: connect {mend} equations."
    if len(near):
        close = listed(flat.ports.names[p] for p in near)
        return f"{text}: {'is' if len(near) == 1 else 'are'} {close} meant to be connected?"
    short = short_of_equations(flat, concerned, names)
    if short:
        return short
    if len(names) == 1:
        return f"{text}: add an equation for it, declare it as an input, or leave it out."
    what = "an equation" if missing == 1 else f"{missing} equations"
    return f"{text}: add {what}, or declare {'one' if missing == 1 else missing} of them as an input."


def _only_through(flat: FlatModel, concerned: np.ndarray) -> bool:
    """True if these variables are flows at ports: redundant constraints leave flows open."""
    at_ports = concerned & (flat.variables.port >= 0)
    return bool(at_ports.any() and not flat.variables.is_across[at_ports].any())


def _best(flat: FlatModel, alias: AliasTable, unknown: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """For each column, the variable that names it best: not one of a port, where there is another."""
    variables = flat.variables
    order = np.lexsort((np.arange(len(variables)), variables.is_port, alias.order, alias.root))
    return order[np.searchsorted(alias.root[order], unknown[columns])]
