"""Which block of simultaneous equations ends a run, and why.

Every quantity is computed at the last accepted point as a run computes it, and just beyond. The first step of the
schedule with an unknown that is not finite, though all it reads is, has failed: because its matrix is singular, because
the order in which it is eliminated divides by zero, or because Newton's method finds no root.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Inputs, State, Time
from ...compile.diagnosis.wording import quoted
from ...compile.lowering.schedule import AnyStep
from ...compile.model.tables import ZERO
from ...host.cache import compiled
from ...solve.methods.dae_term import FlatProblem
from ...solve.methods.index_one import consistent_slope
from ..start.singular_blocks import BlockFinding, examine_blocks
from ..system.input_values import input_values
from ..system.system import AcausalSystem
from .preparation import term_of

SHOWN = 4  # names, values and equations of each kind in an error
NEAR = 10.0 ** np.arange(-15, -5)  # parts of the interval
Instant = tuple[Time, State]  # (time, state)


def failed_block(system: AcausalSystem, first: Instant, last: Instant, t1: Time, inputs: Inputs) -> str:
    """A sentence on the block that fails at the last accepted point (t, x) or just beyond it; "" if none does."""
    t, x = last
    failed = _first_failed(system, t, x, inputs)
    if failed is not None:
        return _why(system, failed, t, x, inputs, "at the start" if float(t) == float(first[0]) else "there")
    found = _findings(system, t, x, inputs)
    if found:
        # A block that was as ill-conditioned at the start did not stop the run.
        known = {block.variables for block in _findings(system, *first, inputs)}
        new = [block for block in found if block.variables not in known]
        if new:
            return _singular(new[0], "there")
    return _just_beyond(system, t, x, t1, inputs) if len(system.plan.carried) else ""


def singular_mode(system: AcausalSystem, first: Instant, last: Instant, inputs: Inputs) -> str:
    """Sentences on the mode that an event began at the last point (t, x), in which states have no slope. Those that it
    spoiled are looked at with their values from the start of the run: a mode makes blocks singular wherever it is."""
    t, x = last
    names = system.discretes
    values = np.asarray(system.discrete_values)[: len(names)]
    mode = ", ".join(f"'{name}' = {value:.6g}" for name, value in [*zip(names, values, strict=True)][:SHOWN])
    found = _findings(system, t, np.where(np.isfinite(x), x, first[1]), inputs)
    singular = next((block for block in found if block.singular), None)
    shown = f", with {mode}. " if mode and singular is None else ". "
    return (
        f"the integration stopped at t={float(t):g}: an event began a mode in which states have no finite slope{shown}"
        + ("" if singular is None else _singular(singular, "there"))
        + "Let events write values with which the equations have a solution."
    )


def _first_failed(system: AcausalSystem, t: Time, x: State, inputs: Inputs) -> AnyStep | None:
    """The first step that has no value, among nonlinear ones and those of two or more equations."""
    plan = system.plan
    known = np.arange(plan.extended.quantities.n_unknown, plan.extended.quantities.n)
    computed = np.concatenate([plan.states, *(q for step in plan.steps for q in step.unknown), known])
    values = np.full(plan.extended.quantities.n + 1, np.nan)
    values[computed] = quantities(system, t, jnp.asarray(x), inputs, tuple(computed.tolist()))
    values[ZERO] = 0.0
    for step in plan.steps:
        if np.isfinite(values[np.concatenate(step.unknown)]).all():
            continue
        # All steps before have values, so that a state or an input is lost, and no block is at fault.
        if not np.isfinite(values[step.needs()]).all():
            return None
        return step if step.simultaneous else None
    return None


@compiled
def quantities(system: AcausalSystem, t: Time, x: State, inputs: Inputs, chosen: tuple[int, ...]) -> Array:
    """The values of quantities, by number, at a point."""
    return system.at(t, inputs).quantities(x, np.array(chosen), np.ones(len(chosen)))


def _findings(system: AcausalSystem, t: Time, x: State, inputs: Inputs) -> list[BlockFinding]:
    """Sentences on the blocks that are singular, or nearly so."""
    plan, parameters = system.plan, system.numbers

    def values():
        return np.array(input_values(plan, inputs, t, parameters.dtype), float)

    networks = tuple(system.neural[n] for n in plan.network_names)
    return list(examine_blocks(plan, np.asarray(parameters, float), networks, float(t), np.asarray(x), values))


def _why(system: AcausalSystem, step: AnyStep, t: Time, x: State, inputs: Inputs, place: str) -> str:
    plan = system.plan
    names = [plan.quantity_name[q] for q in np.concatenate(step.unknown).tolist()]
    for block in _findings(system, t, x, inputs):
        if set(block.variables) & set(names):
            return _singular(block, place)
    if not step.linear:
        return _no_root(system, step, x, f"has no solution {place}")
    if step.whole and plan.linear_solver is not None:
        return (
            f"The block of equations for {quoted(names, SHOWN)} was not solved {place}, though it is not singular: "
            f"linear_solver={plan.linear_solver} did not converge. Let it take more steps (of GMRES, a larger restart "
            f"and max_steps), or compile without linear_solver.{_equations(system, step)}"
        )
    return (
        f"The block of equations for {quoted(names, SHOWN)} has no accurate solution {place}, though it is not "
        "singular: the order in which it is eliminated was chosen for the parameter values that the model was compiled "
        f"with, and fails at the present ones. Compile the model with these values.{_equations(system, step)}"
    )


def _singular(block: BlockFinding, place: str) -> str:
    causes = ", ".join(f"'{name}' = {value:.6g}" for name, value in block.causes[:SHOWN])
    nearly = "singular" if block.singular else f"nearly singular (condition number {block.condition:.1e})"
    one = f"The equation for {quoted(block.variables, SHOWN)} is" if block.size == 1 else (
        f"The block of {block.size} equations that is to determine {quoted(block.variables, SHOWN)} is"
    )  # fmt: skip
    texts = "".join(f"\n  {text}" for text in block.equations[:SHOWN])
    return f"{one} {nearly} {place}{f', with {causes}' if causes else ''}:{texts}\n"


def _no_root(system: AcausalSystem, step: AnyStep, x: State, what: str) -> str:
    plan = system.plan
    place = {int(q): k for k, q in enumerate((*plan.states, *plan.carried))}
    guessed = np.concatenate(step.guessed).tolist()
    shown = [f"'{plan.quantity_name[q]}' = {float(x[place[q]]):.6g}" for q in guessed[:SHOWN]]
    more = f" and {len(guessed) - SHOWN} more" if len(guessed) > SHOWN else ""
    one = "equation" if len(step.equations) == 1 else "block of equations"
    return (
        f"The nonlinear {one} for {', '.join(shown)}{more} {what}: Newton's method does not converge from these values "
        "(a turning point, at which two solutions meet and end; a jump to another branch; or a law without a "
        f"solution).{_equations(system, step)}"
    )


def _just_beyond(system: AcausalSystem, t: Time, x: State, t1: Time, inputs: Inputs) -> str:
    """Names the nonlinear block that loses its root a short way beyond the point."""
    plan = system.plan
    problem = FlatProblem(term_of(system, implicit=True), x, inputs)
    slope = np.asarray(consistent_slope(problem, None, jnp.asarray(t), jnp.asarray(x))).copy()
    # Unknowns of blocks begin at their last values, as in a step.
    slope[len(plan.states) :] = 0
    if not np.isfinite(slope).all():
        return ""
    for part in NEAR:
        dt = part * float(t1 - t)
        failed = _first_failed(system, t + dt, np.asarray(x) + dt * slope, inputs)
        if failed is not None and not failed.linear:
            return _no_root(system, failed, x, "has no solution just beyond")
    return ""


def _equations(system: AcausalSystem, step: AnyStep) -> str:
    texts = dict.fromkeys(system.plan.locate(int(e)) for equation in step.equations for e in equation.equation)
    return "".join(f"\n  {text}" for text in list(texts)[:SHOWN]) + ("\n  …" if len(texts) > SHOWN else "")
