"""Any solver, with steps that end at events."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import PyTree, Result, State, Time
from ...base.private_names import rewrapped
from ..adjoint.appended import NOTED, apart, appended, together
from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from ..methods.wrapped import WrappedSolver
from .event_map import handle, most_at_once
from .kinks import turned
from .log import EventRows
from .looking import looked_at
from .past import after, is_full, reached, waiting
from .problem import HybridState, bound, problem_after, problem_of

MOVED = 1e3  # times the resolution: with a longer step time has gone on, and turns at one instant are counted anew

TOO_MANY: Result = diffrax.RESULTS.max_steps_rejected  # events
STUCK: Result = diffrax.RESULTS.stagnation  # an event happens again and again at one instant
CLASH: Result = diffrax.RESULTS.conlim  # two events give one variable different values at one instant
VANISHED: Result = diffrax.RESULTS.nonfinite_input  # a delay is shorter than any step
FORGETS: Result = diffrax.RESULTS.internal_error  # there is no room for the steps within the longest delay
NOT_FINITE: Result = diffrax.RESULTS.nonlinear_divergence  # what an event wrote


class HybridInterpolation(diffrax.AbstractLocalInterpolation):
    """Dense output of a step: x by the inner solver's dense output within the step, by the state after the events at
    its end."""

    t0: Time
    t1: Time
    inner: Any
    y0: HybridState
    y1: HybridState
    fired: Array
    slope: Array
    resolution: Time
    noted: EventRows  # the events at its end that are listed

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        # Times within rounding of the event are those of the event; one that moves goes along the solution after it.
        at_end = self.fired & (t0 >= self.t1 - self.resolution)
        after = self.y1.x + self.slope * (t0 - lax.stop_gradient(self.t1))
        x = jnp.where(at_end, after, self.inner(self.t0, self.t1, t0))
        q, armed, ticks = (
            jnp.where(at_end, getattr(self.y1, part), getattr(self.y0, part)) for part in ("q", "armed", "ticks")
        )
        return self.y1.but(x=x, q=q, armed=armed, ticks=ticks)


class _DenseOutput(eqx.Module):
    """The inner solver's dense output."""

    interpolation: Any = eqx.field(static=True)
    info: PyTree

    def __call__(self, t0: Time, t1: Time, t: Time) -> State:
        return self.interpolation(t0=t0, t1=t1, **self.info).evaluate(t)


