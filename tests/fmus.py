"""Functional Mock-up Units: opened, driven and differentiated through FMPy."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import simulate
from jaxonomy_dae.run.system.nonlinear import Refinement

fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed (extra fmi)")


class Opened:
    """An instance of an FMU, after initialization, in event mode."""

    def __init__(self, path: Path, starts: dict[str, float] | None = None, t0: float = 0.0, initialize: bool = True):
        from fmpy.fmi2 import FMU2Model
        from fmpy.fmi3 import FMU3Model

        self.description = fmpy.read_model_description(str(path))
        self.version = int(float(self.description.fmiVersion))
        self.messages: list[str] = []
        self._folder = fmpy.extract(str(path))
        self.reference = {v.name: v.valueReference for v in self.description.modelVariables}
        self.model: Any = (FMU3Model if self.version == 3 else FMU2Model)(
            guid=self.description.guid,
            unzipDirectory=self._folder,
            modelIdentifier=self.description.modelExchange.modelIdentifier,
            instanceName="one",
        )
        self.model.instantiate(loggingOn=True)
        self.set(starts or {})
        if initialize:
            if self.version == 2:
                self.model.setupExperiment(startTime=t0)
                self.model.enterInitializationMode()
            else:
                self.model.enterInitializationMode(startTime=t0)
            self.model.exitInitializationMode()
            self.update()

    def references(self, names: Sequence[str]) -> list[int]:
        return [self.reference[name] for name in names]

    def set(self, values: dict[str, float]) -> None:
        if values:
            to = self.model.setFloat64 if self.version == 3 else self.model.setReal
            to(self.references(list(values)), [float(v) for v in values.values()])

    def get(self, *names: str) -> np.ndarray:
        of = self.model.getFloat64 if self.version == 3 else self.model.getReal
        return np.array(of(self.references(names)))

    def update(self) -> tuple:
        update = self.model.updateDiscreteStates if self.version == 3 else self.model.newDiscreteStates
        found = update()
        while found[0]:
            found = update()
        return found

    def forward(self, unknowns: Sequence[str], knowns: Sequence[str], seed: Any) -> np.ndarray:
        sizes = [len(unknowns)] if self.version == 3 else []
        return np.array(
            self.model.getDirectionalDerivative(
                self.references(unknowns), self.references(knowns), list(map(float, seed)), *sizes
            )
        )

    def reverse(self, unknowns: Sequence[str], knowns: Sequence[str], seed: Any, n: int) -> np.ndarray:
        return np.array(
            self.model.getAdjointDerivative(
                self.references(unknowns), self.references(knowns), list(map(float, seed)), n
            )
        )

    def close(self) -> None:
        import shutil

        self.model.freeInstance()
        shutil.rmtree(self._folder, ignore_errors=True)


@contextlib.contextmanager
def opened(path: Path, *args: Any, **options: Any) -> Iterator[Opened]:
    fmu = Opened(path, *args, **options)
    try:
        yield fmu
    finally:
        fmu.close()


def problems(path: Path) -> list[str]:
    """What FMPy finds wrong with an FMU."""
    from fmpy.validation import validate_fmu

    return validate_fmu(str(path))


def run(path: Path, t1: float, output: Sequence[str], rtol: float = 1e-9, **options: Any) -> Any:
    """A run by FMPy's CVode, or by the FMU itself: `fmi_type="CoSimulation"`."""
    given = {"output_interval": t1 / 50, "solver": "CVode", "fmi_type": "ModelExchange"} | options
    return fmpy.simulate_fmu(str(path), stop_time=t1, relative_tolerance=rtol, output=list(output), **given)


def exported(system, folder, name="model", **options):
    path = system.export_fmu(folder / f"{name}.fmu", **options)
    assert problems(path) == []
    return path


def discrete_values(system, fmu):
    """The discrete variables of an FMU: hidden ones of a Modelica model, which it does not show, are what they are
    between two events."""
    shown = [float(fmu.get(name)[0]) for name in system.discretes]
    hidden = system.every_discrete[len(shown) :]
    if not hidden:
        return shown
    between = dict(zip(system.every_discrete, simulate(system, 1e-9).at(-1).discrete.tolist(), strict=False))
    values = between | dict(zip(system.discretes, shown, strict=True))
    before = {name: values[name.replace(":pre(", "").rstrip(")")] for name in hidden if ":pre(" in name}
    return [*shown, *((values | before)[name] for name in hidden)]


