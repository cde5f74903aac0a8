"""A compiled system as a problem with events."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..aliases import Args, Controller, State, Time, Tolerance
from ..hybrid.control import EventControl
from ..hybrid.problem import AbstractHybridProblem
from ..model.tables import EventTable
from ..solvers.switching import Watch
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from ..tolerances import CONSISTENT, LEFT, PULL, RESOLUTION
from .preparation import prepared, term_of

RESTART = 8  # Gauss–Newton steps onto the constraints after an event; from 1e-4 they lead to 1e-8 and to rounding
# Contacts are released at most this many times while one impact is resolved. If an impulse would still have to pull,
# the event fails.
TRIES = 3


class SystemProblem(AbstractHybridProblem):
    """The equations of a system and its events. `watch` and `tolerance` are for its solvers."""

    system: AcausalSystem
    watch: Watch | None
    tolerance: Tolerance
    resolution: Time
    implicit: bool = eqx.field(static=True)
    n_clocks: int = eqx.field(static=True)
    n_guards: int = eqx.field(static=True)
    ends: tuple[bool, ...] = eqx.field(static=True)
    immediate: tuple[bool, ...] = eqx.field(static=True)
    noted: tuple[bool, ...] = eqx.field(static=True)
    revocable: tuple[bool, ...] = eqx.field(static=True)
    relations: tuple[bool, ...] = eqx.field(static=True)
    strict: tuple[bool, ...] = eqx.field(static=True)
    opposite: tuple[int, ...] = eqx.field(static=True)
    choices: tuple[int, ...] = eqx.field(static=True)
    choice_guards: tuple[int, ...] = eqx.field(static=True)
    only_kinks: bool = eqx.field(static=True)

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

    def written(self, t, x, q, previous, event, args):
        events: Any = self.system.plan.events
        values = self.system.around_event(t, q, previous, args).event_values(x)
        happens = jnp.asarray(events.table.event) == event
        is_state, is_discrete = events.state >= 0, events.table.discrete >= 0
        place = events.state[is_state]
        new = (values / jnp.asarray(events.factor, values.dtype))[is_state]
        x = x.at[place].add(jnp.where(happens[is_state], new - x[place], 0.0))
        before = q
        place, new = events.table.discrete[is_discrete], values[is_discrete]
        q = q.at[place].add(jnp.where(happens[is_discrete], new - q[place], 0.0))
        if self.system.plan.held is None:
            return self.admitted(t, x, q, args), q
        x, q, done = self.struck(t, x, before, q, args)
        return jnp.where(done, self.admitted(t, x, q, args), jnp.nan), q

    def settled(self, t, x, q, events, args):
        events_of: Any = self.system.plan.events
        table = events_of.table
        assigns = table.discrete >= 0
        values = self.system.around_event(t, q, q, args).event_values(x)[assigns]
        # More than one event may write a value, but then the same.
        new = (
            jnp.full_like(q, -jnp.inf)
            .at[table.discrete[assigns]]
            .max(jnp.where(events[table.event[assigns]], values, -jnp.inf))
        )
        return jnp.where(new > -jnp.inf, new, q)

    def struck(self, t: Time, x: State, before: Any, q: Any, args: Args) -> tuple[Any, Any, Any]:
        """Applies the impulses of the constraints that begin to hold with q, or that q asks for. Returns (x, q, whether
        the impulses do what they should).

        An equation e' + κ·e = 0 takes the place of e' = 0. States along ∂f/∂κ at κ = 0 are those after the impulse that
        takes e away: exact where e is affine in what jumps (speeds; charges of linear capacitors). What is closed and
        only pushes lets go if its impulse would be negative (Moreau 1988).
        """
        plan: Any = self.system.plan
        held, n = plan.held, len(plan.states)
        place, pushes = held.table.impulse, held.table.closed >= 0
        closed = held.table.closed[pushes]
        held_before, _ = self.system.holding(before).at(t, args).held(x)
        _, levels = self.system.holding(q).at(t, args).held(x)

        def attempt(q, _):
            """The jump with q; and q without what this jump would have to pull instead of push."""
            holds, _ = self.system.holding(q).at(t, args).held(x)
            strength = jnp.where(q[place] == 0, holds * (1 - held_before), q[place])

            def responds(strength):
                system = self.system.holding(q.at[place].set(strength))
                return system.vector_field(t, x, args), system.at(t, args).held_forces(x)

            _, (change, pushed) = jax.jvp(responds, (strength,), (strength,))
            pulls = (holds > 0) & (strength == 0) & (pushed < -PULL * jnp.max(jnp.abs(pushed)))
            lets_go = pulls[pushes]
            return q.at[closed].set(jnp.where(lets_go, 0.0, q[closed])), (change, strength, jnp.any(lets_go))

        length = 1 + min(int(pushes.sum()), TRIES)
        q, tried = jax.lax.scan(attempt, q, length=length)
        change, strength, wrong = jax.tree.map(lambda rows: rows[-1], tried)
        q = q.at[place].set(0.0)
        after = x.at[:n].add(change[:n])
        _, levels_after = self.system.holding(q).at(t, args).held(after)
        e, left = levels[held.last], levels_after[held.last]
        done = jnp.abs(left - (1 - strength) * e) <= LEFT * jnp.abs(strength * e)
        return after, q, jnp.all(done | (strength == 0)) & ~wrong

    def admitted(self, t: Time, x: State, q: Any, args: Args) -> Any:
        """The state projected onto the constraints that hold with q; NaN if it is not near them."""
        plan = self.system.plan
        if not self.system.is_constrained:
            return x
        projected = self.system.holding(q).project(t, x, args, iterations=RESTART)
        n, typical = len(plan.states), self.system.typical_sizes[plan.states]
        allowed = CONSISTENT * (jnp.abs(x[:n]) + jax.lax.stop_gradient(typical))
        consistent = jnp.all(jnp.abs(projected[:n] - x[:n]) <= allowed)
        return jnp.where(consistent, projected, jnp.nan)


def resolution(t0: Any, t1: Any) -> Any:
    """A time that is nothing beside a run from t0 to t1, but more than rounding."""
    largest = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(t0), jnp.abs(t1)), t1 - t0))
    return RESOLUTION * jnp.finfo(largest.dtype).eps * largest


def problem_for(
    system: AcausalSystem, t0: Time, t1: Time, implicit: bool, watch: Watch | None, tolerance: Tolerance
) -> SystemProblem:
    """The problem of a system that has events, to be run from t0 to t1."""
    events: Any = system.plan.events
    ends = tuple(message is not None for message in events.table.message)
    choices, choice_guards = ((), ()) if system.plan.held is not None else _choices(events.table, events.n_clocks)
    return SystemProblem(
        system=system, watch=watch, tolerance=tolerance, implicit=implicit,
        resolution=resolution(t0, t1),
        n_clocks=events.n_clocks, n_guards=len(events) - events.n_clocks, ends=ends, immediate=events.table.immediate,
        noted=events.table.noted,
        revocable=events.table.revocable,
        relations=events.table.relation,
        strict=events.table.strict,
        opposite=_opposite(events.table, events.n_clocks),
        choices=choices,
        choice_guards=choice_guards,
        only_kinks=events.only_kinks,
    )  # fmt: skip


def _choices(table: EventTable, n_clocks: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns (the discrete values that `complementary` chooses, the guards that choose them)."""
    chooses = np.array(table.revocable, bool) & ~np.array(table.relation, bool)
    rows = chooses[table.event] & (table.discrete >= 0) & (table.event >= n_clocks)
    return tuple(np.unique(table.discrete[rows]).tolist()), tuple(np.unique(table.event[rows] - n_clocks).tolist())


def _opposite(table: EventTable, n_clocks: int) -> tuple[int, ...]:
    """For each guard of a relation, the number of the guard that sets the same discrete value the other way; −1 for
    other guards."""
    opposite = np.full(len(table) - n_clocks, -1)
    other: dict[int, int] = {}
    for event, discrete in zip(table.event.tolist(), table.discrete.tolist(), strict=True):
        if not table.relation[event] or event < n_clocks:
            continue
        guard = event - n_clocks
        if discrete in other:
            opposite[[guard, other[discrete]]] = other[discrete], guard
        other[discrete] = guard
    return tuple(opposite.tolist())


def with_event_control(controller: Controller) -> Any:
    """Wraps the controller so that steps end at events. A controller that clips steps at jumps of inputs stays
    outermost."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return eqx.tree_at(lambda c: c.controller, controller, with_event_control(controller.controller))
    return EventControl(controller)  # pyright: ignore[reportCallIssue]
