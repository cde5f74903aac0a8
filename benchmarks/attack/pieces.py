"""Motion in pieces for references: SciPy's DOP853, stopped and started anew wherever a mode changes."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

CLOSE = 1e-7  # of the forces: what is so near to its limit is decided by rounding
MOST = 200  # changes of mode
TIGHT: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-13}
LONGEST = 0.02  # s: a step, so that a guard seldom falls and rises again within one
MISSED = 1e-9  # what a guard may be below zero by while its mode holds


class Delicate(Exception):
    """What the reference cannot decide to all digits."""


def course_of(rng: np.random.Generator, model: Any) -> tuple[np.ndarray, Any]:
    """Times until the end of a reference, `model.run(times)`, and its values there; None if it cannot decide."""
    ts = np.sort(rng.uniform(0.1, 1.0, 6)) * model.end
    try:
        values = model.run(ts)
    except Delicate:
        return ts, None
    return ts, values if np.isfinite(values).all() else None


def in_pieces(
    slopes: Callable[[float, np.ndarray, dict], np.ndarray],
    guards: Callable[[dict], Sequence[tuple[Callable, Callable]]],
    y: np.ndarray,
    modes: dict,
    ts: np.ndarray,
    corners: Sequence[float],
    end: float,
    changed: Callable[[float, np.ndarray, dict], None] = lambda t, y, modes: None,
) -> tuple[np.ndarray, int]:
    """The states at the times `ts`, shape (times, states), and how often a mode changed.

    **Arguments:**

    - `slopes`: dy/dt by time, state and modes.
    - `guards`: by modes, pairs (guard, what happens when it falls through zero), which writes modes and state.
    - `corners`: times at which slopes are not smooth.
    - `changed`: called after a change.

    **Raises:** `Delicate` where two modes change at once, or many, or where SciPy has missed one.
    """
    out, t, changes = np.zeros((len(ts), len(y))), 0.0, 0
    bounds = itertools.chain(corners, [end])
    edge = next(bounds)
    while t < end:
        pairs, events = guards(modes), []
        for guard, _ in pairs:

            def event(t, y, guard=guard):
                return guard(t, y)

            event.terminal, event.direction = True, -1  # pyright: ignore[reportFunctionMemberAccess]
            events.append(event)
        frozen = dict(modes)
        found = solve_ivp(
            lambda t, y, frozen=frozen: slopes(t, y, frozen), (t, edge), y, method="DOP853", events=events,
            dense_output=True, max_step=LONGEST, **TIGHT,
        )  # fmt: skip
        looks = np.concatenate([found.t[1:-1], (found.t[1:] + found.t[:-1]) / 2])
        if any(guard(at, found.sol(at)) < -MISSED for at in looks for guard, _ in pairs):
            raise Delicate("a guard fell and rose within a step, or in the first step after a change")
        inside = (ts >= t) & (ts <= found.t[-1])
        if inside.any():
            out[inside] = found.sol(ts[inside]).T
        t, y = float(found.t[-1]), found.y[:, -1].copy()
        hit = [k for k, times in enumerate(found.t_events) if len(times)]
        for k in hit:
            pairs[k][1](t, y)
        changes += len(hit)
        if changes > MOST or len(hit) > 1:
            raise Delicate("many changes, or two at once")
        if hit:
            changed(t, y, modes)
        elif t < end:
            edge = next(bounds)
    return out, changes