def point(system, fmu, outputs):
    """Returns (names of unknowns, of knowns, values of knowns, the unknowns as a function of the knowns' values)."""
    states = system.states
    unknowns = [*(u.variable.name for u in fmu.description.derivatives), *outputs]
    leaves, tree = jax.tree.flatten(eqx.filter(system.neural, eqx.is_inexact_array))
    weights = [n for n in fmu.reference if n.startswith("drag.")]
    parameters = [
        v.name for v in fmu.description.modelVariables if v.causality == "parameter" and v.name not in weights
    ]
    inputs = system.inputs
    knowns = ["time", *states, *inputs, *parameters, *weights]
    values = [np.asarray(fmu.get(n) if n not in weights else None) for n in knowns if n not in weights]
    values = [jnp.asarray(v[0]) for v in values] + leaves
    n, m, k = len(states), len(inputs), len(parameters)

    discrete = jnp.asarray(discrete_values(system, fmu))
    q = jnp.concatenate([discrete, system.discrete_values[len(discrete) :]])
    guess = system.initialize(inputs=dict(zip(inputs, fmu.get(*inputs), strict=True)))[n:]

    def function(*given):
        t, x, u = given[0], jnp.stack(given[1 : 1 + n]), given[1 + n : 1 + n + m]
        p, w = given[1 + n + m : 1 + n + m + k], given[1 + n + m + k :]
        own = system.with_parameters(dict(zip(parameters, p, strict=True)))
        own = eqx.tree_at(lambda s: s.neural, own, eqx.combine(jax.tree.unflatten(tree, w), system.neural))
        own, args = own.holding(q), dict(zip(inputs, u, strict=True))
        if len(guess):
            x = own.at(t, args).refined(jnp.concatenate([x, guess]), Refinement.ROOT)
        return jnp.concatenate([own.vector_field(t, x, args)[:n], own.observe(outputs, t, x, args)])

    return unknowns, knowns, values, function


def check_derivatives(system, path, outputs, seed=0, rtol=1e-10):
    """Both derivatives are those of JAX, and each other's transposes; only the first in FMI 2.0."""
    rng = np.random.default_rng(seed)
    with opened(path) as fmu:
        unknowns, knowns, values, function = point(system, fmu, outputs)
        along = [rng.normal(size=np.shape(v)) for v in values]
        weight = rng.normal(size=len(unknowns))
        value, slope = jax.jit(lambda v, a: jax.jvp(function, tuple(v), tuple(a)))(values, along)
        back = jax.jit(lambda v, w: jax.vjp(function, *v)[1](w))(values, jnp.asarray(weight))
        flat = np.concatenate([np.ravel(a) for a in along])
        np.testing.assert_allclose(fmu.get(*unknowns), value, rtol=1e-11, atol=1e-11)
        forward = fmu.forward(unknowns, knowns, flat)
        scale = max(np.abs(slope).max(), 1e-300)
        np.testing.assert_allclose(forward / scale, slope / scale, atol=rtol)
        if fmu.version == 2:  # which has no adjoint derivatives
            return
        reverse = fmu.reverse(unknowns, knowns, weight, len(flat))
        expected = np.concatenate([np.ravel(b) for b in back])
        scale = max(np.abs(expected).max(), 1e-300)
        np.testing.assert_allclose(reverse / scale, expected / scale, atol=rtol)
        both = weight @ forward, reverse @ flat
        assert abs(both[0] - both[1]) <= 1e-12 * max(np.abs(reverse * flat).sum(), np.abs(weight * forward).sum())


def compare(system, path, t1, names, atol, inputs=None, **options):
    """A run of an FMU beside one by `simulate`, at times away from events; `atol` is in units of each variable's
    largest value, or of 1."""
    found = run(path, t1, names, record_events=False, **{"rtol": 1e-10} | options)
    ts = jnp.asarray(np.clip(found["time"], 0, t1))
    solution = simulate(system, t1, rtol=1e-10, atol=1e-12, ts=ts, inputs=inputs)
    for name in names:
        size = max(1.0, np.abs(solution[name]).max())
        np.testing.assert_allclose(found[name], solution[name], rtol=0, atol=atol * size, err_msg=name)
    return solution
