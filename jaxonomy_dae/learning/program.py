"""The compiled programs behind a problem: predictions of all experiments, and their derivatives.

How the outputs of one experiment are predicted is a value, an `AbstractPredictor`: by runs from its start to its end
(`Runs`), or from sample to sample (`filter_program.Ahead`). Each program below serves all of them.

A program is given natural values: those of trained parameters, of weights, of starts. Everything that may change from
fit to fit (data, noise, inputs, times, starts, what is frozen, bounds, scales) is an argument of it, or is applied to
what it returns. What it depends on is a `Layout`, in which names and shapes alone count.

The Jacobian is found forwards, one experiment at a time, so its cost is linear in the number of experiments whose
starts are their own.
"""

import abc
import dataclasses
import functools
import math
from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, Int

from ..base.aliases import PyTree
from ..base.errors import ModelError
from ..host.cache import compiled
from ..run.simulation.simulate import simulate
from ..run.simulation.solution import Solution
from ..run.system.system import AcausalSystem
from .data import Stacked
from .dead_time import Delays, late, merged
from .devices import each, each_with_slopes

Inputs: TypeAlias = dict[str, tuple[Float[Array, "*e _"], Float[Array, "*e _"]]]  # times and values of samples by name
SensorLaw: TypeAlias = Callable[[Solution], Array]
Shared: TypeAlias = Float[Array, " s"]  # numbers that all experiments share, in natural values
Own: TypeAlias = Float[Array, " o"]  # those of one experiment
Owns: TypeAlias = Float[Array, "e o"]  # those of all
Module = TypeVar("Module", bound=PyTree)


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
    extra: tuple[str, ...] = ()  # coordinates that come with a method, or are dead times, before the shared starts
    delayed: tuple[str, ...] = ()  # inputs and outputs with a dead time, which the extra coordinates are then
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
    observers: dict[str, SensorLaw]
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
    inputs: Inputs
    length: Int[Array, " e"] | None = None  # the place of each one's number of times in `Layout.lengths`


class Outputs(eqx.Module):
    """Predictions of n samples of k outputs; and their variances, if the predictor says how far samples scatter."""

    values: Float[Array, "*n k"]
    variance: Float[Array, "*n k"] | None


class AbstractPredictor(eqx.Module):
    """A way to predict the outputs of one experiment, and a part of what a program is made for."""

    @property
    def has_variances(self) -> bool:
        """True if it says how large the errors of its predictions are."""
        return False

    @property
    def levels(self) -> tuple[int, ...]:
        """The outputs whose noise levels are coordinates."""
        return ()

    def told(self, system: AcausalSystem, layout: Layout, stacked: Stacked, conditions: Conditions) -> PyTree:
        """What programs are told of all experiments; the first axis of each array counts these."""
        return conditions

    @abc.abstractmethod
    def __call__(self, setting: Setting, shared: Shared, own: Own, told: PyTree) -> Outputs:
        """The predictions for one experiment; NaN where a run fails."""


class Weighted(eqx.Module):
    """The conditions of e experiments, `told`, with samples `values` and the square roots `row` of their weights: √w/σ,
    or √w where the noise level is estimated or follows from the model; zero where there is no sample."""

    told: PyTree
    values: Float[Array, "e n k"]
    row: Float[Array, "e n k"]


def weights_of(module: PyTree) -> list[Array]:
    """The arrays of a network or sensor law that are trained."""
    return jax.tree.leaves(eqx.filter(module, eqx.is_inexact_array))


def with_weights(module: Module, numbers: Float[Array, " count"]) -> Module:
    """A module whose trained arrays are read, one after the other, from an array of shape (count,)."""
    leaves, structure = jax.tree.flatten(eqx.filter(module, eqx.is_inexact_array))
    new, place = [], 0
    for leaf in leaves:
        size = math.prod(leaf.shape)
        new.append(numbers[place : place + size].reshape(leaf.shape).astype(leaf.dtype))
        place += size
    return eqx.combine(jax.tree.unflatten(structure, new), module)


def with_values(
    setting: Setting, shared: Shared
) -> tuple[AcausalSystem, dict[str, SensorLaw], Float[Array, " starts"]]:
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


def placed(
    setting: Setting, shared: Shared, own: Own, known: Float[Array, " known"]
) -> tuple[AcausalSystem, dict[str, SensorLaw], dict[str, Array]]:
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


class Runs(AbstractPredictor):
    """Outputs of a run from the start of an experiment to its end, with derivatives by `adjoint` (as in `simulate`)."""

    adjoint: PyTree = diffrax.ForwardMode()

    def __call__(self, setting: Setting, shared: Shared, own: Own, told: Conditions) -> Outputs:
        layout, c = setting.layout, told
        system, observers, initial = placed(setting, shared, own, c.known)
        delays = delays_of(layout, shared)
        looking, places = c.times, None
        behind = [name for name in layout.outputs if name in delays]
        if behind:
            looking, (now, *then) = merged(c.times, c.t0, [jnp.zeros_like(c.t0), *(delays[name] for name in behind)])
            places = now, dict(zip(behind, then, strict=True))
        solution = simulate(
            system, run_end(c.t0, c.times[-1]), t0=c.t0, ts=looking, initial=initial or None, adjoint=self.adjoint,
            throw=False, inputs=with_kinds(c.inputs, layout, delays), **setting.options,
        )  # fmt: skip
        if places is None:
            return Outputs(outputs_of(solution, observers, layout, c.times.dtype, c.length), None)
        columns = []
        for name in layout.outputs:
            alone = dataclasses.replace(layout, outputs=(name,))
            seen = _rows(solution, places[1].get(name, places[0]))
            columns.append(outputs_of(seen, observers, alone, c.times.dtype, c.length))
        return Outputs(jnp.concatenate(columns, axis=1), None)


