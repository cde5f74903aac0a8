"""Solutions as tables of other libraries, a data frame of pandas, a data set of xarray; and the part of a solution's
interface that tables and figures read."""

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Numeric
from ...base.errors import ModelError
from ...base.optional import optional_module
from ...compile.model.array_names import inner_name
from ..system.system import AcausalSystem
from .event_log import EventLog, Events


@runtime_checkable
class ByName(Protocol):
    """A solution whose variables are read by name. Methods of `Solution` call tables and figures, which therefore
    cannot import its class."""

    @property
    def ts(self) -> Float[Array, "*batch n"]:
        """The saved times."""
        ...

    @property
    def system(self) -> AcausalSystem:
        """The system that was simulated."""
        ...

    @property
    def event_log(self) -> EventLog | None:
        """The events as arrays; None if the model has none."""
        ...

    @property
    def events(self) -> Events:
        """The events by name."""
        ...

    def __getitem__(self, name: Any) -> Any:
        """The values of a variable, or of several."""
        ...

    def __contains__(self, name: str) -> bool: ...

    def __iter__(self) -> Iterator[str]: ...


def data_frame(solution: ByName, names: tuple[str, ...]) -> Any:
    """A `pandas.DataFrame`: one column for each variable, indexed by time."""
    pandas = optional_module("pandas", "pandas", "to_pandas needs pandas")
    if solution.ts.ndim != 1:
        raise ModelError(
            f"a data frame holds one solution, this is a batch of shape {solution.ts.shape[:-1]}: use to_xarray()"
        )
    chosen = solution.system.plan.entry_names(names) or list(solution)
    index = pandas.Index(np.asarray(solution.ts), name="time")
    return pandas.DataFrame(np.asarray(solution[chosen]), index=index, columns=chosen)


def data_set(solution: ByName, names: tuple[str, ...]) -> Any:
    """An `xarray.Dataset`: variables over `time`; a batch adds the dimensions `batch_0`, `batch_1`, …"""
    xarray = optional_module("xarray", "xarray", "to_xarray needs xarray")
    dims = tuple(f"batch_{k}" for k in range(solution.ts.ndim - 1))
    times = np.asarray(solution.ts).reshape(-1, solution.ts.shape[-1])
    if not (times == times[0]).all():
        raise ModelError("the solutions of this batch were saved at different times: give simulate the same ts=...")
    return dataset_of(xarray, solution, dims, {"time": ("time", times[0])}, names)


def dataset_of(
    xarray: Any, solution: ByName, dims: tuple[str, ...], coordinates: dict[str, Numeric], names: tuple[str, ...] = ()
) -> Any:
    """The variables of a solution, or of a batch that has the dimensions `dims`, with their units. An array that is
    named is one variable, with a dimension for each that it has."""
    plan = solution.system.plan
    table = plan.flat.variables
    units = dict(zip(table.names, table.unit, strict=True))
    arrays = {name: found for name in names if (found := plan.entries(name)) is not None}
    chosen = [name for name in names if name not in arrays] if names else list(solution)
    columns = np.moveaxis(np.asarray(solution[chosen]), -1, 0) if chosen else ()
    over = (*dims, "time")

    def attributes(name: str) -> dict[str, str]:
        return {"units": units[name]} if units.get(name) else {}

    variables: dict[str, Any] = {n: (over, values, attributes(n)) for n, values in zip(chosen, columns, strict=True)}
    for name, (one_by_one, _) in arrays.items():
        inner = inner_name(name)[1]
        unit = attributes(one_by_one[0])
        variables[name] = ((*over, *plan.flat.arrays.dimensions(inner)), np.asarray(solution[name]), unit)
    return xarray.Dataset(variables, coords=coordinates)
