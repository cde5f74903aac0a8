"""A point of a model, read by names."""

from collections.abc import Sequence
from html import escape
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.errors import ModelError
from ..host.staging import is_traced
from ..run.system.system import AcausalSystem

SHOWN = 8  # states in the text of a point


class OperatingPoint(eqx.Module):
    """A consistent point of a system: `point["pend.x"]` is a scalar, `point[["pend.x", "pend.y"]]` has shape `(2,)`.

    - `x`: the state array, shape `(len(system.states) + len(system.carried),)`.
    - `system`, `t`, `inputs`: the system with its discrete variables at this point, the time, and the inputs as
        `simulate` would read them.
    - `residual`: the largest residual of the equations, in units of its own rounding error. It is at most 1 at a valid
        point.

    If `equinox.filter_vmap` returns the point, it is a batch: all shapes have a leading batch axis.
    """

    x: Float[Array, " n"]
    system: AcausalSystem
    t: Float[Array, ""]
    inputs: dict[str, Any]
    residual: Float[Array, ""]

    def __getitem__(self, name: Any) -> Array:
        """The value of a variable, or of several, discrete ones included; `"der(...)"` of what the model
        differentiates, and `"time"`. For the name of an array, its shape; among several names, it stands for those of
        all entries.

        **Raises:**

        - `ModelError` for an unknown name.
        """
        single = isinstance(name, str)
        if not single and not (isinstance(name, Sequence) and all(isinstance(one, str) for one in name)):
            raise ModelError(f"read a point by names, point['m.x'] or point[['m.x', 'm.y']]; got {name!r}")
        # A batch is read member by member: `observe` takes one point.
        if self.x.ndim > 1:
            return eqx.filter_vmap(lambda one: one[name])(self)
        plan = self.system.plan
        array = plan.entries(name) if isinstance(name, str) else None
        if array is not None:
            return self[array[0]].reshape(array[1])
        discrete = self.system.discretes
        names = (
            [name] if single else [n for one in name for n in ([one] if one in discrete else plan.entry_names([one]))]
        )
        continuous = [n for n in names if n != "time" and n not in discrete]
        found = iter(self.system.observe(continuous, self.t, self.x, self.inputs) if continuous else ())
        modes = self.system.discrete_values
        read = [self.t if n == "time" else modes[discrete.index(n)] if n in discrete else next(found) for n in names]
        return read[0] if single else jnp.stack(read) if read else jnp.zeros((0,), self.x.dtype)

    @property
    def start(self) -> dict[str, Array]:
        """The states by name: `simulate(point.system, t1, initial=point.start)` continues from here."""
        return {name: self.x[..., k] for k, name in enumerate(self.system.states)}

    def to_dict(self) -> dict[str, Array]:
        """All variables by name."""
        names = self.system.variables
        return dict(zip(names, jnp.moveaxis(self[names], -1, 0), strict=True))

    def _shown(self) -> list[tuple[str, str]]:
        return [(name, _text(value)) for name, value in list(self.start.items())[:SHOWN]]

    def __repr__(self):
        more = ", …" if len(self.system.states) > SHOWN else ""
        return f"OperatingPoint({', '.join(f'{n}={v}' for n, v in self._shown())}{more})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(n)}</th><td>{escape(v)}</td></tr>" for n, v in self._shown())
        more = f"<tr><td>… ({len(self.system.states)} states)</td></tr>" if len(self.system.states) > SHOWN else ""
        return f"<table><caption>OperatingPoint</caption>{rows}{more}</table>"


def _text(value: Any) -> str:
    if is_traced(value):
        return str(value)
    return f"{float(value):.6g}" if np.ndim(value) == 0 else f"shape {np.shape(value)}"
