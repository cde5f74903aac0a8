"""Which solver suits a compiled system: by what the compiler knows, and by how fast it decays at its declared start."""

from typing import NamedTuple

import numpy as np

from ..lowering.plan import SystemPlan
from ..model.consistent_point import initial_point
from ..model.jacobian import residual_and_jacobian
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


def fastest_decay(plan: SystemPlan) -> float:
    """The largest −Re λ among the eigenvalues λ that decay rather than oscillate, per unit of time; 0 if there are
    none, or if the system is large.

    The equations, linearised at a consistent point, leave the quantities q = N c free, with N a basis of the null space
    of ∂F/∂q. Each quantity v and its derivative obey d(N_v c)/dt = N_v' c, so c' = N_v⁺ N_v' c: the eigenvalues of that
    matrix are those of the system, whatever its index and its states.
    """
    known = vars(plan)
    if "_fastest_decay" not in known:  # as `functools.cached_property` does; not by the digest, which knows no values
        known["_fastest_decay"] = _fastest_decay(plan)
    return known["_fastest_decay"]


@np.errstate(all="ignore")
def _fastest_decay(plan: SystemPlan) -> float:
    quantities = plan.extended.quantities
    n = quantities.n_unknown
    if not 0 < n <= LARGE:
        return 0.0
    at = initial_point(plan.model)
    matrix = residual_and_jacobian(plan.extended, at)[1].toarray()[:, :n]
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