class WithEvents(WrappedSolver):
    """Wraps a solver so that steps end where an event happens.

    - `solver`: the problem prepares it for the discrete values at hand.
    - `max_events`: more of them end the run with `TOO_MANY`.
    - `room`: how many of them are listed; `sides`: with the states before and after them.
    """

    solver: diffrax.AbstractSolver
    max_events: int = eqx.field(static=True)
    room: int = eqx.field(static=True, default=0)
    sides: bool = eqx.field(static=True, default=False)

    term_structure = diffrax.AbstractTerm
    interpolation_cls = HybridInterpolation  # pyright: ignore[reportAssignmentType]

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return {}

    def func(self, terms, t0, y0, args):
        if isinstance(y0, HybridState):
            return self.solver.func(bound(terms, y0), t0, y0.x, args)
        return self.solver.func(terms, t0, y0, args)

    def between_events(self, terms, y0, y1):
        """Returns (terms, solver, state, whether an event at its end changed them) after a step from y0 to y1."""
        solver = problem_after(terms, y1).prepared(self.solver, y1.q)
        return bound(terms, y1), solver, y1.x, jnp.any(y0.q != y1.q)

    def init(self, terms, t0, t1, y0, args):
        solver = problem_after(terms, y0).prepared(self.solver, y0.q)
        return solver.init(bound(terms, y0), t0, t1, y0.x, args), jnp.array(False)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        problem = problem_of(terms)
        # The table of events takes no part in a step, and would be kept with each state for reverse mode.
        y0, table = apart(y0)
        inner_state, jumped = solver_state
        # Diffrax knows the jumps that its controller reports. That an event ended the last step is known here: methods
        # with a history, or with a slope kept from the last stage, begin anew after it.
        inputs_jumped, made_jump = made_jump, jumped if made_jump is False else made_jump | jumped
        delays = problem.facts.delays
        remembered = None if delays is None else y0.past.between(t0, t1, problem.resolution)
        if remembered is not None:
            problem = problem.remembering(remembered)
        solver = problem.prepared(self.solver, y0.q)
        x1, y_error, info, inner_state, result = solver.step(
            rewrapped(terms, problem.term(y0.q)), t0, t1, y0.x, args, inner_state, made_jump
        )
        dense = _DenseOutput(solver.interpolation_cls, info)
        reach = None
        if delays is not None and remembered is not None:
            reach = reached(problem, dense, t0, t1, y0, x1, args, inputs_jumped)
            # The times at which breaks come out of delays are found here, and clocks read them.
            due = still(jnp.where(reach.due, t1, jnp.inf))
            y0 = y0.but(due=y0.due.at[np.array(delays.clocks)].set(due))
            # What comes out now may be of this very step.
            problem = problem.remembering(remembered.of(reach.past), reach.ticks)
        request, armed, values, arrival = looked_at(problem, dense, t0, t1, y0, x1, args)
        if reach is not None:
            arrival = arrival._replace(due=arrival.due & ~jnp.isfinite(reach.request))
            request = jnp.minimum(request, reach.request)
        goes_on = t1 - t0 > MOVED * problem.resolution
        turns = jnp.where(goes_on, jnp.zeros_like(y0.turns), y0.turns)
        iteration = None if y0.iteration is None else y0.iteration.anew(goes_on)
        state = y0.but(
            x=x1, armed=armed, size=arrival.size, span=arrival.span, request=request, turns=turns, iteration=iteration
        )
        if delays is not None:
            state = waiting(delays, state, arrival.due)
        fired = jnp.any(arrival.due)

        noted = EventRows.empty(
            min(self.room, most_at_once(problem)), self.sides, len(y0.x) + len(y0.q), jnp.result_type(t1)
        )
        # The time of the last event, which moves with parameters, is one of the breaks of the past.
        none = jnp.zeros_like(x1), noted, *([] if delays is None else [t1])

        def events(state):
            return handle(problem, t1, state, arrival, args, noted)[: 1 + len(none)]

        # Where all events are kinks, what happens is a few selects. No branch is needed, and no slope.
        if problem.facts.only_kinks:
            _, then, _ = problem.at_instant(args)
            y1, slope = turned(problem, t1, state, values, arrival.due, then), jnp.zeros_like(x1)
        else:
            y1, slope, noted, *time = lax.cond(any_member(fired), events, lambda state: (state, *none), state)
            # The branch is taken if any member of a batch has an event; the others keep their states.
            y1 = jax.tree.map(lambda a, b: jnp.where(fired, a, b), y1, state)
            if delays is not None and reach is not None:
                ticked = (y1.ticks != state.ticks) & ~np.isin(np.arange(problem.facts.n_clocks), delays.clocks)
                others = jnp.any(ticked) | (y1.turns != state.turns)
                begun = jnp.where(fired, time[0], t1)
                y1 = after(delays, t1, y1, reach, begun, others, problem.resolution)
        dense_info = dict(
            inner=dense, y0=y0, y1=y1, fired=fired, slope=slope, resolution=problem.resolution, **{NOTED: noted}
        )
        # A step that failed by itself keeps its own result: that x1 is not finite says nothing of the event.
        finite = jnp.all(jnp.isfinite(y1.x)) & jnp.all(jnp.isfinite(y1.q))
        result = diffrax.RESULTS.where(fired & ~finite & jnp.all(jnp.isfinite(x1)), NOT_FINITE, result)
        result = diffrax.RESULTS.where(y1.count > self.max_events, TOO_MANY, result)
        # Where an event ends the run, it does no harm that events would repeat.
        result = diffrax.RESULTS.where((y1.stuck >= 0) & (y1.ended == 0), STUCK, result)
        result = diffrax.RESULTS.where(y1.stuck < -1, CLASH, result)
        if reach is not None:
            result = diffrax.RESULTS.where(reach.vanishes, VANISHED, result)
            result = diffrax.RESULTS.where(is_full(y1.past, t1, problem.longest()), FORGETS, result)
        y1 = together(y1, appended(table, noted, y0, y1))
        return y1, y_error, dense_info, (inner_state, fired), result
