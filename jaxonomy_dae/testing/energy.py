"""Whether energy is accounted for."""

import numpy as np

from ..compile.diagnosis.wording import some
from ..run.simulation.accounts import silent_components
from ..run.simulation.energy_balance import energy_balance
from ..run.simulation.solution import Solution
from .certificate import Certificate


def assert_energy_balance(solution: Solution, rtol: float = 1e-4) -> Certificate:
    """Asserts that the stored energy changes by the supplied and lost energy, as components declare them.

    **Arguments:**

    - `solution`: of a model whose components declare energies and powers; those of `jaxonomy_dae.library` do.
    - `rtol`: the largest allowed error at any saved time, relative to the largest energy that was stored, supplied or
        lost. The saved states have the error of their own run: allow a hundred times its tolerance.

    **Returns:**

    A `Certificate`.

    **Raises:**

    - `AssertionError` with the time at which the error is largest, the terms there, and the components that declare
        nothing.
    - `ModelError` as `Solution.energy_balance_error`.
    """
    # The second run is far more exact than any `rtol` that is asked for: what is left is the error of the accounts.
    found = energy_balance(solution, 1e-8, 1e-10)
    k = int(np.argmax(np.abs(found.error)))
    silent = list(silent_components(solution.system.plan))
    quiet = f"These components declare nothing: {some(silent)}." if silent else ""
    if not abs(float(found.error[k])) <= rtol:
        parts = ", ".join(
            f"{what} {float(value[k]):.6g} J"
            for what, value in (("stored", found.stored), ("supplied", found.supplied), ("lost", found.lost))
        )
        raise AssertionError(
            f"the account of energy is off by {float(found.error[k]):.3g} of {found.scale:.3g} J at "
            f"t={float(solution.ts[k]):.6g} (rtol={rtol:g}): {parts} since t={float(solution.ts[0]):.6g}."
            + (" " + quiet if quiet else "")
        )
    return Certificate(
        "what is stored changes by what is supplied and lost",
        f"the account of energy at {len(solution.ts)} saved times, relative to {found.scale:.3g} J",
        abs(float(found.error[k])),
        rtol,
        f"at t={float(solution.ts[k]):.6g}",
        (quiet,) if quiet else (),
    )
