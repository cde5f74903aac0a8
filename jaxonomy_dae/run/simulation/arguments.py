"""What `simulate` accepts: every argument is checked before anything is compiled.

Whether it can be computed with, finite numbers and parameters within their bounds, is said by name outside jit. Inside,
where values are not known, it is found while running: the run ends at once, its rows are not-a-number, and its result
is `NOT_ADMITTED`.
"""

import math
import warnings
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ...base.aliases import Controller, Inputs, PyTree, Result, Solver, Time, Times
from ...base.errors import ModelError
from ...base.tolerances import RESOLUTION
from ...host.staging import is_traced
from ...solve.adjoint.resting import still
from ...solve.methods.solve_arguments import check_finite, check_longest_step
from ..start.initial_values import check_initial
from ..system.closed_function import ClosedFunction
from ..system.inputs import SampledInput, samples_fit, value_at
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from .from_state import check_array
from .saved_state import SavedState, check_saved_state, initial_time

MOST_ROOM = 4 * 2**30  # bytes that saved steps may reserve

NOT_ADMITTED: Result = diffrax.RESULTS.nonfinite
TEXT = (
    "a parameter, a weight or an input is not finite, a parameter is out of its bounds, t1 is before t0, or the "
    "samples of an input do not increase in time or do not reach over the run"
)
# Times at which inputs are looked at, relative to what is left of a run: what made it stop lies just ahead, on a scale
# that only the run knows.
AHEAD = np.concatenate([[0.0], 10.0 ** np.linspace(-15, 0, 64)])


def check_system(system: AcausalSystem) -> None:
    """Raises a `ModelError` for anything but one system."""
    if not isinstance(system, AcausalSystem):
        raise ModelError(f"simulate needs an AcausalSystem (call the AcausalCompiler); got {type(system).__name__}")
    if system.parameters.values.ndim != 1:
        raise ModelError(
            f"the system is a batch, its parameters have shape {system.parameters.values.shape}: simulate each with "
            "equinox.filter_vmap(lambda s: simulate(s, ...))(system)"
        )
    _note_single_precision(system)


def check_method(system: AcausalSystem, solver: Solver, adjoint: PyTree, stepsize_controller: Controller) -> None:
    """Raises a `ModelError` for a solver, an adjoint or a controller that cannot work, and says what would."""
    if solver is not None and not isinstance(solver, diffrax.AbstractSolver):
        if isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver):
            got = f"the class {solver.__name__}: write {solver.__name__}()"
        else:
            got = f"{solver!r}. For stiff models give solvers.Rodas5P() or solvers.BDF(), or leave solver out"
        raise ModelError(f"solver must be a Diffrax solver such as diffrax.Tsit5(); got {got}")
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ModelError(
            "adjoint=BacksolveAdjoint() is wrong for constrained systems: it integrates the state backwards without "
            "its constraints and leaves the algebraic variables out. Use the default StoredAdjoint(), "
            "RecursiveCheckpointAdjoint(), or ForwardMode() for few parameters"
        )
    if isinstance(stepsize_controller, diffrax.ConstantStepSize):
        raise ModelError(
            "stepsize_controller=ConstantStepSize() needs a step: use diffrax.StepTo(ts=jnp.linspace(t0, t1, n))"
        )
    if system.plan.events is not None and isinstance(stepsize_controller, diffrax.StepTo):
        raise ModelError(
            "stepsize_controller=StepTo(...) prescribes where steps end, but this model has events, at which they must "
            "end too: leave it out, or bound the steps with dtmax="
        )


def check_steps(system: AcausalSystem, ts: Times, dtmax: Time, max_steps: Any) -> None:
    """Raises a `ModelError` for steps that are too many to be saved, and limits that are no numbers."""
    if isinstance(max_steps, bool) or not isinstance(max_steps, int | np.integer) or max_steps < 1:
        raise ModelError(f"max_steps must be a positive integer; got {_told(max_steps)}")
    room = (max_steps + 1) * system.plan.n_state * system.parameters.values.dtype.itemsize
    if ts is None and room > MOST_ROOM:
        raise ModelError(
            f"saving every step (ts=None) reserves max_steps + 1 = {max_steps + 1} rows for {system.plan.n_state} "
            f"states, {room / 2**30:.1f} GiB: say when to save, ts=jnp.linspace(t0, t1, 101), or lower max_steps"
        )
    check_longest_step(dtmax)


