"""Structural diagnosis: which part of a model has too many equations, and which too few.

The Dulmage–Mendelsohn decomposition of the incidence names the smallest parts concerned: equations that compete for the
same variables, and variables that share too few equations.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import StructuralError
from .match import maximum_matching
from .structure import Incidence
from .tables import AliasTable, EquationGroup, FlatModel, describe_equation

SHOWN = 6


def check_structure(
    flat: FlatModel,
    groups: tuple[EquationGroup, ...],
    alias: AliasTable,
    incidence: Incidence,
    unknown: np.ndarray,
) -> None:
    """Raises a `StructuralError` in user names unless every equation can be matched with an unknown of its own.

    `unknown` lists the variable behind each column of the incidence.
    """
    matched = maximum_matching(incidence.pointer, incidence.variable, incidence.n_variables)
    extra = np.flatnonzero(matched < 0)
    taken = np.zeros(incidence.n_variables, bool)
    taken[matched[matched >= 0]] = True
    missing = np.flatnonzero(~taken)
    if not len(extra) and not len(missing):
        return
    n, m = flat.n_equations, len(flat.variables) - int(flat.variables.is_input.sum())
    difference = n - m
    count = f"{n} equations for {m} unknowns, " + (
        f"{difference} too many" if difference > 0 else f"{-difference} too few" if difference < 0 else "as many, but"
    )
    lines = [f"the model is structurally singular: {count}."]
    if len(extra):
        equations = _over_determined(incidence, matched, extra)
        texts = [describe_equation(groups, int(e)) for e in equations]
        lines.append("Over-determined, these equations compete for too few variables:")
        lines.extend(_listed(texts))
        lines.append(
            "Remove one of them, or connect less: for instance two sources, two fixed positions or two grounds on one "
            "node."
        )
    if len(missing):
        columns = _under_determined(incidence, matched, missing)
        texts = [flat.variables.names[v] for v in _display(flat, alias, unknown[columns])]
        lines.append("Under-determined, nothing determines all of these variables:")
        lines.extend(_listed(texts))
        lines.append(
            "Add the missing equation, a connection of their ports, a ground or a fixed position; or make one an input."
        )
    raise StructuralError("\n".join(lines))


def _listed(texts: list[str]) -> list[str]:
    texts = list(dict.fromkeys(texts))
    more = [f"  … and {len(texts) - SHOWN} more"] if len(texts) > SHOWN else []
    return [f"  {t}" for t in texts[:SHOWN]] + more


def _reach(step: Any, start: np.ndarray) -> np.ndarray:
    """All nodes reachable from `start`, in order."""
    seen = np.zeros(step.shape[0], bool)
    frontier = start
    while len(frontier):
        seen[frontier] = True
        following = np.unique(step[frontier].indices)
        frontier = following[~seen[following]]
    return np.flatnonzero(seen)


def _over_determined(incidence: Incidence, matched: np.ndarray, extra: np.ndarray) -> np.ndarray:
    owner = np.full(incidence.n_variables, -1, np.int64)
    owner[matched[matched >= 0]] = np.flatnonzero(matched >= 0)
    following = owner[incidence.variable]
    used = following >= 0
    n = incidence.n_equations
    step = sp.coo_array((np.ones(int(used.sum())), (incidence.rows[used], following[used])), shape=(n, n)).tocsr()
    return _reach(step, extra)


def _under_determined(incidence: Incidence, matched: np.ndarray, missing: np.ndarray) -> np.ndarray:
    rows = incidence.rows
    own = matched[rows]
    used = own >= 0
    n = incidence.n_variables
    step = sp.coo_array((np.ones(int(used.sum())), (incidence.variable[used], own[used])), shape=(n, n)).tocsr()
    return _reach(step, missing)


def _display(flat: FlatModel, alias: AliasTable, roots: np.ndarray) -> list[int]:
    """For each root variable, the variable that names it best: no port, if there is one."""
    out = []
    for root in roots.tolist():
        members = np.flatnonzero(alias.root == root)
        plain = members[~flat.variables.is_port[members]]
        out.append(int(plain[0]) if len(plain) else root)
    return out
