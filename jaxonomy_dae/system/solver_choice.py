"""Which solver suits a compiled system, by what the compiler knows."""

from ..lowering.plan import SystemPlan

SMALL = 30  # up to this many unknowns a factorisation costs less than the steps that a multistep method saves


def solver_choice(plan: SystemPlan) -> tuple[str, str]:
    """(the name of a solver, why): explicit unless nonlinear blocks leave algebraic unknowns to be solved with the
    states. Stiffness depends on parameters and is not known to the compiler."""
    if not len(plan.carried):
        return "Tsit5", "explicit: no nonlinear block is left; if the system is stiff, take Rodas5P or BDF"
    quantities = plan.extended.quantities
    if (quantities.order[plan.carried] < quantities.highest[quantities.owner[plan.carried]]).all():
        return "Tsit5", "explicit: nonlinear blocks only tie differentiated variables to the states"
    names = ", ".join(plan.quantity_name[q] for q in plan.carried[:3])
    more = f" and {len(plan.carried) - 3} more" if len(plan.carried) > 3 else ""
    why = f"nonlinear blocks leave the algebraic unknowns {names}{more}"
    if plan.n_state <= SMALL:
        return "Rodas5P", why
    return "BDF", f"{why}, and {plan.n_state} unknowns are many"
