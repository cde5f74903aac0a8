"""Variables that are not finite at a saved time, though the states are.

Such a variable is read by no state: a quotient, a logarithm, or what a mode leaves undetermined. It is refused where it
is read, with the equation that gives it no finite value.
"""

import warnings
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from ...base.aliases import Args, Numeric, State
from ...base.errors import SimulationError
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.schedule import AnyStep
from ...host.members import numbered
from ...host.staging import is_traced
from ..system.system import AcausalSystem

SHOWN = 4  # equations, and values in each, that an error lists


def refuse_not_finite(
    system: AcausalSystem,
    names: Sequence[str],
    quantity: np.ndarray,
    values: Numeric,
    rows: tuple[Numeric, Numeric, Numeric],
    inputs: Args,
) -> None:
    """**Arguments:**

    - `names`, `quantity`: of variables, and what they are; −1 is zero.
    - `values`: shape (times, variables).
    - `rows`: the saved times, states and discrete values; a state that is not finite was not reached.

    **Raises:**

    - `SimulationError` that names the first variable that is not finite, the time, and the equation.
    """
    found = np.asarray(values, float)
    if np.isfinite(found).all():
        return
    ts, states, discrete = (None if part is None else np.asarray(part, float) for part in rows)
    assert ts is not None and states is not None
    wrong = ~np.isfinite(found) & np.isfinite(states).all(axis=-1, keepdims=True)
    if not wrong.any():
        return
    k = int(np.argmax(wrong.any(axis=1)))
    column = int(np.argmax(wrong[k]))
    at = system if discrete is None else system.holding(jnp.asarray(discrete[k]))
    several = f", and at {wrong[:, column].sum() - 1} more saved times" if wrong[:, column].sum() > 1 else ""
    raise SimulationError(
        f"'{names[column]}' is {found[k, column]:g} at t={ts[k]:.6g}{several}, while all states are finite. "
        + _cause(at, int(quantity[column]), ts[k], states[k], inputs)
        + "Write the equation so that it has a finite value there, or leave such rows to the reader with "
        "simulate(..., throw=False), which returns not-a-number"
    )


def refuse_account(
    plan: SystemPlan, kind: str, terms: np.ndarray, values: Numeric, rows: tuple[Numeric, Numeric]
) -> None:
    """As `refuse_not_finite`, of declared energies or powers: `values`, shape (times, terms), of the terms `terms`."""
    found = np.asarray(values, float)
    if np.isfinite(found).all():
        return
    ts, states = (np.asarray(part, float) for part in rows)
    wrong = ~np.isfinite(found) & np.isfinite(states).all(axis=-1, keepdims=True)
    if wrong.any():
        k, term = (int(place[0]) for place in np.nonzero(wrong))
        owner = np.concatenate([account.component for account in plan.flat.accounts])[terms[term]]
        name = plan.flat.components[owner]
        raise SimulationError(
            f"the {kind} that '{name}' declares is {found[k, term]:g} at t={ts[k]:.6g}, while all states are finite. "
            "Write the declaration so that it has a finite value there"
        )


def warn_of_members(name: str, values: Numeric, states: State) -> None:
    """Warns, outside of jit, that a variable is not finite in members of a batch that reached their saved times."""
    if is_traced((values, states)):
        return
    reached = np.isfinite(states).all(axis=-1)
    found = np.isfinite(values)
    wrong = reached & ~found.reshape(*reached.shape, -1).all(axis=-1)
    if wrong.any():
        warnings.warn(
            f"'{name}' is not a number at saved times of {numbered(wrong.any(axis=-1))}, while all states are finite. "
            "Simulate such a member alone, outside of jit, to see why",
            RuntimeWarning,
            stacklevel=4,
        )


def _cause(system: AcausalSystem, quantity: int, t: float, x: np.ndarray, inputs: Args) -> str:
    """Sentences on the first equation on the way to a quantity that has no finite value, with the values it reads."""
    plan = system.plan
    every = np.arange(plan.extended.quantities.n)
    computed = np.asarray(system.at(jnp.asarray(t), inputs).quantities(jnp.asarray(x), every, np.ones(len(every))))
    values = np.append(computed.astype(float), 0.0)  # the constant zero is −1, the last entry
    of: dict[int, AnyStep] = {int(q): step for step in plan.steps for q in np.concatenate(step.unknown)}
    # Upstream along values that are not finite, to the step in which the first of them arises.
    while True:
        if quantity not in of:
            return ""
        wanted = np.zeros(len(every), bool)
        wanted[quantity] = True
        behind = of[quantity].behind(wanted)
        before = [q for e, rows in behind for r in rows for q in e.quantity[r].tolist() if not np.isfinite(values[q])]
        before = [q for q in before if of.get(q) is not of[quantity]]
        if not before:
            break
        quantity = before[0]
    numbers = np.asarray(system.numbers, float)
    lines = []
    for equation, rows in behind:
        for row in rows:
            read = dict.fromkeys(q for q in equation.quantity[row].tolist() if q >= 0 and np.isfinite(values[q]))
            given = {plan.quantity_name[q]: values[q] for q in read}
            named = [(plan.flat.parameters.names[p], numbers[p]) for p in equation.parameter[row].tolist()]
            given |= {name: value for name, value in named if " " not in name}  # relations are numbered
            shown = ", ".join(f"'{name}' = {value:.6g}" for name, value in [*given.items()][:SHOWN])
            lines.append(plan.describe(int(equation.equation[row])) + (f", with {shown}" if shown else ""))
    more = "\n  …" if len(lines) > SHOWN else ""
    listed = "".join(f"\n  {line}" for line in lines[:SHOWN])
    return f"No finite value of '{plan.quantity_name[quantity]}' follows there from{listed}{more}\n"
