"""Variables that amplify the tolerance of a state.

The error control of a run keeps each state to rtol·|x| + atol. A variable y that hangs on it by a large factor moves by
|∂y/∂x|·(rtol·|x| + atol) then. It is judged in NumPy, at a few saved times, from the partial derivatives of all
equations: nothing is compiled for it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...base.tolerances import RANK, TINY
from ...compile.model.group import Point
from ...compile.model.jacobian import residual_and_jacobian
from ..system.system import AcausalSystem

# What the tolerance of one step moves by more than this part of its range is told, because the errors of many steps add
# up. A pressure that moved by 1/200 of its range by the tolerance of one step ended 1/30 off
# (test_tolerances.py::test_an_amplified_tolerance).
NOTABLE = 1e-3
STEADY = 1e-3  # of its size: a variable that moves by less is compared with its size
MORE = 10.0  # than the relative tolerance of a variable, or of its typical size: less is rounding, or as asked for
LARGE = 100  # quantities up to which this is looked at: it costs their number to the third power, 5 ms at 100
SHOWN = 3  # variables that a sentence explains


class Amplified(NamedTuple):
    """What is found of a variable: how far the tolerance of the state `state` moves it, at most; by what factor the
    variable hangs on the state; and what is small or large for it."""

    name: str
    moved: float
    state: str
    factor: float
    scale: float

    def __str__(self):
        return (
            f"'{self.name}' hangs on the state '{self.state}' by a factor of {self.factor:.3g}: what the tolerance of "
            f"one step leaves open moves it by {self.moved:.2g} of {self.scale:.3g}"
        )


def is_looked_at(system: AcausalSystem) -> bool:
    """True for models that are small, and have neither networks nor discrete variables or modes."""
    plan = system.plan
    writes = plan.events is not None and len(plan.events.discrete)
    is_small = 0 < plan.extended.quantities.n_unknown <= LARGE
    return bool(is_small and plan.n_state and not plan.network_names and not writes)


def amplified(
    system: AcausalSystem, names: Sequence[str], quantity: np.ndarray, factor: np.ndarray, values: np.ndarray,
    at: Sequence[tuple[float, np.ndarray]], tolerances: np.ndarray, rtol: float,
) -> list[Amplified]:  # fmt: skip
    """The variables that the tolerance of a state moves notably.

    **Arguments:**

    - `names`, `quantity`, `factor`: the variables, shape (m,); `values`: at the saved times, shape (times, m).
    - `at`: some times, and all quantities then.
    - `tolerances`: of the entries of the state at these times, shape (some times, n_state).
    - `rtol`: what the user asked for.
    """
    plan, typical = system.plan, np.asarray(system.typical_sizes)
    states = np.concatenate([plan.states, plan.carried])
    slopes = np.stack([_slopes(system, states, t, all_values) for t, all_values in at])
    known = np.arange(plan.extended.quantities.n_unknown)
    found = []
    for name, q, f, column in zip(names, quantity.tolist(), factor.tolist(), values.T, strict=True):
        column = column[np.isfinite(column)]
        if q not in known or q in states or not len(column):
            continue
        size, scale = float(np.abs(column).max()), float(np.ptp(column))
        own = MORE * rtol * max(size, float(typical[q]))  # that much would be no error of the variable itself
        scale = scale if scale > STEADY * size else size
        moved = np.abs(f * slopes[:, q]) * tolerances
        if np.isfinite(moved).all() and moved.max() > max(NOTABLE * scale, own):
            time, state = np.unravel_index(int(np.argmax(moved)), moved.shape)
            hangs = float(abs(f * slopes[time, q, state]))
            found.append(Amplified(name, float(moved.max()), [*system.states, *system.carried][state], hangs, scale))
    return found


def _slopes(system: AcausalSystem, states: np.ndarray, t: float, values: np.ndarray) -> np.ndarray:
    """∂(quantities)/∂(states) along the equations, shape (n_unknown, n_state); not-a-number where equations are not
    finite."""
    plan = system.plan
    n = plan.extended.quantities.n_unknown
    out = np.full((n, len(states)), np.nan)
    with np.errstate(all="ignore"):
        at = Point.of(values, np.asarray(system.numbers, float), t)
        jacobian = residual_and_jacobian(plan.extended, at)[1].toarray()[:, :n]
    if not np.isfinite(jacobian).all():
        return out
    unknown = np.setdiff1d(np.arange(n), states)
    jacobian = jacobian / np.maximum(np.abs(jacobian).max(axis=1, initial=0.0), TINY)[:, None]
    unit = np.maximum(np.abs(jacobian[:, unknown]).max(axis=0, initial=0.0), TINY)
    solved = np.linalg.lstsq(jacobian[:, unknown] / unit, jacobian[:, states], rcond=RANK)[0]
    out[unknown], out[states] = -solved / unit[:, None], np.eye(len(states))
    return out


def sentence(found: Sequence[Amplified]) -> str:
    """What is said of variables that amplify tolerances."""
    names = [one.name for one in found[:SHOWN]]
    more = f", and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return (
        "; ".join(str(one) for one in found[:SHOWN])
        + more
        + f". Errors of many steps add up: put them under the error control with simulate(..., control={names}), or "
        "give a smaller rtol"
    )
