"""`AcausalCompiler`: from a diagram to a system."""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from ...base.errors import ModelError, explained_keywords
from ...compile.lowering.lower import lower
from ...compile.model.typical_sizes import typical_sizes
from ...compile.passes.added_passes import ModelPass, run_passes
from ...compile.passes.check_units import check_units as check_units_of
from ...compile.passes.flatten import flatten
from ...compile.passes.pipeline import compile_flat
from ...solve.linear.choice import check_linear_solver
from ...write.diagram import AcausalDiagram
from ...write.environment import EqnEnv
from ...write.networks import as_weights
from .parameters import ParameterNames, Parameters
from .passes import Passes
from .report import SystemReport
from .solver_choice import Stiffness
from .system import AcausalSystem

Mode = Literal["auto", "dummy_derivatives", "projection"]


class AcausalCompiler:
    """Compiles a diagram: `system = AcausalCompiler(ev, diagram)()`.

    **Arguments:**

    - `ev`: the environment of the components.
    - `diagram`: the model.
    - `state_selection`: `"dummy_derivatives"` integrates a minimal set of states; `"projection"` integrates all
        candidates and projects onto the hidden constraints; `"auto"` takes dummy derivatives where the constraints'
        Jacobian is constant, projection elsewhere.
    - `prefer_states`: names of variables that should be states, the most important first.
    - `linear_solver`: a Lineax solver, such as `lineax.GMRES(rtol=1e-8, atol=1e-8)`, for large blocks of simultaneous
        equations. It receives a `SparseLinearOperator` with scaled rows and columns. Its residual is corrected by
        further solves until every equation holds to rounding; if that fails, the result is not-a-number. By default,
        LAPACK solves up to 48 equations, and KLU larger blocks.
    - `passes`: functions from a `FlatModel` to another one, run after flattening and before all other passes; see
        *Adding a pass* in the documentation of development.
    - `check_units`: whether declared units are compared, in equations, starts, events, accounts of energy and connected
        signals; needs the extra `units`.

    **Raises** (when called):

    - `ModelError`: the model is not well formed.
    - `UnitError`: units do not fit together.
    - `StructuralError`: equations and unknowns do not fit together.

    After the call, `compiler.report` describes the system, and `compiler.passes` lists the effect of each pass.
    """

    @explained_keywords()
    def __init__(
        self,
        ev: EqnEnv,
        diagram: AcausalDiagram,
        *,
        state_selection: Mode = "auto",
        prefer_states: Sequence[str] = (),
        linear_solver: lx.AbstractLinearSolver | None = None,
        passes: Sequence[ModelPass] = (),
        check_units: bool = False,
    ):
        if not isinstance(ev, EqnEnv) or not isinstance(diagram, AcausalDiagram):
            raise ModelError("AcausalCompiler(ev, diagram) needs an EqnEnv and an AcausalDiagram")
        for component in diagram.components.values():
            if component.ev is not ev:
                raise ModelError(
                    f"component '{component.name}' was made with another EqnEnv than the compiler was given: pass the "
                    "one that all components share"
                )
        if state_selection not in ("auto", "dummy_derivatives", "projection"):
            raise ModelError(f"state_selection is 'auto', 'dummy_derivatives' or 'projection'; got {state_selection!r}")
        if isinstance(prefer_states, str):
            raise ModelError(f"prefer_states is a list of names; write prefer_states=[{prefer_states!r}]")
        for k, name in enumerate(prefer_states):
            if not isinstance(name, str):
                raise ModelError(f"prefer_states is a list of variables' names; entry {k} is {name!r}")
        for k, each in enumerate(passes):
            if not callable(each):
                raise ModelError(f"passes is a list of functions of a FlatModel; entry {k} is {each!r}")
        if linear_solver is not None:
            check_linear_solver(linear_solver)
        self.ev = ev
        self.diagram = diagram
        self.state_selection = state_selection
        self.prefer_states = tuple(prefer_states)
        self.linear_solver = linear_solver
        self.check_units = check_units
        self._added = tuple(passes)
        self._report: SystemReport | None = None
        self._passes: Passes | None = None

    @property
    def report(self) -> SystemReport:
        """The report of the last call."""
        if self._report is None:
            raise ModelError("nothing has been compiled yet: call the compiler first")
        return self._report

    @property
    def passes(self) -> Passes:
        """The effect of each pass of the last call, in the names of the user: `print(compiler.passes)`."""
        if self._passes is None:
            raise ModelError("nothing has been compiled yet: call the compiler first")
        return self._passes

    def __call__(self) -> AcausalSystem:
        flat, added = run_passes(flatten(self.diagram), self._added)
        # After the user's passes and flattening: a model that is not well formed has an error of its own, which says
        # more.
        if self.check_units:
            check_units_of(self.diagram)
        model = compile_flat(flat, self.state_selection, self.prefer_states)
        plan = lower(model, self.linear_solver)
        table, declared = flat.parameters, flat.declares
        # The plan holds no values: it is a key of compiled programs, which serve all values.
        self._report, self._passes = SystemReport(plan, declared.values), Passes(plan, added)
        n = table.n_declared
        names = ParameterNames(
            table.names[:n], table.units[:n], table.bounds[:n], table.dependents, table.expressions, flat.arrays,
            plan.digest,
        )  # fmt: skip
        with jax.ensure_compile_time_eval():  # also where it is called while a function is traced
            values = jnp.asarray(declared.values[:n], dtype=jnp.result_type(float))
            sizes = jnp.asarray(typical_sizes(model.reduced, declared.values), dtype=values.dtype)
        parameters = Parameters(values, None, (), names)
        neural = {name: _own(network) for name, network in declared.networks.items()}
        return AcausalSystem(parameters, neural, sizes, plan, Stiffness(plan.model, declared.values))


def _own(network: Any) -> Any:
    """A network whose inexact leaves are JAX arrays."""
    return as_weights(network) if not isinstance(network, eqx.Module) else network
