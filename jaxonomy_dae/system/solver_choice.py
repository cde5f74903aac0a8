"""Which solver suits a compiled system: by what the compiler knows, and by how fast it decays at its declared start."""

from typing import NamedTuple

import numpy as np

from ..lowering.plan import SystemPlan
from ..model.consistent_point import initial_point
from ..model.jacobian import residual_and_jacobian
from ..model.reduced import ReducedModel
from ..model.tables import Declared
from ..solvers.solve import SMALL
from ..tolerances import RANK, TINY

LARGE = 300  # quantities up to which the fastest decay is found


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
        return self is other or np.array_equal(self._asked[1], other._asked[1]) or self.decay == other.decay

    def __hash__(self) -> int:
        return 0  # all else that is static tells models apart

    def __repr__(self) -> str:  # JAX prints it where two systems do not stack
        return f"Stiffness(decays by about {self.decay:.0e} per unit of time)"


@np.errstate(all="ignore")
def fastest_decay(model: ReducedModel, parameters: np.ndarray) -> float:
    """The largest −Re λ among the eigenvalues λ that decay rather than oscillate, per unit of time; 0 if there are
    none, or if the system is large.

    The equations, linearised at a consistent point, leave the quantities q = N c free, with N a basis of the null space
    of ∂F/∂q. Each quantity v and its derivative obey d(N_v c)/dt = N_v' c, so c' = N_v⁺ N_v' c: the eigenvalues of that
    matrix are those of the system, whatever its index and its states. Networks count as zero: their weights change.
    """
    quantities = model.extended.quantities
    n = quantities.n_unknown
    if not 0 < n <= LARGE:
        return 0.0
    at = initial_point(model, Declared(parameters, {}))
    matrix = residual_and_jacobian(model.extended, at)[1].toarray()[:, :n]
    if not np.isfinite(matrix).all():
        return 0.0
    rows = np.maximum(np.abs(matrix).max(axis=1, initial=0.0), TINY)[:, None]
    unit = np.abs(matrix / rows).max(axis=0, initial=0.0)
    unit = 1 / np.where(unit > 0, unit, 1.0)  # of every quantity
    _, s, v = np.linalg.svd(matrix / rows * unit)
    free = v[int((s > RANK * s.max(initial=0.0)).sum()) :].T  # in these units
    owner, order = quantities.owner[:n], quantities.order[:n]
    below = np.flatnonzero(order < quantities.highest[owner])
    change = free[below + 1] * (unit[below + 1] / unit[below])[:, None]
    try:
        rates = np.linalg.eigvals(np.linalg.lstsq(free[below], change, rcond=RANK)[0])
    except np.linalg.LinAlgError:
        return 0.0
    decays = -rates.real[-rates.real > np.abs(rates.imag)]
    return float(decays.max(initial=0.0))
