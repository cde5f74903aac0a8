"""A compiled system as a problem with events."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, State, Time, Tolerance
from ...base.tolerances import CONSISTENT, LEFT, PULL, RESOLUTION
from ...compile.lowering.plan_events import EventPlan
from ...solve.adjoint.resting import still
from ...solve.events.facts import EventFacts
from ...solve.events.first_order import constant_once
from ...solve.events.problem import AbstractHybridProblem
from ...solve.methods.switching import Watch
from ...write.events import EventFlag
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from .preparation import prepared, term_of

RESTART = 8  # Gauss–Newton steps onto the constraints after an event; from 1e-4 they lead to 1e-8 and to rounding
# Contacts are exchanged at most this many times, for each of them, while one impact is resolved. If an impulse would
# still have to pull, the event fails.
TRIES = 4

_Point = tuple[Time, State, Array, Args]  # time, states, discrete values, and what equations get beside these


class SystemProblem(AbstractHybridProblem):
    """The equations of a system and its events; the plan of the system says what these are. `watch` and `tolerance` are
    for its solvers."""

    system: AcausalSystem
    watch: Watch | None
    tolerance: Tolerance
    resolution: Time
    implicit: bool = eqx.field(static=True)
    facts: EventFacts = eqx.field(static=True)

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

    def written(self, t, x, read, q, previous, events, args):
        plan = self.events
        values = self.system.around_event(t, q, previous, args).event_values(read)
        happens = events[plan.table.event]
        is_state, is_discrete = plan.state >= 0, plan.table.discrete >= 0
        place = plan.state[is_state]
        new = (values / jnp.asarray(plan.factor, values.dtype))[is_state]
        x = x.at[place].add(jnp.where(happens[is_state], new - x[place], 0.0))
        before = q
        place, new = plan.table.discrete[is_discrete], values[is_discrete]
        q = q.at[place].add(jnp.where(happens[is_discrete], new - q[place], 0.0))
        if self.system.plan.held is None:
            return self.admitted(t, x, q, args), q
        x, q, done = self.struck(t, x, before, q, args)
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

    def struck(self, t: Time, x: State, before: Array, q: Array, args: Args) -> tuple[Array, Array, Array]:
        """Applies the impulses of the constraints that begin to hold with q, or that q asks for. Returns (x, q, whether
        the impulses do what they should).

        An equation e' + κ·e = 0 takes the place of e' = 0. States along ∂f/∂κ at κ = 0 are those after the impulse that
        takes e away: exact where e is affine in what jumps (speeds; charges of linear capacitors).

        Contacts push and do not pull: of those that strike or are closed, some act, with impulses p ≥ 0, and the others
        part, w = e⁺ − (1 − strength)·e ≥ 0 (Moreau 1988; Newton's law of restitution). Which ones act is found by
        exchanging the first that pulls or does not part, until there is none (Murty 1974: finite where all impulses
        have energies, as of independent contacts; from those that were closed, so that one that repeats others never
        acts).
        """
        plan = self.system.plan
        held, n = plan.held, len(plan.states)
        assert held is not None
        place, pushes = held.table.impulse, held.table.closed >= 0
        closed = held.table.closed[pushes]
        held_before, _ = self.system.holding(before).at(t, args).held(x)
        holds, levels = self.system.holding(q).at(t, args).held(x)
        e = levels[held.last]
        strength = jnp.where(q[place] == 0, holds * (1 - held_before), q[place])

        def jump(problem: SystemProblem, point: _Point, acting: Array, strength: Array) -> tuple[Array, ...]:
            """(q with the contacts that act, the states after their impulses, these, e⁺)."""
            t, x, q, args = point
            system = problem.system
            q = q.at[closed].set(jnp.where(acting[pushes], q[closed], 0.0))
            strength = jnp.where(acting, strength, 0.0)

            def responds(strength):
                on = system.holding(q.at[place].set(strength))
                return on.vector_field(t, x, args), on.at(t, args).held_forces(x)

            _, (change, pushed) = jax.jvp(responds, (strength,), (strength,))
            after = x.at[:n].add(change[:n])
            q = q.at[place].set(0.0)
            return q, after, pushed, system.holding(q).at(t, args).held(after)[1][held.last]

        acting, wrong = jnp.ones(len(pushes), bool), jnp.zeros((), bool)
        if len(pushes) > 1 and pushes.any():
            strikes = jnp.asarray(pushes) & (strength > 0)
            may_change = strikes | (jnp.asarray(pushes) & (holds > 0))
            acting, wrong = self._acting(jump, (t, x, q, args), strength, e, strikes, may_change)
        q, after, _, left = jump(self, (t, x, q, args), acting, strength)
        done = jnp.abs(left - (1 - strength) * e) <= LEFT * jnp.abs(strength * e)
        return after, q, jnp.all(done | (strength == 0) | ~acting) & ~wrong

    def _acting(
        self,
        jump: Callable[..., tuple[Array, ...]],
        point: _Point,
        strength: Array,
        e: Array,
        strikes: Array,
        may_change: Array,
    ) -> tuple[Array, Array]:
        """Which contacts act, and whether that could not be found; not differentiated."""
        problem, point, strength, e = still(constant_once((self, point, strength, e)))
        n = len(may_change)
        speed = PULL * jnp.max(jnp.abs(strength * e), initial=0.0)

        def exchanged(carry):
            acting, _, count = carry
            _, _, pushed, after = jump(problem, point, acting, strength)
            pulls = acting & (pushed < -PULL * jnp.max(jnp.abs(pushed)))
            meets = ~acting & (after - (1 - strength) * e < -speed)
            wrong = may_change & (pulls | meets)
            first = jnp.arange(n) == jnp.argmax(wrong)
            return jnp.where(wrong & first, ~acting, acting), jnp.any(wrong), count + 1

        # One that strikes alone acts, and is tried first.
        alone = jnp.sum(strikes) == 1
        begin = ~strikes | alone, jnp.ones((), bool), jnp.zeros((), int)
        acting, wrong, _ = jax.lax.while_loop(lambda c: c[1] & (c[2] < TRIES * n), exchanged, begin)
        return acting, wrong

    def admitted(self, t: Time, x: State, q: Array, args: Args) -> Array:
        """The state projected onto the constraints that hold with q; NaN if it is not near them."""
        plan = self.system.plan
        if not self.system.is_constrained:
            return x
        projected = self.system.holding(q).project(t, x, args, iterations=RESTART)
        n, typical = len(plan.states), self.system.typical_sizes[plan.states]
        allowed = CONSISTENT * (jnp.abs(x[:n]) + jax.lax.stop_gradient(typical))
        consistent = jnp.all(jnp.abs(projected[:n] - x[:n]) <= allowed)
        return jnp.where(consistent, projected, jnp.nan)


def resolution(t0: Time, t1: Time) -> Time:
    """A time that is nothing beside a run from t0 to t1, but more than rounding."""
    largest = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(t0), jnp.abs(t1)), t1 - t0))
    return RESOLUTION * jnp.finfo(largest.dtype).eps * largest


def problem_for(
    system: AcausalSystem, t0: Time, t1: Time, implicit: bool, watch: Watch | None, tolerance: Tolerance
) -> SystemProblem:
    """The problem of a system that has events, to be run from t0 to t1."""
    events = system.plan.some_events
    return SystemProblem(
        system=system,
        watch=watch,
        tolerance=tolerance,
        resolution=resolution(t0, t1),
        implicit=implicit,
        facts=events.facts,
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
