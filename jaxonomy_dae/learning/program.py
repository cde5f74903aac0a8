"""The compiled program behind a problem: predictions of all experiments, and their Jacobian.

It is given natural values: those of trained parameters, of weights, of starts. Everything that may change from fit to
fit (data, noise, inputs, times, starts, what is frozen, bounds, scales) is an argument of it, or is applied to what it
returns. What it depends on is a `Layout`, in which names and shapes alone count.

The Jacobian is found forwards, one experiment at a time, so its cost is linear in the number of experiments whose
starts are their own.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from ..errors import ModelError
from ..programs.cache import compiled
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from ..system.system import AcausalSystem
from .devices import each, each_with_slopes


@dataclasses.dataclass(frozen=True)
class Layout:
    """The names of the numbers that a program is given, and of those that it returns."""

    outputs: tuple[str, ...]
    parameters: tuple[str, ...]  # trained, one number each
    modules: tuple[str, ...]  # networks and sensor laws whose weights are trained
    shared: tuple[str, ...]  # starts that all experiments share
    own: tuple[str, ...]  # starts that are each experiment's own
    known: tuple[str, ...]  # starts that are given
    kinds: tuple[tuple[str, str], ...]  # of inputs
    options: tuple[tuple[str, Any], ...]  # of `simulate`
    extra: tuple[str, ...] = ()  # coordinates that come with a method, before the shared starts
    lengths: tuple[int, ...] = ()  # of records, if they differ and there are sensor laws
    mesh: Mesh | None = None  # the devices that share the experiments

    @property
    def n_own(self) -> int:
        """The number of values that each experiment has of its own."""
        return len(self.own)


class Setting(NamedTuple):
    """What a program is made for: a system, sensor laws by name, the layout of its numbers, and a factor of the
    tolerances, `fine`, below one where a search has to see more than the integration's error lets it."""

    system: AcausalSystem
    observers: dict[str, Any]
    layout: Layout
    fine: float | Float[Array, ""]

    @property
    def options(self) -> dict[str, Any]:
        """The options of `simulate`. Tolerances are values, so that others compile nothing."""
        given = dict(self.layout.options)
        return given | {name: jax.tree.map(lambda a: a * self.fine, given[name]) for name in ("rtol", "atol")}


class Conditions(eqx.Module):
    """The conditions of e experiments, for one run of a program."""

    times: Float[Array, "e n"]
    t0: Float[Array, " e"]
    known: Float[Array, "e known"]
    inputs: dict[str, tuple[Float[Array, "e _"], Float[Array, "e _"]]]
    length: Int[Array, " e"] | None = None  # the place of each one's number of times in `Layout.lengths`


class Weighted(eqx.Module):
    """The conditions of e experiments, `told`, with samples `values` and the square roots `row` of their weights: √w/σ,
    or √w where the noise level is estimated or follows from the model; zero where there is no sample."""

    told: Any
    values: Float[Array, "e n k"]
    row: Float[Array, "e n k"]


def weights_of(module: Any) -> list[Any]:
    """The arrays of a network or sensor law that are trained."""
    return jax.tree.leaves(eqx.filter(module, eqx.is_inexact_array))


def with_weights(module: Any, numbers: Any) -> Any:
    """A module whose trained arrays are read, one after the other, from an array of shape (count,)."""
    leaves, structure = jax.tree.flatten(eqx.filter(module, eqx.is_inexact_array))
    new, place = [], 0
    for leaf in leaves:
        size = math.prod(leaf.shape)
        new.append(numbers[place : place + size].reshape(leaf.shape).astype(leaf.dtype))
        place += size
    return eqx.combine(jax.tree.unflatten(structure, new), module)


def with_values(setting: Setting, shared: Any) -> tuple[AcausalSystem, dict[str, Any], Any]:
    """(system, sensor laws, shared starts) with the shared numbers in their places."""
    system, observers, layout, _ = setting
    n = len(layout.parameters)
    if n:
        system = system.with_parameters({name: shared[k] for k, name in enumerate(layout.parameters)})
    for name in layout.modules:
        module = system.neural[name] if name in system.neural else observers[name]
        size = sum(math.prod(leaf.shape) for leaf in weights_of(module))
        changed = with_weights(module, shared[n : n + size])
        n += size
        if name in system.neural:
            system = eqx.tree_at(lambda s, name=name: s.neural[name], system, changed)
        else:
            observers = {**observers, name: changed}
    return system, observers, shared[n + len(layout.extra) :]