def check_start(system: AcausalSystem, t0: Time, t1: Time, ts: Times, initial: PyTree) -> None:
    """Raises a `ModelError` for an interval, times and a start that cannot be."""
    if isinstance(initial, SavedState):
        check_saved_state(system, t0, initial)
    elif hasattr(initial, "ndim"):
        check_array(system, initial)
    else:
        check_initial(system, initial)
    _check_interval(initial_time(t0, initial), t1, ts, system.parameters.values.dtype)
    _check_periods(system)
    _check_delays(system, initial)


def _note_single_precision(system: AcausalSystem) -> None:
    """Warns of a system whose numbers were made before JAX was told to use double precision."""
    if system.parameters.values.dtype == np.float32 and jax.config.jax_enable_x64:  # pyright: ignore
        warnings.warn(
            "the system was compiled before double precision was enabled, so its numbers are float32: compile it after "
            'jax.config.update("jax_enable_x64", True)',
            RuntimeWarning,
            stacklevel=5,
        )


def check_switches(max_events: Any, **switches: object) -> None:
    """Raises a `ModelError` for options that are not Python numbers: they decide what the program is."""
    for name, value in switches.items():
        if value is not None and not isinstance(value, bool | np.bool_):
            raise ModelError(f"{name} must be True or False; got {_told(value)}")
    whole = isinstance(max_events, int | np.integer) and not isinstance(max_events, bool)
    if max_events is not None and not (whole and max_events >= 0):
        raise ModelError(f"max_events must be an integer, 0 or more; got {_told(max_events)}")


def _told(value: object) -> str:
    if is_traced(value):
        return "a traced value, which is not known when the program is made: give it from outside of jit, grad and vmap"
    return repr(value)


def _check_periods(system: AcausalSystem):
    if system.plan.events is None or not system.plan.events.n_clocks:
        return
    # Under `jax.grad` alone, too, their values are known, and nothing is compiled to look at them.
    known = eqx.tree_at(lambda s: s.parameters, system, still(system.parameters))
    periods = _concrete(SystemAt(system.plan, known.numbers, (), 0.0, {}, system.typical_sizes).clocks()[0])
    if periods is None:
        return
    bad = np.flatnonzero(~(periods > 0))
    if len(bad):
        name = system.plan.events.names[bad[0]]
        raise ModelError(
            f"'{name}': the period must be positive; it is {periods[bad[0]]:g}. Set it with with_parameters"
        )


def _check_delays(system: AcausalSystem, initial: PyTree) -> None:
    delays = system.plan.delays
    if delays is None:
        return
    if isinstance(initial, SavedState):
        raise ModelError(
            f"initial: '{delays.table.text[0]}' is delayed, and the state of another run does not hold its past: run "
            "from the beginning"
        )
    known = eqx.tree_at(lambda s: s.parameters, system, still(system.parameters))
    point = SystemAt(system.plan, known.numbers, (), 0.0, {}, system.typical_sizes)
    longest = _concrete(point.longest_delays())
    if longest is None or (longest > 0).all():
        return
    bad = int(np.flatnonzero(~(longest > 0))[0])
    raise ModelError(
        f"the delay of '{delays.table.text[bad]}' must be positive; it is {longest[bad]:g} s. Set it with "
        "with_parameters"
    )


def _concrete(value: object) -> np.ndarray | None:
    return None if is_traced(value) else np.asarray(value, float)


def _check_length(t0: float, t1: float, dtype: np.dtype) -> None:
    """Raises a `ModelError` if numbers of this type hardly tell the times of a run apart."""
    largest = max(abs(t0), abs(t1))
    if t1 - t0 > RESOLUTION * float(np.finfo(dtype).eps) * largest:
        return
    double = 'use double precision, jax.config.update("jax_enable_x64", True), or ' if dtype == np.float32 else ""
    raise ModelError(
        f"the interval from t0={t0!r} to t1={t1!r} is too short for {dtype.name}, in which times near {largest:g} are "
        f"{float(np.spacing(dtype.type(largest))):g} s apart: {double}count time from the start, t0=0.0"
    )


