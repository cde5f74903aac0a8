"""The compiled programs of multiple shooting: all segments of all experiments at once, as one batch, with derivatives
by what they share, by what each experiment has to itself, and by the states at their nodes."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..host.cache import compiled
from ..run.simulation.simulate import simulate
from .devices import each, each_with_slopes
from .program import Conditions, Inputs, Owns, Setting, Shared, outputs_of, placed, run_end, with_kinds


class Cut(eqx.Module):
    """The conditions of e experiments, each in N segments: l times from the start of a segment to its end, its start,
    known starts, and inputs over the whole time."""

    times: Float[Array, "e N l"]
    t0: Float[Array, "e N"]
    known: Float[Array, "e known"]
    inputs: Inputs


class Ran(eqx.Module):
    """The results of segments: outputs at l times, and the consistent states of n entries at both ends."""

    outputs: Float[Array, "*batch l k"]
    start: Float[Array, "*batch n"]
    end: Float[Array, "*batch n"]


@compiled
def first_states(
    setting: Setting, shared: Shared, own: Owns, conditions: Conditions
) -> tuple[Float[Array, "e n"], Float[Array, "e n s"], Float[Array, "e n o"]]:
    """The states at which experiments start, and their derivatives by the shared numbers and by each one's own."""

    def one(shared, own, c):
        here, _, initial = placed(setting, shared, own, c.known)
        return here.initialize(c.t0, with_kinds(c.inputs, setting.layout) or None, initial or None, throw=False)

    return each_with_slopes(one, setting.layout.mesh, shared, own, conditions)


@compiled
def on_constraints(
    setting: Setting, iterations: int, shared: Shared, own: Owns, states: Float[Array, "e N n"], cut: Cut
) -> tuple[Float[Array, "e N n"], Float[Array, "e N n f"]]:
    """The states at the nodes moved onto the constraints, and the derivatives there of this projection by the f
    differential states."""
    f = len(setting.system.plan.states)

    def one(shared, own, x, t, c):
        here, _, _ = placed(setting, shared, own, c.known)
        inputs = with_kinds(c.inputs, setting.layout) or None
        x = here.project(t, x, inputs, iterations=iterations)
        slope = jax.jacfwd(lambda first: here.project(t, jnp.concatenate([first, x[f:]]), inputs))(x[:f])
        return x, slope

    def nodes(shared, own, told):
        states, c = told
        return jax.vmap(lambda x, t: one(shared, own, x, t, c))(states, c.t0)

    return each(nodes, setting.layout.mesh, shared, own, (states, cut))


@compiled
def run_segments(
    setting: Setting,
    moving: tuple[int, ...],
    shared: Shared,
    own: Owns,
    states: Float[Array, "e N n"],
    bases: Float[Array, "e N n d"],
    cut: Cut,
) -> tuple[Ran, Ran]:
    """All segments, from states at the nodes; and their derivatives, in a last axis, by numbers common to segments, at
    the places `moving` in [shared | own], and by the coefficients of `bases`, shape (e, N, n, d), along which nodes
    move."""
    layout, count, places = setting.layout, len(moving), np.array(moving, int)

    def one(moved, shared, own, segment, c):
        x, basis, times, t0 = segment
        both = jnp.concatenate([shared, own]).at[places].set(moved[:count])
        shared, own = both[: len(shared)], both[len(shared) :]
        delta = moved[count:]
        here, laws, _ = placed(setting, shared, own, c.known)
        solution = simulate(
            here, run_end(t0, times[-1]), t0=t0, ts=times, initial=x + basis @ delta, adjoint=diffrax.ForwardMode(),
            throw=False, inputs=with_kinds(c.inputs, layout), **setting.options,
        )  # fmt: skip
        found = Ran(outputs_of(solution, laws, layout, times.dtype), solution.states[0], solution.states[-1])
        return found, found

    def with_slopes(shared, own, segment, c):
        basis = segment[1]
        moved = jnp.concatenate([jnp.concatenate([shared, own])[places], jnp.zeros(basis.shape[-1:], basis.dtype)])
        slopes, found = jax.jacfwd(one, has_aux=True)(moved, shared, own, segment, c)
        return found, slopes

    def segments(shared, own, told):
        states, bases, c = told

        return jax.vmap(lambda segment: with_slopes(shared, own, segment, c))((states, bases, c.times, c.t0))

    return each(segments, layout.mesh, shared, own, (states, bases, cut))
