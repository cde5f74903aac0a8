"""Values at the initial time that a caller gives, checked before anything is compiled."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ...base.errors import ModelError
from ...host.staging import is_traced
from ...write.real_number import is_unknown_to_jax


def check_initial(system: Any, initial: Any) -> None:
    """Raises a `ModelError` that names a value of `initial={...}` which cannot be meant."""
    if initial is None:
        return
    if not isinstance(initial, Mapping):
        raise ModelError(f"initial is a dictionary by names, initial={{'m.x': 1.0}}; got {type(initial).__name__}")
    for name, value in initial.items():
        if name in system.parameters.names:
            raise ModelError(f"initial: '{name}' is a parameter; use system.with_parameters({{'{name}': value}})")
        if is_unknown_to_jax(value) or np.shape(value) != ():
            found = f"shape {np.shape(value)}" if np.shape(value) else repr(value)
            hint = "" if isinstance(value, str) or np.shape(value) else ": write float(...)"
            raise ModelError(f"initial: '{name}' needs a scalar; got {found}{hint}")
        if jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
            raise ModelError(f"initial: '{name}' must be real; got {jnp.result_type(value)}")
        if not is_traced(value) and not np.isfinite(np.asarray(value, float)):
            raise ModelError(f"initial: '{name}' must be finite; got {value}")
        is_zero = system.plan.resolve([name])[0][0] < 0
        if is_zero and not is_traced(value) and float(value) != 0.0:
            found = f"{float(value):g}"
            raise ModelError(f"initial: '{name}' is identically zero in this model; got {found}. Leave it out")
