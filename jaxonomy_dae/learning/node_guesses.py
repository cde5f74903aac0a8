"""First guesses of the states at the nodes.

Where a state or its derivative was measured, the guess is a smoothed sample. Elsewhere it is the state at which the run
of the segment before ends.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..compile.lowering.plan import SystemPlan
from .segments import Segments

FEWEST = 5  # samples to smooth: two more than a parabola has coefficients
# Sweeps end where they move nodes by no more than this part of a state's size.
SETTLED = 1e-3


def measured_states(segments: Segments) -> Float[np.ndarray, "e N n"]:
    """States at the nodes by local parabolas through samples (Savitzky & Golay 1964), NaN where there are none near."""
    o = segments.objective
    s, plan = o.stacked, o.system.plan
    nodes = segments.nodes[:, :-1]
    out = np.full((*nodes.shape, plan.n_state), np.nan)
    for j, name in enumerate(s.outputs):
        if name in o.observers:
            continue
        for place, order, factor in _states_of(plan, name):
            for e, one in enumerate(segments.experiments):
                seen = s.observed[one, :, j]
                width = segments.nodes[e, 1] - segments.nodes[e, 0]
                found = local_parabolas(s.times[one, seen], s.values[one, seen, j], nodes[e], width, order)
                out[e, :, place] = np.where(np.isnan(found), out[e, :, place], found / factor)
    return out


def _states_of(plan: SystemPlan, name: str) -> Sequence[tuple[int, int, float]]:
    """(position in the state array, order of the derivative, factor) of the states that samples of a variable tell."""
    quantity, factor = plan.resolve([name])
    q, by = int(quantity[0]), float(factor[0])
    place = {int(state): k for k, state in enumerate(plan.states)}
    owner = plan.extended.quantities.owner
    found = []
    for order in (0, 1):
        if q + order in place and q >= 0 and owner[q + order] == owner[q]:
            found.append((place[q + order], order, by))
    return found


def local_parabolas(
    times: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    at: Float[np.ndarray, " m"],
    width: float,
    order: int,
) -> Float[np.ndarray, " m"]:
    """The value, or with `order` 1 the slope, of parabolas fitted to the samples within half a `width` of each time, or
    to the nearest few; NaN where samples are further away than a width."""
    out = np.full(len(at), np.nan)
    for k, t in enumerate(at):
        distance = np.abs(times - t)
        reach = max(width / 2, np.sort(distance)[min(FEWEST, len(times)) - 1]) if len(times) else 0.0
        near = distance <= reach
        if reach > width or near.sum() <= order:
            continue
        scale = reach or 1.0
        degree = min(2, int(near.sum()) - 1)
        fitted = np.polynomial.polynomial.polyfit((times[near] - t) / scale, values[near], degree)
        out[k] = fitted[order] / scale**order
    return out


def node_guesses(segments: Segments, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, "e N n"] | None:
    """States at the nodes for a first point. What was not measured is found by runs of all segments at once, each from
    where the one before ended, with measured states put in their places: after as many sweeps as there are segments
    this is a run through all of them."""
    first = segments.first(z)
    if first is None:
        return None
    known = measured_states(segments)
    known[:, 0] = first[0]
    states = np.where(np.isnan(known), first[0][:, None], known)
    if not np.isnan(known).any():
        return states
    for _ in range(segments.count):
        ended = segments.ends(z, states)
        following = np.concatenate([states[:, :1], ended[:, :-1]], axis=1)
        following = np.where(np.isfinite(following), following, states)
        following = np.where(np.isnan(known), following, known)
        moved = np.abs(following - states).max(axis=(0, 1))
        states = following
        if (moved <= SETTLED * sizes(states)).all():
            break
    return states


def sizes(states: Float[np.ndarray, "e N n"]) -> Float[np.ndarray, " n"]:
    """The unit in which each state's gaps are measured: its range over the nodes, or where it does not move, its
    value."""
    spread = states.max(axis=(0, 1)) - states.min(axis=(0, 1))
    largest = np.abs(states).max(axis=(0, 1))
    size = np.maximum(spread, 1e-3 * largest)
    return np.where(size > 0, size, 1.0)
