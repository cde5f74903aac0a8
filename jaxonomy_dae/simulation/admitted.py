"""Whether what a run is given can be computed with: finite numbers, parameters within their bounds.

Outside jit, errors name what is wrong. Inside, where values are not known, this is found while running: the run ends at
once, its rows are not-a-number, and its result is `NOT_ADMITTED`.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..aliases import Inputs, Time
from ..system.closed_function import ClosedFunction
from ..system.inputs import value_at
from ..system.system import AcausalSystem

NOT_ADMITTED: Any = diffrax.RESULTS.nonfinite
TEXT = "a parameter, a weight or an input is not finite, or a parameter is out of its bounds"
# Times at which inputs are looked at, relative to what is left of a run: what made it stop lies just ahead, on a scale
# that only the run knows.
AHEAD = np.concatenate([[0.0], 10.0 ** np.linspace(-15, 0, 64)])


def are_admitted(system: AcausalSystem, inputs: Inputs) -> Bool[Array, ""]:
    """True if parameters, weights, constants and samples are finite, and parameters are within their bounds."""
    data = [source for source in inputs.values() if not isinstance(source, ClosedFunction)]
    leaves = jax.tree.leaves(eqx.filter((system.neural, data), eqx.is_inexact_array))
    return jnp.stack([system.parameters.are_admitted, *(jnp.isfinite(leaf).all() for leaf in leaves)]).all()


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
