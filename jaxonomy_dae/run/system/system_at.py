"""What a compiled system computes at a point: its vector field, constraints, projection and every variable.

All functions take the static plan, the flat parameters, the networks, time, the state array and input values. Small
systems are traced on scalars, which XLA fuses into a few kernels; large ones on arrays.
"""

import functools
import operator
from collections.abc import Sequence
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax import Array

from ...base.aliases import Args, Time
from ...base.errors import ModelError
from ...compile.lowering.gather import SCALARS, Chunk, Gather, entries, times
from ...compile.lowering.plan import PlannedRow, SystemPlan
from ...compile.lowering.plan_delays import DelayPlan
from ...compile.lowering.plan_events import EventPlan, HeldPlan
from ...compile.lowering.program import Program
from ...compile.model.opaque import Networks
from ...compile.model.starts import Start, formulas_of
from ...host.staging import is_traced, joined, on_device
from ...solve.events.past import Remembered
from ...solve.linear.arrays import Numbers
from ...solve.linear.once import stacked_in_batches
from ...solve.linear.sparse import SparsePattern, sparse_jacobian
from ...solve.linear.whole import solve_whole
from ...solve.linear.written_out import UNROLLED_POSITIVE, solve
from ...solve.methods.field_size import is_large
from .evaluate import Evaluation
from .input_values import input_values
from .measured import Measured
from .nonlinear import Refinement
from .roots import newton_step
from .traced_once import TracedOnce, traced_once


