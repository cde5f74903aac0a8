"""Step sizes for a compiled system: the controller, the first step, and where steps must end."""

from collections.abc import Sequence

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Args, Controller, Numeric, Solver, State, Time, Times, Tolerance
from ...base.errors import ModelError
from ...host.staging import as_argument, is_traced, joined
from ...solve.adjoint.ends import End, ending
from ...solve.adjoint.resting import still
from ...solve.methods.solve import step_control
from ...solve.methods.step_control import UNSEEN, ConstantLengths
from ..system.inputs import StepEnds
from ..system.system import AcausalSystem
from ..system.system_at import SystemAt
from .controlled_variables import with_variables
from .wave_control import AtWaves

HERE = 8  # roundings, within which two times are one


def scaled_atol(system: AcausalSystem, atol: Tolerance) -> Tolerance:
    """The absolute tolerance of each entry of the state, shape (n_state,): in units of its nominal value, or of its
    typical size where none is declared and that is less than one.

    A state of some nanometres would otherwise be all tolerance; of a large one the relative tolerance counts.
    """
    nominal, typical = system.plan.nominal, system.state_sizes
    if is_traced((typical, atol)):
        return atol * jnp.where(nominal != 1, nominal, jnp.minimum(typical, 1.0)).astype(atol.dtype)
    size = np.where(nominal != 1, nominal, np.minimum(np.asarray(typical), 1.0))
    return as_argument(np.asarray(atol) * size, atol.dtype)


def controller_for(
    system: AcausalSystem,
    solver: Solver,
    rtol: Tolerance,
    atol: Tolerance,
    scaled: Tolerance,
    dtmax: Time,
    control: Sequence[str] = (),
) -> Controller:
    """The step-size controller for these tolerances; `scaled` is `scaled_atol(system, atol)`. If the user gives no
    longest step, it is bounded by the period of the waves that drive the model."""
    controller: Controller = step_control(solver, rtol, scaled, dtmax=dtmax)
    if control:
        controller = with_variables(system, controller, solver, control, atol)
    if dtmax is not None or not system.plan.waves:
        return controller
    # The ends of steps are constants of differentiation. Where their values are known, nothing is compiled for them.
    known = eqx.tree_at(lambda s: s.parameters, system, still(system.parameters))
    at = SystemAt(system.plan, known.numbers, (), 0.0, {}, system.typical_sizes)
    return ending(controller, AtWaves(*at.waves(is_traced(system.parameters))))


def clipped(controller: Controller, jump_ts: Times, ends: StepEnds) -> Controller:
    """Wraps the controller so that steps end at jumps and kinks; steps prescribed by the user stay as they are."""
    if isinstance(controller, diffrax.StepTo):
        if jump_ts is not None:
            raise ModelError("jump_ts and StepTo both say where steps end: list the jumps in StepTo(ts=...)")
        return controller
    jumps = ends.jumps if jump_ts is None else [jump_ts, *ends.jumps]
    if not jumps and not ends.kinks:
        return controller
    controller = ending(controller, ConstantLengths(), *([AtTimes(jnp.sort(joined(ends.kinks)))] if ends.kinks else []))
    return diffrax.ClipStepSizeController(controller, jump_ts=joined(jumps)) if jumps else controller


class AtTimes(End):
    """Steps end at each of these times, increasing. `diffrax.ClipStepSizeController` does the same, but carries them
    from step to step: of 40,000 samples, each step then copied them all, and a run took 25 times as long."""

    ts: Float[Array, " n"]

    def wrap(self, direction: Time) -> "AtTimes":
        """The same for a run in the direction of time 1 or −1."""
        return AtTimes(jnp.sort(self.ts * direction))

    def moved(self, start: Time, end: Time) -> Time:
        """The end of a step, or the first of the times if that is before it. Times within rounding of the start have
        passed: where another input jumps at one of them, a step ends just before the jump."""
        passed = start + HERE * jnp.finfo(start.dtype).eps * jnp.abs(start)
        k = jnp.searchsorted(self.ts, jax.lax.stop_gradient(passed), side="right")
        ahead = jnp.where(k < len(self.ts), self.ts[jnp.minimum(k, len(self.ts) - 1)], jnp.inf)
        return jnp.minimum(end, ahead.astype(end.dtype))


def first_step(
    system: AcausalSystem, t0: Time, t1: Time, x0: State, inputs: Args, order: Numeric, controller: Controller
) -> Time:
    """The size of the first step (Hairer, Nørsett & Wanner 1993, II.4), kept out of differentiation."""
    if isinstance(controller, diffrax.StepTo) or not x0.shape[0]:
        return None if isinstance(controller, diffrax.StepTo) else t1 - t0
    # A controller of the user's need not have tolerances. These are the defaults.
    rtol, atol = getattr(controller, "rtol", 1e-6), getattr(controller, "atol", 1e-8)
    system, x0, inputs, t0, t1 = still((system, x0, inputs, t0, t1))
    scale = atol + rtol * jnp.abs(x0)

    def size(v):
        return jnp.sqrt(jnp.mean((v / scale) ** 2))

    # Hairer's limits: below them |y| or |y'| tells no size, and the probe is a fixed small step.
    tiny = 1e-5

    def probe(f0):
        d0, d1 = size(x0), size(f0)
        least = 1e-6 * jnp.minimum(t1 - t0, 1.0)
        h0 = jnp.where((d0 < tiny) | (d1 < tiny), least, 0.01 * d0 / jnp.maximum(d1, tiny))
        return jnp.minimum(h0, t1 - t0)

    def slope(point, _):
        t, x = point
        f = system.vector_field(t, x, inputs)
        h0 = probe(f)
        return (t0 + h0, x0 + h0 * f), f

    _, (f0, f1) = jax.lax.scan(slope, (t0, x0), length=2)  # a loop: the field is compiled once
    h0, d1 = probe(f0), size(f0)
    d2 = size(f1 - f0) / h0
    largest = jnp.maximum(d1, d2)
    power = 1.0 / ((order or 1) + 1)
    h1 = jnp.where(largest <= 1e-15, jnp.maximum(1e-6, h0 * 1e-3), (0.01 / jnp.maximum(largest, 1e-15)) ** power)
    h = jnp.minimum(jnp.minimum(100 * h0, h1), t1 - t0)
    # Where slopes are small beside how fast they change, the run begins nearly at rest: the step resolves that change.
    # A slope may be rounding alone, as behind an event: the step is never shorter than from a slope of zero.
    from_rest = 1e-6 * (t1 - t0)
    resolved = jnp.maximum(0.1 * d1 / jnp.maximum(d2, 1e-15), from_rest)
    h = jnp.where(d1**2 < UNSEEN * d2, jnp.minimum(h, resolved), h)
    h = jnp.where(jnp.isfinite(h) & (h > 0), h, from_rest)
    return jax.lax.stop_gradient(h)  # inputs may close over what is differentiated
