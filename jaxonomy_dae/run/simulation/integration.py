"""One run of a compiled system: a consistent start, the integration, and saved states on the constraints."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, Controller, Inputs, PyTree, Result, Solver, State, Terms, Time, Times
from ...host.cache import compiled
from ...host.platform import precisely
from ...solve.adjoint.ends import ending
from ...solve.adjoint.late_times import Integration
from ...solve.events.control import ENDED, AtEvents
from ...solve.events.problem import HybridState, HybridTerm
from ...solve.events.solver import CLASH, WithEvents
from ...solve.events.start import Resumed, start
from ...solve.methods.drive import Run, integrate, is_implicit, right_between_steps
from ...solve.methods.rows import not_a_number, padded
from ...solve.methods.switching import STIFF, Watch
from ..start.check import check
from ..start.initialize import InitialPoint, initialize, is_consistent
from ..start.ladder import Found
from ..system.system import AcausalSystem
from .arguments import NOT_ADMITTED, TEXT, are_admitted, inputs_are_finite
from .event_log import EventLog
from .from_state import from_state
from .hybrid_problem import (
    SavedWithPast,
    SystemProblem,
    problem_for,
    saved_with_events,
    tolerances_of_a_record,
    without_clocked,
)
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
    remembered: int = eqx.field(static=True, default=0)  # so many steps within the longest delay


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
    last: tuple[Time, State]
    stats: dict[str, PyTree]
    result: Result
    is_stiff: Array
    discrete: Array | None = None
    events: EventLog | None = None
    held: Array | None = None  # the discrete values at the last accepted point
    memory: Memory | None = None

    def numbers(self) -> dict[str, PyTree]:
        """The counts as Python integers."""
        return {name: int(value) for name, value in jax.device_get(self.stats).items() if np.ndim(value) == 0}


class _Start(NamedTuple):
    """Where a run begins.

    - `system`: with its bounds looked at, and with the discrete values of another run if it goes on from there; what
        that run left of its events is `resumed`.
    - `found`: the initial point; `admitted`: whether what is given can be run.
    """

    system: AcausalSystem
    found: InitialPoint
    resumed: Resumed | None
    admitted: Array


class _Parts(NamedTuple):
    """What is integrated, and by what.

    - `problem`: with events, else None; `y0`: the state of the integration; `saved`: what is saved of it.
    - `admitted`, `consistent`, `goes_on`: whether the run is possible, begins at a consistent point, and takes steps.
    - `clashes`: whether two events of the first instant contradict each other; None without events.
    """

    term: Terms
    solver: Solver
    controller: Controller
    dt0: Time
    problem: SystemProblem | None
    y0: State
    saved: Callable[..., State]
    admitted: Array
    consistent: Array
    goes_on: Array
    clashes: Array | None


class _Rows(NamedTuple):
    """The saved rows: times, states, discrete values and what another run needs to go on, in all of which the rows
    that were not reached are not `filled`; the last point, and whether every row is finite and on the constraints."""

    ts: Times
    x: Array
    discrete: Array | None
    memory: Memory | None
    filled: Array
    last: tuple[Time, State]
    okay: Array


@precisely
def run(
    given: Given,
    options: Options,
    watch: Watch | None,
    checked: bool = False,
    begun: Found | InitialPoint | None = None,
) -> Outcome:
    """Integrates what is given; `watch` is for Tsit5. With `checked`, an inconsistent start and times that do not fit
    are errors while running. `begun` is what is known of the start: what `search_outside` found, or all of it."""
    begin = _started(given, checked, begun)
    parts = _parts(given, options, watch, begin)
    ts, fn = given.ts, parts.saved
    save = diffrax.SubSaveAt(t0=True, steps=True, fn=fn) if ts is None else diffrax.SubSaveAt(ts=ts, fn=fn)
    integration = Integration(
        parts.term, parts.solver, given.t0, given.t1, parts.dt0, parts.y0, given.inputs, save, parts.controller,
        options.adjoint, options.max_steps,
    )  # fmt: skip
    # What happens at the end, such as a clock's tick, reads what holds from then on.
    done = integrate(integration, options.progress, checked, parts.goes_on, before_jumps=parts.problem is None)
    rows = _rows(given, begin, parts, done)
    consistent = parts.consistent & parts.admitted
    # What is not a number here has derivatives that are not, so that a loss over failed rows cannot seem to have a
    # gradient.
    x = not_a_number(rows.x, rows.filled & consistent, begin.found.x, begin.system, given.inputs)
    discrete = rows.discrete
    if discrete is not None:
        discrete = jnp.where((rows.filled & consistent)[:, None], discrete, jnp.nan)
    end: HybridState = done.last[1]
    with_events = parts.problem is not None
    held = end.q if with_events else None
    if isinstance(fn, SavedWithPast):
        held = fn.held(done.last[0], end, given.inputs)
    return Outcome(
        found=begin.found._replace(jacobian=None), ts=rows.ts, x=x, last=rows.last, stats=done.stats,
        result=_result(given, parts, done.result, rows, consistent),
        is_stiff=consistent & (done.result == STIFF) if watch is not None else jnp.array(False), discrete=discrete,
        events=EventLog.of(end) if with_events else None, held=held, memory=rows.memory,
    )  # fmt: skip


def _started(given: Given, checked: bool, begun: Found | InitialPoint | None) -> _Start:
    """Finds the initial point, unless it is known."""
    system, t0, inputs, initial = given.system, given.t0, given.inputs, given.initial
    admitted = are_admitted(system, inputs, t0, given.t1)
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
    return _Start(system.traced_once(), found, resumed, admitted)


def _parts(given: Given, options: Options, watch: Watch | None, begin: _Start) -> _Parts:
    """Prepares the solver, and what watches over events."""
    system, t0, t1, inputs, controller = begin.system, given.t0, given.t1, given.inputs, options.controller
    x0, admitted, consistent = begin.found.x, begin.admitted, is_consistent(begin.found)
    implicit, prescribed = is_implicit(options.solver), isinstance(controller, diffrax.StepTo)
    # What is delayed is recorded along the dense output, too.
    ends_count = given.ts is None and system.plan.delays is None
    chosen = options.solver if ends_count else right_between_steps(options.solver)
    tolerance = largest_tolerance(system, controller)
    solver = prepared(system, chosen, implicit, watch, tolerance, judged=not prescribed)
    term = term_of(system, implicit)
    # With an implicit solver the controller chooses the first step itself: `dt0=None`.
    own_start = implicit and not prescribed
    dt0 = None if own_start else first_step(system, t0, t1, x0, inputs, solver.order(term), controller)
    if system.plan.events is None:
        return _Parts(
            term=term, solver=solver, controller=controller, dt0=dt0, problem=None, y0=x0, saved=_whole,
            admitted=admitted, consistent=consistent, goes_on=admitted, clashes=None,
        )  # fmt: skip
    # With events, the solver is prepared for the discrete values of each mode, inside the steps
    # (`SystemProblem.prepared`). So it is wrapped as it was chosen.
    record = None if system.plan.delays is None else tolerances_of_a_record(controller, tolerance)
    problem = problem_for(system, t0, t1, implicit, watch, tolerance, record)
    if system.plan.held is not None:
        admitted = admitted & jnp.all(jnp.isfinite(problem.admitted(t0, x0, system.discrete_values, inputs)))
        consistent = consistent & admitted
    resumed, q0 = begin.resumed, system.discrete_values
    q0 = q0 if resumed is None else without_clocked(system, q0)
    y0 = start(problem, t0, x0, q0, inputs, options.room, options.save_events, resumed)
    y0 = problem.with_past(t0, y0, inputs, options.remembered)
    saved = saved_with_events if system.plan.delays is None else SavedWithPast(problem)
    clashes = y0.stuck < -1
    return _Parts(
        term=HybridTerm(problem), solver=WithEvents(chosen, options.max_events, options.room, options.save_events),
        controller=ending(controller, AtEvents()), dt0=dt0, problem=problem, y0=y0, saved=saved,
        admitted=admitted, consistent=consistent, goes_on=admitted & (y0.ended == 0) & ~clashes, clashes=clashes,
    )  # fmt: skip


def _rows(given: Given, begin: _Start, parts: _Parts, done: Run) -> _Rows:
    """The rows that were saved, on the constraints."""
    system, ts, t0, x0 = begin.system, given.ts, given.t0, begin.found.x
    saved, x, last = done.ts, done.ys, done.last
    discrete = memory = None
    if parts.problem is not None:
        x, discrete, marks = x
        end: HybridState = last[1]
        memory, last = Memory.of(parts.problem, saved, marks, end.size), (last[0], end.x)
    x = jnp.asarray(x)
    filled = jnp.isfinite(saved)
    if parts.problem is not None:  # nothing is known at the instant at which two events contradict each other
        filled = filled & ((done.last[1].stuck >= -1) | (saved < last[0]) | (saved == t0))
    if parts.problem is not None and ts is not None:
        filled = filled & (parts.goes_on | (ts == t0))
    okay = diffrax.is_okay(done.result)
    safe, times = jnp.where(filled[:, None], x, x0), jnp.where(filled, saved, t0)
    holds = finite = jnp.all(jnp.isfinite(safe), axis=1)
    if system.is_constrained:
        # Rows that were not reached are projected at the start, so that their derivatives are finite, and left out
        # below.
        def projected_onto(t, y, q):
            now = system if q is None else system.holding(q)
            return now.project_fully(t, y, given.inputs, SAVED_ITERATIONS)

        values = None if discrete is None else jnp.where(filled[:, None], discrete, system.discrete_values)
        # Dense output lies on the constraints to the accuracy of the method only. What users read holds to rounding.
        projected = jax.vmap(projected_onto)(times, safe, values)
        holds = jnp.all(jnp.isfinite(projected), axis=1)
        x = jnp.where(filled[:, None], projected, x)
    # The run counts as failed at the first row that is not finite, or at which the equations have no solution.
    right, k = jnp.all(holds), jnp.argmax(~holds)
    okay, filled = okay & right, filled & (right | (jnp.arange(len(filled)) < k))
    k = jnp.where(finite[k], k, jnp.maximum(k - 1, 0))
    last = jax.tree.map(lambda a, b: jnp.where(right, a, b), last, (times[k], safe[k]))
    if ts is not None:
        return _Rows(ts, x, discrete, memory, filled, last, okay)
    steps = done.stats["num_accepted_steps"]
    if discrete is not None and memory is not None:
        _, discrete = padded(saved, discrete, steps)
        memory = memory.padded(saved, steps)
    saved, x = padded(saved, x, steps)
    return _Rows(saved, x, discrete, memory, filled | okay, last, okay)


def _result(given: Given, parts: _Parts, code: Result, rows: _Rows, consistent: Array) -> Result:
    """The code of the run: Diffrax', unless rows, events, the start or what is given are at fault."""
    failure: Result = diffrax.RESULTS.nonlinear_divergence
    result = diffrax.RESULTS.where(rows.okay | ~diffrax.is_okay(code), code, failure)
    if parts.clashes is not None:
        result = diffrax.RESULTS.where(rows.okay & ~parts.goes_on, ENDED, result)
        result = diffrax.RESULTS.where(parts.clashes, CLASH, result)
    result = diffrax.RESULTS.where(consistent, result, failure)
    # An input that is not finite stops a run as equations without a solution do, and is named as what it is.
    looked_at = diffrax.is_okay(result) | inputs_are_finite(given.inputs, rows.last[0], given.t1)
    return diffrax.RESULTS.where(parts.admitted & looked_at, result, NOT_ADMITTED)


run_compiled = compiled(run)


def _whole(t: Time, y: State, args: Args) -> State:
    return y
