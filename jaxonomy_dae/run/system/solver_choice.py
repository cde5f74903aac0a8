"""Which solver suits a compiled system: by what the compiler knows, and by how fast it decays at its declared start."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ...base.tolerances import KNOWN, RANK
from ...compile.lowering.plan import SystemPlan
from ...compile.model.consistent_point import initial_point
from ...compile.model.jacobian import residual_and_jacobian
from ...compile.model.quantities import ReducedModel
from ...compile.model.tables import Declared
from ...graph.judgement.scaling import equilibrated
from ...solve.linear.sparse_least_squares import SparseLeastSquares, regular_factors
from ...solve.methods.solve import SMALL

# Dimension of the space in which the largest eigenvalues are sought: of 1,000 heated cells, 10, 20, 40 give the fastest
# one to 0.6, 0.2, 0.05 %, where decades count.
KRYLOV = 40
LAST = 1e4  # a cost above any logarithm of an entry
HOLDS = 1e3  # weight of the equations in the choice of quantities; from 10 to 1e6 that decay is the same to ten digits


class Choice(NamedTuple):
    """A solver by name and the reason for it; not `final` if a run may show that another is better."""

    solver: str
    reason: str
    final: bool


def solver_choice(plan: SystemPlan) -> Choice:
    """Explicit unless nonlinear blocks leave algebraic unknowns to be solved with the states. Stiffness depends on
    parameters and is not known to the compiler."""
    if not len(plan.carried):
        return Choice("Tsit5", "explicit: no nonlinear block is left; implicit if a run turns out to be stiff", False)
    quantities = plan.extended.quantities
    if (quantities.order[plan.carried] < quantities.highest[quantities.owner[plan.carried]]).all():
        return Choice("Tsit5", "explicit: nonlinear blocks only tie differentiated variables to the states", False)
    names = ", ".join(plan.quantity_name[q] for q in plan.carried[:3])
    more = f" and {len(plan.carried) - 3} more" if len(plan.carried) > 3 else ""
    return implicit_choice(plan, f"nonlinear blocks leave the algebraic unknowns {names}{more}")


def implicit_choice(plan: SystemPlan, why: str) -> Choice:
    """The implicit solver for a system of this size."""
    if plan.n_state <= SMALL:
        return Choice("Rodas5P", why, True)
    return Choice("BDF", f"{why}; cheaper for {plan.n_state} unknowns", True)


class Stiffness:
    """How fast a model decays at its declared start, to a decade: a static part of a system.

    A program for traced values must choose a solver without knowing them, so that this belongs to what the program is
    made for: of two models that are alike but for their parameters, a stiff one must not run the explicit program of
    the other. The decade is found when it is first asked for: most runs try an explicit solver, and never ask.
    """

    def __init__(self, model: ReducedModel, parameters: np.ndarray):
        self._found: float | None = None
        self._asked = model, parameters

    @property
    def decay(self) -> float:
        """The fastest decay per unit of time, to the nearest power of ten; 0 if there is none."""
        if self._found is None:
            fastest = fastest_decay(*self._asked)
            self._found = 0.0 if fastest == 0.0 else float(10.0 ** np.round(np.log10(fastest)))
        return self._found

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Stiffness):
            return False
        # Equal parameters decay alike (all else that is static is compared beside this), so that most comparisons need
        # no decade.
        return self is other or np.array_equal(self._asked[1], other._asked[1]) or self.decay == other.decay

    def __hash__(self) -> int:
        return 0  # all else that is static tells models apart

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`: the decade."""
        return repr(self.decay), ()

    def __repr__(self) -> str:  # JAX prints it where two systems do not stack
        return f"Stiffness(decays by about {self.decay:.0e} per unit of time)"


