"""Parameters: one flat array with names."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..errors import ModelError, nearest


@dataclasses.dataclass(frozen=True)
class ParameterNames:
    """The name table: static, compared by its digest."""

    names: list[str] = dataclasses.field(compare=False, hash=False)
    units: list[str] = dataclasses.field(compare=False, hash=False)
    bounds: np.ndarray = dataclasses.field(compare=False, hash=False)
    digest: str = ""

    def index(self, name: str) -> int:
        if not hasattr(self, "_index"):
            object.__setattr__(self, "_index", {n: k for k, n in enumerate(self.names)})
        found = self._index.get(name)  # type: ignore[attr-defined]
        if found is None:
            raise ModelError(f"'{name}' is no parameter: " + nearest(name, self.names))
        return found


class Parameters(eqx.Module):
    """All parameters of a system: `parameters["pend.m"]`; `parameters.array` has shape `(len(parameters),)`.

    `free` holds the values of parameters that `AcausalSystem.partition` took apart to be trained; they override the
    entries of `values` at `free_index`.
    """

    values: Float[Array, " n"]
    free: Float[Array, " k"] | None
    free_index: tuple[int, ...] = eqx.field(static=True)
    table: ParameterNames = eqx.field(static=True)

    @property
    def array(self) -> Float[Array, " n"]:
        """All values, in the order of `names`."""
        if self.free is None or not self.free_index:
            return self.values
        return self.values.at[np.array(self.free_index)].set(self.free)

    @property
    def names(self) -> list[str]:
        """The parameters' names."""
        return list(self.table.names)

    def __getitem__(self, name: str) -> Any:
        k = self.table.index(name)
        if self.free is not None and k in self.free_index:
            return self.free[self.free_index.index(k)]
        return self.values[k]

    def __iter__(self) -> Iterator[str]:
        return iter(self.table.names)

    def __len__(self) -> int:
        return len(self.table.names)

    def items(self) -> list[tuple[str, Any]]:
        """Pairs of name and value."""
        array = self.array
        return [(name, array[k]) for k, name in enumerate(self.table.names)]

    def merged(self) -> "Parameters":
        """The same values with nothing set apart."""
        return Parameters(self.array, None, (), self.table)

    def freed(self, names: tuple[str, ...]) -> "Parameters":
        """The same values with the named ones set apart in `free`."""
        index = tuple(self.table.index(n) for n in names)
        if not index:
            return self.merged()
        array = self.array
        return Parameters(array, array[np.array(index)], index, self.table)

    def replaced(self, new: Mapping[str, Any]) -> "Parameters":
        """The same table with new values, which may be tracers.

        **Raises:**

        - `ModelError` for an unknown name, a value that is no scalar, is not finite, or is out of the bounds.
        """
        array = self.array
        for name, value in new.items():
            k = self.table.index(name)
            if jnp.shape(value) != ():
                raise ModelError(
                    f"parameter '{name}' is a scalar; got shape {jnp.shape(value)}. For a batch, use "
                    f"jax.vmap(lambda v: ... system.with_parameters({{'{name}': v}}) ...)"
                )
            if not isinstance(value, Tracer):
                number = float(value)
                low, high = self.table.bounds[k]
                if not np.isfinite(number):
                    raise ModelError(f"parameter '{name}' must be finite; got {number}")
                if not low <= number <= high:
                    raise ModelError(f"parameter '{name}' must lie in [{low}, {high}]; got {number}")
            array = array.at[k].set(jnp.asarray(value, array.dtype))
        return Parameters(array, None, (), self.table)

    def __repr__(self):
        shown = ", ".join(f"{n}={v}" for n, v in self.items()[:12])
        return f"Parameters({shown}{', …' if len(self) > 12 else ''})"
