"""A compiled system as a problem with events."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, Controller, State, Time, Tolerance
from ...base.tolerances import CONSISTENT, RESOLUTION
from ...compile.lowering.plan_events import EventPlan
from ...solve.adjoint.resting import still
from ...solve.events.facts import EventFacts
from ...solve.events.past import Past, begin_due
from ...solve.events.problem import AbstractHybridProblem, HybridState
from ...solve.methods.switching import Watch
from ...write.events import EventFlag
from ..start.after_event import with_blocks_solved
from ..system.inputs import any_held, from_then_on
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from .impulses import struck
from .preparation import prepared, term_of

RESTART = 8  # Gauss–Newton steps onto the constraints after an event; from 1e-4 they lead to 1e-8 and to rounding


class SystemProblem(AbstractHybridProblem):
    """The equations of a system and its events; the plan of the system says what these are. `watch` and `tolerance` are
    for its solvers."""

    system: AcausalSystem
    watch: Watch | None
    tolerance: Tolerance
    resolution: Time
    implicit: bool = eqx.field(static=True)
    facts: EventFacts = eqx.field(static=True)
    ticks: Array | None = None  # when the breaks come out of delays that do so now
    record: tuple[Tolerance, Tolerance] | None = None  # (atol, rtol) of the record of what is delayed

    @property
    def events(self) -> EventPlan:
        """How the system evaluates its events."""
        assert self.system.plan.events is not None
        return self.system.plan.events

    def term(self, q):
        return term_of(self.system.holding(q), self.implicit)

    def prepared(self, solver, q):
        return prepared(self.system.holding(q), solver, self.implicit, self.watch, self.tolerance)

    def field(self, t, x, q, args):
        return self.system.holding(q).vector_field(t, x, args)

    def guards(self, t, x, q, args):
        return self.system.holding(q).at(t, args).guards(x)

    def clocks(self):
        return SystemAt(self.system.plan, self.system.numbers, (), 0.0, {}, self.system.typical_sizes).clocks()

    def at_instant(self, args):
        problem, past = self, self.system.past
        if past is not None:
            problem = self.remembering(past.past.onwards(self.resolution), self.ticks)
        then, may_jump = (from_then_on(args, self.resolution), any_held(args)) if args else (args, False)
        return problem, then, may_jump

    def remembering(self, past, ticks=None):
        return dataclasses.replace(self, system=dataclasses.replace(self.system, past=past), ticks=ticks)

    def due(self, ticks):
        due = super().due(ticks)
        if self.ticks is None or self.facts.delays is None:
            return due
        return due.at[np.array(self.facts.delays.clocks)].set(self.ticks)

    def sources(self, t, x, q, args):
        values, instants = self.system.holding(q).at(t, args).delayed(x)
        return values, instants

    def longest(self):
        system = self.system
        return SystemAt(system.plan, system.numbers, (), 0.0, {}, system.typical_sizes).longest_delays()

    def allowed(self, size):
        delays = self.system.plan.delays
        assert delays is not None and self.record is not None
        quantity = self.system.plan.variable_map.quantity[delays.table.source]
        atol, rtol = self.record
        return rtol * size + atol * self.system.typical_sizes[quantity]

    def with_past_read(self, t, x, q, args):
        delays = self.system.plan.delays
        if delays is None:
            return q
        return q.at[delays.table.read].set(self.system.holding(q).at(t, args).past_read(x))

    def with_past(self, t0: Time, y0: HybridState, args: Args, room: int) -> HybridState:
        """The state in which a run begins, with room for so many steps within the longest delay."""
        delays = self.facts.delays
        if delays is None:
            return y0
        first, instants = self.sources(t0, y0.x, y0.q, args)
        past = Past.begin(t0, first, t0 - instants, room)
        q = y0.q.at[np.array(delays.begins)].set(0.0)
        return y0.but(q=q, past=past, due=begin_due(delays, t0, t0 - instants, y0.due))

    def written(self, t, x, read, q, previous, events, args):
        plan = self.events
        values = self.system.around_event(t, q, previous, args).event_values(read)
        happens = events[plan.table.event]
        is_state, is_discrete = plan.state >= 0, plan.table.discrete >= 0
        place = plan.state[is_state]
        new = (values / jnp.asarray(plan.factor, values.dtype))[is_state]
        # Added rather than set: what does not happen adds zero, and an event leaves other entries with their
        # derivatives.
        x = x.at[place].add(jnp.where(happens[is_state], new - x[place], 0.0))
        before = q
        place, new = plan.table.discrete[is_discrete], values[is_discrete]
        q = q.at[place].add(jnp.where(happens[is_discrete], new - q[place], 0.0))
        # An event may take nonlinear blocks to another branch, far from their last solution.
        if len(self.system.plan.carried):
            holding, now, guess, given = still((self.system.holding(q), t, x, args))
            n = len(self.system.plan.states)
            x = x.at[n:].set(with_blocks_solved(holding.at(now, given), guess)[n:])
        if self.system.plan.held is None:
            return self.admitted(t, x, q, args), q
        x, q, done = struck(self.system, t, x, before, q, args)
        return jnp.where(done, self.admitted(t, x, q, args), jnp.nan), q

    def settled(self, t, x, q, events, args):
        table = self.events.table
        assigns = table.discrete >= 0
        values = self.system.around_event(t, q, q, args).event_values(x)[assigns]
        # More than one event may write a value, but then the same.
        new = (
            jnp.full_like(q, -jnp.inf)
            .at[table.discrete[assigns]]
            .max(jnp.where(events[table.event[assigns]], values, -jnp.inf))
        )
        return jnp.where(new > -jnp.inf, new, q)

    def admitted(self, t: Time, x: State, q: Array, args: Args) -> Array:
        """The state projected onto the constraints that hold with q; NaN if it is not near them."""
        plan = self.system.plan
        if not self.system.is_constrained:
            return x
        projected = self.system.holding(q).project(t, x, args, iterations=RESTART)
        n, typical = len(plan.states), self.system.typical_sizes[plan.states]
        allowed = CONSISTENT * (jnp.abs(x[:n]) + jax.lax.stop_gradient(typical))
        # A projection that moves a state farther would decide what the event has left open, or ask for the impossible.
        consistent = jnp.all(jnp.abs(projected[:n] - x[:n]) <= allowed)
        return jnp.where(consistent, projected, jnp.nan)


def resolution(t0: Time, t1: Time) -> Time:
    """A time that is nothing beside a run from t0 to t1, but more than rounding."""
    largest = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(t0), jnp.abs(t1)), t1 - t0))
    return RESOLUTION * jnp.finfo(largest.dtype).eps * largest


def problem_for(
    system: AcausalSystem, t0: Time, t1: Time, implicit: bool, watch: Watch | None, tolerance: Tolerance,
    record: tuple[Tolerance, Tolerance] | None = None,
) -> SystemProblem:  # fmt: skip
    """The problem of a system that has events, to be run from t0 to t1."""
    events = system.plan.some_events
    return SystemProblem(
        system=system,
        watch=watch,
        tolerance=tolerance,
        resolution=resolution(t0, t1),
        implicit=implicit,
        facts=events.facts,
        record=record,
    )


def without_clocked(system: AcausalSystem, q: Array) -> Array:
    """The discrete values with the relations of time as they are before they are known: a run that goes on from another
    one, perhaps with other parameters, looks at the clock instead."""
    events = system.plan.some_events
    table = events.table
    clocked = table.are(EventFlag.RELATION)[table.event] & (table.event < events.n_clocks)
    chosen = np.unique(table.discrete[clocked])
    if not len(chosen):
        return q
    return q.at[chosen].set(jnp.asarray(system.plan.flat.parameters.starts_of(events.discrete[chosen]), q.dtype))


def saved_with_events(t: Time, y: HybridState, args: Args) -> State:
    """What is saved of a state: (x, q, the sides of guards and the counts of ticks)."""
    return y.x, y.q, jax.lax.stop_gradient(jnp.concatenate([y.armed, y.ticks]))


class SavedWithPast(eqx.Module):
    """What is saved of a state with a past: discrete values have what equations read of it."""

    problem: SystemProblem

    def __call__(self, t: Time, y: HybridState, args: Args) -> State:
        return saved_with_events(t, y.but(q=self.held(t, y, args)), args)

    def held(self, t: Time, y: HybridState, args: Args) -> Array:
        """The discrete values at a time."""
        problem = self.problem.remembering(y.past.onwards(self.problem.resolution))
        return problem.with_past_read(t, y.x, y.q, args)


def tolerances_of_a_record(controller: Controller, atol: Tolerance) -> tuple[Tolerance, Tolerance]:
    """The absolute and the relative tolerance of a record of what is delayed; where steps are prescribed, all is as
    exact as they are."""
    while isinstance(controller, diffrax.ClipStepSizeController):
        controller = controller.controller
    rtol = getattr(controller, "rtol", None)
    return (1e30, 1.0) if rtol is None else (atol, jax.lax.stop_gradient(rtol))