def placed(setting: Setting, shared: Any, own: Any, known: Any) -> tuple[AcausalSystem, dict[str, Any], dict[str, Any]]:
    """(system, sensor laws, starts by variables' names) of one experiment, with its own parameters in their places."""
    layout = setting.layout
    system, observers, starts = with_values(setting, shared)
    initial = dict(zip(layout.shared, starts, strict=True))
    initial |= dict(zip(layout.own, own, strict=True))
    initial |= dict(zip(layout.known, known, strict=True))
    own_parameters = {name: v for name, v in initial.items() if name in system.parameters}
    if own_parameters:
        system = system.with_parameters(own_parameters)
        initial = {name: v for name, v in initial.items() if name not in own_parameters}
    return system, observers, initial


def run_one(setting: Setting, adjoint: Any, shared: Any, own: Any, c: Conditions) -> Float[Array, "n k"]:
    """The outputs of one experiment."""
    layout = setting.layout
    system, observers, initial = placed(setting, shared, own, c.known)
    solution = simulate(
        system, run_end(c.t0, c.times[-1]), t0=c.t0, ts=c.times, initial=initial or None, adjoint=adjoint, throw=False,
        inputs=with_kinds(c.inputs, layout), **setting.options,
    )  # fmt: skip
    return outputs_of(solution, observers, layout, c.times.dtype, c.length)


def misfit(setting: Setting, adjoint: Any, shared: Any, own: Any, c: Weighted) -> Float[Array, " k"]:
    """The sum of squared weighted residuals of each output in a run of one experiment; NaN where it fails."""
    outputs = run_one(setting, adjoint, shared, own, c.told)
    return jnp.sum(jnp.where(c.row > 0, c.row * (outputs - c.values), 0.0) ** 2, axis=0)


def with_kinds(inputs: dict[str, Any], layout: Layout) -> dict[str, Any]:
    """Samples of inputs as `simulate` takes them."""
    kinds = dict(layout.kinds)
    return {name: (*samples, kinds[name]) for name, samples in inputs.items()}


def run_end(t0: Any, last: Any) -> Any:
    """The end of a run to the last sample: runs of no length are made of next to none."""
    return jnp.where(last > t0, last, t0 + 8 * jnp.finfo(t0.dtype).eps * (1 + jnp.abs(t0)))


def outputs_of(
    solution: Solution, observers: dict[str, Any], layout: Layout, dtype: Any, length: Any = None
) -> Float[Array, "n k"]:
    """The outputs of a run. Sensor laws see its record alone: none of the times by which it was padded."""
    variables = [name for name in layout.outputs if name not in observers]
    read = dict(zip(variables, solution[variables].T, strict=True)) if variables else {}
    chosen = [name for name in layout.outputs if name in observers]

    def derived(rows: int) -> dict[str, Any]:
        own = solution if rows == len(solution.ts) else _first_rows(solution, rows)
        found = {name: _checked(name, observers[name](own), rows, dtype) for name in chosen}
        return {name: jnp.pad(values, (0, len(solution.ts) - rows), mode="edge") for name, values in found.items()}

    if chosen and length is not None:
        read |= jax.lax.switch(length, [functools.partial(derived, rows) for rows in layout.lengths])
    elif chosen:
        read |= derived(len(solution.ts))
    return jnp.stack([read[n] for n in layout.outputs], axis=1)


def _first_rows(solution: Solution, rows: int) -> Solution:
    def first(a: Any) -> Any:
        return None if a is None else a[:rows]

    return dataclasses.replace(
        solution, ts=first(solution.ts), states=first(solution.states), discrete=first(solution.discrete)
    )


def _checked(name: str, values: Any, rows: int, dtype: Any) -> Float[Array, " n"]:
    """What a sensor law returned, if it is a real number for each time."""
    values = jnp.asarray(values)
    if values.shape != (rows,) or not jnp.issubdtype(values.dtype, jnp.floating):
        raise ModelError(
            f"observe: '{name}' must return a real number for each of the {rows} times, shape ({rows},); got "
            f"{values.dtype} of shape {values.shape}"
        )
    return values.astype(dtype)


@compiled
def predict(setting: Setting, adjoint: Any, shared: Any, own: Any, conditions: Conditions) -> Float[Array, "e n k"]:
    """The outputs of all experiments; NaN where a run failed."""

    def one(shared, own, c):
        return run_one(setting, adjoint, shared, own, c)

    return each(one, setting.layout.mesh, shared, own, conditions)


@compiled
def predict_and_differentiate(
    setting: Setting, shared: Any, own: Any, conditions: Conditions
) -> tuple[Float[Array, "e n k"], Float[Array, "e n k s"], Float[Array, "e n k o"]]:
    """The outputs of all experiments, and their derivatives by the shared numbers and by each experiment's own."""

    def one(shared, own, c):
        return run_one(setting, diffrax.ForwardMode(), shared, own, c)

    return each_with_slopes(one, setting.layout.mesh, shared, own, conditions)
