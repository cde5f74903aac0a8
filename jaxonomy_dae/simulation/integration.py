"""One run of a compiled system: a consistent start, the integration, and saved states on the constraints."""

from collections.abc import Callable, Mapping
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..adjoint.ends import ending
from ..aliases import Args, Controller, Inputs, PyTree, Result, Solver, State, Time, Times
from ..hybrid.control import ENDED, AtEvents
from ..hybrid.problem import HybridState, HybridTerm
from ..hybrid.solver import CLASH, WithEvents
from ..hybrid.start import start
from ..initialization.check import check
from ..initialization.initialize import InitialPoint, initialize, is_consistent
from ..initialization.ladder import Found
from ..programs.cache import compiled
from ..programs.platform import precisely
from ..solvers.drive import integrate, is_implicit, right_between_steps
from ..solvers.rows import not_a_number, padded
from ..solvers.switching import STIFF, Watch
from ..system.system import AcausalSystem
from .arguments import NOT_ADMITTED, TEXT, are_admitted, inputs_are_finite
from .event_log import EventLog
from .from_state import from_state
from .hybrid_problem import problem_for, without_clocked
from .preparation import SAVED_ITERATIONS, largest_tolerance, prepared, term_of
from .saved_state import Memory, SavedState, same_time
from .step_sizes import first_step


class Given(eqx.Module):
    """What is integrated: a system over an interval, with inputs as they were read, from values by names, a state, or
    where another run ended; saved at `ts`, or after every step."""

    system: AcausalSystem
    t0: Time
    t1: Time
    ts: Times
    inputs: Inputs
    initial: PyTree


class Options(eqx.Module):
    """Options of a run: solver, adjoint, controller and limits."""

    solver: Solver
    adjoint: diffrax.AbstractAdjoint
    controller: Controller
    max_steps: int = eqx.field(static=True)
    progress: bool = eqx.field(static=True)
    max_events: int = eqx.field(static=True, default=0)
    room: int = eqx.field(static=True, default=0)  # for so many events in the log
    save_events: bool = eqx.field(static=True, default=False)


class Outcome(eqx.Module):
    """The raw result of a run.

    - `found`: the initial point.
    - `ts`, `x`: the saved times and states; `last`: the last accepted point (t, x).
    - `stats`, `result`: counts of steps, and Diffrax's result code.
    - `is_stiff`: True if the run was given up because stability, not accuracy, limits explicit steps.
    - `discrete`, `events`, `memory`: with events, the discrete values at the saved times, the log, and what another
        run needs to go on.
    """

    found: InitialPoint
    ts: Times
    x: State
    last: tuple[Any, Any]
    stats: dict[str, PyTree]
    result: Result
    is_stiff: Array
    discrete: Any = None
    events: EventLog | None = None
    held: Any = None  # the discrete values at the last accepted point
    memory: Memory | None = None

    def numbers(self) -> dict[str, PyTree]:
        """The counts as Python integers."""
        return {name: int(value) for name, value in self.stats.items() if jnp.ndim(value) == 0}


