"""The compiled model."""

import dataclasses
import html
from collections.abc import Mapping, Sequence
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Time
from ...base.errors import ModelError
from ...base.tolerances import CONSISTENT
from ...compile.diagnosis.wording import counted, some
from ...compile.lowering.plan import SystemPlan
from ...compile.model.pickling import functions_by_name, named_functions
from ...compile.model.tables import complete
from ...compile.model.typical_sizes import typical_sizes
from ...host.cache import compiled
from ...host.platform import precisely
from ...host.staging import is_staged, is_traced, joined, on_device, picked
from ...solve.events.past import Remembered
from ...solve.linear.sparse import SparseMatrix, SparsePattern, sparse_jacobian
from .input_values import check_given
from .inputs import check_range, read_inputs
from .nonlinear import Refinement
from .parameters import Parameters
from .solver_choice import Stiffness
from .system_at import SystemAt
from .traced_once import TracedOnce
from .trained_numbers import at_free_numbers, free_numbers, is_trained, parameters_among


class AcausalSystem(eqx.Module):
    """A compiled model, an `equinox.Module` whose leaves are its parameters and the weights of its networks.

    - `parameters`: a flat array with names, `system.parameters["pend.m"]`.
    - `neural`: the networks by name, `system.neural["drag"]`.
    - `states`, `algebraics`, `variables`: names.
    - `typical_sizes`: the typical size of each quantity in the equations, a power of two. It is declared (`nominal`) or
        follows from starts and equations at the parameters' values; inside jit, grad and vmap, at the values outside.
        Searches begin at this scale, and it decides what counts as zero. Typical sizes are not differentiated.
    """

    parameters: Parameters
    neural: dict[str, Any]
    typical_sizes: Float[Array, " quantities"]
    plan: SystemPlan = eqx.field(static=True)
    stiffness: Stiffness | None = eqx.field(static=True)  # None where no solver is left to be chosen
    modes: Float[Array, "*batch relations"] | None = None  # hidden discrete variables, within a run
    once: TracedOnce | None = eqx.field(static=True, default=None)  # within a run
    past: Remembered | None = None  # within a run

    # --- names -------------------------------------------------------------------------------------------------

    @property
    def states(self) -> list[str]:
        """The names of the differential states, in the order of the state array."""
        return list(self.plan.state_names)

    @property
    def carried(self) -> list[str]:
        """The tearing variables of nonlinear blocks. They are algebraic unknowns and follow the states in the state
        array."""
        return [self.plan.quantity_name[q] for q in self.plan.carried]

    @property
    def variables(self) -> list[str]:
        """All variables of the model, eliminated ones included."""
        return self.plan.visible_variables

    @property
    def algebraics(self) -> list[str]:
        """The variables that are neither states nor aliases of states."""
        chosen = set(self.plan.states.tolist())
        inputs = set(self.plan.inputs.names)
        names = self.plan.variable_index
        return [n for n in self.variables if n not in inputs and self.plan.quantity_of(names[n])[0] not in chosen]

    @property
    def inputs(self) -> list[str]:
        """The names of the inputs."""
        return list(self.plan.inputs.names)

    @property
    def report(self):
        """The report of the compiler, to be printed."""
        # Imported where it is needed: reports, starts and exports read systems, and import this module themselves.
        from .report import SystemReport

        return SystemReport(self.plan, self.parameters.known)

    def __reduce__(self):
        return _unpickled, (
            self.parameters, functions_by_name(self.neural), self.typical_sizes, self.plan, self.stiffness, self.modes
        )  # fmt: skip

    def __repr__(self):
        plan = self.plan
        counts = [
            counted(len(self.states), "state") + f" ({some(self.states)})" * bool(self.states),
            counted(len(self.algebraics), "algebraic variable"),
            counted(len(self.parameters), "parameter"),
        ]
        if plan.inputs.names:
            counts.append(counted(len(plan.inputs.names), "input") + f" ({some(plan.inputs.names)})")
        if self.neural:
            counts.append(counted(len(self.neural), "network") + f" ({some(list(self.neural))})")
        name = f"'{plan.flat.name}': " * bool(plan.flat.name)
        batch = self.parameters.batch
        return f"AcausalSystem({name}{', '.join(counts)}{f', a batch of shape {batch}' if batch else ''})"

    def _repr_html_(self) -> str:
        """The system for a notebook: its counts, and sections that fold."""
        sections = [
            ("states", [", ".join([*self.states, *self.carried])]),
            ("parameters", [self.parameters._repr_html_()]),
            ("report", [self.report._repr_html_()]),
        ]
        folded = "".join(f"<details><summary>{title}</summary>{''.join(body)}</details>" for title, body in sections)
        return f"<p><code>{html.escape(repr(self))}</code></p>{folded}"

    @property
    def without_stiffness(self) -> "AcausalSystem":
        """The same for programs that choose no solver, which models share though one is stiffer than the other."""
        return self if self.stiffness is None else dataclasses.replace(self, stiffness=None)

    # --- changing ----------------------------------------------------------------------------------------------

    def with_parameters(self, values: Mapping[str, Any]) -> "AcausalSystem":
        """A system with new parameter values (numbers or tracers); nothing is compiled again.

        **Raises:**

        - `ModelError` for unknown names, and for values that are not finite or out of bounds. Inside jit, grad and
            vmap, where values are unknown, such values become not-a-number, and all results with them: see `simulate`.
        """
        return self._at(self.parameters.replaced(values))

    def _at(self, parameters: Parameters) -> "AcausalSystem":
        """The system with these parameters, and the typical sizes that follow from them."""
        system, sizes = eqx.tree_at(lambda s: s.parameters, self, parameters), self._sizes_at(parameters)
        # Of one that holds some leaves only, as `partition` makes it, sizes may be None, which `tree_at` does not take.
        return system if sizes is self.typical_sizes else eqx.tree_at(lambda s: s.typical_sizes, system, sizes)

    def _sizes_at(self, parameters: Parameters) -> Float[Array, "*batch quantities"]:
        """Typical sizes at other parameter values; the present ones where these are not known, or a batch."""
        known, plan = parameters.known, self.plan
        if known is None or is_traced(self.typical_sizes):
            return self.typical_sizes
        sizes = typical_sizes(plan.model, plan.flat.parameters.everything(known))
        if np.array_equal(sizes, self.typical_sizes):  # nearby values have the same
            return self.typical_sizes
        with jax.ensure_compile_time_eval():
            return jnp.asarray(sizes, self.typical_sizes.dtype)

    def unconstrain(self, *names: str) -> dict[str, Any]:
        """Parameters as free numbers z, for optimizers that know no bounds:

            z = log(x − low),  z = −log(high − x),  z = log((x − low)/(high − x)),  z = x

        for a lower, an upper, two and no bounds. `constrain` turns them back. The numbers are a pytree for Optax:

            free = system.unconstrain("pend.m", "drag")
            loss = lambda free: jnp.sum(simulate(system.constrain(free), 1.0, ts=ts)["pend.x"] ** 2)

        **Arguments:**

        - `names`: names of parameters, of arrays of parameters, and of networks. Weights of networks are not
            transformed.

        **Returns:**

        The free numbers by name, in the shapes of the parameters; for a network, its inexact arrays.

        **Raises:**

        - `ModelError` for a name that is neither, for a parameter that is computed from others, and for a value on a
            bound, which has no finite z (inside jit, z is then infinite).
        """
        return free_numbers(self.parameters, self.neural, names)

    def constrain(self, free: Mapping[str, Any]) -> "AcausalSystem":
        """The system with the parameters that belong to the free numbers of `unconstrain`. Every free number, traced or
        not, belongs to a value inside the bounds. All other parameters keep their values.

        **Raises:**

        - `ModelError` for a name that is neither a parameter nor a network, and for wrong shapes.
        """
        values, networks = at_free_numbers(self.parameters, self.neural, free)
        system = self.with_parameters(values)
        return eqx.tree_at(lambda s: s.neural, system, self.neural | networks) if networks else system

    def partition(self, *names: str) -> tuple["AcausalSystem", "AcausalSystem"]:
        """Separates the trained numbers: returns `(trainable, frozen)`, which `equinox.combine` joins again.

        `names` are networks (`"drag"`) and parameters (`"pend.m"`). Parameters are not transformed: a parameter that a
        step moves out of its bounds becomes not-a-number. `unconstrain` gives numbers without bounds.

        **Raises:**

        - `ModelError` for a name that is neither.
        """
        chosen = parameters_among(self.parameters, self.neural, names)
        system = eqx.tree_at(lambda s: s.parameters, self, self.parameters.freed(chosen))
        return eqx.partition(system, is_trained(system, bool(chosen), {n for n in names if n in self.neural}))

    def merged(self) -> "AcausalSystem":
        """This system with trainable and frozen parts joined again."""
        return eqx.tree_at(lambda s: s.parameters, self, self.parameters.merged())

    def settled(self) -> "AcausalSystem":
        """`merged`, with dependent parameters evaluated to numbers, for a program that sets no parameters."""
        return eqx.tree_at(lambda s: s.parameters, self, self.parameters.settled())

    # --- computing ---------------------------------------------------------------------------------------------

    def traced_once(self) -> "AcausalSystem":
        """This system with its field, guards and projection as functions of their own in the program traced now."""
        return dataclasses.replace(self, once=TracedOnce())

    def at(self, t: Time, args: Any = None) -> SystemAt:
        """The system at a time, with these inputs, ready to be evaluated at states."""
        args = read_inputs(self.plan, self.parameters.values.dtype, args)
        check_given(self.plan, args)
        networks = tuple(self.neural[n] for n in self.plan.network_names)
        return SystemAt(self.plan, self.numbers, networks, t, args, self.typical_sizes, self.past, self.once)

    @property
    def numbers(self) -> Float[Array, " m"]:
        """The numbers that equations read, shape (m,): declared parameters, hidden discrete variables, and the values
        of all discrete variables before an event."""
        array = self.parameters.array
        events = self.plan.events
        if events is None or not len(events.discrete):
            # Without events, hidden discrete variables stay as they start.
            table = self.plan.flat.parameters
            if not table.n_relations:
                return array
            starts = np.asarray(table.relation_starts, array.dtype)
            hidden = np.broadcast_to(starts, (*array.shape[:-1], len(starts)))
            shown = picked(array, (..., table.discrete[: len(table.discrete) - table.n_relations]))
            return joined([array, hidden, shown, hidden])
        values = self.discrete_values
        return joined([array, picked(values, (..., slice(events.n_declared, None))), values])

    def holding(self, values: Any) -> "AcausalSystem":
        """The system with these values of its discrete variables, followed by the hidden ones."""
        events = self.plan.events
        if events is None or not len(events.discrete):
            return self
        n, chosen = events.n_declared, events.discrete[: events.n_declared]
        array = self.parameters.array
        if n:
            array = complete(events.dependents, array.at[chosen].set(values[:n]))
        # A start that is an expression holds at the start alone.
        parameters = Parameters(array, None, (), self.parameters.table.given(chosen))
        return AcausalSystem(
            parameters, self.neural, self.typical_sizes, self.plan, None, values[n:], self.once, self.past
        )

    def around_event(self, t: Time, values: Any, previous: Any, args: Any = None) -> SystemAt:
        """`at`, with these values of the discrete variables and other values before the present event."""
        held = self.holding(values)
        point = held.at(t, args)
        numbers = point.parameters.at[-len(previous) :].set(previous) if len(previous) else point.parameters
        return SystemAt(self.plan, numbers, point.networks, t, point.inputs, self.typical_sizes, self.past, self.once)

    @property
    def discrete_values(self) -> Float[Array, " q"]:
        """The values of the discrete variables at the start, and of the hidden ones."""
        events = self.plan.events
        if events is None:
            return jnp.zeros((0,))
        array = self.parameters.array
        declared = picked(array, (..., events.discrete[: events.n_declared]))
        starts = np.asarray(self.plan.flat.parameters.starts_of(events.discrete[events.n_declared :]), array.dtype)
        hidden = np.broadcast_to(starts, (*declared.shape[:-1], len(starts)))
        return joined([declared, hidden if self.modes is None else self.modes])

    @property
    def discretes(self) -> list[str]:
        """The names of the discrete variables."""
        return self.every_discrete[: 0 if self.plan.events is None else self.plan.events.n_visible]

    @property
    def every_discrete(self) -> list[str]:
        """The names of the declared discrete variables, followed by those that the package has added to a component,
        such as what a variable of a Modelica model was in the iteration before."""
        events = self.plan.events
        return [] if events is None else [self.parameters.names[p] for p in events.discrete[: events.n_declared]]

    def vector_field(self, t: Time, x: Float[Array, " n"], args: Any = None) -> Float[Array, " n"]:
        """d(state)/dt for `diffrax.ODETerm(system.vector_field)`; `args` is the dictionary of inputs, or None."""
        return self.at(t, args).vector_field(x)

    def semi_explicit(self, t: Time, x: Float[Array, " n"], args: Any = None) -> Float[Array, " n"]:
        """The right-hand side of M d(state)/dt = F(t, state): slopes of the differential states, then the residuals of
        nonlinear blocks, whose rows of `mass` are zero."""
        return self.at(t, args).semi_explicit(x)

    @property
    def mass(self) -> np.ndarray:
        """The diagonal of M in M d(state)/dt = `semi_explicit`: one for states, zero for algebraic unknowns."""
        return np.concatenate([np.ones(len(self.plan.states)), np.zeros(len(self.plan.carried))])

    @property
    def jacobian_pattern(self) -> SparsePattern | None:
        """The sparsity pattern of the Jacobian of the vector field: `.rows` and `.cols`, sorted by row. None if the
        Jacobian is large and dense."""
        return self.plan.jacobian_pattern

    def jacobian(self, t: Time, x: Float[Array, " n"], args: Any = None) -> SparseMatrix:
        """∂(vector field)/∂(state) at a consistent state, sparse: `.values` at the places of `.pattern`, `.dense()`,
        `.solve(b)`, `matrix @ vector`.

        It takes as many directional derivatives as the pattern has colours: three for a chain, however long.

        **Raises:**

        - `ModelError` if it is large and dense.
        """
        pattern = self.jacobian_pattern
        if pattern is None:
            raise ModelError(
                f"the Jacobian of these {self.plan.n_state} states is dense and too large to list its entries: use "
                "jax.jvp(system.vector_field, …) for its products with vectors"
            )
        point = self.at(t, args)
        if len(self.plan.carried):
            # The unknowns of nonlinear blocks are refined, and entries stay derivatives by the state that was given.
            x = jax.lax.stop_gradient(point.refined(x, Refinement.ROOT)) + (x - jax.lax.stop_gradient(x))
        return SparseMatrix(sparse_jacobian(point.vector_field, pattern)(x), pattern)

    def project(self, t: Time, x: Float[Array, " n"], args: Any = None, iterations: int = 1) -> Float[Array, " n"]:
        """Projects the state onto the hidden constraints, if there are any."""
        return self.at(t, args).project(x, iterations)

    def project_fully(self, t: Time, x: Float[Array, " n"], args: Any, iterations: int) -> Float[Array, " n"]:
        """As `project`, but not-a-number if the hidden constraints do not hold afterwards. A short last step shows that
        the search converged."""
        if not self.plan.n_projected:
            return self.project(t, x, args, iterations)
        near = self.project(t, x, args, iterations - 1)
        # Judged by the last step rather than by residuals: these have units, and the length of a step is that of the
        # states.
        found = self.project(t, near, args)
        short = jnp.abs(found - near) <= CONSISTENT * (jnp.abs(found) + self.state_sizes)
        return jnp.where(jax.lax.stop_gradient(jnp.all(short)), found, jnp.nan)

    @property
    def state_sizes(self) -> Any:
        """The typical sizes of the entries of the state, shape (n_state,); not differentiated."""
        places, sizes = np.concatenate([self.plan.states, self.plan.carried]), self.typical_sizes
        return jax.lax.stop_gradient(sizes[places]) if is_traced(sizes) else np.asarray(sizes)[places]

    def dummy_determinants(self, t: Time, x: Float[Array, " n"], args: Any = None) -> Float[Array, " blocks"]:
        """The determinants that vanish where the choice of states is singular: one for each nonlinear block that
        determines variables outside the minimal set. They are not differentiated."""
        here, x = self._still_at(t, x, args)
        return jax.lax.stop_gradient(here.dummy_determinants(x))

    def block_determinants(self, t: Time, x: Float[Array, " n"], args: Any = None) -> Float[Array, " blocks"]:
        """The determinants of all nonlinear blocks that are solved by written-out elimination. They are not
        differentiated."""
        here, x = self._still_at(t, x, args)
        return jax.lax.stop_gradient(here.block_determinants(x))

    def _still_at(self, t: Time, x: Float[Array, " n"], args: Any) -> tuple[SystemAt, Float[Array, " n"]]:
        """The system at a time, and the state, not differentiated."""
        frozen, t, x, args = jax.tree.map(
            lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, (self, t, x, args)
        )
        return frozen.at(t, args), x

    @property
    def is_constrained(self) -> bool:
        """True if a state must satisfy hidden constraints, or carries unknowns of nonlinear blocks."""
        return bool(self.plan.n_projected or len(self.plan.carried))

    def constraint_residual(self, t: Time, x: Float[Array, " n"], args: Any = None) -> Float[Array, " m"]:
        """The residuals of all hidden constraints at a state."""
        point = self.at(t, args)
        parts = [point.constraint_vector(x)]
        if len(self.plan.carried):
            parts.append(point.carried_vector(point.t, x))
        return jnp.concatenate(parts)

    def observe(self, names: str | Sequence[str], t: Time, x: Float[Array, " n"], args: Any = None) -> Any:
        """The values of variables at a state: a scalar for one name, shape `(len(names),)` for several names, and the
        array's shape for the name of an array such as `"cell.v"`. Among several names, the name of an array stands for
        all of its entries.

        **Raises:**

        - `ModelError` for an unknown name.
        """
        single = isinstance(names, str)
        entries = self.plan.entries(names) if isinstance(names, str) else None
        if entries is not None:
            return self.observe(entries[0], t, x, args).reshape(entries[1])
        quantity, factor = self.plan.resolve([names] if single else self.plan.entry_names(names))
        args = read_inputs(self.plan, self.parameters.values.dtype, args)
        check_range(args, t, t)
        if is_staged((self, t, x, args)):
            values = self.at(t, args).quantities(x, quantity, factor)
            return values[0] if single else values
        # Padded to a power of two, so that reading three variables and reading four are one program.
        n, dtype = 1 << (len(quantity) - 1).bit_length(), self.parameters.values.dtype
        padded = on_device(np.resize(quantity, n)), on_device(np.resize(factor, n), dtype)
        values = _observed(dataclasses.replace(self, stiffness=None), on_device(t, dtype), on_device(x), args, *padded)
        return picked(values, 0 if single else slice(len(quantity)))

    @overload
    def initialize(
        self,
        t0: Time = 0.0,
        inputs: Mapping[str, Any] | None = None,
        initial: Mapping[str, Any] | None = None,
        *,
        solver: Any = None,
        throw: bool | None = None,
    ) -> Array: ...

    @overload
    def initialize(
        self,
        t0: Time = 0.0,
        inputs: Mapping[str, Any] | None = None,
        initial: Mapping[str, Any] | None = None,
        *,
        solve_for: Sequence[str],
        solver: Any = None,
        throw: bool | None = None,
    ) -> tuple[Array, "AcausalSystem"]: ...

    def initialize(
        self,
        t0: Time = 0.0,
        inputs: Mapping[str, Any] | None = None,
        initial: Mapping[str, Any] | None = None,
        *,
        solve_for: Sequence[str] | None = None,
        solver: Any = None,
        throw: bool | None = None,
    ) -> Any:
        """A consistent state at `t0`: all equations, hidden ones included, and the fixed starts hold.

        **Arguments:**

        - `t0`: the initial time.
        - `inputs`: as in `simulate`.
        - `initial`: values of variables at `t0`. They replace the starts declared in components. `"der(m.v)"` is the
            derivative of a variable that the model differentiates.
        - `solve_for`: parameters that are unknown. For each of them, one more value must be given in `initial` or fixed
            in components. The search starts at their present values. To find the rest length for which a mass is in
            equilibrium at 0.3 m: `initial={"m.x": 0.3, "m.v": 0.0, "der(m.v)": 0.0}, solve_for=["spring.length"]`.
        - `solver`: an Optimistix root finder or least-squares solver, such as `optimistix.LevenbergMarquardt(rtol=1e-8,
            atol=1e-8)`, in place of the sequence of built-in methods. Unknowns and equations are scaled by their sizes.
        - `throw`: whether to raise an error if there is no such state. With False, the state and its derivatives are
            then not-a-number. None: raise outside jit, grad and vmap only. Inside jit, True needs callbacks to the
            host, and JAX's persistent cache does not keep such programs.

        **Returns:**

        The state, shape `(len(states) + len(carried),)`: differentiable with respect to parameters and given values.
        With `solve_for`, the state and a system with the parameters found; continue with that system and the same
        `initial`, as in `simulate(found, t1, initial=...)`.

        **Raises:**

        - `InitializationError` if fixed starts contradict the equations, if no consistent point was found, if a block
            of equations is singular there, if too few or too many values are given for `solve_for`, or if a parameter
            found is out of its bounds. Inside jit, with `throw=True`, errors that depend on values are Equinox run-time
            errors.
        """
        from ..start.check import check
        from ..start.given_solver import check_solver
        from ..start.initialize import find_initial

        names = self._names_to_solve_for(solve_for)
        if solver is not None:
            check_solver(solver)
        inputs = read_inputs(self.plan, self.parameters.values.dtype, inputs)
        check_range(inputs, t0, t0)
        initial = self.plan.one_by_one(initial)
        found = find_initial(self, t0, inputs, initial, names, solver)
        found = check(self, found, t0, inputs, initial, names, throw=throw, stacklevel=3)
        if solve_for is None:
            return found.x
        table = self.parameters.table
        index = np.array([table.index(n) for n in names], np.int64)
        low, high = (jnp.asarray(b, found.x.dtype) for b in table.bounds[index].reshape(-1, 2).T)
        # Rounding must not leave the bounds, nor the clip the gradient.
        solved = found.solved + jax.lax.stop_gradient(jnp.clip(found.solved, low, high) - found.solved)
        values = table.complete(self.parameters.array.at[index].set(solved))
        return found.x, self._at(Parameters(values, None, (), table))

    def initialization_report(
        self,
        t0: Time = 0.0,
        inputs: Mapping[str, Any] | None = None,
        initial: Mapping[str, Any] | None = None,
        *,
        solve_for: Sequence[str] = (),
    ):
        """A printable report of `initialize` with the same arguments: the starts that hold, the guesses and how far
        each moved, starts that are redundant or contradict each other, conditions that do not hold, and the method that
        succeeded.

        **Raises:**

        - `ModelError` inside jit, where there are no numbers to report.
        """
        from ..start.initialize import find_initial
        from ..start.report import InitializationReport

        names = self._names_to_solve_for(solve_for)
        initial = self.plan.one_by_one(initial)
        found = find_initial(self, t0, inputs, initial, names)
        if is_traced((found, self, t0)):
            raise ModelError("initialization_report needs numbers: call it outside jit, grad and vmap")
        return InitializationReport(self, found, t0, inputs, initial, names)

    def export_fmu(
        self,
        path: Any,
        *,
        outputs: Sequence[str] | None = None,
        parameters: Sequence[str] | str = "all",
        fmi: int = 3,
        arrays: bool = False,
        dae: bool = False,
        kinds: Sequence[str] | None = None,
        platforms: Sequence[str] | str | None = None,
        stop_time: float = 1.0,
        tolerance: float = 1e-6,
        overwrite: bool = False,
    ) -> Any:
        """Writes this system as a Functional Mock-up Unit, which other tools run without Python: see
        `jaxonomy_dae.fmi.export_fmu`, which has the same arguments."""
        from ...fmi.export import export_fmu

        return export_fmu(
            self, path, outputs=outputs, parameters=parameters, fmi=fmi, arrays=arrays, dae=dae, kinds=kinds,
            platforms=platforms, stop_time=stop_time, tolerance=tolerance, overwrite=overwrite,
        )  # fmt: skip

    def to_c(
        self,
        path: Any,
        *,
        outputs: Sequence[str] | None = None,
        functions: Sequence[str] | None = None,
        stop_time: float = 1.0,
        tolerance: float = 1e-6,
        overwrite: bool = False,
    ) -> Any:
        """Writes this system as C99 into a folder: see `jaxonomy_dae.fmi.write_c`, which has the same arguments."""
        from ...fmi.plain_c import write_c

        return write_c(
            self, path, outputs=outputs, functions=functions, stop_time=stop_time, tolerance=tolerance,
            overwrite=overwrite,
        )  # fmt: skip

    def to_casadi(self, *, outputs: Sequence[str] | None = None) -> Any:
        """This system as a `casadi.Function` of time, states, algebraic unknowns, discrete values, parameters and
        inputs: see `jaxonomy_dae.fmi.to_casadi`, which has the same argument."""
        from ...fmi.to_casadi import to_casadi

        return to_casadi(self, outputs=outputs)

    def _names_to_solve_for(self, solve_for: Sequence[str] | None) -> tuple[str, ...]:
        if isinstance(solve_for, str):
            raise ModelError(f"solve_for is a list of parameters' names; write solve_for=[{solve_for!r}]")
        names = tuple(dict.fromkeys(n for name in solve_for or () for n in self.parameters.table.one_by_one(name)))
        for name in names:
            if name not in self.parameters.names and name in self.plan.variable_index:
                raise ModelError(f"solve_for: '{name}' is a variable, which is found anyway: name parameters")
            self.parameters.table.settable(name)
        return names


@compiled
@precisely
def _observed(system: AcausalSystem, t: Time, x: Any, args: Any, quantity: Any, factor: Any) -> Any:
    """The values of quantities at a state. Their numbers are traced, so that one program serves all names."""
    every = np.arange(system.plan.extended.quantities.n)
    found = system.at(t, args).quantities(x, every, np.ones(len(every)))
    return jnp.where(quantity < 0, 0.0, factor * found[quantity])


def _unpickled(parameters: Parameters, neural: Any, *others: Any) -> AcausalSystem:
    return AcausalSystem(parameters, named_functions(neural), *others)
