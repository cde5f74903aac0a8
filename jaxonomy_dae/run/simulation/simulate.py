"""`simulate`: a compiled system integrated by Diffrax."""

import dataclasses
import functools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, Controller, PyTree, Solver, State, Time, Times, Tolerance
from ...base.errors import InitializationError, ModelError, SimulationError, explained_keywords
from ...host.cache import PROGRAMS
from ...host.members import batch_size, is_batched, say_of_members
from ...host.rows import filled_up
from ...host.staging import as_argument, as_array, is_staged, is_traced, on_device, picked
from ...solve.adjoint.resting import still
from ...solve.adjoint.stored_adjoint import default_adjoint
from ...solve.events.solver import FORGETS
from ...solve.methods import BDF, Rodas5P, Tsit5
from ...solve.methods.causes import decay_at, is_stiff
from ...solve.methods.drive import is_implicit
from ...solve.methods.failures import Stopped
from ...solve.methods.solve import check_tolerances, default_tolerances
from ...solve.methods.solve_arguments import jump_times
from ...solve.methods.switching import BOUNDARY, MANY, SHARE, Watch
from ..start.check import check, warn_of_outranked
from ..start.initialize import InitialPoint, known_start, search_outside
from ..start.ladder import Found
from ..system.input_values import check_given
from ..system.inputs import StepEnds, check_range, read_inputs, step_ends
from ..system.solver_choice import Choice, Stiffness, implicit_choice, solver_choice
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from .arguments import check_method, check_parameters, check_start, check_steps, check_switches, check_system
from .failures import OKAY, codes, explain, is_code, mode_at_start, raised
from .from_state import check_state
from .idle_conditions import always_equal
from .integration import Given, Options, Outcome, run, run_compiled
from .preparation import term_of
from .saved_state import Memory, SavedState, initial_time
from .solution import Asked, Solution, comparable
from .step_sizes import clipped, controller_for, scaled_atol

FEW_NUMBERS = 20_000  # on one side of all events: up to so many, states before and after events are kept (160 kB)
ROOM = 100  # events that the log of a first run has room for; a run with more is made again with room for all
# Steps within the longest delay for which there is room, and the most numbers that they take: each step copies these.
REMEMBERED, MOST_REMEMBERED = 1024, 40_000
MOST_EVENTS = 2**7 * ROOM  # of a run, if the user does not say: with a few steps each, near the default max_steps
MOST_TICKS = 2**24  # counted in addition to `max_steps`: days of running
SOLVERS = {"Tsit5": Tsit5, "Rodas5P": Rodas5P, "BDF": BDF}


# Options of scipy.integrate.solve_ivp and of diffrax.diffeqsolve, and what they are here.
ELSEWHERE = {
    "method": "solver=diffrax.Tsit5(), solvers.BDF() or solvers.Rodas5P(), or leave it out",
    "t_eval": "ts=",
    "t_span": "simulate(system, t1, t0=t0)",
    "args": "system.with_parameters({...}) for parameters, inputs={...} for inputs",
    "p": "system.with_parameters({...})",
    "params": "system.with_parameters({...})",
    "parameters": "system.with_parameters({...})",
    "y0": "initial={'component.variable': value}",
    "x0": "initial={'component.variable': value}",
    "max_step": "dtmax=",
    "first_step": "stepsize_controller=diffrax.PIDController(...), which takes it into account with dt0",
    "dt0": "stepsize_controller=, or leave it out: the first step is chosen",
    "dense_output": "ts=, the times to save",
    "saveat": "ts=, the times to save",
    "events": "self.when(condition, ...) in a component",
    "event": "self.when(condition, ...) in a component",
    "u": "inputs={'component.input': value}",
}


