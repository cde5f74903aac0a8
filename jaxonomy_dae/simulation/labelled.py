"""Solutions as tables of other libraries: a data frame of pandas, a data set of xarray."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ModelError
from ..optional import optional_module

if TYPE_CHECKING:
    from .solution import Solution


def data_frame(solution: "Solution", names: tuple[str, ...]) -> Any:
    """A `pandas.DataFrame`: one column for each variable, indexed by time."""
    pandas = optional_module("pandas", "pandas", "to_pandas needs pandas")
    if solution.ts.ndim != 1:
        raise ModelError(
            f"a data frame holds one solution, this is a batch of shape {solution.ts.shape[:-1]}: use to_xarray()"
        )
    chosen = _one_by_one(solution, names) or tuple(solution)
    index = pandas.Index(np.asarray(solution.ts), name="time")
    return pandas.DataFrame(np.asarray(solution[list(chosen)]), index=index, columns=list(chosen))


def _one_by_one(solution: "Solution", names: tuple[str, ...]) -> tuple[str, ...]:
    """Names, with those of the entries in place of an array's."""
    plan = solution.system.plan
    return tuple(one for name in names for one in (plan.entries(name) or ([name],))[0])


def data_set(solution: "Solution", names: tuple[str, ...]) -> Any:
    """An `xarray.Dataset`: variables over `time`; a batch adds the dimensions `batch_0`, `batch_1`, …"""
    xarray = optional_module("xarray", "xarray", "to_xarray needs xarray")
    dims = tuple(f"batch_{k}" for k in range(solution.ts.ndim - 1))
    times = np.asarray(solution.ts).reshape(-1, solution.ts.shape[-1])
    if not (times == times[0]).all():
        raise ModelError("the solutions of this batch were saved at different times: give simulate the same ts=...")
    return dataset_of(xarray, solution, dims, {"time": ("time", times[0])}, names)


def dataset_of(
    xarray: Any, solution: "Solution", dims: tuple[str, ...], coordinates: dict[str, Any], names: tuple[str, ...] = ()
) -> Any:
    """The variables of a solution, or of a batch that has the dimensions `dims`, with their units."""
    chosen = _one_by_one(solution, names) or tuple(solution)
    table = solution.system.plan.flat.variables
    units = dict(zip(table.names, table.unit, strict=True))
    columns = np.moveaxis(np.asarray(solution[list(chosen)]), -1, 0)
    variables = {
        name: ((*dims, "time"), values, {"units": units[name]} if units.get(name) else {})
        for name, values in zip(chosen, columns, strict=True)
    }
    return xarray.Dataset(variables, coords=coordinates)