class SystemAt:
    """A system at one time and state, ready to be evaluated."""

    def __init__(
        self, plan: SystemPlan, parameters: Array, networks: tuple, t: Time, inputs: Args, typical: Array,
        past: Remembered | None = None, once: TracedOnce | None = None,
    ):  # fmt: skip
        """`typical` are the sizes of all quantities, shape (quantities,); `past` is that of a run, within it; `once`:
        see `traced_once`."""
        self.plan, self.once = plan, once
        self.typical = jax.lax.stop_gradient(typical)
        self.parameters = parameters
        self.dtype = parameters.dtype
        self.networks = networks
        self.past = past
        self.inputs = inputs
        self.t = on_device(t, self.dtype)
        self._last: tuple[Array, Chunk] | None = None  # the state that was asked for last, and its chunk

    def run(self, program: Program, x: Chunk, refine: Refinement, t: Time = None) -> Evaluation:
        """Evaluates a program at a state."""
        t = self.t if t is None else t
        inputs = input_values(self.plan, self.inputs, t, self.dtype)
        networks, parameters = Networks(self.networks), self._with_past(x, inputs, t)
        return Evaluation(self._chunk(x), inputs, parameters, t, networks, self.typical).run(program, refine)

    def _with_past(self, x: Chunk, inputs: Chunk, t: Time) -> Array:
        """The parameters, with what equations read of the past of a run."""
        if self.past is None:
            return self.parameters
        delays, networks = self._delays(), Networks(self.networks)
        at = Evaluation(self._chunk(x), inputs, self.parameters, t, networks, self.typical)
        instant = jax.lax.stop_gradient(self._filled(at.run(delays.instants, Refinement.NONE), delays.instant))
        waits = self.parameters[delays.parameters[:, 0]] > 0
        read = jnp.stack([jnp.zeros_like(instant), instant, *self.past.read(t, instant, waits)], axis=1)
        return self.parameters.at[delays.parameters].set(read)

    def _chunk(self, x: Chunk) -> Chunk:
        """The state as a tuple of scalars, if it is one or has up to `SCALARS` entries; else as an array."""
        if isinstance(x, tuple):
            return x
        # A program reads the state at several places. Split once, its cotangents are joined once, too.
        if self._last is None or self._last[0] is not x:
            array = jnp.asarray(x)
            if jnp.shape(array) != (self.plan.n_state,):
                raise ModelError(f"a state of this system has shape ({self.plan.n_state},); got {jnp.shape(array)}")
            self._last = (x, tuple(entries(array)) if self.plan.n_state <= SCALARS else array)
        return self._last[1]

    def _values(self, evaluation: Evaluation, gather: Gather) -> Chunk:
        """Gathered values: those of a small system one by one, which XLA fuses, else as an array."""
        if self.plan.n_state > SCALARS:
            return self._filled(evaluation, gather)
        return tuple(jnp.asarray(evaluation.read(gather.only(k)), self.dtype) for k in range(len(gather.chunk)))

    def _array(self, *chunks: Chunk) -> Array:
        """All values of these chunks. Scalars are put together once, at the end: in a batch, XLA makes no vector loop
        of an array that is made of arrays, and computes its entries one by one."""
        if all(isinstance(chunk, tuple) for chunk in chunks):
            values = [value for chunk in chunks for value in chunk]
            return stacked_in_batches(values) if values else jnp.zeros(0, self.dtype)
        return jnp.concatenate([self._array(chunk) if isinstance(chunk, tuple) else chunk for chunk in chunks])

    # --- vector field ------------------------------------------------------------------------------------------

    @traced_once
    def vector_field(self, x: Array) -> Array:
        """d(state)/dt, shape (n_state,)."""
        plan = self.plan
        if not len(plan.carried):
            return self._array(self._slopes(x)[0])
        # The algebraic unknowns of a stage are extrapolated by the method, and lie off their equations by its error.
        x = self.refined(x, Refinement.ONCE)
        slopes, evaluation = self._slopes(x)
        # Where index reduction has differentiated the equations of these unknowns, their rates are quantities already.
        if plan.carried_rates is not None:
            return self._array(slopes, self._values(evaluation, plan.carried_rates))
        return self._array(slopes, self._carried_rates(x, slopes))

    @traced_once
    def semi_explicit(self, x: Array) -> Array:
        """dx/dt of the states, then the residuals of nonlinear blocks, at the state as it is: shape (n_state,)."""
        slopes = self._array(self._slopes(x)[0])
        return jnp.concatenate([slopes, self.carried_vector(self.t, x)]) if len(self.plan.carried) else slopes

    def _slopes(self, x: Array) -> tuple[Chunk, Evaluation]:
        """dx/dt of the differential states, and all that was computed on the way."""
        plan = self.plan
        evaluation = self.run(plan.derivative, x, Refinement.NONE)
        slopes = self._values(evaluation, plan.next_derivative)
        for row in plan.rows:
            slopes = self._corrected(slopes, row, evaluation)
        return slopes, evaluation

    def _corrected(self, slopes: Chunk, row: PlannedRow, evaluation: Evaluation) -> Chunk:
        """The slopes with what a network adds to them."""
        read = iter(row.inputs)
        u = [
            self.t if k in row.opaque.time_positions else jnp.asarray(evaluation.read(next(read)), self.dtype)
            for k in range(row.opaque.n_inputs)
        ]
        out = row.opaque(self.networks[row.opaque.index], self.t, jnp.stack(u))
        added = out[: len(row.rows)] / jnp.asarray(row.factor, self.dtype)
        if isinstance(slopes, tuple):
            more = dict(zip(row.rows, entries(added), strict=True))
            return tuple(slope + more[k] if k in more else slope for k, slope in enumerate(slopes))
        place = np.full(len(self.plan.states), -1)  # nothing is added to other slopes: the last entry, zero
        place[list(row.rows)] = np.arange(len(row.rows))
        return slopes + jnp.append(added, 0.0)[place]

    def _carried_rates(self, x: Array, slopes: Chunk) -> Chunk:
        """dz/dt = −(∂g/∂z)⁻¹ (∂g/∂t + ∂g/∂x dx/dt) for the tearing variables z of nonlinear blocks."""
        plan = self.plan
        n, m = len(plan.states), len(plan.carried)

        def along(rates: Chunk) -> Array:
            each = rates if isinstance(rates, tuple) else entries(rates)
            moved = (*slopes, *each) if isinstance(slopes, tuple) else self._array(slopes, rates)
            return jax.jvp(self.carried_vector, (self.t, self._chunk(x)), (jnp.ones_like(self.t), moved))[1]

        if plan.carried_pattern is None:
            # Affine in the rates, so that one Newton step from zero solves it.
            _, rates = newton_step(lambda rates: entries(along(tuple(rates))), [jnp.zeros((), self.dtype)] * m)
            return tuple(rates)
        matrix = sparse_jacobian(lambda z: self.carried_vector(self.t, jnp.append(x[:n], z)), plan.carried_pattern)(
            x[n:]
        )
        rest = along(jnp.zeros(m, self.dtype))
        return -solve_whole(plan.carried_pattern, matrix, rest, solver=plan.linear_solver)

    @traced_once
    def carried_vector(self, t: Array, x: Array) -> Array:
        """The residuals of nonlinear blocks at the tearing variables in the state, shape (carried,)."""
        return self._joined(self.run(self.plan.carried_residuals, x, Refinement.NONE, t=t).residuals)

    @traced_once
    def block_determinants(self, x: Array) -> Array:
        """det ∂g/∂z of every nonlinear block that is written out, shape (blocks,)."""
        plan = self.plan
        n, m = len(plan.states), len(plan.carried)
        y = jnp.asarray(x)

        def of_z(z):
            return self.carried_vector(self.t, jnp.concatenate([y[:n], z]))

        found = []
        if plan.carried_pattern is None:
            jacobian = jax.jacfwd(of_z)(y[n:])
            found = [jacobian[b.rows[:, :, None], b.columns[:, None, :]] for b in plan.written_blocks]
        else:
            pattern = plan.carried_pattern
            entries = jnp.append(sparse_jacobian(of_z, pattern)(y[n:]), 0.0)
            place = sp.csr_array((np.arange(1, len(pattern) + 1), (pattern.rows, pattern.cols)), shape=(m, m))
            for b in plan.written_blocks:  # −1, the last entry, where there is none
                rows = np.broadcast_to(b.rows[:, :, None], (*b.rows.shape, b.columns.shape[1]))
                columns = np.broadcast_to(b.columns[:, None, :], rows.shape)
                found.append(entries[np.asarray(place[rows.ravel(), columns.ravel()]).reshape(rows.shape) - 1])
        return jnp.concatenate([b[:, 0, 0] if b.shape[-1] == 1 else jnp.linalg.det(b) for b in found])

    @traced_once
    def dummy_determinants(self, x: Array) -> Array:
        """det ∂g/∂z of every block that determines dummy derivatives z, each equation g = 0 in units of its gradient
        with respect to all states, shape (blocks,). Zero where the choice of states is singular."""
        plan = self.plan
        n, m = len(plan.states), len(plan.carried)

        if m == 1 and plan.n_state <= SCALARS:  # on scalars, which XLA fuses: arrays take twice as long in batches

            def only(*x):
                return jnp.reshape(self.run(plan.carried_residuals, x, Refinement.NONE).residuals[0], ())

            slopes = jax.grad(only, tuple(range(n + 1)))(*self._chunk(x))
            gradient = [times(float(w), slope) for w, slope in zip(plan.nominal, slopes, strict=True)]
            size = jnp.sqrt(_sum([g * g for g in gradient], 0.0))
            return jnp.stack([gradient[-1] / jnp.where(size == 0, 1, size)])

        def g(x):
            return self.carried_vector(self.t, x)

        if plan.carried_pattern is not None and plan.dae_pattern is not None:
            inside = plan.dae_pattern.rows >= n
            rows, cols = (plan.dae_pattern.rows[inside] - n, plan.dae_pattern.cols[inside])
            pattern = SparsePattern(rows, cols, plan.n_state, n_rows=m)
            jacobian = pattern.dense(sparse_jacobian(g, pattern)(x))
        else:
            # Reverse mode takes a pass for each row, which costs more than a pass of forward mode for a column.
            jacobian = (jax.jacrev if 4 * m < n else jax.jacfwd)(g)(x)
        jacobian = jacobian * jnp.asarray(plan.nominal, self.dtype)
        size = jnp.sqrt(jnp.sum(jacobian**2, axis=1, keepdims=True))
        matrix = (jacobian / jnp.where(size == 0, 1, size))[:, n:]
        found = [matrix[b.rows[:, :, None], b.columns[:, None, :]] for b in plan.dummy_blocks]
        return jnp.concatenate([b[:, 0, 0] if b.shape[-1] == 1 else jnp.linalg.det(b) for b in found])

    def refined(self, x: Array, refine: Refinement) -> Array:
        """The state after Newton corrections of the tearing variables of nonlinear blocks, block by block;
        not-a-number where these blocks' equations do not hold then."""
        plan = self.plan
        evaluation = self.run(plan.carried_residuals, x, refine)
        gather = plan.carried_residuals.layout.gather(plan.carried)
        own = self._chunk(x)[: len(plan.states)]
        return self._array(own, self._values(evaluation, gather))

    # --- constraints -------------------------------------------------------------------------------------------

    def _constraints(self, x: Chunk) -> list[Array]:
        """The hidden constraints' residuals, one array for each template: scalars, or shape (instances,)."""
        evaluation = self.run(self.plan.constraint_program, x, Refinement.NONE)
        found = (evaluation.equation(planned) for planned in self.plan.constraints)
        return [at.filled(at.residual()) for at in found]

    @traced_once
    def constraint_vector(self, x: Array) -> Array:
        """All hidden constraints' residuals, shape (n_constraints,)."""
        return self._joined(self._constraints(x))

    def _joined(self, parts: Sequence[Array]) -> Array:
        return jnp.concatenate([jnp.reshape(v, (-1,)) for v in parts]) if parts else jnp.zeros((0,), self.dtype)

    # --- magnitudes --------------------------------------------------------------------------------------------

    # How large the terms are of which something is computed, where `sizes` are those of the state's entries, shape
    # (n_state,), |x| at least. Not differentiated.

    def _measured(self, program: Program, x: Array, sizes: Array) -> Measured:
        inputs = input_values(self.plan, self.inputs, self.t, self.dtype)
        networks = Networks(self.networks)
        return Measured(
            self._chunk(x),
            self._chunk(sizes),
            inputs,
            self._with_past(x, inputs, self.t),
            self.t,
            networks,
            self.typical,
        ).run(program, Refinement.NONE)

    @traced_once
    def constraint_magnitudes(self, x: Array, sizes: Array) -> Array:
        """The magnitudes of the hidden constraints' terms, shape (n_constraints,)."""
        evaluation = self._measured(self.plan.constraint_program, x, sizes)
        return self._joined([evaluation.terms_of(evaluation.equation(planned)) for planned in self.plan.constraints])

    @traced_once
    def carried_magnitudes(self, x: Array, sizes: Array) -> Array:
        """The magnitudes of the terms of nonlinear blocks, shape (carried,)."""
        return self._joined(self._measured(self.plan.carried_residuals, x, sizes).carried_magnitudes)

    def magnitudes(self, x: Array, sizes: Array, quantity: np.ndarray, factor: np.ndarray) -> Array:
        """The magnitudes of quantities with factors, shape (len(quantity),); infinite or not-a-number where it is not
        known."""
        program = self.plan.reading(quantity)
        found = self._measured(program, x, sizes).size(program.layout.gather(quantity, factor))
        return jnp.broadcast_to(jnp.asarray(found, self.dtype), (len(quantity),))

    def slope_magnitudes(self, x: Array, sizes: Array) -> Array:
        """The magnitudes of the states' slopes, shape (states,); infinite or not-a-number where it is not known."""
        plan = self.plan
        found = self._measured(plan.derivative, x, sizes).size(plan.next_derivative)
        return jnp.broadcast_to(jnp.asarray(found, self.dtype), (len(plan.states),))

    def held(self, x: Array) -> tuple[Array, Array]:
        """For the constraints that come and go with modes: (1.0 where one holds, 0.0 otherwise, shape (held,); all
        levels, shape (levels,), which are zero while it does)."""
        plan = self._held()
        active = self._filled(self.run(plan.active_program, x, Refinement.NONE), plan.active)
        return active, self._filled(self.run(plan.level_program, x, Refinement.ONCE), plan.level)

    def level_magnitudes(self, x: Array, sizes: Array) -> Array:
        """The magnitudes of the levels' terms, shape (levels,); infinite or not-a-number where it is not known."""
        plan = self._held()
        found = self._measured(plan.level_program, x, sizes).size(plan.level)
        return jnp.broadcast_to(jnp.asarray(found, self.dtype), (len(plan.level.chunk),))

    def held_forces(self, x: Array) -> Array:
        """The forces of the constraints that only push, shape (held,), zero for all others."""
        plan = self._held()
        return self._filled(self.run(plan.force_program, x, Refinement.ONCE), plan.force)

    def _held(self) -> HeldPlan:
        if self.plan.held is None:
            raise ModelError("no constraint of this system comes and goes with modes")
        return self.plan.held

    def projected_onto(self, x: Array) -> Array:
        """All residuals that states are projected onto: zero, whatever the state, where a mode does not ask for one."""
        residuals = self.constraint_vector(x)
        if self.plan.held is None:
            return residuals
        active, levels = self.held(x)
        holds = active[self.plan.held.table.owner] > 0
        return jnp.concatenate([residuals, jnp.where(holds, levels, 0.0)])

    @traced_once
    def project(self, x: Array, iterations: int) -> Array:
        """The state moved onto the hidden constraints, and onto those of the modes at hand, by Gauss–Newton steps of
        least (nominal-weighted) norm, and the tearing variables of nonlinear blocks refined."""
        plan = self.plan
        x = jnp.asarray(x)
        # Several steps of a large model stand in the program once.
        if plan.n_projected and iterations > 1 and is_large(self._least_norm_step, x):
            x, _ = jax.lax.scan(lambda x, _: (self._least_norm_step(x), None), x, length=iterations)
        else:
            for _ in range(iterations if plan.n_projected else 0):
                x = self._least_norm_step(x)
        if len(plan.carried):
            x = self.refined(x, Refinement.ONCE if iterations == 1 else Refinement.ROOT)
        return x

    @traced_once
    def _least_norm_step(self, x: Array) -> Array:
        plan = self.plan
        n = len(plan.states)
        if plan.n_state <= SCALARS and plan.n_constraints <= UNROLLED_POSITIVE and plan.held is None:
            return self._least_norm_of_few(self._chunk(x))
        nominal = jnp.asarray(plan.nominal[:n], self.dtype)
        # Rows by reverse mode: there are fewer constraints than states.
        value, pull = jax.vjp(self.projected_onto, x)
        jacobian = jax.vmap(lambda e: pull(e)[0])(np.eye(len(value), dtype=self.dtype))[:, :n] * nominal
        # Each constraint in units of its gradient: multiplied by 1e9 it is projected onto alike.
        size = jnp.max(jnp.abs(jax.lax.stop_gradient(jacobian)), axis=1, initial=0.0)
        absent = None
        if plan.held is not None:  # a row that asks for nothing is zero, and is left out
            active, _ = self.held(x)
            absent = jnp.append(jnp.zeros(plan.n_constraints, self.dtype), 1 - active[plan.held.table.owner])
            size = size + absent
        jacobian, value = jacobian / size[:, None], value / size
        gram = jacobian @ jacobian.T
        gram = gram if absent is None else gram + jnp.diag(absent)
        # LAPACK apart, for few: with a matrix that turns out to be constant, XLA does not find it (jaxlib 0.10.2).
        small = len(value) <= UNROLLED_POSITIVE
        multiplier = (
            jnp.stack(solve([[*row] for row in gram], [*value], positive=True))
            if small
            else jnp.linalg.solve(gram, value)
        )
        moved = x[:n] - nominal * (multiplier @ jacobian)
        return jnp.append(moved, x[n:]) if len(x) > n else moved

    def _least_norm_of_few(self, state: Chunk) -> Array:
        """As `_least_norm_step` on scalars, which XLA fuses: products of small matrices take a pendulum three times as
        long, alone and in batches."""
        plan = self.plan
        n = len(plan.states)
        nominal, rest = plan.nominal[:n], state[n:]

        def residuals(*x):
            found = self._constraints((*x, *rest))
            return [v[k] if jnp.ndim(v) else v for v in found for k in range(max(1, v.size))]

        value, pull = jax.vjp(residuals, *state[:n])
        one, zero, m = jnp.ones((), self.dtype), jnp.zeros((), self.dtype), len(value)
        rows = [pull([one if j == k else zero for j in range(m)]) for k in range(m)]
        # In units of the states, and each constraint beside the largest unit in it: squares of single precision
        # underflow at 1e-19. In a definite matrix other scales do not matter.
        pattern = plan.constraint_pattern or (frozenset(range(n)),) * m
        largest = [max((nominal[c] for c in inside), default=1.0) for inside in pattern]
        rows = [[times(nominal[c] / s, v) for c, v in enumerate(row)] for s, row in zip(largest, rows, strict=True)]
        gram = [
            [_sum([rows[a][c] * rows[b][c] for c in sorted(pattern[a] & pattern[b])], zero) for b in range(m)]
            for a in range(m)
        ]
        multiplier = solve(gram, [times(1 / s, v) for s, v in zip(largest, value, strict=True)], positive=True)
        moved = list(state)
        for c in range(n):
            terms = [rows[a][c] * multiplier[a] for a in range(m) if c in pattern[a]]
            moved[c] = moved[c] - times(nominal[c], _sum(terms, zero))
        return jnp.stack(moved)

    # --- events ------------------------------------------------------------------------------------------------

    @traced_once
    def guards(self, x: Array, refine: Refinement = Refinement.ONCE) -> Array:
        """The guards of all events of conditions, shape (guards,)."""
        events = self._events()
        evaluation = self.run(events.guards, x, refine)
        return self._filled(evaluation, events.guard)

    @traced_once
    def event_values(self, x: Array) -> Array:
        """The values that the actions of all events would write, shape (actions,)."""
        events = self._events()
        read = self._filled(self.run(events.values, x, Refinement.ROOT), events.value)
        return jnp.where(events.table.value < 0, jnp.asarray(events.table.constant, self.dtype), read)

    def clocks(self) -> tuple[Numbers, Numbers]:
        """Periods and offsets of sampled events, shape (clocks,) each; infinite periods of those that happen once."""
        clocks = [event.clock for event in self._events().table.events if event.clock is not None]
        periods, offsets = zip(*clocks, strict=True) if clocks else ((), ())
        return self._computed(periods), self._computed(offsets)

    def _computed(self, starts: Sequence[Start | None]) -> Numbers:
        """Expressions in parameters, those that are alike at once; infinity for None."""
        values: Numbers = np.full((len(starts),), np.inf, self.dtype)
        known = not is_traced((self.parameters, self.t))
        numbers, t = (np.asarray(self.parameters), np.asarray(self.t)) if known else (self.parameters, self.t)
        values = values if known else jnp.asarray(values)
        for group in formulas_of(starts):
            values = group.put(values, numbers, t)
        return values

    def waves(self, differentiated: bool = False) -> tuple[Array, Array]:
        """Angular frequencies and phases of what drives the model, shape (waves,) each; NaN for phases that move. Where
        parameters are known, waves on which nothing depends, as those of amplitude zero, have the frequency zero.
        Derivatives by the amplitude need steps that see the wave: where they are `differentiated` or traced, all
        waves count."""
        frequencies, phases = [], []
        known = not is_traced((self.parameters, self.t))
        xp: ModuleType = np if known else jnp
        numbers, t = (np.asarray(self.parameters), np.asarray(self.t)) if known else (self.parameters, self.t)
        for group in self.plan.waves:
            n, given = len(group), group.numbers(numbers)

            def values(template, n=n, given=given):
                found = template.residual([], *given, t, None, backend="numpy" if known else "jax")
                return xp.broadcast_to(xp.asarray(found, self.dtype), (n,))

            frequency = values(group.template)
            if group.weight is not None and not differentiated and not is_traced(self.parameters):
                frequency = xp.where(values(group.weight) == 0.0, 0.0, frequency)
            frequencies.append(frequency)
            phases.append(xp.full((n,), xp.nan, self.dtype) if group.phase is None else values(group.phase))
        return joined(frequencies), joined(phases)

    def _events(self) -> EventPlan:
        if self.plan.events is None:
            raise ModelError("this system has no events")
        return self.plan.events

    def _filled(self, evaluation: Evaluation, gather: Gather) -> Array:
        n = len(gather.chunk)
        if not n:
            return jnp.zeros((0,), self.dtype)
        return jnp.broadcast_to(jnp.asarray(evaluation.read(gather), self.dtype), (n,))

    # --- delays ------------------------------------------------------------------------------------------------

    @traced_once
    def delayed(self, x: Array) -> Array:
        """What is delayed, and the times at which the past is read, shape (2, delays)."""
        delays = self._delays()
        sources = self._filled(self.run(delays.sources, x, Refinement.ROOT), delays.source)
        return jnp.stack([sources, self._filled(self.run(delays.instants, x, Refinement.ROOT), delays.instant)])

    def past_read(self, x: Array) -> Array:
        """The discrete variables by which equations read the past, shape (delays, 5)."""
        inputs = input_values(self.plan, self.inputs, self.t, self.dtype)
        return self._with_past(x, inputs, self.t)[self._delays().parameters]

    def longest_delays(self) -> Numbers:
        """The longest delays, shape (delays,)."""
        return self._computed(self._delays().table.longest)

    def _delays(self) -> DelayPlan:
        if self.plan.delays is None:
            raise ModelError("nothing is delayed in this system")
        return self.plan.delays

    # --- reading -----------------------------------------------------------------------------------------------

    def quantities(
        self, x: Array, quantity: np.ndarray, factor: np.ndarray, refine: Refinement = Refinement.ROOT
    ) -> Array:
        """The values of quantities with factors, shape (len(quantity),)."""
        program = self.plan.reading(quantity)
        return self._filled(self.run(program, x, refine), program.layout.gather(quantity, factor))


def _sum(terms: list[Array], zero: Array | float) -> Array | float:
    return functools.reduce(operator.add, terms) if terms else zero
