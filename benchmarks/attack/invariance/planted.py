"""Deliberate faults, some for each letter, and the number of a model by which the letter notices them.

`python -m benchmarks.attack.invariance.planted` plants one after the other, each in a process of its own, and prints
what notices it; letters and numbers choose among them. The exit status is 1 if one is not noticed.
"""

import contextlib
import dataclasses
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

Bend = Callable[[Any], Any]  # from what is there to what takes its place


@dataclasses.dataclass(frozen=True)
class Planted:
    """`letter` must find the fault with the model `number`. `target`: "module:name" or "module:class.name" inside the
    package; `bend` makes what stands in its place."""

    letter: str
    number: int
    what: str
    target: str
    bend: Bend


@contextlib.contextmanager
def planted(fault: Planted) -> Iterator[None]:
    """While this lasts, the fault is in the package."""
    import importlib

    module, _, path = fault.target.partition(":")
    owner: Any = importlib.import_module(f"jaxonomy_dae.{module}")
    *classes, name = path.split(".")
    for part in classes:
        owner = getattr(owner, part)
    with mock.patch.object(owner, name, fault.bend(owner.__dict__[name])):
        yield


def forgets(kind: str) -> Bend:
    """A walk over a plan to which all objects of this type are alike."""

    def bend(walk: Any) -> Any:
        return lambda self, part: b"" if type(part).__name__ == kind else walk(self, part)

    return bend


def _by_names(_: Any) -> Any:
    from jaxonomy_dae.compile.model.identity import Identity

    return property(lambda plan: Identity.of(tuple(plan.quantity_name)))


def _sizes_by_count(sizes: Any) -> Any:
    kept: dict[Any, Any] = {}

    def bent(model: Any, values: Any) -> Any:
        found = sizes(model, values)
        return kept.setdefault(found.shape, found)

    return bent


def _always_well(run: Any) -> Any:
    import diffrax

    def bent(*args: Any, **options: Any) -> Any:
        return dataclasses.replace(run(*args, **options), result=diffrax.RESULTS.successful)

    return bent


def _looser_inside(controller: Any) -> Any:
    from jaxonomy_dae.host.staging import is_traced

    def bent(system: Any, solver: Any, rtol: Any, atol: Any, *rest: Any) -> Any:
        factor = 1e6 if is_traced(system) else 1.0
        return controller(system, solver, rtol * factor, atol * factor, *rest)

    return bent


def _off_inside(with_parameters: Any) -> Any:
    from jaxonomy_dae.host.staging import is_traced

    def bent(self: Any, values: Any) -> Any:
        return with_parameters(self, {n: v * (1 + 1e-4) if is_traced(v) else v for n, v in values.items()})

    return bent


def _parameter_bent(chosen: Callable[[Any], int]) -> Bend:
    """A compiler that reads one of the parameters wrongly."""

    def bend(call: Any) -> Any:
        def bent(self: Any) -> Any:
            system = call(self)
            names = list(system.parameters.names)
            if not names:
                return system
            name = names[chosen(names)]
            return system.with_parameters({name: float(system.parameters[name]) * (1 + 1e-6)})

        return bent

    return bend


def _at(change: Callable[[Any, Any, Any], Any]) -> Bend:
    """Saved states that are changed: `change(state, solution, k)`."""

    def bend(at: Any) -> Any:
        return lambda self, k: change(at(self, k), self, k)

    return bend


def _starts_again(state: Any, solution: Any, k: Any) -> Any:
    return dataclasses.replace(state, discrete=solution.system.discrete_values)


def _row_before(state: Any, solution: Any, k: Any) -> Any:
    return dataclasses.replace(state, x=0.999 * state.x)


def _tocked(state: Any, solution: Any, k: Any) -> Any:
    return dataclasses.replace(state, ticked=1.0 - state.ticked)


def _no_small_values(initialize: Any) -> Any:
    import jax.numpy as jnp

    def bent(*args: Any, **options: Any) -> Any:
        x = initialize(*args, **options)
        return jnp.where(jnp.abs(x) < 1e-8, 0.0, x)

    return bent


def _by_count(names: Callable[[Any], int]) -> Bend:
    """Slopes that hang on how many names there are."""

    def bend(field: Any) -> Any:
        return lambda self, *args: field(self, *args) * (1 + 1e-6 * names(self))

    return bend


def _step_off(step: Any) -> Any:
    def bent(self: Any, *args: Any, **options: Any) -> Any:
        y1, *rest = step(self, *args, **options)
        return y1 * (1 + 1e-4), *rest

    return bent


def _dense_off(step: Any) -> Any:
    def bent(self: Any, *args: Any, **options: Any) -> Any:
        y1, error, dense, *rest = step(self, *args, **options)
        return y1, error, {**dense, "k": dense["k"] * 1.01}, *rest

    return bent


def _share_of_one(weights: Any) -> Any:
    import numpy as np

    def bent(self: Any, *args: Any) -> Any:
        found = weights(self, *args)
        return dataclasses.replace(found, share=np.ones_like(found.share))

    return bent


