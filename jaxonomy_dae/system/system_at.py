"""What a compiled system computes at a point: its vector field, constraints, projection and every variable.

All functions take the static plan, the flat parameters, the networks, time, the state array and input values. Small
systems are traced on scalars, which XLA fuses into a few kernels; large ones on arrays.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from ..errors import ModelError
from ..linear.dense import solve_dense
from ..linear.sparse import SparsePattern, sparse_jacobian
from ..linear.whole import solve_whole
from ..linear.written_out import UNROLLED, solve
from ..lowering.gather import SCALARS, Gather, entries, take, times
from ..lowering.plan import PlannedRow, SystemPlan
from ..lowering.plan_events import EventPlan
from ..lowering.plan_held import HeldPlan
from ..lowering.program import Program
from ..model.networks import Networks
from ..model.starts import Start
from ..programs.staging import is_traced, joined, on_device
from ..solvers.field_size import is_large
from .evaluate import Evaluation
from .input_values import input_values
from .measured import Measured
from .nonlinear import Refinement
from .roots import newton


class SystemAt:
    """A system at one time and state, ready to be evaluated."""

    def __init__(self, plan: SystemPlan, parameters: Any, networks: tuple, t: Any, inputs: Any, typical: Any):
        """`typical` are the sizes of all quantities, shape (quantities,)."""
        self.plan = plan
        self.typical = jax.lax.stop_gradient(typical)
        self.parameters = parameters
        self.dtype = parameters.dtype
        self.networks = networks
        self.inputs = inputs
        self.t = on_device(t, self.dtype)

    def split(self, x: Any) -> Any:
        """The state as a tuple of scalars, if it has up to `SCALARS` entries; else as an array."""
        x = jnp.asarray(x)
        if jnp.shape(x) != (self.plan.n_state,):
            raise ModelError(f"a state of this system has shape ({self.plan.n_state},); got {jnp.shape(x)}")
        return tuple(entries(x)) if self.plan.n_state <= SCALARS else x

    @staticmethod
    def join(x: Any) -> Any:
        """The state as an array."""
        if isinstance(x, tuple | list):
            return jnp.stack(x) if len(x) else jnp.zeros((0,))
        return x

    def run(self, program: Program, state: Any, refine: Refinement, t: Any = None) -> Evaluation:
        """Evaluates a program."""
        t = self.t if t is None else t
        inputs = input_values(self.plan, self.inputs, t, self.dtype)
        networks = Networks(self.networks)
        return Evaluation(state, inputs, self.parameters, t, networks, self.typical).run(program, refine)

    # --- vector field ------------------------------------------------------------------------------------------

    def vector_field(self, x: Any) -> Any:
        """d(state)/dt, shape (n_state,)."""
        plan = self.plan
        state = self.split(x)
        if len(plan.carried):
            state = self.refined(state, Refinement.ONCE)
        slopes, evaluation = self._slopes(state)
        if plan.carried_rates is not None:
            slopes = self._appended(slopes, evaluation, plan.carried_rates)
        elif len(plan.carried):
            slopes = self._with_carried(state, slopes)
        return self.join(slopes)

    def semi_explicit(self, x: Any) -> Any:
        """dx/dt of the states, then the residuals of nonlinear blocks, at the state as it is: shape (n_state,)."""
        state = self.split(x)
        slopes, _ = self._slopes(state)
        if not len(self.plan.carried):
            return self.join(slopes)
        residuals = self._carried(self.t, state)
        if isinstance(slopes, list) and all(jnp.ndim(r) == 0 for r in residuals):
            return self.join([*slopes, *residuals])
        return jnp.concatenate([self.join(slopes), *(jnp.reshape(r, (-1,)) for r in residuals)])

    def _slopes(self, state: Any) -> tuple[Any, Evaluation]:
        """dx/dt of the differential states, and all that was computed on the way."""
        plan = self.plan
        n = len(plan.states)
        evaluation = self.run(plan.derivative, state, Refinement.NONE)
        if isinstance(state, tuple):
            slopes: Any = [evaluation.read(_only(plan.next_derivative, k)) for k in range(n)]
            slopes = [jnp.asarray(s, self.dtype) for s in slopes]
        else:
            slopes = jnp.broadcast_to(evaluation.read(plan.next_derivative), (n,)).astype(self.dtype)
        for row in plan.rows:
            u = [jnp.asarray(evaluation.read(g), self.dtype) for g in row.inputs]
            slopes = self._corrected(slopes, row, u)
        return slopes, evaluation

    def _corrected(self, slopes: Any, row: PlannedRow, u: list[Any]) -> Any:
        entries = iter(u)
        full = [self.t if k in row.opaque.time_positions else next(entries) for k in range(row.opaque.n_inputs)]
        out = row.opaque(self.networks[row.opaque.index], self.t, jnp.stack(full))
        for k, (target, factor) in enumerate(zip(row.rows, row.factor, strict=True)):
            if isinstance(slopes, list):
                slopes[target] = slopes[target] + times(1 / factor, out[k])
            else:
                slopes = slopes.at[target].add(times(1 / factor, out[k]))
        return slopes

    def _with_carried(self, state: Any, slopes: Any) -> Any:
        """Appends dz/dt = −(∂g/∂z)⁻¹ (∂g/∂t + ∂g/∂x dx/dt) for the tearing variables z of nonlinear blocks."""
        plan = self.plan
        n, m = len(plan.states), len(plan.carried)

        if isinstance(state, tuple):
            x, z = list(state[:n]), list(state[n:])

            def along(rates: list[Any]) -> list[Any]:
                def g(t, x, z):  # blocks that are alike have one residual, an array
                    return [v for r in self._carried(t, (*x, *z)) for v in (r if jnp.ndim(r) else [r])]

                return jax.jvp(g, (self.t, x, z), (jnp.ones_like(self.t), slopes, rates))[1]

            rates = newton(along, [jnp.zeros_like(a) for a in z])
            return [*slopes, *rates]
        g = self.carried_vector
        value = jax.jvp(g, (self.t, state), (jnp.ones_like(self.t), jnp.append(slopes, jnp.zeros(m, self.dtype))))[1]

        def of_z(z):
            return g(self.t, jnp.concatenate([state[:n], z]))

        if plan.carried_pattern is not None:
            matrix = sparse_jacobian(of_z, plan.carried_pattern)(state[n:])
            rates = -solve_whole(plan.carried_pattern, matrix, value, solver=plan.linear_solver)
            return jnp.concatenate([slopes, rates])
        return jnp.concatenate([slopes, -solve_dense(jax.jacfwd(of_z)(state[n:]), value)])

    def _carried(self, t: Any, state: Any) -> list[Any]:
        """The residuals of nonlinear blocks at the tearing variables in the state."""
        return self.run(self.plan.carried_residuals, state, Refinement.NONE, t=t).residuals

    def carried_vector(self, t: Any, state: Any) -> Any:
        return self._joined(self._carried(t, state))

    def block_determinants(self, x: Any) -> Any:
        """det ∂g/∂z of every nonlinear block that is written out, shape (blocks,)."""
        plan = self.plan
        n, m = len(plan.states), len(plan.carried)
        y = self.join(self.split(x))

        def of_z(z):
            return self.carried_vector(self.t, self.split(jnp.concatenate([y[:n], z])))

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

    def dummy_determinants(self, x: Any) -> Any:
        """det ∂g/∂z of every block that determines dummy derivatives z, each equation g = 0 in units of its gradient
        with respect to all states, shape (blocks,). Zero where the choice of states is singular."""
        plan = self.plan
        n, m = len(plan.states), len(plan.carried)
        state = self.split(x)
        if isinstance(state, tuple) and m == 1:
            return jnp.stack([self._only_determinant(state)])

        def g(x):
            return self.carried_vector(self.t, self.split(x))

        if plan.carried_pattern is not None and plan.dae_pattern is not None:
            inside = plan.dae_pattern.rows >= n
            rows, cols = plan.dae_pattern.rows[inside] - n, plan.dae_pattern.cols[inside]
            pattern = SparsePattern(rows, cols, plan.n_state, n_rows=m)
            jacobian = pattern.dense(sparse_jacobian(g, pattern)(x))
        else:
            jacobian = (jax.jacrev if 4 * m < n else jax.jacfwd)(g)(x)
        jacobian = jacobian * jnp.asarray(plan.nominal, self.dtype)
        size = jnp.sqrt(jnp.sum(jacobian**2, axis=1, keepdims=True))
        matrix = (jacobian / jnp.where(size == 0, 1, size))[:, n:]
        found = [matrix[b.rows[:, :, None], b.columns[:, None, :]] for b in plan.dummy_blocks]
        return jnp.concatenate([b[:, 0, 0] if b.shape[-1] == 1 else jnp.linalg.det(b) for b in found])

    def _only_determinant(self, state: tuple) -> Any:
        """As `dummy_determinants` for a single equation, on scalars, which XLA fuses."""
        _, push = jax.linearize(lambda *x: self._carried(self.t, x)[0], *state)
        one, zero = jnp.ones((), self.dtype), jnp.zeros((), self.dtype)
        gradient = [
            float(w) * push(*(one if j == k else zero for j in range(len(state))))
            for k, w in enumerate(self.plan.nominal)
        ]
        size = jnp.sqrt(_sum([g * g for g in gradient], zero))
        return jnp.reshape(gradient[-1] / jnp.where(size == 0, 1, size), ())

    def refined(self, state: Any, refine: Refinement) -> Any:
        """The state after Newton corrections of the tearing variables of nonlinear blocks, block by block;
        not-a-number where these blocks' equations do not hold then."""
        plan = self.plan
        evaluation = self.run(plan.carried_residuals, state, refine)
        gather = plan.carried_residuals.layout.gather(plan.carried)
        return self._appended(state[: len(plan.states)], evaluation, gather)

    def _appended(self, first: Any, evaluation: Evaluation, gather: Gather) -> Any:
        """The values that were computed, appended to scalars (a list or a tuple) or to an array."""
        n = len(gather.chunk)
        if isinstance(first, list | tuple):
            return type(first)(
                [*first, *(jnp.asarray(evaluation.read(_only(gather, k)), self.dtype) for k in range(n))]
            )
        return jnp.concatenate([first, jnp.broadcast_to(jnp.asarray(evaluation.read(gather), self.dtype), (n,))])

    # --- constraints -------------------------------------------------------------------------------------------

    def constraints(self, state: Any) -> list[Any]:
        """The hidden constraints' residuals, one array for each template: scalars, or shape (instances,)."""
        evaluation = self.run(self.plan.constraint_program, state, Refinement.NONE)
        found = (evaluation.equation(planned) for planned in self.plan.constraints)
        return [at.filled(at.residual()) for at in found]

    def constraint_vector(self, state: Any) -> Any:
        """All hidden constraints' residuals, shape (n_constraints,)."""
        return self._joined(self.constraints(state))

    def _joined(self, parts: Sequence[Any]) -> Any:
        return jnp.concatenate([jnp.reshape(v, (-1,)) for v in parts]) if parts else jnp.zeros((0,), self.dtype)

    # --- magnitudes --------------------------------------------------------------------------------------------

    # How large the terms are of which something is computed, where `sizes` are those of the state's entries, shape
    # (n_state,), |x| at least. Not differentiated.

    def _measured(self, program: Program, x: Any, sizes: Any) -> Measured:
        inputs = input_values(self.plan, self.inputs, self.t, self.dtype)
        networks = Networks(self.networks)
        state, sizes = self.split(x), self.split(sizes)
        return Measured(state, sizes, inputs, self.parameters, self.t, networks, self.typical).run(
            program, Refinement.NONE
        )

    def constraint_magnitudes(self, x: Any, sizes: Any) -> Any:
        """The magnitudes of the hidden constraints' terms, shape (n_constraints,)."""
        evaluation = self._measured(self.plan.constraint_program, x, sizes)
        return self._joined([evaluation.terms_of(evaluation.equation(planned)) for planned in self.plan.constraints])

    def carried_magnitudes(self, x: Any, sizes: Any) -> Any:
        """The magnitudes of the terms of nonlinear blocks, shape (carried,)."""
        return self._joined(self._measured(self.plan.carried_residuals, x, sizes).carried_magnitudes)

    def magnitudes(self, x: Any, sizes: Any, quantity: np.ndarray, factor: np.ndarray) -> Any:
        """The magnitudes of quantities with factors, shape (len(quantity),); infinite or not-a-number where it is not
        known."""
        program = self.plan.reading(quantity)
        found = self._measured(program, x, sizes).size(program.layout.gather(quantity, factor))
        return jnp.broadcast_to(jnp.asarray(found, self.dtype), (len(quantity),))

    def slope_magnitudes(self, x: Any, sizes: Any) -> Any:
        """The magnitudes of the states' slopes, shape (states,); infinite or not-a-number where it is not known."""
        plan = self.plan
        found = self._measured(plan.derivative, x, sizes).size(plan.next_derivative)
        return jnp.broadcast_to(jnp.asarray(found, self.dtype), (len(plan.states),))

    def held(self, x: Any) -> tuple[Any, Any]:
        """For the constraints that come and go with modes: (1.0 where one holds, 0.0 otherwise, shape (held,); all
        levels, shape (levels,), which are zero while it does)."""
        plan = self._held()
        state = self.split(x)
        active = self._filled(self.run(plan.active_program, state, Refinement.NONE), plan.active)
        return active, self._filled(self.run(plan.level_program, state, Refinement.ONCE), plan.level)

    def held_forces(self, x: Any) -> Any:
        """The forces of the constraints that only push, shape (held,), zero for all others."""
        plan = self._held()
        return self._filled(self.run(plan.force_program, self.split(x), Refinement.ONCE), plan.force)

    def _held(self) -> HeldPlan:
        if self.plan.held is None:
            raise ModelError("no constraint of this system comes and goes with modes")
        return self.plan.held

    def projected_onto(self, x: Any) -> Any:
        """All residuals that states are projected onto: zero, whatever the state, where a mode does not ask for one."""
        residuals = self.constraint_vector(self.split(x))
        if self.plan.held is None:
            return residuals
        active, levels = self.held(x)
        holds = active[self.plan.held.table.owner] > 0
        return jnp.concatenate([residuals, jnp.where(holds, levels, 0.0)])

    def project(self, x: Any, iterations: int) -> Any:
        """The state moved onto the hidden constraints, and onto those of the modes at hand, by Gauss–Newton steps of
        least (nominal-weighted) norm, and the tearing variables of nonlinear blocks refined."""
        plan = self.plan
        state = self.split(x)
        if plan.n_projected and iterations > 1 and is_large(self._least_norm_step, state):
            state, _ = jax.lax.scan(lambda state, _: (self._least_norm_step(state), None), state, length=iterations)
        else:
            for _ in range(iterations if plan.n_projected else 0):
                state = self._least_norm_step(state)
        if len(plan.carried):
            state = self.refined(state, Refinement.ONCE if iterations == 1 else Refinement.ROOT)
        return self.join(state)

    def _least_norm_step(self, state: Any) -> Any:
        plan = self.plan
        n = len(plan.states)
        nominal = plan.nominal[:n]
        # In units of the states, and each constraint beside the largest unit in it: squares of single precision
        # underflow at 1e-19.
        if isinstance(state, tuple) and plan.n_constraints <= UNROLLED and plan.held is None:
            rest = state[n:]

            def h(*x):
                return [
                    v[k] if jnp.ndim(v) else v for v in self.constraints((*x, *rest)) for k in range(max(1, v.size))
                ]

            value, pull = jax.vjp(h, *state[:n])
            one, zero = jnp.ones((), self.dtype), jnp.zeros((), self.dtype)
            m = len(value)
            rows = [pull([one if j == k else zero for j in range(m)]) for k in range(m)]
            pattern = plan.constraint_pattern or (frozenset(range(n)),) * m
            largest = [max((nominal[c] for c in inside), default=1.0) for inside in pattern]
            unit = [[nominal[c] / size for c in range(n)] for size in largest]
            gram = [
                [_sum([times(unit[a][c] * unit[b][c], rows[a][c] * rows[b][c])
                       for c in sorted(pattern[a] & pattern[b])], zero)
                 for b in range(m)]
                for a in range(m)
            ]  # fmt: skip
            value = [times(1 / size, v) for size, v in zip(largest, value, strict=True)]
            multiplier = solve(gram, value, positive=True)  # of a definite matrix: scales do not matter
            moved = [
                s - _sum([times(nominal[c] * unit[a][c], rows[a][c] * multiplier[a])
                          for a in range(m) if c in pattern[a]], zero)
                for c, s in enumerate(state[:n])
            ]  # fmt: skip
            return (*moved, *rest)
        array = self.join(state)
        x, rest = array[:n], array[n:]

        def vector(x):
            return self.projected_onto(jnp.concatenate([x, rest]))

        value, pull = jax.vjp(vector, x)
        jacobian = jax.vmap(lambda e: pull(e)[0])(jnp.eye(value.shape[0], dtype=self.dtype))
        jacobian = jacobian * jnp.asarray(nominal, self.dtype)
        # Each constraint in units of its gradient: multiplied by 1e9 it is projected onto alike.
        size = jnp.max(jnp.abs(jax.lax.stop_gradient(jacobian)), axis=1, initial=0.0)
        absent: Any = None
        if plan.held is not None:  # a row that asks for nothing is zero, and is left out
            active, _ = self.held(array)
            absent = jnp.append(jnp.zeros(plan.n_constraints, self.dtype), 1 - active[plan.held.table.owner])
            size = size + absent
        unit = 1 / size
        jacobian, value = jacobian * unit[:, None], value * unit
        gram = jacobian @ jacobian.T
        multiplier = jnp.linalg.solve(gram if absent is None else gram + jnp.diag(absent), value)
        return self.split(jnp.concatenate([x - jnp.asarray(nominal, self.dtype) * (jacobian.T @ multiplier), rest]))

    # --- events ------------------------------------------------------------------------------------------------

    def guards(self, x: Any) -> Any:
        """The guards of all events of conditions, shape (guards,)."""
        events = self._events()
        evaluation = self.run(events.guards, self.split(x), Refinement.ONCE)
        return self._filled(evaluation, events.guard)

    def event_values(self, x: Any) -> Any:
        """The values that the actions of all events would write, shape (actions,)."""
        events = self._events()
        read = self._filled(self.run(events.values, self.split(x), Refinement.ROOT), events.value)
        return jnp.where(events.table.value < 0, jnp.asarray(events.table.constant, self.dtype), read)

    def clocks(self) -> tuple[Any, Any]:
        """Periods and offsets of sampled events, shape (clocks,) each; infinite periods of those that happen once."""
        clocks = [event.clock for event in self._events().table.events if event.clock is not None]
        periods, offsets = zip(*clocks, strict=True) if clocks else ((), ())
        return self._computed(periods), self._computed(offsets)

    def _computed(self, starts: Sequence[Start | None]) -> Any:
        """Expressions in parameters, those that are alike at once; infinity for None."""
        known = not is_traced((self.parameters, self.t))
        values: Any = np.full((len(starts),), np.inf, self.dtype)
        values = values if known else jnp.asarray(values)
        alike: dict[Any, list[int]] = {}
        for k, start in enumerate(starts):
            if start is not None:
                alike.setdefault(start.template, []).append(k)
        for template, places in alike.items():
            rows = np.array([starts[k].parameters for k in places], np.int64)  # pyright: ignore[reportOptionalMemberAccess]
            if known:
                numbers = [np.asarray(self.parameters)[column] for column in rows.T]
                values[places] = template.residual([], numbers, [], np.asarray(self.t), None, backend="numpy")
                continue
            numbers = [take(self.parameters, column) for column in rows.T]
            new = template.residual([], numbers, [], self.t, None)
            values = values.at[np.array(places)].set(jnp.broadcast_to(jnp.asarray(new, self.dtype), (len(places),)))
        return values

    def waves(self, differentiated: bool = False) -> tuple[Any, Any]:
        """Angular frequencies and phases of what drives the model, shape (waves,) each; NaN for phases that move. Where
        parameters are known, waves on which nothing depends, as those of amplitude zero, have the frequency zero.
        Derivatives by the amplitude need steps that see the wave: where they are `differentiated` or traced, all
        waves count."""
        frequencies, phases = [], []
        known = not is_traced((self.parameters, self.t))
        xp: Any = np if known else jnp
        numbers, t = (np.asarray(self.parameters), np.asarray(self.t)) if known else (self.parameters, self.t)
        for group in self.plan.waves:
            n = len(group.parameter)
            given = [numbers[column] for column in group.parameter.T], list(group.coefficient.T)

            def values(template, n=n, given=given):
                found = template.residual([], *given, t, None, backend="numpy" if known else "jax")
                return xp.broadcast_to(xp.asarray(found, self.dtype), (n,))

            frequency = values(group.frequency)
            if group.weight is not None and not differentiated and not is_traced(self.parameters):
                frequency = xp.where(values(group.weight) == 0.0, 0.0, frequency)
            frequencies.append(frequency)
            phases.append(xp.full((n,), xp.nan, self.dtype) if group.phase is None else values(group.phase))
        return joined(frequencies), joined(phases)

    def _events(self) -> EventPlan:
        if self.plan.events is None:
            raise ModelError("this system has no events")
        return self.plan.events

    def _filled(self, evaluation: Evaluation, gather: Gather) -> Any:
        n = len(gather.chunk)
        if not n:
            return jnp.zeros((0,), self.dtype)
        return jnp.broadcast_to(jnp.asarray(evaluation.read(gather), self.dtype), (n,))

    # --- reading -----------------------------------------------------------------------------------------------

    def quantities(self, x: Any, quantity: np.ndarray, factor: np.ndarray) -> Any:
        """The values of quantities with factors, shape (len(quantity),)."""
        program = self.plan.reading(quantity)
        return self._filled(self.run(program, self.split(x), Refinement.ROOT), program.layout.gather(quantity, factor))


def _sum(terms: list[Any], zero: Any) -> Any:
    total = None
    for term in terms:
        total = term if total is None else total + term
    return zero if total is None else total


def _only(gather, k: int):
    return type(gather)(gather.chunk[k : k + 1], gather.offset[k : k + 1], gather.factor[k : k + 1])
