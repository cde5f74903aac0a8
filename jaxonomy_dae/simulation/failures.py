"""Why a run of a compiled system failed, in names of the model."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..solvers.choice_guard import SINGULAR_CHOICE
from ..solvers.failures import SHOWN, explain_failure, how_it_stopped
from .failed_blocks import failed_block
from .integration import term_of
from .not_finite import equation_not_finite
from .solution import Solution
from .step_sizes import scaled_atol

NEARLY = 1e-2  # of the first determinant: a singular choice explains a failure so close to it
PROBES = 64  # times at which inputs are looked at


def explain(
    solution: Solution,
    first: tuple[Any, Any],
    last: tuple[Any, Any],
    t1: Any,
    implicit: bool,
    max_steps: int,
    rtol: Any,
    atol: Any,
) -> str:
    """Why the integration from `first` to t1 stopped at its last accepted point (t, x), and what to do."""
    system, inputs = solution.system, solution.inputs
    (t0, _), (t, x) = first, last
    bad = _bad_input(inputs, float(t0), float(t), float(t1))
    if bad:
        return f"the integration stopped at t={float(t):g}: {bad}"
    equation = equation_not_finite(system, inputs, t, x)
    if equation:
        where, mend = ("at the start", "Start elsewhere, or look") if float(t) == float(t0) else ("there", "Look")
        return (
            f"the integration stopped at t={float(t):g}: an equation is not finite {where}, {equation}. {mend} for a "
            "division by zero, or a root or logarithm without a real value."
        )
    singular = _singular_choice(solution, first, t, x)
    if singular:
        return f"{singular}."
    block = failed_block(system, first, last, t1, inputs)
    if block:
        return how_it_stopped(solution.result, t, max_steps) + block
    names = [*system.states, *system.carried]
    return explain_failure(
        term_of(system, implicit), inputs, t, x, names,
        result=solution.result, t0=t0, t1=t1, max_steps=max_steps, rtol=rtol, atol=scaled_atol(system, atol),
        explicit=not implicit,
    )  # fmt: skip


def _bad_input(inputs: dict[str, Any], t0: float, t: float, t1: float) -> str:
    """The input that is not finite at the last accepted point or beyond it, if one is."""
    near = t + (t1 - t) * np.concatenate([[0.0], 10.0 ** np.linspace(-15, 0, PROBES)])
    for name, value in inputs.items():
        for s in near if callable(value) else near[:1]:
            found = float(np.asarray(value(jnp.asarray(s)) if callable(value) else value))
            if not np.isfinite(found):
                where = f" at t={s:.6g}" if callable(value) else ""
                return (
                    f"input '{name}' is {found}{where}. Give a value at every time from {t0:g} to {t1:g} "
                    "(jnp.nan_to_num, or samples without gaps)."
                )
    return ""


def _singular_choice(solution: Solution, first: tuple[Any, Any], t: Any, x: Any) -> str:
    """What the states do not determine at a point, if that is where and why the run ended."""
    system, inputs = solution.system, solution.inputs
    plan = system.plan
    if not plan.dummy_blocks:
        return ""
    here = np.abs(np.asarray(system.dummy_determinants(t, x, inputs)))
    before = np.abs(np.asarray(system.dummy_determinants(*first, inputs)))
    # Other causes may end a run just before: steps too many, or too short.
    if solution.result != SINGULAR_CHOICE and not (here <= NEARLY * before).any():
        return ""
    columns = [column for block in plan.dummy_blocks for column in block.columns]
    lost = columns[int(np.argmin(here))]
    values = np.asarray(x)[len(plan.states) + lost]
    shown = ", ".join(f"'{system.carried[c]}' = {v:.3g}" for c, v in list(zip(lost, values, strict=True))[:SHOWN])
    states = ", ".join(f"'{name}'" for name in system.states[:SHOWN])
    more = f" and {len(system.states) - SHOWN} more" if len(system.states) > SHOWN else ""
    return (
        f"the integration stopped at t={float(t):.6g}: the states {states}{more} have become a singular choice. There "
        f"they no longer determine {shown}, and it cannot be told which branch continues. "
        'Compile with state_selection="auto", which has no such points, or with other prefer_states'
    )
