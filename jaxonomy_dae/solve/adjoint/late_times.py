"""Solves whose times Diffrax does not check while they run.

Given are the times at which a solve saves, and its first step. `diffrax.diffeqsolve` checks by `equinox.error_if` that
they fit to the interval, which puts callbacks to the host into the program; one is enough to keep it out of JAX's
persistent compilation cache and out of `jax.export`. So it is not told of these times: those to save at join where its
loop over the steps begins, and the first step is the controller's own. `times_fit` makes the same check as a value.
What a user's functions check stays where it is.
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ...base.aliases import Args, Controller, PyTree, Solver, State, Terms, Time, Times
from ...base.private_names import FOR_LATE_TIMES, missing
from ...host.staging import is_traced
from .closure_conversion import as_traced
from .ends import End, ending


def times_fit(t0: Time, t1: Time, ts: Times, controller: Controller) -> Bool[Array, ""] | bool:
    """True if the times to save, shape (n,) or None, are sorted and lie between t0 and t1, and if those of a
    `diffrax.StepTo` lead from t0 to t1. A Python bool where nothing is traced."""
    steps = controller.ts if isinstance(controller, diffrax.StepTo) else None
    traced = is_traced((t0, t1, ts, steps))
    xp: Any = jnp if traced else np
    if not traced:
        t0, t1, ts, steps = (None if value is None else np.asarray(value) for value in (t0, t1, ts, steps))
    sign = xp.where(t0 < t1, 1, -1)
    fits = xp.isfinite(t0) & xp.isfinite(t1)
    if ts is not None:
        inside = (ts * sign >= t0 * sign) & (ts * sign <= t1 * sign)
        fits = fits & xp.all(inside) & xp.all(xp.diff(ts) * sign >= 0)
    if steps is not None:
        fits = fits & (steps[0] == t0) & (steps[-1] == t1) & xp.all(xp.diff(steps) * sign > 0)
    return fits if traced else bool(fits)


class Integration(NamedTuple):
    """What is integrated, and by what, in Diffrax' terms. `save` says what is saved. The first step `dt0`, or None, is
    positive where t0 < t1."""

    term: Terms
    solver: Solver
    t0: Time
    t1: Time
    dt0: Time
    y0: State
    args: Args
    save: diffrax.SubSaveAt
    controller: Controller
    adjoint: Any
    max_steps: int


def diffeqsolve(of: Integration, solver_state: bool, progress: diffrax.AbstractProgressMeter) -> diffrax.Solution:
    """`diffrax.diffeqsolve` without its checks of times, for an interval and times of one dtype. What is saved is found
    in `ts["out"]` and `ys["out"]`, the last accepted point in `ts["last"]` and `ys["last"]`."""
    subs, controller, adjoint = {"last": diffrax.SubSaveAt(t1=True)}, of.controller, of.adjoint
    # With another version of Diffrax the times are given to it, and its checks return with them.
    if of.save.ts is None or missing(FOR_LATE_TIMES) is not None:
        subs["out"] = of.save
    else:
        adjoint = _LateTimes(adjoint, of.save, jnp.where(of.t0 < of.t1, 1, -1))  # pyright: ignore[reportCallIssue]
    if of.dt0 is not None:
        controller = ending(controller, FirstStep(of.dt0))
    elif isinstance(controller, diffrax.StepTo):
        controller = _StepTo(controller)  # pyright: ignore[reportCallIssue]
    return diffrax.diffeqsolve(
        of.term, of.solver, of.t0, of.t1, None, of.y0, of.args, stepsize_controller=controller, adjoint=adjoint,
        saveat=diffrax.SaveAt(subs=subs, solver_state=solver_state), max_steps=of.max_steps, throw=False,
        progress_meter=progress,
    )  # fmt: skip


class _LateTimes(diffrax.AbstractAdjoint):
    """Wraps an adjoint so that its solves save at times that `diffrax.diffeqsolve` was not given.

    - `save`: when to save, in the time of the equations.
    - `direction`: −1 where that runs backwards; Diffrax' loop always goes forwards.
    """

    adjoint: diffrax.AbstractAdjoint
    save: diffrax.SubSaveAt
    direction: Time

    def loop(self, **given: PyTree) -> PyTree:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The loop over the steps, as `diffrax.diffeqsolve` calls it; buffers and times of `SaveAt` are put in here."""
        # Diffrax's loop goes forwards in a time of its own: times are turned for it, and turned back for the user's
        # function.
        state, saveat, t0 = given["init_state"], given["saveat"], given["t0"]
        ts, direction = self.save.ts, self.direction
        assert ts is not None
        save = dataclasses.replace(
            self.save,
            ts=(ts * direction).astype(t0.dtype),
            fn=lambda t, y, args: self.save.fn(direction * t, y, args),
        )
        count = len(ts)
        shapes = eqx.filter_eval_shape(save.fn, t0, state.y, given["args"])
        # As Diffrax would begin: rows that are not reached stay infinite. The counters in the buffer of the last point
        # are zero, since nothing is saved at t0.
        saved = dataclasses.replace(
            state.save_state["last"],
            ts=jnp.full((count,), jnp.inf, t0.dtype),
            ys=jax.tree.map(lambda y: jnp.full((count, *y.shape), jnp.inf, y.dtype), shapes),
        )
        return self.adjoint.loop(
            **given
            | dict(
                init_state=dataclasses.replace(
                    state, save_state=state.save_state | {"out": saved}, result=as_traced(state.result)
                ),
                saveat=dataclasses.replace(saveat, subs=saveat.subs | {"out": save}),
            )
        )


class FirstStep(End):
    """The first step has the size `dt0`."""

    dt0: Time

    def wrap(self, direction):
        return FirstStep(self.dt0 * direction)

    def asked(self, dt0):
        return self.dt0


class _StepTo(diffrax.AbstractStepSizeController):
    """`diffrax.StepTo` without the run-time checks of its times."""

    controller: diffrax.StepTo

    def wrap(self, direction):
        turned = diffrax.StepTo(self.controller.ts * direction)
        return _StepTo(turned)  # pyright: ignore[reportCallIssue]

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        # What `diffrax.StepTo.init` returns: the end of the first step, and the place of the time after it.
        return self.controller.ts[1], 2

    def adapt_step_size(self, *given):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.adapt_step_size(*given)
