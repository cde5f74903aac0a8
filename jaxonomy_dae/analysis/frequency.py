"""`frequency_response`: how a model near a point answers sinusoids."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from numpy.typing import ArrayLike

from ..base.aliases import Time
from ..base.errors import explained_keywords
from ..run.system.system import AcausalSystem
from .linearize import linearize
from .operating_point import OperatingPoint
from .response import FrequencyResponse


@explained_keywords()
def frequency_response(
    system: AcausalSystem,
    *,
    inputs: Sequence[str] | Mapping[str, ArrayLike],
    outputs: Sequence[str],
    omega: ArrayLike,
    at: OperatingPoint | None = None,
    t: Time = 0.0,
    sampled: bool = False,
) -> FrequencyResponse:
    """The response of outputs to small sinusoids at inputs, around an operating point.

    **Arguments:**

    - `inputs`, `outputs`, `at`, `t`, `sampled`: as in `linearize`.
    - `omega`: angular frequencies (rad/s), shape `(k,)`.

    **Returns:**

    A `FrequencyResponse`: `response["output", "input"]` is complex, shape `(k,)`. Differentiable; one dense solve for
    each frequency.

    **Raises:**

    - as `linearize`.
    """
    return linearize(system, inputs, outputs, at=at, t=t, sampled=sampled).frequency_response(jnp.asarray(omega))