@explained_keywords(ELSEWHERE)
def simulate(
    system: AcausalSystem,
    t1: Time,
    *,
    t0: Time = None,
    ts: Times = None,
    solver: diffrax.AbstractSolver[Any] | None = None,
    rtol: Tolerance = None,
    atol: Tolerance = None,
    inputs: Mapping[str, Args] | None = None,
    initial: Mapping[str, Any] | Any = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController[Any, Any] | None = None,
    jump_ts: Times = None,
    dtmax: Time = None,
    control: Sequence[str] = (),
    max_steps: int = 16384,
    max_events: int | None = None,
    save_events: bool | None = None,
    progress: bool = False,
    throw: bool | None = None,
) -> Solution:
    """Integrates a system from a consistent initial point.

    **Arguments:**

    - `system`: from an `AcausalCompiler`.
    - `t0`, `t1`: the interval, `t0 < t1`. `t0` None: the time of a whole state given as `initial`, otherwise 0.
    - `ts`: when to save, shape `(n,)`, increasing, inside the interval; None saves every step. Inside jit, where shapes
        are fixed, there are then `max_steps + 1` rows, and rows beyond the last step repeat it.
    - `solver`: any Diffrax solver for ordinary differential equations, or `solvers.BDF`, `solvers.Rodas5P` for stiff
        systems and those with nonlinear blocks. None chooses, and `solution.stats` gives the choice and its reason. The
        run begins with explicit steps; if stability limits them, it is repeated with Rodas5P or BDF. Inside jit, grad
        and vmap, the choice follows from the eigenvalues at the declared start. Systems with hidden constraints are
        projected onto them after every step and at every saved time.
    - `rtol`, `atol`: tolerances of the local error, by default 1e-6 and 1e-8 (1e-4 and 1e-6 in single precision);
        `atol` is multiplied by the nominal values of the states. A state without a nominal value has the size that
        follows from starts and equations, if that is below one.
    - `inputs`: by the inputs' names: constants; samples `(times, values)`, interpolated linearly, or with `"spline"`,
        `"cubic"` or `"held"` as a third entry; `diffrax.LinearInterpolation` and `diffrax.CubicInterpolation`;
        functions of time.
        Steps end at the times of samples. A function reads variables of its surroundings when `simulate` is called.
    - `initial`: values at `t0` by variables' names. They replace the starts declared in components. Or the whole state
        of another run, `solution.at(k)`: this run continues from it, with its discrete variables, modes and clocks, and
        ignores declared starts and discrete variables set by `with_parameters`. If the model has no events other than
        relations in equations, an array of shape `(n_state,)` is a whole state, too. It is projected onto the
        constraints.
    - `adjoint`: how to differentiate. The default is `solvers.StoredAdjoint()`, and `diffrax.ForwardMode()` under
        `jax.jvp` and `jax.jacfwd`. Give `diffrax.ForwardMode()` yourself if a function is jitted before it is
        differentiated in forward mode.
    - `stepsize_controller`: instead of the controller made from the tolerances.
    - `jump_ts`: times at which input functions jump, a number or shape `(n,)`. Steps end there, and the method
        restarts.
    - `dtmax`: the longest step. None: a quarter of the shortest period of sin(ωt + φ) in equations on which states
        depend, if ω is an expression in parameters; long steps also end at zeros and extremes of the sine. `jnp.inf`
        removes this limit. The periods of input functions are unknown. Give `dtmax` for the derivative by an amplitude
        that is zero, if the input is faster than the model.
    - `control`: variables whose errors count in addition to those of the states, such as a pressure that depends on a
        mass by a large factor. When a solution is read, a warning names variables that amplify the tolerance of a
        state.
    - `max_steps`: the largest number of steps, without those that end at samples or at ticks of clocks. With `ts=None`,
        this many rows are reserved. Ticks are counted where periods and the length of the run are known, not inside jit
        where they are traced.
    - `max_events`: the largest number of events of conditions, which is also the room in `solution.events`. None:
        12,800 events. Outside jit, grad and vmap, the room starts at 100 events, and the run is repeated with twice the
        room until all fit. Inside, the first 100 are listed. Switches of relations in equations are not listed.
    - `save_events`: whether `solution.events` also has the variables before and after events. None: outside jit, if
        they need little memory.
    - `progress`: shows a progress bar.
    - `throw`: whether to raise an error if the start is inconsistent or the integration fails. With False,
        `solution.result` has a code, and rows that were not reached are NaN, with their derivatives.
        `RESULTS.nonfinite` stands for parameters out of bounds, for parameters, weights and inputs that are not finite,
        for a run backwards in time, and for samples that do not cover the run. None raises outside jit and vmap.
        `jax.vmap` outside of jit warns instead and names the members that failed. Inside jit, True puts callbacks to
        the host into the program, and JAX's persistent cache does not keep such a program.

    **Returns:**

    A `Solution`: `solution["pend.x"]` has shape `(n,)`.

    Outside of jit, it is compiled once for each structure, set of options and shapes. `jax.grad`, `jax.vmap` and
    `jax.jvp` transform that program. Inside `jax.jit` it is traced like any function.

    **Raises:**

    - `ModelError` for arguments that cannot work; `InitializationError`; `SimulationError`. Inside jit, grad and vmap,
        with `throw=True`, errors that depend on values are Equinox run-time errors.
    """
    if isinstance(system, AcausalSystem):  # `check_system` says what to do with anything else
        if initial is None or isinstance(initial, Mapping):
            initial = system.plan.one_by_one(initial)
    ts = ts if ts is None or hasattr(ts, "ndim") else as_array(ts)
    if isinstance(control, str):
        raise ModelError(f"control is a list of variables' names; write control=[{control!r}]")
    check_switches(max_events, save_events=save_events, progress=progress, throw=throw)
    check_system(system)
    check_method(system, solver, adjoint, stepsize_controller)
    check_steps(system, ts, dtmax, max_steps)
    check_start(system, t0, t1, ts, initial)
    # NumPy's truths and integers are no Python ones: `np.False_ is False` does not hold.
    save_events, throw = (value if value is None else bool(value) for value in (save_events, throw))
    max_steps, progress = int(max_steps), bool(progress)
    max_events = None if max_events is None else int(max_events)
    t0 = initial_time(t0, initial)
    dtype = system.parameters.values.dtype
    read = read_inputs(system.plan, dtype, inputs)
    check_given(system.plan, read)
    check_range(read, t0, t1)
    rtol, atol = default_tolerances(rtol, atol, dtype)
    prescribed = stepsize_controller is not None
    if not prescribed:
        check_tolerances(rtol, atol, dtype)
    elif control:
        raise ModelError("control= and stepsize_controller= both say what errors count: leave one of them out")
    rtol, atol = as_argument(rtol, dtype), as_argument(atol, dtype)
    dtmax = None if dtmax is None else as_argument(dtmax, dtype)
    jump_ts = jump_times(jump_ts, dtype)
    given = _given(system, t0, t1, ts, read, initial)
    begun = None
    if isinstance(given.initial, Mapping):  # one search for all runs of this call, whichever solvers they take
        # Inside jit, arrays made of these have no values.
        begun = (
            known_start(system, t0, inputs, initial)
            if is_staged(given)
            else search_outside(system, given.t0, given.inputs, given.initial)
        )
    scaled = scaled_atol(system, atol)
    chosen, tolerances = (None, None) if prescribed else (comparable(solver), (rtol, scaled))
    duration = None if is_traced((t0, t1)) else float(t1) - float(t0)
    asked = Asked(jump_ts, dtmax, max_steps, chosen, tuple(control), tolerances, throw is not False)
    call = _Call(
        system=system,
        given=given,
        begun=begun,
        choice=solver_choice(system.plan) if solver is None else Choice(type(solver).__name__, "as asked for", True),
        solver=solver,
        rtol=rtol,
        atol=atol,
        scaled=scaled,
        ends=step_ends(system.plan, read),
        ticks=_ticks(system, duration),
        adjoint=adjoint,
        controller=stepsize_controller,
        max_events=max_events,
        save_events=save_events,
        progress=progress,
        throw=throw,
        known=not is_traced((given, adjoint, stepsize_controller)),
        duration=duration,
        asked=asked,
    )
    # A solver of the user's may hold what is traced, as the tolerance of its root finder.
    return call.outside() if call.known and not is_traced((solver, rtol, scaled, jump_ts, dtmax)) else call.traced()


