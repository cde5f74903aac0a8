"""Which connections make the tree along which overdetermined quantities are equal, and what the others demand."""

import functools
from collections.abc import Sequence

import numpy as np

from ...base.errors import ModelError
from ...graph.expressions.from_sympy import read
from ...write.ports import Overdetermined
from ...write.symbols import VariableSymbol, symbol_label
from ..model.names import Names
from ..model.symbolic import SymbolicTemplate, canonical


def tree_edges(
    n: int, roots: np.ndarray, branches: np.ndarray, edges: np.ndarray, names: Names, there: np.ndarray
) -> np.ndarray:
    """For each edge, whether it belongs to the tree.

    **Arguments:**

    - `n`: how many ports there are.
    - `roots`: ports where a tree begins.
    - `branches`, `edges`: pairs of ports, of shape (·, 2), that components and connections join.
    - `names`: of the ports.
    - `there`: ports that must be reached from a root.

    **Raises:**

    - `ModelError` for ports that no root reaches.
    """
    parent = list(range(n + 1))  # all roots are one node, the last

    def top(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    def join(a: int, b: int) -> bool:
        a, b = top(a), top(b)
        parent[a] = b
        return a != b

    for root in roots.tolist():
        join(root, n)
    # Branches within components are part of the tree in any case, since their equations are the component's own. Only
    # of connections one may be chosen to close a loop.
    for a, b in branches.tolist():
        join(a, b)
    found = np.array([join(a, b) for a, b in edges.tolist()], bool)
    loose = [k for k in there.tolist() if top(k) != top(n)]
    if loose:
        raise ModelError(
            f"no root is connected to the port '{names[loose[0]]}', so that nothing says where it is and how it is "
            "turned: connect it to a component that does, such as World or Fixed of Modelica.Mechanics.MultiBody"
        )
    return found


@functools.cache
def closings(of: Overdetermined) -> Sequence[SymbolicTemplate]:
    """What a connection that closes a loop sets to zero: residuals in the quantities of its two ends."""
    ends = [{n: VariableSymbol(f"{end}.{n}") for n in of.names} for end in "ab"]
    slots = [s for end in ends for s in end.values()]
    return [canonical(read(r, symbol_label), slots, ()) for r in of.residues(*ends)]
