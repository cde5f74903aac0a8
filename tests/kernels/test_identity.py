"""Which models share compiled programs: those of one structure, and no others.

Kind of defect: identity was a list kept by hand of what counts, which forgot the bounds of parameters, so that a model
ran the program of another; and a choice made from values was kept under what knows no values.
"""

import dataclasses
import inspect
import pickle
import types
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sympy import Eq

from benchmarks.attack.invariance.declarations import NOTHING, PAIRS, STRUCTURE, Law, built, falling, model, rising
from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    NeuralDAEBlock,
    assign,
    der,
    reinit,
    simulate,
    terminate,
)
from jaxonomy_dae.compile.model.identity import Identity
from jaxonomy_dae.compile.model.tables import Declared

# What says nothing of one declaration: how parts are put together, and what reads names.
ELSEWHERE = {"add", "connect", "symbol", "outside_path", "add_equations"}


def arguments() -> Iterator[str]:
    """All arguments of all public declarations."""
    named = [(n, getattr(Component, n)) for n in dir(Component) if not n.startswith("_") and n not in ELSEWHERE]
    named += [(f.__name__, f) for f in (NeuralDAEBlock, AcausalCompiler, AcausalDiagram, reinit, assign, terminate)]
    for name, function in named:
        if callable(function):
            yield from (f"{name}.{p}" for p in inspect.signature(function).parameters)


def test_every_argument_of_every_declaration_is_tried():
    left_out = {"ev", "diagram", "self", "kind", "args"}
    wanted = {n for n in arguments() if n.partition(".")[2] not in left_out or n in ("learned.kind", "when.actions")}
    assert wanted <= set(PAIRS), sorted(wanted - set(PAIRS))


@pytest.mark.parametrize("name", PAIRS)
def test_models_share_programs_if_they_differ_in_values_alone(name):
    """Of two models that differ in one argument: plans are equal if it is a value, and differ if it is structure; an
    equal plan says the same of all that is static."""
    (one, other), kind = PAIRS[name]
    a, b, again = built(one), built(other), built(one)
    assert a.plan == again.plan and hash(a.plan) == hash(again.plan) and a.plan.digest == again.plan.digest
    assert jax.tree.structure(a) == jax.tree.structure(again)
    assert (a.plan == b.plan) == (kind != STRUCTURE)
    if kind == STRUCTURE:
        return
    numbers = [jax.tree.leaves((s.parameters, s.neural)) for s in (a, b)]
    same = jax.tree.structure(a.neural) == jax.tree.structure(b.neural)
    same = same and all(p is q or np.array_equal(p, q) for p, q in zip(*numbers, strict=True))
    assert same == (kind == NOTHING)
    assert a.variables == b.variables and a.parameters.names == b.parameters.names


def parts(tree: Any, seen: dict[int, Any] | None = None) -> Iterator[Any]:
    """All objects that can be reached by attributes, items and closures."""
    seen = {} if seen is None else seen
    if id(tree) in seen or isinstance(tree, str | bytes | int | float | type(None) | type | types.ModuleType):
        return
    seen[id(tree)] = tree
    yield tree
    inside: list[Any] = []
    if isinstance(tree, dict):
        inside += [*tree, *tree.values()]
    elif isinstance(tree, list | tuple | set | frozenset):
        inside += tree
    elif isinstance(tree, types.FunctionType):
        inside += [c.cell_contents for c in tree.__closure__ or ()]
    elif isinstance(tree, types.MethodType | types.BuiltinMethodType):
        inside.append(tree.__self__)
    else:
        inside += vars(tree).values() if hasattr(tree, "__dict__") else ()
        inside += [getattr(tree, s, None) for k in type(tree).__mro__ for s in getattr(k, "__slots__", ())]
    for one in inside:
        yield from parts(one, seen)


@pytest.mark.parametrize("name", ["learned.network", "NeuralDAEBlock.theta", "when.actions", "add_array.kwargs"])
def test_no_attribute_of_a_plan_leads_to_a_value(name):
    """Plans held the values of parameters and the networks that a model was declared with, and caches held plans."""
    system = built(PAIRS[name][0][0])
    reached = list(parts(system.plan))
    assert len(reached) > 100
    assert not [p for p in reached if isinstance(p, Declared | Component | EqnEnv | jax.Array | Law)]


def test_a_type_that_nobody_thought_of_is_refused():
    """What is not known to the walk cannot be forgotten by it."""
    with pytest.raises(TypeError, match="it is not known what makes two objects of type"):
        Identity.of((1, iter([2])))

    @dataclasses.dataclass
    class Record:
        table: dict[str, Any]

    one, other = (Record({"a": [np.arange(3), v]}) for v in (1, 1.0))
    assert Identity.of(one) != Identity.of(other)
    assert Identity.of(one) == Identity.of(Record({"a": [np.arange(3), 1]}))
    assert Identity.of(["ab", "c"]) != Identity.of(["a", "bc"]) != Identity.of(("a", "bc"))
    assert Identity.of([rising]) != Identity.of([falling]) and Identity.of([rising, 1]) == Identity.of([rising, 1])
    # A number and a vector of one number are two things.
    assert Identity.of(np.array(1.0)) != Identity.of(np.array([1.0]))


def test_identity_survives_a_file():
    for name in ("when.actions", "NeuralDAEBlock.network"):
        system = built(PAIRS[name][0][0])
        assert pickle.loads(pickle.dumps(system)).plan == system.plan


# --- by runs ---------------------------------------------------------------------------------------------------------


def decay(rate: float) -> Callable:
    def write(self):
        k, x = self.parameter("k", rate), self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * (x - 1)))

    return write


def told(system, z):
    """What one program says of a model and a number."""
    x = system.initialize()
    changed = system.constrain({"c.p": z}) if "c.p" in system.parameters else system
    return x, system.vector_field(0.0, x), system.typical_sizes, changed.parameters.array


@pytest.mark.parametrize(
    "name", ["parameter.bounds", "variable.start", "variable.nominal", "input.default", "discrete.start"]
)
def test_what_ran_before_changes_nothing(name):
    """A after B, and B after A, in one function compiled by `jax.jit`, say what each says alone."""
    models = [built(one) for one in PAIRS[name][0]]
    alone = [jax.jit(lambda s, z: told(s, z))(one, 1.5) for one in models]
    for order in ((0, 1), (1, 0)):
        shared = jax.jit(lambda s, z: told(s, z))
        for k in order:
            for got, wanted in zip(shared(models[k], 1.5), alone[k], strict=True):
                np.testing.assert_array_equal(got, wanted)


@pytest.mark.slow
def test_the_choice_of_a_solver_is_no_other_models():
    """The explicit solver that a slow model chose inside `jax.jit` was taken for a stiff one of equal structure, which
    failed after 16,384 steps."""
    slow, stiff = model(decay(1.0)), model(decay(1e6))
    assert slow.plan == stiff.plan
    run = jax.jit(lambda s: simulate(s, 1.0, ts=jnp.array([1.0]), initial={"c.x": 3.0})["c.x"][0])
    assert float(run(slow)) == pytest.approx(1 + 2 * np.exp(-1.0), rel=1e-4)
    assert float(run(stiff)) == pytest.approx(1.0, abs=1e-4)
    assert float(run(slow)) == pytest.approx(1 + 2 * np.exp(-1.0), rel=1e-4)
    other = model(decay(1.5))  # of the same decade
    assert jax.tree.structure(other) == jax.tree.structure(slow) != jax.tree.structure(stiff)
