"""Why a run of a compiled system failed, in names of the model."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Inputs, Result, State, Time
from ...base.errors import SimulationError
from ...base.tolerances import CONSISTENT
from ...compile.diagnosis.lost_cancellation import lost_cancellation
from ...compile.diagnosis.wording import listed, quoted, some
from ...compile.lowering.plan import SystemPlan
from ...compile.model.events import Event
from ...host.members import is_batched
from ...host.staging import is_traced, layers
from ...solve.events.rivals import pair_of
from ...solve.events.solver import CLASH, FORGETS, MOVED, STUCK, TOO_MANY, VANISHED
from ...solve.methods.choice_guard import SINGULAR_CHOICE
from ...solve.methods.failures import SHOWN, Stopped, explain_failure, how_it_stopped
from ...solve.methods.switching import STIFF
from ...write.events import EventFlag
from ..system.inputs import value_at
from ..system.system import AcausalSystem
from .arguments import NOT_ADMITTED, TEXT
from .end_of_domain import end_of_domain, equation_not_finite
from .event_log import Events
from .failed_blocks import failed_block, singular_mode
from .hybrid_problem import RESTART, resolution
from .lost_constraints import lost_constraint
from .preparation import term_of
from .repeated_events import turning_in_turn, writes_what_holds
from .solution import Solution

# A run that failed for another reason (steps too short, too many) is explained by a singular choice of states if a
# determinant has fallen to this part of its first value.
NEARLY = 1e-2
# Times between events that shrink at least by this factor each accumulate: a ball whose speed is multiplied by e at
# each bounce bounces at intervals that shrink by e.
SHRINKING = 0.98
CHATTERING = 1e-6  # of the time that has passed: events that follow each other faster undo each other
REST = (
    "Say how the model rests: a mode in which it stays (complementary(…, rest_speed=…), contacts.HardStop; a discrete "
    "variable that the event assigns and the equations read), or when(…, terminate(…)) before"
)
# What `diffrax.is_okay` accepts.
OKAY: tuple[Result, Result] = (diffrax.RESULTS.successful, diffrax.RESULTS.event_occurred)
PROBES = 64  # times at which inputs are looked at


def codes(result: Result, has_events: bool, max_steps: int, max_events: int) -> tuple[Array, list[str]]:
    """A number for the reason by which a run failed, traced, 0 if it did not; and what the numbers from 1 on mean."""
    of_diffrax = diffrax.RESULTS
    lost = "the equations have no solution there, or the start is not consistent"
    many = f"more than max_events={max_events} events" if has_events else "too many rejected steps"
    texts = [
        (of_diffrax.max_steps_reached, f"max_steps={max_steps} was reached"),
        (of_diffrax.dt_min_reached, "no step was short enough to be accepted"),
        (TOO_MANY, many),
        (STUCK, "an event happens, or a relation turns, again and again at one instant"),
        (STIFF, f"the system is stiff, and max_steps={max_steps} hardly suffice: use solver=Rodas5P() or BDF()"),
        (CLASH, "two events give one variable different values at one instant"),
        (NOT_ADMITTED, TEXT),
        (SINGULAR_CHOICE, "the states have become a singular choice"),
        (VANISHED, "a delay has become negative, or too short for what it reads"),
        (FORGETS, "the record of what is delayed has too little room for the steps within the longest delay"),
        (
            of_diffrax.nonlinear_divergence,
            f"{lost}, or an event wrote a value that is not finite" if has_events else lost,
        ),
    ]
    number = sum(jnp.where(result == code, k, 0) for k, (code, _) in enumerate(texts, start=1))
    number = jnp.where(diffrax.is_okay(result), 0, jnp.where(number == 0, len(texts) + 1, number))
    return number, [*(text for _, text in texts), "it failed"]


def is_code(result: Result, *codes: Result) -> bool:
    """True if a known result is one of the codes."""

    def number(code: Result) -> int:
        return int(np.asarray(jax.tree.leaves(code)[0]))

    return number(result) in map(number, codes)


def raised(x: State, result: Result, has_events: bool, max_steps: int, max_events: int) -> Result:
    """x, with a run-time error if the run failed: in traced runs only a code is known."""
    values = jax.tree.map(lambda leaf: [*layers(leaf)][-1], result)
    known = not is_traced(values) and not is_batched(result)  # under `jax.grad` outside of jit
    if known and is_code(values, *OKAY):
        return x
    number, texts = codes(values if known else result, has_events, max_steps, max_events)
    messages = [
        f"the integration stopped: {text}. simulate(...) outside jit, grad and vmap says where" for text in texts
    ]
    if known:
        raise SimulationError(messages[int(number) - 1])
    return eqx.branched_error_if(x, number > 0, jnp.maximum(number - 1, 0), messages)


def explain(solution: Solution, at: Stopped, x0: State, implicit: bool, max_events: int) -> str:
    """The reason, in a sentence, why an integration from x0 on stopped, and the smallest mend."""
    system, inputs = solution.system, solution.inputs
    t, x, first = at.t, at.y, (at.t0, x0)
    stopped = f"the integration stopped at t={float(t):g}: "
    # From what is certain to what is likely: the first explanation that applies is the one that is told.
    of_event = _of_event(solution, at, max_events)
    if of_event:
        return of_event
    if at.result == VANISHED or at.result == FORGETS:
        return stopped + _of_delays(system, at, inputs)
    if at.result == STIFF:
        return (
            f"{stopped}the system is stiff. From there on stability, not accuracy, limits explicit steps, so that "
            f"max_steps={at.max_steps} hardly suffice to t={float(at.t1):g}. Write "
            "solver=jaxonomy_dae.solvers.Rodas5P(), BDF() for many unknowns, or leave solver= out"
        )
    written, others = _not_finite(system, x)
    if others and not written and not system.is_constrained and system.plan.held is None:
        return singular_mode(system, first, (t, x), inputs) + _of_short_circuits(system)
    written = written or others
    gap = _gap_at_event(solution, at)
    if gap:
        return gap
    if written:
        return f"{stopped}an event gave {written} a value that is not finite" + (
            ", or it entered a mode whose constraint does not hold at that instant (its gap or speed is not zero), or "
            "which no impulse can enforce. Check the event's condition, or reset the states with reinit(...)"
            if system.plan.held is not None
            else ", or left states that the hidden constraints do not admit: let it write, with reinit(...), all that "
            "jumps" + _of_kinks(system)
            if system.is_constrained
            else ""
        )
    bad = _bad_input(system.plan, inputs, float(at.t0), float(t), float(at.t1))
    if bad:
        return stopped + bad
    plan, numbers = system.plan, np.asarray(system.numbers, float)
    lost = lost_cancellation(plan.model.groups, numbers, plan.flat.parameters.names, float(t))
    if lost:
        return f"{stopped}{lost}."
    equation = equation_not_finite(system, inputs, t, x)
    if equation is not None:
        where, mend = ("at the start", "Start elsewhere, or look") if float(t) == float(at.t0) else ("there", "Look")
        return (
            f"{stopped}an equation is not finite {where}, {equation.text(system)}. {mend} for a division by zero, or a "
            "root or logarithm without a real value."
        )
    found = _singular_choice(solution, first, t, x) or lost_constraint(system, inputs, t, x, at.t1)
    if found:
        return f"{stopped}{found}."
    block = failed_block(system, first, (t, x), at.t1, inputs)
    if block:
        return how_it_stopped(at.result, t, at.max_steps) + block
    domain = end_of_domain(system, t, x, at.t1, inputs)
    if domain:
        return f"{stopped}{domain}."
    return explain_failure(term_of(system, implicit), inputs, [*system.states, *system.carried], at, not implicit)


def _of_delays(system: AcausalSystem, at: Stopped, inputs: Inputs) -> str:
    """Why a run with delays stopped."""
    delays = system.plan.delays
    assert delays is not None
    point = system.at(at.t, inputs)
    if at.result == FORGETS:
        longest = np.asarray(point.longest_delays(), float)
        k = int(np.argmax(longest))
        return (
            f"more steps lie within the longest delay, that of '{delays.table.text[k]}' ({longest[k]:g} s), than "
            "max_steps admits or a record inside jit, grad and vmap has room for. Ask for less accuracy (rtol, atol), "
            "so that steps are longer"
        )
    delay = float(at.t) - np.asarray(point.delayed(at.y)[1], float)
    k = int(np.argmin(delay))
    return (
        f"the delay of '{delays.table.text[k]}' is {delay[k]:.3g} s and becomes negative, or it is so short that what "
        "it reads follows itself without one. Only the past can be read: let the delay stay positive, for instance "
        "Max(time, least)"
    )


def _of_event(solution: Solution, at: Stopped, max_events: int) -> str:
    """Says which events ended the run; "" if none did."""
    log, t = solution.event_log, float(at.t)
    if log is None:
        return ""
    if at.result == TOO_MANY:
        return _too_many_events(solution.events, max_events, t)
    if at.result == STUCK:
        return _stuck(solution, int(log.stuck), at)
    return _clash(solution, int(log.stuck), t) if at.result == CLASH else ""


def mode_at_start(system: AcausalSystem, inputs: Inputs, t0: Time, x0: State) -> str:
    """The constraints that do not hold although a run begins in their modes, in a sentence; "" if all hold."""
    held = system.plan.held
    if held is None:
        return ""
    active, levels = map(np.asarray, system.at(t0, inputs).held(x0))
    projected = np.asarray(system.project(t0, x0, inputs, iterations=RESTART))
    n, typical = len(system.plan.states), np.asarray(system.typical_sizes)[system.plan.states]
    moved = np.abs(projected - np.asarray(x0))[:n] / (np.abs(np.asarray(x0))[:n] + typical)
    if (moved <= CONSISTENT).all():
        return ""
    lost = np.unique(held.table.owner[~np.isfinite(levels)]).tolist()
    if lost:
        return (
            f"the run cannot begin at t={float(t0):g}, where {some([repr(held.table.text[k]) for k in lost])} has no "
            "finite derivatives, as a root at zero: begin elsewhere, or write it without, as L**2 - x**2 - y**2 in "
            "place of L - sqrt(x**2 + y**2)"
        )
    lines = []
    for k in np.flatnonzero(active > 0).tolist():
        values = levels[held.table.owner == k]
        found = ", ".join(f"its derivative {v:.3g}" if level else f"it is {v:.3g}" for level, v in enumerate(values))
        lines.append(f"'{held.table.text[k]}': {found}")
    return (
        f"the run cannot begin at t={float(t0):g} in the mode of " + "; ".join(lines) + ". Give starts at which these "
        "are zero, or begin in the other mode"
    )


def _gap_at_event(solution: Solution, at: Stopped) -> str:
    """Names the constraints of modes that the last event entered though they do not hold where it happened, and by how
    much; "" if all of them hold, if it is not known what was before, or if the run went on after it."""
    system, inputs, log = solution.system, solution.inputs, solution.event_log
    held, n = system.plan.held, len(system.plan.nominal)
    last = 0 if log is None else int(log.count) - 1
    if held is None or log is None or not 0 <= last < len(log.before):
        return ""
    (x, q), after = (log.before[last][:n], log.before[last][n:]), log.after[last][n:]
    t = float(log.ts[last])
    # A state that is not finite is no last point of a run, so that this may be one before the event.
    goes_on = t < float(at.t) - MOVED * float(resolution(at.t0, at.t1))
    if goes_on or not np.isfinite(np.asarray(x)).all():
        return ""
    system = system.holding(after)
    begun = np.asarray(system.at(t, inputs).held(x)[0]) > np.asarray(system.holding(q).at(t, inputs).held(x)[0])
    levels = np.asarray(system.at(t, inputs).held(x)[1])
    gaps = {k: float(levels[held.table.owner == k][0]) for k in np.flatnonzero(begun).tolist()}
    size = CONSISTENT * float(np.max(np.abs(np.asarray(x)[: len(system.plan.states)]), initial=1.0))
    lines = [f"'{held.table.text[k]}', where it is {gap:.3g}" for k, gap in gaps.items() if abs(gap) > size]
    if not lines:
        return ""
    return (
        f"the integration stopped at t={t:g}: '{solution.events.names[-1]}' began a mode whose constraint does not "
        f"hold there: {some(lines)}. No impulse closes a gap. Let the mode begin where the constraint holds, with that "
        "as the event's condition, or write the states with reinit(...)"
    )


def _not_finite(system: AcausalSystem, x: State) -> tuple[str, str]:
    """The names of discrete variables and states that are not finite after an event: those that events write, and the
    others, which an event spoils by a mode in which they have no slope."""
    events = system.plan.events
    if events is None:
        return "", ""
    names = system.every_discrete
    n = len(system.states)
    resets = np.isin(np.arange(n), events.state)
    pairs = [*zip(names, np.asarray(system.discrete_values)[: len(names)], [True] * len(names), strict=True)]
    pairs += [*zip(system.states, np.asarray(x)[:n], resets, strict=True)]
    lost = [(repr(name), resets) for name, value, resets in pairs if not np.isfinite(value)]
    return ", ".join(name for name, resets in lost if resets), ", ".join(name for name, resets in lost if not resets)


def _of_short_circuits(system: AcausalSystem) -> str:
    """What may be wrong with ideal switches, if there are any."""
    if not system.report.modes:
        return ""
    return (
        " Ideal switches and diodes that short-circuit a source or a capacitor do so: give those a resistance, Ron=1e-5"
    )


def _too_many_events(events: Events, max_events: int, t: float) -> str:
    """Names the most frequent event, and the time at which its instants accumulate, if they do."""
    which = np.asarray(events.which, int)
    counts = np.bincount(which[which >= 0], minlength=len(events.all_names))
    most = int(np.argmax(counts))
    times = np.asarray(events.ts)[which == most]
    text = (
        f"more than max_events={max_events} events by t={t:.6g}, {counts[most]} of them '{events.all_names[most]}'. "
        "Give a larger max_events if they are meant"
    )
    accumulate = _accumulation(times)
    if accumulate:
        return f"{text}; but {accumulate}. {REST}"
    apart = np.diff(times[-8:])
    if len(apart) and apart[-1] < CHATTERING * max(abs(t), apart.max()):
        return (
            f"{text}; but they follow each other at once: the event undoes what made it happen. Let the conditions "
            "for switching on and off lie apart (hysteresis), or smooth the relation"
        )
    return f"{text}."


def _stuck(solution: Solution, event: int, at: Stopped) -> str:
    """Says why event number `event` happens, or its relation turns, again and again at one instant."""
    t, instant = float(at.t), MOVED * float(resolution(at.t0, at.t1))
    system, inputs = solution.system, solution.inputs
    table = system.plan.some_events
    if EventFlag.RELATION in table.table.events[event].flags:
        together = turning_in_turn(system, event, (at.t, at.y), abs(float(at.t1 - at.t0)), inputs)
        return _in_turn([table.table.events[k] for k in together], t) or _sliding(table.table.events[event], t)
    if EventFlag.REPEATED in table.table.events[event].flags:
        unsettled = _unsettled(solution, t)
        if unsettled:
            return unsettled
    times, which = np.asarray(solution.events.ts), np.asarray(solution.events.which, int)
    # Where events accumulate, the last ones follow each other as rounding has it.
    lately = times > t - instant
    often = np.bincount(which[lately & (which >= 0)], minlength=len(table.names)) > 1
    names = [name for k, name in enumerate(table.names) if k == event or often[k]]
    text = f"the integration stopped at t={t:.6g}: {listed(names)} would happen again and again there (Zeno behaviour)"
    accumulate = _accumulation(times[(which == event) & ~lately])
    if accumulate:
        return f"{text}: {accumulate}. {REST}"
    revocable = table.table.are(EventFlag.REVOCABLE)
    if len(names) > 1 and all(revocable[k] for k in range(len(table.names)) if k == event or often[k]):
        return (
            f"the integration stopped at t={t:.6g}: no mode is consistent there, {listed(names)} are true in turn. "
            "What complementary(…) asks for contradicts the other equations: give what drives a current against a "
            "diode that blocks, or pulls at what can only push, another way (a small conductance, a spring)"
        )
    if len(names) > 1:
        return (
            f"{text}: what one of them writes makes the other one's condition true at once. Let the conditions for "
            f"switching on and off lie apart (hysteresis). {REST}"
        )
    same = writes_what_holds(system, event, (at.t, at.y), inputs)
    if same:
        name, value = same[0]
        short = name.split(".", 1)[-1]
        return (
            f"the integration stopped at t={t:.6g}: {listed(names)} would happen again and again there, and change "
            f"nothing: {some([f'{n} = {v:g}' for n, v in same])} holds already, and the equations of this mode keep "
            f"the condition on the verge of being true. Let it count in the other mode only, "
            f"when(…, on=Ne({short}, {value:g}))"
        )
    return (
        f"{text}: what it writes leaves its condition on the verge of being true, and the equations make it true at "
        f"once. {REST}"
    )


def _unsettled(solution: Solution, t: float) -> str:
    """Says which discrete variables go round in a circle at t, or change in every iteration; "" if none does."""
    log, system = solution.event_log, solution.system
    if log is None or log.iteration is None:
        return ""
    count, names = int(log.iteration.count), system.discretes
    changed = [name for name, turns in zip(names, np.asarray(log.iteration.turning), strict=False) if turns > 0]
    text = f"the integration stopped at t={t:.6g}: the discrete equations have no values that stay there"
    if count < 0:
        which = f"{listed(changed)} go" if len(changed) > 1 else f"{listed(changed)} goes" if changed else "they go"
        return (
            f"{text}: {which} round in a circle, and after {-count} iterations all values are those of an iteration "
            "before. What one asks of another through its value before, pre(…), must end: let the conditions for "
            "turning on and off lie apart, or put a delay between them (a clock)"
        )
    if changed and count > 2:
        return (
            f"{text}: {listed(changed)} {'change' if len(changed) > 1 else 'changes'} in each of {count} iterations. "
            "Let a condition end that"
        )
    return ""


def _clash(solution: Solution, number: int, t: float) -> str:
    """Says which two events contradict each other at t, and in what."""
    system = solution.system
    plan = system.plan.some_events
    pair = pair_of(number, len(plan) + 1)
    places = [{place for event, place in plan.facts.contested if event == k} for k in pair]
    events = sorted(plan.names[k] for k in pair)
    names = [*system.states, *system.carried, *system.every_discrete]
    hidden = len(plan.discrete) - plan.n_declared
    shared = [names[place + hidden if place < 0 else place] for place in sorted(places[0] & places[1])]
    return (
        f"the integration stopped at t={t:.6g}: {listed(events)} happen at one instant and give {listed(shared)} "
        "different values. Let one event write it, with a Piecewise that says which value counts, or give them "
        "conditions (on=…) that exclude each other"
    )


def _accumulation(times: np.ndarray) -> str:
    """Says by which factor the times between an event's instants shrink, and where they accumulate; "" if they do not
    shrink."""
    apart = np.diff(times[-8:])
    if len(apart) < 2 or (apart[:-1] <= 0).any():
        return ""
    ratios = apart[1:] / apart[:-1]
    if ratios.max() >= SHRINKING:
        return ""
    # The times that are left are a geometric series.
    end = times[-1] + apart[-1] * ratios[-1] / (1 - ratios[-1])
    return f"the times between them shrink, each to {ratios[-1]:.3g} of the one before, and accumulate at t={end:.6g}"


def _of_kinks(system: AcausalSystem) -> str:
    """Advice for models with relations, in case one of them turned where a constraint has a kink; "" without
    relations."""
    found = system.report.relations
    if not found:
        return ""
    shown = ", ".join(found[:SHOWN])
    return (
        f". If it is a constraint that has a kink where a relation turns ({shown}), speeds jump there: round the kink, "
        "or say with self.complementary what pushes"
    )


def _in_turn(relations: list[Event], t: float) -> str:
    """Explains relations that turn one after the other, ever faster; "" if there are none."""
    if not relations:
        return ""
    which = "; ".join(f"'{e.condition}' of component '{e.owner}'" for e in relations)
    return (
        f"the integration stopped at t={t:.6g}: relations turn one after the other, ever faster (Zeno behaviour): "
        f"{which}. The solution comes to where all of them are equal, and is driven back to none of these surfaces by "
        f"itself. What it does from there on the equations leave open: end the run before, with "
        "when(…, terminate(…)), let an event assign a mode in which it rests, or round the corner with a smooth law, "
        "for instance tanh(x/small) instead of sign(x)"
    )


def _sliding(relation: Event, t: float) -> str:
    """Explains a relation that turns again and again at the instant t, and what to write instead."""
    return (
        f"the integration stopped at t={t:.6g}: chattering. On both sides of '{relation.condition}' of component "
        f"'{relation.owner}' the equations drive the solution back to where it turns. Say what holds on both sides, "
        "with self.sliding(surface, above, below): the solution then stays there; or let the conditions for turning "
        "forth and back lie apart (hysteresis), with self.when; or use a smooth law, for instance tanh(x/small) "
        "instead of sign(x)"
    )


def _bad_input(plan: SystemPlan, inputs: Inputs, t0: float, t: float, t1: float) -> str:
    """The input that is not finite at the last accepted point or beyond it; "" if there is none."""
    near = t + (t1 - t) * np.concatenate([[0.0], 10.0 ** np.linspace(-15, 0, PROBES)])
    for name, value in inputs.items():
        for s in near if callable(value) else near[:1]:
            found = np.ravel(value_at(value, jnp.asarray(s)))
            if not np.isfinite(found).all():
                k = int(np.flatnonzero(~np.isfinite(found))[0])
                places = plan.input_places(name)
                which = name if places is None or len(found) < places.size else plan.inputs.names[places.ravel()[k]]
                where = f" at t={s:.6g}" if callable(value) else ""
                return (
                    f"input '{which}' is {found[k]}{where}. Give a value at every time from {t0:g} to {t1:g} "
                    "(jnp.nan_to_num, or samples without gaps)."
                )
    return ""


def _singular_choice(solution: Solution, first: tuple[State, State], t: Time, x: State) -> str:
    """Names the quantities that the chosen states no longer determine at (t, x), if a singular choice of states ended
    the run; "" otherwise."""
    system, inputs = solution.system, solution.inputs
    plan = system.plan
    if not plan.dummy_blocks:
        return ""
    here = np.abs(np.asarray(system.dummy_determinants(t, x, inputs)))
    before = np.abs(np.asarray(system.dummy_determinants(*first, inputs)))
    # Other causes may end a run just before: steps too many, or too short.
    if solution.result != SINGULAR_CHOICE and not (here <= NEARLY * before).any():
        return ""
    columns = [column for block in plan.dummy_blocks for column in block.columns]
    lost = columns[int(np.argmin(here))]
    values = np.asarray(x)[len(plan.states) + lost]
    shown = ", ".join(f"'{system.carried[c]}' = {v:.3g}" for c, v in list(zip(lost, values, strict=True))[:SHOWN])
    return (
        f"the states {quoted(system.states, SHOWN)} have become a "
        f"singular choice. There they no longer determine {shown}, and it cannot be told which branch continues. "
        'Compile with state_selection="auto", which has no such points, or with other prefer_states'
    )