def misfit(setting: Setting, predictor: AbstractPredictor, shared: Shared, own: Own, c: Weighted) -> Float[Array, " k"]:
    """For each output of one experiment, the sum of squared weighted residuals, or with variances s, Σ w (r²/s + ln s);
    NaN where a run fails."""
    found = predictor(setting, shared, own, c.told)
    seen, residual = c.row > 0, found.values - c.values
    if found.variance is None:
        return jnp.sum(jnp.where(seen, c.row * residual, 0.0) ** 2, axis=0)
    s = jnp.where(seen, found.variance, 1.0)
    return jnp.sum(jnp.where(seen, c.row**2 * (residual**2 / s + jnp.log(s)), 0.0), axis=0)


def delays_of(layout: Layout, shared: Shared) -> dict[str, Float[Array, ""]]:
    """The dead times of inputs and outputs, by name."""
    first = len(shared) - len(layout.shared) - len(layout.extra)
    return {name: shared[first + k] for k, name in enumerate(layout.delayed)}


def with_kinds(inputs: Inputs, layout: Layout, delays: Delays = MappingProxyType({})) -> dict[str, Any]:
    """Samples of inputs as `simulate` takes them, those with a dead time late."""
    kinds = dict(layout.kinds)
    return {
        name: late(*samples, kinds[name], delays[name]) if name in delays else (*samples, kinds[name])
        for name, samples in inputs.items()
    }


def run_end(t0: Float[Array, ""], last: Float[Array, ""]) -> Float[Array, ""]:
    """The end of a run to the last sample: runs of no length are made of next to none."""
    return jnp.where(last > t0, last, t0 + 8 * jnp.finfo(t0.dtype).eps * (1 + jnp.abs(t0)))


def outputs_of(
    solution: Solution,
    observers: dict[str, SensorLaw],
    layout: Layout,
    dtype: DTypeLike,
    length: Int[Array, ""] | None = None,
) -> Float[Array, "n k"]:
    """The outputs of a run. Sensor laws see its record alone: none of the times by which it was padded."""
    variables = [name for name in layout.outputs if name not in observers]
    read = dict(zip(variables, solution[variables].T, strict=True)) if variables else {}
    chosen = [name for name in layout.outputs if name in observers]

    def derived(rows: int) -> dict[str, Array]:
        own = solution if rows == len(solution.ts) else _rows(solution, slice(rows))
        found = {name: _checked(name, observers[name](own), rows, dtype) for name in chosen}
        return {name: jnp.pad(values, (0, len(solution.ts) - rows), mode="edge") for name, values in found.items()}

    if chosen and length is not None:
        read |= jax.lax.switch(length, [functools.partial(derived, rows) for rows in layout.lengths])
    elif chosen:
        read |= derived(len(solution.ts))
    return jnp.stack([read[n] for n in layout.outputs], axis=1)


def _rows(solution: Solution, rows: slice | Int[Array, " n"]) -> Solution:
    discrete = None if solution.discrete is None else solution.discrete[rows]
    return dataclasses.replace(solution, ts=solution.ts[rows], states=solution.states[rows], discrete=discrete)


def _checked(name: str, values: ArrayLike, rows: int, dtype: DTypeLike) -> Float[Array, " n"]:
    """What a sensor law returned, if it is a real number for each time."""
    values = jnp.asarray(values)
    if values.shape != (rows,) or not jnp.issubdtype(values.dtype, jnp.floating):
        raise ModelError(
            f"observe: '{name}' must return a real number for each of the {rows} times, shape ({rows},); got "
            f"{values.dtype} of shape {values.shape}"
        )
    return values.astype(dtype)


@compiled
def predict(setting: Setting, predictor: AbstractPredictor, shared: Shared, own: Owns, told: PyTree) -> Outputs:
    """All that a predictor finds of all experiments; NaN where a run failed."""
    return each(lambda s, o, c: predictor(setting, s, o, c), setting.layout.mesh, shared, own, told)


@compiled
def predict_and_differentiate(
    setting: Setting, predictor: AbstractPredictor, shared: Shared, own: Owns, told: PyTree
) -> tuple[Outputs, Outputs, Outputs]:
    """The outputs of all experiments, and in a last axis, their derivatives by the shared numbers and by each
    experiment's own."""

    def one(shared, own, c):
        found = predictor(setting, shared, own, c)
        return Outputs(found.values, found.variance)

    return each_with_slopes(one, setting.layout.mesh, shared, own, told)
