"""Sweeps: one function of a system for many values of named parameters, at once."""

import functools
import itertools
from collections.abc import Callable, Mapping
from html import escape
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import PyTree
from ..base.errors import InitializationError, ModelError, SimulationError, SteadyStateError
from ..base.optional import optional_module
from ..host.cache import compiled
from ..host.staging import is_traced
from ..run.simulation.labelled import dataset_of
from ..run.simulation.simulate import simulate
from ..run.simulation.solution import Solution
from ..run.system.system import AcausalSystem
from .steady_state import check_system


class Sweep(eqx.Module):
    """The results of a sweep and their parameter values.

    - `axes`: the values of each parameter by name: shape `(k,)`, or `(k, *shape)` of an array. In a grid, each
        parameter is an axis of the results, in this order; zipped, all share the first axis.
    - `values`: what the function returned, a pytree whose arrays have the axes of the sweep in front. `sweep[key]` is
        `sweep.values[key]`: of simulations, `sweep["c.v"]` has shape `(*shape, times)`.
    - `zipped`: whether the parameters vary together.
    """

    axes: dict[str, np.ndarray]
    values: PyTree
    zipped: bool = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the sweep: one entry for each parameter of a grid, one in all if zipped."""
        sizes = tuple(len(v) for v in self.axes.values())
        return sizes[:1] if self.zipped else sizes

    def __getitem__(self, key: Any) -> PyTree:
        """The array that the function returned under `key`: `sweep["c.v"]`."""
        return self.values[key]

    def to_xarray(self) -> Any:
        """The results as an `xarray.Dataset` (extra `xarray`), with the parameters as coordinates. A grid has one
        dimension for each parameter; zipped, the one dimension is `case`. Simulations have all variables over
        `time`; of a function's result, entries of a dictionary are variables, and an array is `value`."""
        xarray = optional_module("xarray", "xarray", "to_xarray needs xarray")
        dims = ("case",) if self.zipped else tuple(self.axes)
        coordinates = {}
        for name, values in self.axes.items():
            array = np.asarray(values)
            entries = tuple(f"{name}_{k}" for k in range(array.ndim - 1))
            # An array of more than one dimension cannot be the coordinate of the dimension of its name.
            label = name if array.ndim == 1 else f"{name} values"
            coordinates[label] = (("case" if self.zipped else name, *entries), array)
        if isinstance(self.values, Solution):
            first = np.asarray(self.values.ts).reshape(-1, self.values.ts.shape[-1])
            return dataset_of(xarray, self.values, dims, coordinates | {"time": ("time", first[0])})
        entries = self.values if isinstance(self.values, Mapping) else {"value": self.values}
        variables = {}
        for name, value in entries.items():
            array = np.asarray(value)
            more = tuple(f"{name}_{k}" for k in range(array.ndim - len(dims)))
            variables[name] = ((*dims, *more), array)
        return xarray.Dataset(variables, coords=coordinates)

    def __repr__(self):
        return f"Sweep({self._described()})"

    def _described(self) -> str:
        axes = [f"{name}: {_span(values)}" for name, values in self.axes.items()]
        return f"{' with ' if self.zipped else ' × '}".join(axes)

    def _repr_html_(self) -> str:
        rows = [(name, _span(values)) for name, values in self.axes.items()]
        rows += [("shape", str(self.shape)), ("results", _kinds(self.values))]
        cells = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in rows)
        return f"<table><caption>Sweep{' (zipped)' if self.zipped else ''}</caption>{cells}</table>"


