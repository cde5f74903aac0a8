"""Names and sizes of quantities."""

import numpy as np

from .extended import Extended
from .tables import ZERO, AliasTable, FlatModel


def name_quantities(flat: FlatModel, alias: AliasTable, extended: Extended) -> list[str]:
    """A user's name for every quantity: of a variable that equals it, best without a minus sign and no port."""
    quantities = extended.quantities
    names: list[str] = [""] * quantities.n
    best: list[tuple] = [(2,)] * quantities.n
    for v, name in enumerate(flat.variables.names):
        root = int(alias.root[v])
        if root == ZERO or quantities.column[root] < 0:
            continue
        j = quantities.column[root]
        if alias.order[v] > quantities.highest[j]:
            continue
        q = int(quantities.first[j] + alias.order[v])
        internal = ":" in name
        rank = (int(alias.sign[v] < 0), int(internal), int(flat.variables.is_port[v]), int(v != root), v)
        if rank < best[q]:
            best[q], names[q] = rank, ("-" if alias.sign[v] < 0 else "") + name
    for q in range(quantities.n):
        if not names[q]:
            names[q] = f"der({names[q - 1]})"
    return names


def quantity_scale(flat: FlatModel, alias: AliasTable, extended: Extended) -> np.ndarray:
    """The nominal value of every quantity: the largest that a variable which equals it declares, else 1."""
    quantities = extended.quantities
    scale = np.zeros(quantities.n)
    known = alias.root != ZERO
    known[known] = quantities.column[alias.root[known]] >= 0
    v = np.flatnonzero(known)
    q = quantities.first[quantities.column[alias.root[v]]] + alias.order[v]
    inside = alias.order[v] <= quantities.highest[quantities.column[alias.root[v]]]
    np.maximum.at(scale, q[inside], flat.variables.nominal[v[inside]])
    return np.where(scale == 0, 1.0, scale)
