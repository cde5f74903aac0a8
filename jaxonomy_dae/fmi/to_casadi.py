"""A compiled system as a function of CasADi."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.optional import optional_module
from ..run.system.system import AcausalSystem
from .content import Content
from .programs import check_exportable
from .symbols import Symbols


def to_casadi(system: AcausalSystem, *, outputs: Sequence[str] | None = None) -> Any:
    """The system as a `casadi.Function`, for optimal control by IPOPT, acados and others.

    Its arguments are `t`, the states `x`, the unknowns `z` of nonlinear blocks, discrete values `q`, parameters `p` and
    inputs `u`, as columns in the order of `system.states`, `.carried`, `.discretes`, of the model's parameters, and
    `.inputs`. Its results are `slopes`, dx/dt; `residuals`, which are zero where `z` fulfils the equations of these
    blocks; `outputs`; and `guards`. Linear blocks are solved inside. Networks keep the weights that they have.

    **Arguments:**

    - `outputs`: the variables among the results. None: all that are neither states, inputs nor discrete.

    **Returns:**

    The `casadi.Function`, made of scalar symbols (`SX`).

    **Raises:**

    - `MissingPackage` without CasADi.
    - `ModelError` for a name that does not exist, and a function that CasADi has no expression for, with its line:
        loops whose length depends on values are among them.
    """
    casadi = optional_module("casadi", "casadi", "functions of CasADi need CasADi")
    check_exportable(system)
    system = system.merged().without_stiffness
    content = Content(system, outputs, ("unsolved",))
    programs = content.programs
    counts = {name: content.layout.places[name][1] for name in ("x", "z", "q", "p", "u")}
    given = {"t": casadi.SX.sym("t")} | {name: casadi.SX.sym(name, n) for name, n in counts.items()}
    interpreter = Symbols(casadi)
    columns = [_entries(symbol, () if name == "t" else (counts[name],)) for name, symbol in given.items()]
    found = interpreter.closed(programs.traced["unsolved"], [*columns, *(w.value for w in programs.weights)])
    results = [casadi.vertcat(*map(casadi.SX, np.ravel(f))) if np.size(f) else casadi.SX(0, 1) for f in found]
    names = ["slopes", "residuals", "outputs", "guards"]
    return casadi.Function("plant", list(given.values()), results, list(given), names)


def _entries(column: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A column of symbols as an array of objects."""
    out = np.empty(shape, object)
    for k in range(out.size):
        out.reshape(-1)[k] = column[k]
    return out
