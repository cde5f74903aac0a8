"""The compiled program behind a problem: predictions of all experiments, and their Jacobian.

It is given natural values: those of trained parameters, of weights, of starts. Everything that may change from fit to
fit (data, noise, inputs, times, starts, what is frozen, bounds, scales) is an argument of it, or is applied to what it
returns. What it depends on is a `Layout`, in which names and shapes alone count.

The Jacobian is found forwards, one experiment at a time, so its cost is linear in the number of experiments whose
starts are their own.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ..programs.cache import compiled
from ..simulation.simulate import simulate
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
    mesh: Mesh | None = None  # the devices that share the experiments

    @property
    def n_own(self) -> int:
        """The number of values that each experiment has of its own."""
        return len(self.own)


class Setting(NamedTuple):
    """What a program is made for: a system, sensor laws by name, and the layout of its numbers."""

    system: AcausalSystem
    observers: dict[str, Any]
    layout: Layout


class Conditions(eqx.Module):
    """The conditions of e experiments, for one run of a program."""

    times: Float[Array, "e n"]
    t0: Float[Array, " e"]
    known: Float[Array, "e known"]
    inputs: dict[str, tuple[Float[Array, "e _"], Float[Array, "e _"]]]


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
    system, observers, layout = setting
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
        system, c.times[-1], t0=c.t0, ts=c.times, initial=initial or None, adjoint=adjoint, throw=False,
        inputs=with_kinds(c.inputs, layout), **dict(layout.options),
    )  # fmt: skip
    return outputs_of(solution, observers, layout, c.times.dtype)


def misfit(setting: Setting, adjoint: Any, shared: Any, own: Any, c: Weighted) -> Float[Array, " k"]:
    """The sum of squared weighted residuals of each output in a run of one experiment; NaN where it fails."""
    outputs = run_one(setting, adjoint, shared, own, c.told)
    return jnp.sum(jnp.where(c.row > 0, c.row * (outputs - c.values), 0.0) ** 2, axis=0)


def with_kinds(inputs: dict[str, Any], layout: Layout) -> dict[str, Any]:
    """Samples of inputs as `simulate` takes them."""
    kinds = dict(layout.kinds)
    return {name: (*samples, kinds[name]) for name, samples in inputs.items()}


def outputs_of(solution: Any, observers: dict[str, Any], layout: Layout, dtype: Any) -> Float[Array, "n k"]:
    """The outputs of a run."""
    variables = [name for name in layout.outputs if name not in observers]
    read = dict(zip(variables, solution[variables].T, strict=True)) if variables else {}
    derived = {name: observers[name](solution) for name in layout.outputs if name in observers}
    return jnp.stack([read[n] if n in read else jnp.asarray(derived[n], dtype) for n in layout.outputs], axis=1)


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
