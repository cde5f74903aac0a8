"""A model along a run, linearized: how its outputs answer to terms that its equations lack.

A term w(t) that is added to the slopes of the differential states moves them by δ, and outputs by C δ:

    δ' = A(t) δ + w(t),    δ(t₀) = 0,    A = ∂f/∂x,    C = ∂y/∂x.

Between two samples, A and w are constants: the means of those at both ends. Discrete values stay as the run has them.
"""

import dataclasses
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..host.cache import compiled
from ..run.simulation.simulate import simulate
from ..run.system.input_values import by_entry
from ..run.system.inputs import read_inputs, value_at
from .filter_steps import Model, read, slopes_of
from .linear_models import linear_flow
from .objective import Objective
from .program import Conditions, Own, Owns, Setting, Shared, delays_of, placed, run_end, with_kinds


class Along(NamedTuple):
    """Of e experiments, at their start and at their n sampling times: differential `states`, their slopes, and ∂f/∂u
    of p inputs; from each of these times to the next, exp(A h) and ∫₀ʰ exp(A s) ds; and ∂y/∂x at the samples."""

    states: Float[Array | np.ndarray, "*e m f"]
    slopes: Float[Array | np.ndarray, "*e m f"]
    by_input: Float[Array | np.ndarray, "*e m f p"]
    flow: Float[Array | np.ndarray, "*e n f f"]
    gathered: Float[Array | np.ndarray, "*e n f f"]
    read: Float[Array | np.ndarray, "*e n k f"]


@compiled
def linearized(setting: Setting, shared: Shared, own: Owns, conditions: Conditions) -> Along:
    """All experiments, along their runs; NaN where one fails."""
    return jax.lax.map(lambda each: _one(setting, shared, *each), (own, conditions))


def _one(setting: Setting, shared: Shared, own: Own, c: Conditions) -> Along:
    layout, plan, dtype = setting.layout, setting.system.plan, c.times.dtype
    f = len(plan.states)
    here, laws, initial = placed(setting, shared, own, c.known)
    inputs = with_kinds(c.inputs, layout, delays_of(layout, shared))
    times = jnp.concatenate([c.t0[None], c.times])
    solution = simulate(
        here, run_end(c.t0, c.times[-1]), t0=c.t0, ts=times, initial=initial or None, inputs=inputs,
        adjoint=diffrax.ForwardMode(), throw=False, **setting.options,
    )  # fmt: skip
    none = jnp.zeros((f, len(layout.outputs)), dtype)
    model = Model(here, laws, {}, inputs, none[:, :0], {}, none[0], none, setting.options)
    sources = by_entry(plan, read_inputs(plan, dtype, inputs))
    names = [name for name in plan.inputs.names if name in sources]

    def at(t, x, q):
        held = model if q is None else model._replace(here=here.holding(q))

        def slopes(first, u):
            given = {**sources, **dict(zip(names, u, strict=True))}
            found = slopes_of(held.here.at(t, given), jnp.concatenate([first, x[f:]]))
            return found, found

        u = [jnp.asarray(value_at(sources[name], t), dtype) for name in names]
        (a, b), found = jax.jacfwd(slopes, argnums=(0, 1), has_aux=True)(x[:f], jnp.stack(u) if u else x[:0])
        return found, a, b, read(model, layout, t, x, q)[1]

    slopes, a, b, c_x = jax.vmap(at)(times, solution.states, solution.discrete)
    h = jnp.diff(times)

    def across(a, h):
        big = jnp.zeros((2 * f, 2 * f), dtype).at[:f, :f].set(a).at[:f, f:].set(jnp.eye(f, dtype=dtype))
        moved = linear_flow(big, jnp.zeros_like(big), h)[0]
        return moved[:f, :f] + jnp.eye(f, dtype=dtype), moved[:f, f:]

    flow, gathered = jax.vmap(across)((a[1:] + a[:-1]) / 2, h)
    return Along(solution.states[:, :f], slopes, b, flow, gathered, c_x[1:])


@dataclasses.dataclass(frozen=True)
class Linearized:
    """What `linearized` finds at a point, in NumPy, for the samples that count; the `times` at which an experiment
    starts and is sampled; and the names of states and inputs."""

    along: Along
    times: Float[np.ndarray, "e m"]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    rows: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, objective: Objective, full: Float[np.ndarray, " p"]) -> "Linearized | None":
        """The linear model of an objective; None where a run fails or nothing moves."""
        plan, s = objective.system.plan, objective.stacked
        if not len(plan.states):
            return None
        shared, own = objective.numbers(objective.coordinates.natural(full))
        found = linearized(objective.setting, shared, own, objective.conditions)
        along = Along(*(np.asarray(a, np.float64) for a in found))
        counted = np.unique(objective.rows[0])
        if not all(np.isfinite(a[counted]).all() for a in along):
            return None
        times = np.concatenate([s.t0[:, None], s.times], axis=1)
        names = tuple(name for name in plan.inputs.names if name in s.inputs)
        return cls(along, times, tuple(objective.system.states), names, objective.rows)

    @property
    def driven(self) -> list[int]:
        """The states whose slopes a term can change: not those whose slope is another state, as of a position."""
        x, dx = (np.concatenate(list(a)) for a in (self.along.states, self.along.slopes))
        size = np.max(np.abs(x), axis=0)
        gap = [np.min(np.max(np.abs(x - dx[:, [i]]), axis=0) - NO_MORE * size) for i in range(x.shape[1])]
        return [i for i, least in enumerate(gap) if least > 0]

    def reads(self, i: int) -> list[int]:
        """The states that the slope of one depends on, itself included."""
        a = np.max(np.abs(self.along.flow[..., i, :]), axis=(0, 1))
        return sorted({i, *np.flatnonzero(a > 0).tolist()})

    def answers(self, into: int, terms: Float[np.ndarray, "e n q"]) -> Float[np.ndarray, "m q"]:
        """The outputs' answers, at the samples that count, to terms in the slope of a state: their means from each time
        to the next."""
        return self.moved(np.einsum("enf,enq->enfq", self.along.gathered[..., into], terms))

    def moved(self, pushes: Float[np.ndarray, "e n f q"]) -> Float[np.ndarray, "m q"]:
        """The outputs' answers to states that are pushed aside before each sample."""
        e, n, f, q = pushes.shape
        delta, moved = np.zeros((e, f, q)), np.empty((e, n, f, q))
        for k in range(n):
            delta = self.along.flow[:, k] @ delta + pushes[:, k]
            moved[:, k] = delta
        experiment, row, output = self.rows
        return np.einsum("mf,mfq->mq", self.along.read[experiment, row, output], moved[experiment, row])


# A slope that differs from another state by no more than this part of its size is that state.
NO_MORE = 1e-6