@precisely
def run(
    given: Given,
    options: Options,
    watch: Watch | None,
    checked: bool = False,
    begun: Found | InitialPoint | None = None,
) -> Outcome:
    """Integrates what is given; `watch` is for Tsit5. With `checked`, an inconsistent start
    and times that do not fit are errors while running. `begun` is what
    is known of the start: what `search_outside` found, or all of it."""
    system, t0, t1, ts = given.system, given.t0, given.t1, given.ts
    inputs, initial = given.inputs, given.initial
    admitted = are_admitted(system, inputs, t0, t1)
    system = system.settled()  # so that bounds are looked at once, and not whenever equations are
    if checked:
        system = eqx.tree_at(
            lambda s: s.parameters.values, system, eqx.error_if(system.parameters.values, ~admitted, TEXT)
        )
    resumed = None
    if isinstance(initial, SavedState):
        admitted = admitted & same_time(t0, initial)
        system, resumed = system.holding(initial.discrete), initial.events
        found = from_state(system, t0, inputs, initial.x)
    elif isinstance(begun, InitialPoint):
        found = begun
    elif isinstance(initial, Mapping):
        found = initialize(system, t0, inputs, initial, found=begun)
    else:
        found = from_state(system, t0, inputs, initial)
    if checked:
        found = check(system, found, t0, inputs, initial, running=True, throw=True)
    x0, controller = found.x, options.controller
    implicit = is_implicit(options.solver)
    chosen = options.solver if ts is None else right_between_steps(options.solver)
    tolerance = largest_tolerance(system, controller)
    judged = not isinstance(controller, diffrax.StepTo)
    solver = prepared(system, chosen, implicit, watch, tolerance, judged)
    term = term_of(system, implicit, forwards=isinstance(options.adjoint, diffrax.ForwardMode))
    # With an implicit solver the controller chooses the first step itself: `dt0=None`.
    own_start = implicit and not isinstance(controller, diffrax.StepTo)
    dt0 = None if own_start else first_step(system, t0, t1, x0, inputs, solver.order(term), controller)
    y0: State = x0
    goes_on: Any = admitted
    clashes: Any = None
    saved_of: Callable = _whole
    consistent = is_consistent(found)
    if system.plan.events is not None:
        problem = problem_for(system, t0, t1, implicit, watch, tolerance)
        if system.plan.held is not None:
            admitted = jnp.all(jnp.isfinite(problem.admitted(t0, x0, system.discrete_values, inputs)))
            consistent = consistent & admitted
        q0 = system.discrete_values if resumed is None else without_clocked(system, system.discrete_values)
        y0 = start(problem, t0, x0, q0, inputs, options.room, options.save_events, resumed)
        clashes = y0.stuck < -1
        goes_on = admitted & (y0.ended == 0) & ~clashes
        term, solver = HybridTerm(problem), WithEvents(chosen, options.max_events, options.room, options.save_events)
        controller = ending(controller, AtEvents())
        saved_of = _with_events
    save = diffrax.SubSaveAt(t0=True, steps=True, fn=saved_of) if ts is None else diffrax.SubSaveAt(ts=ts, fn=saved_of)
    done = integrate(
        term, solver, t0, t1, dt0, y0, inputs,
        save=save, controller=controller, adjoint=options.adjoint, max_steps=options.max_steps,
        progress=options.progress, checked=checked, goes_on=goes_on,
    )  # fmt: skip
    saved, x, last = done.ts, done.ys, done.last
    discrete, events, held, memory = None, None, None, None
    if system.plan.events is not None:
        x, discrete, marks = x
        events = EventLog.of(last[1])
        memory = Memory.of(problem, saved, marks, last[1].size)
        held, last = last[1].q, (last[0], last[1].x)
    x = jnp.asarray(x)
    filled = jnp.isfinite(saved)
    if system.plan.events is not None and ts is not None:
        filled = filled & (goes_on | (ts == t0))
    okay = diffrax.is_okay(done.result)
    safe, times = jnp.where(filled[:, None], x, x0), jnp.where(filled, saved, t0)
    holds = finite = jnp.all(jnp.isfinite(safe), axis=1)
    if system.is_constrained:
        # Rows that were not reached are projected at the start, so that their derivatives are finite, and left out
        # below.
        def projected_onto(t, y, q):
            now = system if q is None else system.holding(q)
            return now.project_fully(t, y, inputs, SAVED_ITERATIONS)

        values = None if discrete is None else jnp.where(filled[:, None], discrete, system.discrete_values)
        projected = jax.vmap(projected_onto)(times, safe, values)
        holds = jnp.all(jnp.isfinite(projected), axis=1)
        x = jnp.where(filled[:, None], projected, x)
    # The run counts as failed at the first row that is not finite, or at which the equations have no solution.
    right, k = jnp.all(holds), jnp.argmax(~holds)
    okay, filled = okay & right, filled & (right | (jnp.arange(len(filled)) < k))
    k = jnp.where(finite[k], k, jnp.maximum(k - 1, 0))
    last = jax.tree.map(lambda a, b: jnp.where(right, a, b), last, (times[k], safe[k]))
    if ts is None:
        steps = done.stats["num_accepted_steps"]
        if discrete is not None and memory is not None:
            _, discrete = padded(saved, discrete, steps)
            memory = memory.padded(saved, steps)
        saved, x = padded(saved, x, steps)
        filled = filled | okay
    else:
        saved = ts
    # What is not a number here has derivatives that are not, so that a loss over failed rows cannot seem to have a
    # gradient.
    consistent = consistent & admitted
    x = not_a_number(x, filled & consistent, x0, system, inputs)
    failure: Result = diffrax.RESULTS.nonlinear_divergence
    result = diffrax.RESULTS.where(okay | ~diffrax.is_okay(done.result), done.result, failure)
    if system.plan.events is not None:
        result = diffrax.RESULTS.where(okay & ~goes_on, ENDED, result)
        result = diffrax.RESULTS.where(clashes, CLASH, result)
    result = diffrax.RESULTS.where(consistent, result, failure)
    looked_at = diffrax.is_okay(result) | inputs_are_finite(inputs, last[0], t1)
    result = diffrax.RESULTS.where(admitted & looked_at, result, NOT_ADMITTED)
    stiff = consistent & (done.result == STIFF) if watch is not None else jnp.array(False)
    if discrete is not None:
        discrete = jnp.where((filled & consistent)[:, None], discrete, jnp.nan)
    return Outcome(
        found=found._replace(jacobian=None),
        ts=saved,
        x=x,
        last=last,
        stats=done.stats,
        result=result,
        is_stiff=stiff,
        discrete=discrete,
        events=events,
        held=held,
        memory=memory,
    )


run_compiled = compiled(run)


def _whole(t: Time, y: State, args: Args) -> State:
    return y


def _with_events(t: Time, y: HybridState, args: Args) -> State:
    return y.x, y.q, jax.lax.stop_gradient(jnp.concatenate([y.armed, y.ticks]))