def _given(system: AcausalSystem, t0: Time, t1: Time, ts: Times, inputs: Args, initial: Any) -> Given:
    """What is integrated. Numbers become arrays, so that another value is not another program."""
    dtype = system.parameters.values.dtype
    if initial is None or isinstance(initial, Mapping):
        initial = {name: as_argument(v, dtype) for name, v in sorted((initial or {}).items())}
    else:
        initial = jax.tree.map(lambda part: on_device(part, dtype), initial)
    t0, t1 = as_argument(t0, dtype), as_argument(t1, dtype)
    if ts is not None:
        ts = as_argument(ts, dtype)
        if not is_traced((t0, t1, ts)):
            # `check_start` lets rounding pass, Diffrax does not.
            ts = as_argument(np.clip(np.asarray(ts), t0, t1), dtype)
    # The solver is chosen by `simulate`, so that the programs of models that differ in how stiff they are are the same.
    return Given(system.without_stiffness, t0, t1, ts, inputs, initial)


@dataclasses.dataclass(frozen=True)
class _Call:
    """A call of `simulate`: what is integrated, the solver chosen, and the options as they were checked.

    - `begun`: what is known of the start; `known`: whether nothing is traced; `duration`: of the run, None if traced.
    """

    system: AcausalSystem
    given: Given
    begun: Found | InitialPoint | None
    choice: Choice
    solver: Solver  # None: that of the choice
    rtol: Tolerance
    atol: Tolerance
    scaled: Tolerance  # atol of each entry of the state
    ends: StepEnds
    ticks: int
    adjoint: diffrax.AbstractAdjoint | None
    controller: Controller
    max_events: int | None
    save_events: bool | None
    progress: bool
    throw: bool | None
    known: bool
    duration: float | None
    asked: Asked
    more: int = 1  # times the room for what is delayed

    @property
    def bounds(self) -> tuple[int, int]:
        """The largest numbers of steps and of events."""
        return self.asked.max_steps, MOST_EVENTS if self.max_events is None else self.max_events

    @property
    def remembered(self) -> int:
        """For so many steps within the longest delay there is room."""
        delays = self.system.plan.delays
        if delays is None:
            return 0
        room = min(REMEMBERED, max(MOST_REMEMBERED // (9 * len(delays)), 64))
        return min(self.more * room, self.asked.max_steps) + 1

    @functools.cached_property
    def run_by(self) -> Solver:
        """The solver of a run."""
        return SOLVERS[self.choice.solver]() if self.solver is None else self.solver

    @property
    def switches(self) -> bool:
        """True if another solver may take the place of the one chosen."""
        return not self.choice.final and self.controller is None

    def implicit(self, why: str) -> "_Call":
        """The same with an implicit solver."""
        return dataclasses.replace(self, choice=implicit_choice(self.system.plan, why))

    def options(self, room: int = ROOM) -> Options:
        """The options of a run whose log has room for so many events."""
        system, solver, events = self.system, self.run_by, self.system.plan.events
        listed = room if self.max_events is None else self.max_events
        room = listed if events is not None and events.are_listed else 0
        few = room * (system.plan.n_state + len(system.discretes)) <= FEW_NUMBERS
        steps, adjoint, asked = self.controller, self.adjoint, self.asked
        if steps is None:
            steps = controller_for(system, solver, self.rtol, self.atol, self.scaled, asked.dtmax, asked.control)
        if adjoint is None:
            adjoint = default_adjoint(self.given, batch_size(self.given), self.known)
        return Options(
            solver=solver, adjoint=adjoint, controller=clipped(steps, asked.jump_ts, self.ends),
            max_steps=asked.max_steps + self.ends.count + self.ticks, progress=self.progress,
            max_events=self.bounds[1], room=room,
            save_events=few and self.known if self.save_events is None else self.save_events,
            remembered=self.remembered,
        )  # fmt: skip

    def watch(self, traced: bool) -> Watch | None:
        """What watches whether explicit steps are the right ones. Where the default cannot be replaced, it would cost
        every program inside jit 1 to 2 % of its lines."""
        final = self.choice.final
        if self.controller is not None or not isinstance(self.run_by, diffrax.Tsit5) or (traced and not final):
            return None
        size = self.scaled
        known = not is_traced((size, self.rtol))
        floor = as_argument(np.divide(size, self.rtol) if known else jnp.divide(size, self.rtol), size.dtype)
        return (
            Watch(self.given.t1, floor, int(SHARE * self.asked.max_steps), of_run=True)
            if final
            else Watch(self.given.t1, floor)
        )

    def traced(self) -> Solution:
        """The solution inside jit, grad or vmap."""
        # A program is made once for all values, so that no run can be tried and given up.
        call, why = self, _stiff_without_a_run(self.system.stiffness, self.duration) if self.switches else ""
        if why:
            call = self.implicit(why)
        return call.in_program(is_staged((self.given, call.options())))

    def in_program(self, staged: bool) -> Solution:
        """The solution where values cannot be read."""
        checked, has_events = self.throw is True, self.system.plan.events is not None
        if self.throw is not False and isinstance(self.given.initial, Mapping):
            warn_of_outranked(self.system, self.given.initial, (), stacklevel=5)
        if staged:
            PROGRAMS.make_room()
            outcome = run(self.given, self.options(), self.watch(True), checked, self.begun)
        else:  # under `jax.grad` and `jax.vmap` outside of jit, where values are known
            checked = self.throw is not False
            outcome = run_compiled(self.given, self.options(), self.watch(True), begun=self.begun)
            if is_batched(outcome.result):
                hint = "; simulate(...) of one alone says where"
                number, texts = codes(outcome.result, has_events, *self.bounds)
                say_of_members(number, texts, "runs that stopped", hint, self.throw, stacklevel=5)
                checked = False
        x = raised(outcome.x, outcome.result, has_events, *self.bounds) if checked else outcome.x
        return self._solution(outcome, outcome.stats, (jnp.asarray(outcome.ts), x, outcome.discrete), outcome.memory)

    def outside(self) -> Solution:
        """The solution where values are known. Runs are repeated with an implicit solver, or with more room for events,
        if they turn out to need it."""
        call, given, system = self, self.given, self.system
        # The log is part of the compiled program. With too little room, the run is made again by a second program.
        room = _room_for(_expected_events(system, float(given.t1) - float(given.t0)))
        room = room if room * (system.plan.n_state + len(system.discretes)) <= FEW_NUMBERS else ROOM
        # Records of 180 and of 200 samples are then one program.
        rows = given if given.ts is None else dataclasses.replace(given, ts=filled_up(given.ts))
        outcome = run_compiled(rows, call.options(room), call.watch(False), begun=call.begun)
        if is_traced(outcome):  # a network may close over a traced value, which shows in the outcome only
            return call.in_program(staged=True)
        counts = outcome.numbers()
        if self.throw is not False:
            check_parameters(system)
            if isinstance(given.initial, Mapping):
                check(system, outcome.found, given.t0, given.inputs, given.initial, stacklevel=4)
            else:
                check_state(outcome.found)
        # Whether a system is stiff depends on its parameters, so it is found by running: explicit steps cost little
        # until stability limits them.
        if self.switches and self._is_stiff(outcome):
            t = float(outcome.last[0])
            call = self.implicit(f"stiff: stability limits explicit steps from t={t:.3g} on")
            before = {"num_explicit_steps": counts["num_steps"], "stiff_from": t}
            outcome = run_compiled(rows, call.options(room), None, begun=call.begun)
            counts = outcome.numbers() | before
        while is_code(outcome.result, FORGETS) and call.remembered <= self.asked.max_steps:
            call = dataclasses.replace(call, more=4 * call.more)
            outcome = run_compiled(rows, call.options(room), None, begun=call.begun)
            counts = outcome.numbers()
        if outcome.events is not None and self.max_events is None and float(outcome.events.count) > room:
            room = _room_for(float(outcome.events.count))
            outcome = run_compiled(rows, call.options(room), None, begun=call.begun)
        memory, n = outcome.memory, len(given.ts) if given.ts is not None else counts["num_accepted_steps"] + 1
        saved = (outcome.ts, outcome.x, outcome.discrete)
        if n < len(outcome.ts):
            saved = jax.tree.map(lambda rows: picked(rows, slice(n)), saved)
            memory = memory if memory is None else memory.first(n)
        solution = call._solution(outcome, counts, saved, memory)
        if self.throw is not False and not is_code(outcome.result, *OKAY):
            raise call._failure(solution, outcome)
        idle = always_equal(solution) if self.throw is not False else ""
        if idle:
            warnings.warn(idle, RuntimeWarning, stacklevel=4)
        return solution

    def _is_stiff(self, outcome: Outcome) -> bool:
        """True if stability limited the steps of a run, or would have, had it gone on."""
        # A run may also use up its steps before so many of them were limited in a row.
        if not is_code(outcome.result, diffrax.RESULTS.max_steps_reached):
            return bool(outcome.is_stiff)
        there = self.system if outcome.held is None else self.system.holding(outcome.held)
        decay = decay_at(term_of(there, implicit=False), self.given.inputs, *outcome.last)
        return is_stiff(decay, float(self.given.t1 - outcome.last[0]), self.asked.max_steps)

    def _solution(
        self,
        outcome: Outcome,
        counts: dict[str, PyTree],
        saved: tuple[Times, State, Array | None],
        memory: Memory | None,
    ) -> Solution:
        ts, states, discrete = saved
        return Solution(
            ts=ts, states=states, system=self.system, inputs=self.given.inputs, counts=counts, result=outcome.result,
            solver=self.choice.solver, reason=self.choice.reason, discrete=discrete, event_log=outcome.events,
            memory=memory, asked=self.asked,
        )  # fmt: skip

    def _failure(self, solution: Solution, outcome: Outcome) -> Exception:
        """The error of a run that failed."""
        given, system = self.given, self.system
        first = given.t0, outcome.found.x
        held = system.holding(given.initial.discrete) if isinstance(given.initial, SavedState) else system
        mode = mode_at_start(held, given.inputs, *first)
        if mode:
            return InitializationError(mode)
        if outcome.held is not None:
            solution = eqx.tree_at(lambda s: s.system, solution, system.holding(outcome.held))
        (t, x), (steps, events) = outcome.last, self.bounds
        stopped = Stopped(t, x, outcome.result, given.t0, given.t1, steps, self.rtol, self.scaled)
        return SimulationError(explain(solution, stopped, outcome.found.x, is_implicit(self.run_by), events))


def _clocks(system: AcausalSystem) -> set[tuple[float, float]]:
    """The different periods and offsets of clocks; none where they are not known."""
    events = system.plan.events
    if events is None or not events.n_clocks:
        return set()
    # Under `jax.grad` alone, too, their values are known, and nothing is compiled to look at them.
    known = eqx.tree_at(lambda s: s.parameters, system, still(system.parameters))
    if is_traced(known.parameters):
        return set()
    periods, offsets = SystemAt(system.plan, known.numbers, (), 0.0, {}, system.typical_sizes).clocks()
    return set(zip(np.asarray(periods).tolist(), np.asarray(offsets).tolist(), strict=True))


def _ticks(system: AcausalSystem, duration: float | None) -> int:
    """The ticks of clocks in a run, each of which ends a step."""
    ticks = 0.0 if duration is None else sum(duration / period for period, _ in _clocks(system) if period > 0)
    return _room_for(min(ticks, MOST_TICKS)) if ticks else 0


def _expected_events(system: AcausalSystem, duration: float) -> float:
    """The events that a model with clocks has, if each of its conditions comes true once in every shortest period: so
    the log of the first run has room for them, and no second program with a larger one is compiled."""
    clocks, events = _clocks(system), system.plan.events
    if not clocks or events is None:
        return 0.0
    return min(duration / min(period for period, _ in clocks) * len(events), MOST_EVENTS)


def _room_for(events: float) -> int:
    """The room of a log for so many events: of few different sizes, each of which is a program."""
    return ROOM * 2 ** max(int(np.ceil(np.log2(max(events, 1.0) / ROOM))), 0)


def _stiff_without_a_run(stiffness: Stiffness | None, duration: float | None) -> str:
    """The reason to count a system as stiff where an explicit solver cannot be tried first, inside jit; "" if it is
    not. Runs outside of jit leave no trace for this: the result would depend on what the process did before."""
    if stiffness is None or duration is None or stiffness.decay * duration <= BOUNDARY * MANY:
        return ""
    return f"stiff: at the declared start something decays within about {1 / stiffness.decay:.0e}"
