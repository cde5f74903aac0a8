"""A compiled system as a problem with events."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ..hybrid.control import EventControl
from ..hybrid.problem import AbstractHybridProblem
from ..solvers.switching import Watch
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from .preparation import prepared, term_of

RESOLUTION = 32.0  # times the spacing of floating-point numbers at the largest time of a run
CONSISTENT = 1e-4  # of a state's size: what projection may change of what an event writes and leaves
RESTART = 8  # Gauss–Newton steps onto the constraints after an event


class SystemProblem(AbstractHybridProblem):
    """The equations of a system and its events. `watch` and `tolerance` are for its solvers."""

    system: AcausalSystem
    watch: Watch | None
    tolerance: Any
    resolution: Any
    implicit: bool = eqx.field(static=True)
    n_clocks: int = eqx.field(static=True)
    n_guards: int = eqx.field(static=True)
    ends: tuple[bool, ...] = eqx.field(static=True)
    immediate: tuple[bool, ...] = eqx.field(static=True)
    noted: tuple[bool, ...] = eqx.field(static=True)
    revocable: tuple[bool, ...] = eqx.field(static=True)

    def term(self, q):
        return term_of(self.system.holding(q), self.implicit)

    def prepared(self, solver, q):
        return prepared(self.system.holding(q), solver, self.implicit, self.watch, self.tolerance)

    def field(self, t, x, q, args):
        return self.system.holding(q).vector_field(t, x, args)

    def guards(self, t, x, q, args):
        return self.system.holding(q).at(t, args).guards(x)

    def clocks(self):
        return SystemAt(self.system.plan, self.system.numbers, (), 0.0, {}).clocks()

    def written(self, t, x, q, previous, event, args):
        events: Any = self.system.plan.events
        values = self.system.around_event(t, q, previous, args).event_values(x)
        happens = jnp.asarray(events.table.event) == event
        is_state, is_discrete = events.state >= 0, events.table.discrete >= 0
        place = events.state[is_state]
        new = (values / jnp.asarray(events.factor, values.dtype))[is_state]
        x = x.at[place].add(jnp.where(happens[is_state], new - x[place], 0.0))
        place, new = events.table.discrete[is_discrete], values[is_discrete]
        q = q.at[place].add(jnp.where(happens[is_discrete], new - q[place], 0.0))
        if self.system.is_constrained:
            projected = self.system.holding(q).project(t, x, args, iterations=RESTART)
            n, typical = len(self.system.plan.states), self.system.plan.typical_sizes[self.system.plan.states]
            allowed = CONSISTENT * (jnp.abs(x[:n]) + jnp.asarray(typical, x.dtype))
            consistent = jnp.all(jnp.abs(projected[:n] - x[:n]) <= allowed)
            x = jnp.where(consistent, projected, jnp.nan)
        return x, q


def problem_for(
    system: AcausalSystem, t0: Any, t1: Any, implicit: bool, watch: Watch | None, tolerance: Any
) -> SystemProblem:
    """The problem of a system that has events, to be run from t0 to t1."""
    largest = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(t0), jnp.abs(t1)), t1 - t0))
    events: Any = system.plan.events
    ends = tuple(message is not None for message in events.table.message)
    return SystemProblem(
        system=system, watch=watch, tolerance=tolerance, implicit=implicit,
        resolution=RESOLUTION * jnp.finfo(t1.dtype).eps * largest,
        n_clocks=events.n_clocks, n_guards=len(events) - events.n_clocks, ends=ends, immediate=events.table.immediate,
        noted=events.table.noted,
        revocable=events.table.revocable,
    )  # fmt: skip


def with_event_control(controller: Any) -> Any:
    """The controller whose steps end at events; what clips steps at jumps of inputs stays outside."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return eqx.tree_at(lambda c: c.controller, controller, with_event_control(controller.controller))
    return EventControl(controller)  # pyright: ignore[reportCallIssue]
