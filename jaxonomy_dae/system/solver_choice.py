"""Which solver suits a compiled system, by what the compiler knows."""

from typing import NamedTuple

from ..lowering.plan import SystemPlan
from ..solvers.solve import SMALL


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