@np.errstate(all="ignore")
def fastest_decay(model: ReducedModel, parameters: np.ndarray) -> float:
    """The largest −Re λ among the eigenvalues λ that decay rather than oscillate, per unit of time; 0 if there are
    none.

    The equations, linearised at a consistent point, leave some quantities v free, and determine all others: v' = A v.
    The eigenvalues of A are those of the system, whatever its index and its states. Networks count as zero: their
    weights change.
    """
    quantities = model.extended.quantities
    n = quantities.n_unknown
    at = initial_point(model, Declared(parameters, {}))
    matrix = residual_and_jacobian(model.extended, at)[1].tocsc()[:, :n]
    owner, order = quantities.owner[:n], quantities.order[:n]
    below = np.flatnonzero(order < quantities.highest[owner])
    if not len(below) or not np.isfinite(matrix.data).all():
        return 0.0
    found: Any = _fast_rates(matrix, below)
    found = found[np.abs(found) > RANK * np.abs(found).max(initial=0.0)]  # an oscillator's zero is no decay
    # Fast oscillations have to be followed by any solver: an implicit one would gain nothing.
    decays = -found.real[-found.real > np.abs(found.imag)]
    return float(decays.max(initial=0.0))


def _fast_rates(matrix: Any, below: np.ndarray) -> np.ndarray:
    """The eigenvalues of largest size, by Arnoldi's method, in terms of free quantities among those `below`."""
    scaled, _, unit = equilibrated(matrix)
    free, changes = _changes(scaled, below)
    # The quantity behind v in their order is v'.
    per, steps = unit[free + 1] / unit[free], min(len(free), KRYLOV)
    basis, hessenberg = np.zeros((steps + 1, len(free))), np.zeros((steps + 1, steps))
    # Generic, so that it has a part along every eigenvector, and of a fixed seed: a model has the same solver on every
    # run.
    basis[0] = np.random.default_rng(0).normal(size=len(free))
    basis[0] /= np.linalg.norm(basis[0])
    for k in range(steps):
        v = changes(basis[k]) * per
        for _ in range(2):  # twice is enough (Giraud et al. 2005)
            along = basis[: k + 1] @ v
            hessenberg[: k + 1, k] += along
            v = v - along @ basis[: k + 1]
        size = np.linalg.norm(v)
        if not np.isfinite(size) or size <= RANK * np.abs(hessenberg[:, k]).max():
            steps = k + 1
            break
        hessenberg[k + 1, k], basis[k + 1] = size, v / size
    found = hessenberg[:steps, :steps]
    return np.linalg.eigvals(found) if np.isfinite(found).all() else np.zeros(0)


def _free(matrix: Any, below: np.ndarray) -> np.ndarray:
    """As many of the quantities `below` as the equations leave free: all of them, or those that a matching of equations
    to quantities by large entries of the Jacobian passes over (weights as by Duff & Koster 2001)."""
    m, n = matrix.shape
    if m == n - len(below):
        return below
    entries = matrix.tocoo()
    entries.eliminate_zeros()
    last = np.isin(entries.col, below)  # all others follow
    costs = sp.csr_array((LAST * (1 + last) - np.log(np.abs(entries.data)), (entries.row, entries.col)), shape=(m, n))
    return np.setdiff1d(below, csgraph.min_weight_full_bipartite_matching(costs)[1])


def _changes(matrix: Any, below: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """(quantities v that can be chosen, from v to their derivatives), given the equations' Jacobian."""
    m, n = matrix.shape
    try:
        free = _free(matrix, below)
    except ValueError:  # no full matching
        free = below
    others = np.delete(np.arange(n), free)
    # An open switch makes equations nearly singular, which hold all the same.
    solve = regular_factors(matrix[:, others], KNOWN) if m == len(others) else None
    if solve is not None:
        given, values = matrix[:, free], np.empty(n)

        def change(v: np.ndarray) -> np.ndarray:
            values[free], values[others] = v, -solve(given @ v)
            return values[free + 1]

        return free, change
    # Equations depend on each other: v is the nearest for which they hold.
    chosen = sp.csr_array((np.ones(len(below)), (np.arange(len(below)), below)), shape=(len(below), n))
    factors = SparseLeastSquares(sp.vstack([HOLDS * matrix, chosen]))
    zero = np.zeros(m)
    return below, lambda v: factors.solve(np.concatenate([zero, v]))[below + 1]
