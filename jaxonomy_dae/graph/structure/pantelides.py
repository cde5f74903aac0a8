"""Index reduction: which equations must be differentiated, how often, and which blocks their highest derivatives form.

Given the signature matrix σ (σᵢⱼ: highest order of variable j in equation i), finds the smallest numbers cᵢ ≥ 0 of
differentiations and dⱼ such that dⱼ ≥ σᵢⱼ + cᵢ and the equations i, differentiated cᵢ times, can be matched with the
highest derivatives dⱼ along entries with equality: Pantelides (1988), in the offsets of Pryce (2001). The structural
index is max c (plus one if some variable has dⱼ = 0), the degrees of freedom are Σd − Σc.

No differentiated equation is ever built here: the pass works on integers alone.
"""

import dataclasses

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ...base.errors import StructuralError
from .incidence import Incidence
from .matching import maximum_matching


@dataclasses.dataclass(frozen=True)
class Offsets:
    """The offsets of equations and variables.

    - `equation`: how often each equation is differentiated.
    - `variable`: the highest order of each variable.
    - `matched_variable`: the variable whose highest derivative each equation determines.
    """

    equation: np.ndarray  # c
    variable: np.ndarray  # d
    matched_variable: np.ndarray  # the variable whose highest derivative equation i determines

    @property
    def structural_index(self) -> int:
        if len(self.equation) == 0:
            return 0
        return int(self.equation.max() + (1 if (self.variable == 0).any() else 0))

    @property
    def degrees_of_freedom(self) -> int:
        return int(self.variable.sum() - self.equation.sum())


def match_highest(incidence: Incidence, least: np.ndarray | None = None) -> np.ndarray:
    """A maximum matching of the equations with their highest derivatives, `least` as in `reduce_index`; −1 for
    equations that it leaves out. If it leaves none, no index needs to be reduced."""
    columns = incidence.variable
    # Only entries at the highest order of their variable count: a matching along these says which equation determines
    # which highest derivative.
    active = incidence.order == _highest(incidence, least)[columns]
    rows = incidence.rows[active]
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=incidence.n_equations))])
    return maximum_matching(start, columns[active], incidence.n_variables)


def _highest(incidence: Incidence, least: np.ndarray | None) -> np.ndarray:
    d = np.zeros(incidence.n_variables, np.int64)
    np.maximum.at(d, incidence.variable, incidence.order)
    return d if least is None else np.maximum(d, least)


def reduce_index(incidence: Incidence, least: np.ndarray | None = None, matching: np.ndarray | None = None) -> Offsets:
    """Pantelides' algorithm.

    `least` gives orders that the variables must reach in any case, because eliminated variables equal these
    derivatives; `matching` is what `match_highest` finds, if it is known. The incidence must have a perfect matching,
    otherwise the algorithm would not end; `check_structure` makes sure of that before, in user names.

    **Raises:**

    - `StructuralError` if there is no perfect matching.
    """
    n_equations, n = incidence.n_equations, incidence.n_variables
    pointer, columns, sigma = incidence.pointer, incidence.variable, incidence.order
    c, d = np.zeros(n_equations, np.int64), _highest(incidence, least)

    # A maximum matching along the highest derivatives first; only what it leaves out needs the careful search.
    match_equation = match_highest(incidence, least) if matching is None else matching
    match_variable = np.full(n, -1, np.int64)
    matched = np.flatnonzero(match_equation >= 0)
    match_variable[match_equation[matched]] = matched

    if len(matched) < n_equations or n_equations != n:
        # Pantelides (1988): the algorithm ends if and only if equations and variables match when orders are ignored.
        whole = maximum_matching(pointer, columns, n)
        if n_equations != n or (whole < 0).any():
            raise StructuralError(f"{n_equations} equations cannot be matched with {n} unknowns")
    pointer_list, column_list, sigma_list = pointer.tolist(), columns.tolist(), sigma.tolist()
    c_list, d_list = c.tolist(), d.tolist()
    of_variable, of_equation = match_variable.tolist(), match_equation.tolist()
    for equation in range(n_equations):
        while of_equation[equation] == -1:
            seen_equations, seen_variables = _augment(
                equation, pointer_list, column_list, sigma_list, c_list, d_list, of_variable, of_equation
            )
            if of_equation[equation] != -1:
                break
            # No path leads from this equation to a highest derivative that is left. The equations on the way hold fewer
            # highest derivatives than they are, so each of them hides a constraint: all are differentiated, and their
            # variables with them.
            for v in seen_variables:
                d_list[v] += 1
            for e in seen_equations:
                c_list[e] += 1
    return Offsets(np.array(c_list, np.int64), np.array(d_list, np.int64), np.array(of_equation, np.int64))


def _augment(root, pointer, columns, sigma, c, d, of_variable, of_equation):
    """Searches an augmenting path from an unmatched equation along highest derivatives, without recursion.

    Returns the equations and variables it reached; on success the matching has been changed in place.
    """
    # Without recursion: in a chain, the path is as long as the model, and Python stops at 1,000 calls.
    came_from: dict[int, int] = {}  # variable -> equation that reached it
    seen_equations = [root]
    position = {root: pointer[root]}
    stack = [root]
    while stack:
        e = stack[-1]
        k = position[e]
        end = pointer[e + 1]
        advanced = False
        while k < end:
            v = columns[k]
            if sigma[k] + c[e] == d[v] and v not in came_from:
                came_from[v] = e
                if of_variable[v] == -1:
                    while True:
                        e = came_from[v]
                        previous = of_equation[e]
                        of_equation[e], of_variable[v] = v, e
                        if e == root:
                            return seen_equations, list(came_from)
                        v = previous
                following = of_variable[v]
                position[e] = k + 1
                seen_equations.append(following)
                position[following] = pointer[following]
                stack.append(following)
                advanced = True
                break
            k += 1
        if not advanced:
            position[e] = end
            stack.pop()
    return seen_equations, list(came_from)


def diagonal_blocks(signature: Incidence, offsets: Offsets) -> tuple[np.ndarray, np.ndarray]:
    """The diagonal block of every equation in the system Jacobian, and how many equations that block has."""
    rows, n = signature.rows, signature.n_equations
    active = signature.order + offsets.equation[rows] == offsets.variable[signature.variable]
    # Equation i depends on the equation that determines each highest derivative in it. Equations that depend on each
    # other are solved together, and only inside such a block can highest derivatives cancel.
    owner = np.empty(signature.n_variables, np.int64)
    owner[offsets.matched_variable] = np.arange(n)
    follow = (rows[active], owner[signature.variable[active]])
    _, label = connected_components(
        sp.coo_array((np.ones(len(follow[0])), follow), shape=(n, n)), directed=True, connection="strong"
    )
    return label, np.bincount(label)[label]