def _missing_are_zero(stack: Any) -> Any:
    import numpy as np

    def bent(*args: Any) -> Any:
        found = stack(*args)
        return dataclasses.replace(found, observed=np.ones_like(found.observed))

    return bent


def _moved_with_start(change: Callable[[Any], dict[str, Any]]) -> Bend:
    """Coordinates of which something else begins where the search does."""

    def bend(as_asked: Any) -> Any:
        def bent(*args: Any) -> Any:
            found = as_asked(*args)
            return dataclasses.replace(found, **change(found))

        return bent

    return bend


def _centre_at_start(c: Any) -> dict[str, Any]:
    return {"centre": c.z_start}


def _size_of_start(c: Any) -> dict[str, Any]:
    import numpy as np

    return {"size": np.where(c.log, 1.0, np.abs(c.start))}


FAULTS = (
    Planted("a", 1, "bounds are no part of a model's identity", "compile.model.identity:_Walk._of",
            forgets("Interval")),
    Planted("a", 17, "models with the same names are the same", "compile.lowering.plan:SystemPlan._identity",
            _by_names),
    Planted("a", 17, "typical sizes are kept by how many there are", "run.system.acausal_compiler:typical_sizes",
            _sizes_by_count),
    Planted("b", 100, "parameters that are traced are off", "run.system.system:AcausalSystem.with_parameters",
            _off_inside),
    Planted("b", 100, "inside jit, all runs end well", "run.simulation.simulate:run", _always_well),
    Planted("b", 100, "tolerances are looser inside jit", "run.simulation.simulate:controller_for", _looser_inside),
    Planted("c", 2, "the parameter declared first is off", "run.system.acausal_compiler:AcausalCompiler.__call__",
            _parameter_bent(lambda names: 0)),
    Planted("c", 9, "the parameter that is first by name is off",
            "run.system.acausal_compiler:AcausalCompiler.__call__",
            _parameter_bent(lambda names: names.index(min(names)))),
    Planted("d", 8, "discrete variables start again", "run.simulation.solution:Solution.at", _at(_starts_again)),
    Planted("d", 0, "a saved state is off", "run.simulation.solution:Solution.at", _at(_row_before)),
    Planted("d", 1, "clocks forget what has ticked", "run.simulation.solution:Solution.at", _at(_tocked)),
    Planted("e", 22, "small starts are zero", "run.system.system:AcausalSystem.initialize", _no_small_values),
    Planted("e", 21, "nominal values scale no tolerance", "run.simulation.step_sizes:scaled_atol",
            lambda _: lambda system, atol: atol),
    Planted("f", 0, "a weight counts in residuals alone", "learning.objective:Objective.weights", _share_of_one),
    Planted("f", 1, "missing samples are zeros", "learning.problem:stack", _missing_are_zero),
    Planted("g", 0, "priors begin where the search does", "learning.problem:as_asked",
            _moved_with_start(_centre_at_start)),
    Planted("g", 0, "sizes are those of the start", "learning.problem:as_asked", _moved_with_start(_size_of_start)),
    Planted("h", 2, "slopes hang on how many parameters there are", "run.system.system:AcausalSystem.vector_field",
            _by_count(lambda system: len(system.parameters.names))),
    Planted("h", 1, "slopes hang on how many variables there are", "run.system.system:AcausalSystem.vector_field",
            _by_count(lambda system: len(system.variables))),
    Planted("i", 38, "BDF keeps to no tolerance", "solve.methods.bdf:CAUTION", lambda _: 1e-7),
    Planted("i", 100, "steps of Rodas5P are off", "solve.methods.rodas5p:Rodas5P.step", _step_off),
    Planted("i", 100, "between steps, Tsit5 is off", "solve.methods.tsit5:Tsit5.step", _dense_off),
)  # fmt: skip


def noticed(number: int) -> str:
    """What the letter says of the fault of this number; empty if it does not notice it."""
    from . import LETTERS, process

    fault = FAULTS[number]
    if fault.letter == "a":
        pairs = process.process(fault.number, planted=number)
    else:
        with planted(fault):
            pairs = LETTERS[fault.letter](fault.number)
    return next((o.text[:300] for o in pairs.outcomes if o.kind == "wrong"), "")


def apart(number: int) -> str:
    """`noticed` in a process of its own, whose programs nobody else uses."""
    if FAULTS[number].letter == "a":
        return noticed(number)  # it starts processes of its own
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.attack.invariance", "jaxonomy_dae.learning"])
    with context.Pool(1, maxtasksperchild=1) as pool:
        return pool.apply(noticed, (number,))


def main() -> int:
    os.environ["JAX_ENABLE_X64"] = "1"  # read where processes start
    chosen, missed = sys.argv[1:], 0  # letters, or numbers of faults
    for k, fault in enumerate(FAULTS):
        if chosen and fault.letter not in chosen and str(k) not in chosen:
            continue
        found = apart(k)
        missed += not found
        print(f"{fault.letter} {fault.number:>3} {fault.what}: {found or 'NOT NOTICED'}", flush=True)
    return min(missed, 1)


if __name__ == "__main__":
    sys.exit(main())
