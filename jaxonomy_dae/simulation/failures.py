"""Why a run of a compiled system failed, in names of the model."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..solvers.failures import explain_failure
from ..system.system import AcausalSystem
from .integration import term_of
from .solution import Solution
from .step_sizes import scaled_atol

PROBES = 64  # times at which inputs are looked at


def explain(
    solution: Solution, last: tuple[Any, Any], t0: Any, t1: Any, implicit: bool, max_steps: int, rtol: Any, atol: Any
) -> str:
    """Why the integration from t0 to t1 stopped at its last accepted point (t, x), and what to do."""
    system, inputs = solution.system, solution.inputs
    t, x = last
    bad = _bad_input(inputs, float(t0), float(t), float(t1))
    if bad:
        return f"the integration stopped at t={float(t):g}: {bad}"
    names = [*system.states, *system.carried]
    text = explain_failure(
        term_of(system, implicit), inputs, t, x, names,
        result=solution.result, t0=t0, t1=t1, max_steps=max_steps, rtol=rtol, atol=scaled_atol(system, atol),
        explicit=not implicit,
    )  # fmt: skip
    return f"{text} {_chart_hint(system)}".rstrip()


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


def _chart_hint(system: AcausalSystem) -> str:
    if system.plan.mode != "dummy_derivatives" or not system.carried:
        return ""
    return (
        f"Perhaps the states {', '.join(system.states[:4])} have become a singular choice, which "
        'state_selection="auto" avoids.'
    )
