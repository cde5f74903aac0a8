"""The data of filters: samples one after the other, with the parts of inputs and of time between them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from ..run.system.inputs import CURVED
from ..run.system.system import AcausalSystem
from .data import Stacked
from .experiment import Unknown
from .filtering import Structure
from .program import Conditions, Layout


class Told(eqx.Module):
    """The data for programs of e experiments at n times: samples and which there are, noise levels (NaN where they are
    coordinates), known starts, and the standard deviations of their priors; and of each input, the w samples around the
    time between each row and the one before: integration looks at all that it is given."""

    times: Float[Array, "e n"]
    t0: Float[Array, " e"]
    known: Float[Array, "e known"]
    inputs: dict[str, tuple[Float[Array, "e n w"], Float[Array, "e n w"]]]
    values: Float[Array, "e n k"]
    observed: Bool[Array, "e n k"]
    sigma: Float[Array, "e k"]
    spread: Float[Array, "e known"]
    ends: Float[Array, "e n m"]  # of the m − 1 parts of the time before each row in which no input has a kink or jump


def told_of(
    structure: Structure, system: AcausalSystem, layout: Layout, stacked: Stacked, conditions: Conditions
) -> Told:
    """The data for the programs, as arrays of the system's dtype."""
    s, c, dtype = stacked, conditions, system.parameters.values.dtype
    parameters = set(system.parameters.table.names)

    def spread(name: str, value: float | Unknown) -> float:
        return float(value.spread or 0.0) if isinstance(value, Unknown) and name not in parameters else 0.0

    spreads = [[spread(name, s.starts[name][k]) for name in layout.known] for k in range(len(s.labels))]
    estimated = np.isin(np.arange(len(s.outputs)), structure.sigma)
    before = np.concatenate([s.t0[:, None], s.times[:, :-1]], axis=1)
    return Told(
        times=c.times,
        t0=c.t0,
        known=c.known,
        inputs=_windows(s, before, dtype),
        values=jnp.asarray(s.values, dtype),
        observed=jnp.asarray(s.observed),
        sigma=jnp.asarray(np.where(s.estimated & ~estimated, 1.0, s.levels), dtype),
        spread=jnp.asarray(np.array(spreads, float).reshape(c.known.shape), dtype),
        ends=jnp.asarray(_ends(s, before, structure.is_linear), dtype),
    )


def _ends(s: Stacked, before: Float[np.ndarray, "e n"], split: bool) -> Float[np.ndarray, "e n m"]:
    """The ends of the parts of the time before each row; if `split`, of those in which no input has a kink or jump.
    Parts that a row does not need have no length."""
    inside = []
    for k in range(len(before)):
        knots = np.unique(np.concatenate([[], *(times[k] for times, _ in s.inputs.values())]))
        inside.append([knots[(knots > a) & (knots < b)] for a, b in zip(before[k], s.times[k], strict=True)])
    most = max(len(row) for rows in inside for row in rows) if split else 0
    ends = np.repeat(s.times[:, :, None], most + 2, axis=2)
    ends[:, :, 0] = before
    if most:
        for k, rows in enumerate(inside):
            for n, row in enumerate(rows):
                ends[k, n, 1 : 1 + len(row)] = row
    return ends


def _windows(
    s: Stacked, before: Float[np.ndarray, "e n"], dtype: DTypeLike
) -> dict[str, tuple[Float[Array, "e n w"], Float[Array, "e n w"]]]:
    """For each input, its samples around the time between each row and the one before."""
    kinds = dict(s.kinds)
    found = {}
    for name, (times, values) in s.inputs.items():
        if kinds[name] in CURVED:  # whose slopes follow from all samples
            first, width = np.zeros(before.shape, int), times.shape[1]
        else:
            first = np.stack([np.searchsorted(*a, side="right") - 1 for a in zip(times, before, strict=True)])
            last = np.stack([np.searchsorted(*a) for a in zip(times, s.times, strict=True)])
            width = min(max(int((last - first).max()) + 1, 2), times.shape[1])
            first = np.clip(first, 0, times.shape[1] - width)
        place = first[..., None] + np.arange(width)
        rows = np.arange(len(times))[:, None, None]
        found[name] = (jnp.asarray(times[rows, place], dtype), jnp.asarray(values[rows, place], dtype))
    return found
