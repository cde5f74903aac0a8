"""Variables that are not states, under the error control of a run.

A variable y(t, x) may hang on a state by a large factor: the pressure of a stiff volume on the mass in it. Errors of
the state that its tolerance allows then show. Here |∂y/∂x|·|error of x| counts as an error of y beside rtol·|y| + atol.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, Solver, State, Time, Tolerance
from ...base.errors import ModelError
from ...host.staging import is_traced
from ...solve.adjoint.resting import still
from ...solve.methods import BDF
from ...solve.methods.drive import inner
from ...solve.methods.step_control import StepControl
from ..system.system import AcausalSystem


class Variables(eqx.Module):
    """Variables of the model that stand beside the states in the norm of errors.

    - `quantity`, `factor`: the variables, shape (m,) each; `atol`: their absolute tolerances, shape (m,).
    """

    system: AcausalSystem
    atol: Tolerance
    quantity: tuple[int, ...] = eqx.field(static=True)
    factor: tuple[float, ...] = eqx.field(static=True)

    def __call__(self, t0, t1, y0, y1, error, args):
        """The variables before and after a step, and their errors, not differentiated."""
        own, given, here, there, y0, y1, error = still((self, args, t0, t1, y0, y1, error))
        slopes = jax.jacrev(lambda x: own._read(there, x, given))(y1)
        # Without signs: error estimates of two states may have lost theirs, and must not cancel.
        return own._read(here, y0, given), own._read(there, y1, given), jnp.abs(slopes) @ jnp.abs(error)

    def _read(self, t: Time, x: State, args: Args) -> Array:
        return self.system.at(t, args).quantities(x, np.array(self.quantity), np.array(self.factor))


def with_variables(
    system: AcausalSystem, controller: StepControl, solver: Solver, names: Sequence[str], atol: Tolerance
) -> StepControl:
    """The controller, with the variables of these names under error control, too.

    **Raises:**

    - `ModelError` for a solver that chooses its own steps, and for models with events that write.
    """
    if isinstance(inner(solver), BDF):
        raise ModelError(
            "control= needs a solver whose steps follow from the errors of all states: use solver=Rodas5P(); BDF "
            "chooses its order and steps by errors of its own"
        )
    if system.plan.events is not None and len(system.plan.events.discrete):
        raise ModelError(
            "control= does not know the discrete variables and modes of this model: give a smaller rtol instead"
        )
    quantity, factor = system.plan.resolve(system.plan.entry_names(list(names)))
    read = quantity >= 0
    quantity, factor = quantity[read], factor[read]
    size = np.minimum(np.abs(factor) * _sizes(system)[quantity], 1.0)
    extra = atol * jnp.asarray(size, atol.dtype)
    beside = Variables(system, extra, tuple(quantity.tolist()), tuple(factor.tolist()))
    return dataclasses.replace(controller, beside=beside)


def _sizes(system: AcausalSystem) -> np.ndarray:
    """The typical sizes of all quantities, one where they are traced."""
    sizes = system.typical_sizes
    return np.ones(sizes.shape) if is_traced(sizes) else np.asarray(sizes)