def _check_interval(t0, t1, ts, dtype):
    check_finite(t0=t0, t1=t1)
    a, b = _concrete(t0), _concrete(t1)
    if a is not None and b is not None and not a < b:
        raise ModelError(f"the interval needs t0 < t1; got t0={float(a)}, t1={float(b)}")
    if a is not None and b is not None:
        _check_length(float(a), float(b), np.dtype(dtype))
    if ts is None:
        return
    if np.ndim(ts) != 1 or not np.shape(ts)[0]:
        raise ModelError(f"ts must have shape (n,), n ≥ 1; got {np.shape(ts)}")
    if not is_traced(ts) and np.asarray(ts).dtype.kind not in "biuf":
        raise ModelError(f"ts must be numbers; got {np.asarray(ts).dtype}")
    saved = _concrete(ts)
    if saved is None:
        return
    if not np.isfinite(saved).all():
        raise ModelError("ts must be finite")
    backwards = np.flatnonzero(np.diff(saved) < 0)
    if len(backwards):
        k = int(backwards[0])
        raise ModelError(
            f"ts must be sorted; ts[{k}]={saved[k]} is followed by ts[{k + 1}]={saved[k + 1]}: use jnp.sort(ts)"
        )
    # Times are computed, as by `linspace`, and may miss the ends by rounding.
    slack = 1e-6 if np.asarray(ts).dtype == np.float32 else 1e-12
    low = -math.inf if a is None else float(a) - slack * (1 + abs(float(a)))
    high = math.inf if b is None else float(b) + slack * (1 + abs(float(b)))
    outside = saved[(saved < low) | (saved > high)]
    if len(outside):
        raise ModelError(
            f"ts must lie between t0={t0} and t1={t1}; {outside[0]} does not. Extend the interval, or leave that time "
            "out"
        )


def check_parameters(system: AcausalSystem):
    """Raises a `ModelError` that names a parameter that is not finite or out of its bounds, or a network with a weight
    that is not finite."""
    problem = system.parameters.problem
    if problem is not None:
        raise ModelError(problem)
    for name, network in system.neural.items():
        for leaf in jax.tree.leaves(eqx.filter(network, eqx.is_inexact_array)):
            if not np.isfinite(np.asarray(leaf)).all():
                raise ModelError(f"a weight of network '{name}' is not finite: go back to an earlier iterate")


def are_admitted(system: AcausalSystem, inputs: Inputs, t0: Time, t1: Time) -> Bool[Array, ""]:
    """True if parameters, weights, constants and samples are finite, parameters are within their bounds, samples reach
    over the run, and it does not go backwards."""
    data = [source for source in inputs.values() if not isinstance(source, ClosedFunction)]
    leaves = jax.tree.leaves(eqx.filter((system.neural, data), eqx.is_inexact_array))
    finite = [jnp.isfinite(leaf).all() for leaf in leaves]
    fit = [samples_fit(inputs, t0, t1)] if any(isinstance(s, SampledInput) for s in data) else []
    # Backwards, clocks would not tick, and conditions become true where they cease to be.
    if system.plan.delays is not None:
        point = SystemAt(system.plan, system.numbers, (), 0.0, {}, system.typical_sizes)
        fit.append(jnp.all(jnp.asarray(point.longest_delays()) > 0))
    return jnp.stack([system.parameters.are_admitted, t0 <= t1, *finite, *fit]).all()


def inputs_are_finite(inputs: Inputs, t: Time, t1: Time) -> Bool[Array, ""]:
    """True if inputs given as functions are finite at the time t at which a run stopped, and at a few instants between
    t and t1."""
    functions = [source for source in inputs.values() if isinstance(source, ClosedFunction)]
    if not functions:
        return jnp.array(True)
    functions, t, t1 = jax.lax.stop_gradient((functions, t, t1))

    def finite(time):
        return jnp.stack([jnp.isfinite(value_at(source, time)).all() for source in functions]).all()

    return jnp.all(jax.lax.map(finite, t + (t1 - t) * jnp.asarray(AHEAD, t1.dtype)))