def sweep(
    system: AcausalSystem,
    parameters: Mapping[str, object],
    function: Callable[[AcausalSystem], Any] | None = None,
    *,
    zipped: bool = False,
    **options: Any,
) -> Sweep:
    """Calls a function of the system for many parameter values at once: one compiled program, vectorized.

    **Arguments:**

    - `system`: a compiled system.
    - `parameters`: values by parameters' names, each of shape `(k,)`. If a name stands for an array of parameters, each
        value sets all of its entries; values of shape `(k, *shape)` set them one by one.
    - `function`: from the system with its new values to an array or a pytree of arrays, such as
        `lambda s: steady_state(s)["load.v"]`; it is traced. If left out, the system is simulated.
    - `zipped`: by default all combinations are computed, a grid with one axis for each parameter, in the order of
        `parameters`. With `zipped=True` the parameters vary together, and all have the same number of values.
    - `options`: of `simulate`, if no function is given; `t1` and `ts` are needed.

    **Returns:**

    A `Sweep`. It is differentiable. Calling the same function again with other values does not compile anything.

    **Raises:**

    - `ModelError` for an unknown parameter, a value out of its bounds, and shapes that do not fit.
    - `SimulationError`, `SteadyStateError` or `InitializationError`: if results are not-a-number, the function is
        called again with the first such values, outside of compiled programs, and its error is raised. With
        `throw=False` in the function, or with the sweep inside jit, grad or vmap, the result is not-a-number instead.
    """
    check_system(system)
    columns = {name: _values(system, name, given) for name, given in _named(parameters).items()}
    if function is None:
        if options.get("ts") is None or "t1" not in options:
            raise ModelError("a sweep of simulations needs t1=..., and ts=..., so that all runs save the same times")
        function = _Simulation(options)
    elif options:
        raise ModelError(f"{', '.join(options)}: options of simulate are for a sweep without a function")
    elif not callable(function):
        raise ModelError(f"the function takes a system, lambda s: steady_state(s)['m.x']; got {function!r}")
    sizes = [len(v) for v in columns.values()]
    if zipped and len(set(sizes)) > 1:
        found = ", ".join(f"{len(v)} for '{n}'" for n, v in columns.items())
        raise ModelError(f"zipped parameters vary together, so each needs as many values; got {found}")
    if zipped:
        rows = tuple(columns.values())
        shape = (sizes[0],)
    else:
        # One row for each combination, so that a grid is vectorized as zipped values are.
        places = np.array(list(itertools.product(*map(range, sizes))), np.int64).reshape(-1, len(sizes))
        rows = tuple(v[places[:, k]] for k, v in enumerate(columns.values()))
        shape = tuple(sizes)
    results = _mapped(function, system, tuple(columns), rows)
    _raise_first(function, system, columns, rows, results)
    shaped = jax.tree.map(lambda a: jnp.reshape(a, (*shape, *a.shape[1:])) if eqx.is_array(a) else a, results)
    return Sweep(columns, shaped, zipped)


class _Simulation(eqx.Module):
    """`simulate` with its options."""

    options: dict[str, Any]

    def __call__(self, system: AcausalSystem) -> Solution:
        return simulate(system, **self.options)


@functools.partial(compiled, optimize=True)
def _mapped(function: Callable, system: AcausalSystem, names: tuple[str, ...], rows: tuple[Array, ...]) -> PyTree:
    # Names are static and values traced, so that other values find the program compiled.
    def one(row):
        return function(system.with_parameters(dict(zip(names, row, strict=True))))

    return eqx.filter_vmap(one)(rows)


def _raise_first(
    function: Callable, system: AcausalSystem, columns: dict[str, Array], rows: tuple[Array, ...], results: PyTree
):
    """Runs the function by itself for the first row that contains NaN, so that it raises its error; adds which row it
    was."""
    arrays = [leaf for leaf in jax.tree.leaves((results, rows)) if eqx.is_inexact_array(leaf)]
    if is_traced((arrays, system)):
        return
    count = len(rows[0])
    failed = np.zeros(count, bool)
    # A run that failed is not-a-number from there on.
    for leaf in arrays:
        failed |= np.isnan(np.asarray(leaf).reshape(count, -1)).any(axis=1)
    if not failed.any():
        return
    values = {name: np.asarray(row)[int(failed.argmax())] for name, row in zip(columns, rows, strict=True)}
    try:
        # What a compiled program returns carries no text: the function by itself raises the error.
        function(system.with_parameters(values))
    except (InitializationError, SimulationError, SteadyStateError) as error:
        where = ", ".join(f"{name} = {np.array2string(value, precision=6)}" for name, value in values.items())
        text = f"{failed.sum()} of {count} values of the sweep failed, the first at {where}: {error}"
        raise type(error)(text) from error


def _named(parameters: object) -> Mapping[str, object]:
    if not isinstance(parameters, Mapping) or not parameters:
        raise ModelError(f"a sweep takes values by parameters' names, {{'r.R': [1.0, 2.0]}}; got {parameters!r}")
    return parameters


def _values(system: AcausalSystem, name: str, given: object) -> Any:
    """Checks the values of one parameter, or of an array of them, against their bounds."""
    table = system.parameters.table
    entries = table.entries(name)
    shape = () if entries is None else entries.shape
    values = jnp.asarray(given, system.parameters.values.dtype)
    if not values.ndim or values.shape[1:] not in ((), shape) or not values.size:
        either = f" or (k, {', '.join(map(str, shape))})" if shape else ""
        raise ModelError(f"the values of parameter '{name}' need shape (k,){either}, k ≥ 1; got {values.shape}")
    places = np.array([table.settable(one) for one in table.one_by_one(name)])
    if not is_traced(values):
        table.check(places, np.asarray(values).reshape(len(values), -1))
    return values


def _span(values: PyTree) -> str:
    if is_traced(values):
        return f"{len(values)} values"
    least, largest = float(np.min(values)), float(np.max(values))
    return f"{least:g}" if len(values) == 1 else f"{len(values)} values from {least:g} to {largest:g}"


def _kinds(values: PyTree) -> str:
    if isinstance(values, Mapping):
        return ", ".join(f"{k} {np.shape(v)}" for k, v in values.items())
    return repr(values) if isinstance(values, Solution) else str(np.shape(values)) if eqx.is_array(values) else "pytree"
