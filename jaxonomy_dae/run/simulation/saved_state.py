"""Whole states of runs, from which other runs go on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Numeric, Time, Times
from ...base.errors import ModelError
from ...base.tolerances import KNOWN_ROUNDINGS
from ...compile.diagnosis.wording import some
from ...host.staging import is_traced, picked
from ...solve.events.problem import AbstractHybridProblem
from ...solve.events.start import Resumed
from ...solve.methods.rows import padded
from ..system.system import AcausalSystem


class SavedState(eqx.Module):
    """The whole state of a run at one time, as `solution.at(k)` returns it. Another run can continue from it:

    ```python
    first = simulate(system, 5.0, ts=ts)
    second = simulate(system, 10.0, initial=first.at(-1))
    ```

    It is a pytree of arrays. It can be the carry of `jax.lax.scan`, and works under `jax.vmap` and `jax.grad`.

    - `t`: the time.
    - `x`: the array of states for `system.vector_field`, shape `(n_state,)`.
    - `discrete`: the discrete variables, `system.discretes`, followed by those of relations, shape `(q,)`.
        `system.holding(state.discrete)` is the system while they have these values:
        `system.holding(state.discrete).vector_field(state.t, state.x)`.
    - `sides`, `ticked`, `sizes`: the memory of the events: the side of each condition, the clocks that have ticked at
        this time, and the largest sizes of the quantities in conditions.
    - `of`: a digest of the names of the states and of the discrete variables, so that a state is not taken for one of
        another model with as many.
    """

    t: Time
    x: Float[Array, "*batch n"]
    discrete: Float[Array, "*batch q"]
    sides: Float[Array, "*batch guards"]
    ticked: Float[Array, "*batch clocks"]
    sizes: Float[Array, "*batch guards"]
    of: str = eqx.field(static=True, default="")

    @property
    def events(self) -> Resumed:
        """What is known of the events."""
        return Resumed(*(jax.lax.stop_gradient(part) for part in (self.sides, self.ticked, self.sizes)))


class Memory(eqx.Module):
    """Of a run with events: `sides` of the guards and `ticked` clocks at the n saved times, and the guards' `sizes`."""

    sides: Float[Array, "*batch n guards"]
    ticked: Float[Array, "*batch n clocks"]
    sizes: Float[Array, "*batch guards"]

    @classmethod
    def of(cls, problem: AbstractHybridProblem, ts: Times, marks: Numeric, sizes: Numeric) -> "Memory":
        """The memory of the rows saved at `ts`, whose `marks` are the sides of the guards and the counts of ticks."""
        sides, ticks = marks[:, : problem.facts.n_guards], marks[:, problem.facts.n_guards :]
        # Whether a clock has ticked at the saved time itself: a run that goes on from there must not tick again, nor
        # leave out a tick that is due.
        since = jnp.abs(jax.vmap(problem.due)(ticks - 1.0) - ts[:, None])
        ticked = (ticks > 0) & (since <= 2 * problem.resolution)
        return jax.lax.stop_gradient(cls(sides, ticked.astype(sides.dtype), sizes))

    def first(self, rows: int) -> "Memory":
        """The first rows alone."""
        return Memory(picked(self.sides, slice(rows)), picked(self.ticked, slice(rows)), self.sizes)

    def padded(self, ts: Times, steps: Numeric) -> "Memory":
        """The memory with the last row in place of the rows beyond the steps taken."""
        sides, ticked = (padded(ts, rows, steps)[1] for rows in (self.sides, self.ticked))
        return Memory(sides, ticked, self.sizes)


def initial_time(t0: Time, initial: object) -> Time:
    """The time at which a run begins: as given, that of a whole state, or 0."""
    if t0 is not None:
        return t0
    return initial.t if isinstance(initial, SavedState) else 0.0


def same_time(t0: Time, state: SavedState) -> Numeric:
    """True if a state is that of the time t0, up to the rounding of a few sums."""
    return jnp.abs(t0 - state.t) <= KNOWN_ROUNDINGS * jnp.finfo(state.x.dtype).eps * jnp.abs(state.t)


def check_saved_state(system: AcausalSystem, t0: Time, state: SavedState) -> None:
    """Raises a `ModelError` if a state cannot be one of this system, or is of another time than `t0`."""
    events, n = system.plan.events, system.plan.n_state
    clocks, guards, discretes = (
        (0, 0, 0) if events is None else (events.n_clocks, len(events) - events.n_clocks, len(events.discrete))
    )
    needed = {"x": n, "discrete": discretes, "sides": guards, "ticked": clocks, "sizes": guards}
    for name, length in needed.items():
        shape = jnp.shape(getattr(state, name))
        if shape != (length,):
            raise ModelError(
                f"initial: a state of this system has {name} of shape ({length},); this one has {shape}. It is a state "
                "of another model, or a batch: map over batches with equinox.filter_vmap"
            )
    if state.of and state.of != system.plan.digest_of_states:
        raise ModelError(
            f"initial: this state is one of another model: here, it has {some([*system.states, *system.carried])}"
            + (f" and {some(list(system.discretes))}" if len(system.discretes) else "")
            + ". Give initial={'component.variable': value, …} for what is to be taken over"
        )
    finite = [part for part in (state.t, state.x, state.discrete) if not is_traced(part)]
    if not all(np.isfinite(np.asarray(part)).all() for part in finite):
        raise ModelError("initial: this state has entries that are not finite: the run that it is of did not get there")
    if t0 is None or is_traced(t0) or is_traced(state.t):
        return
    known = np.abs(np.asarray(t0, state.x.dtype) - np.asarray(state.t))
    if not known <= KNOWN_ROUNDINGS * np.finfo(state.x.dtype).eps * np.abs(np.asarray(state.t)):
        raise ModelError(
            f"t0={float(t0):g}, but the state given as initial is that of t={float(state.t):g}: leave t0 out. To go on "
            "from it at another time, say so with dataclasses.replace(state, t=...)"
        )
