"""The same model gives the same system: whatever the hash seed, whatever the names."""

import functools
import json
import os
import random
import subprocess
import sys

import pytest
from problems import drag_on, environment, oscillator, pendulum, rc_circuit
from recipes import draw_recipe, names_of, outcome
from shared_models import ladder
from test_explained_structure import CASES

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der


def systems():
    """One system for each kind of lowering: projected, minimal with a row injection, linear blocks, plain."""
    minimal = {"state_selection": "dummy_derivatives", "prefer_states": ["pend.vx"]}
    yield "pendulum", pendulum(drag_on("vx", "vy"))
    yield "row", pendulum(drag_on("vx", inject="row"), compiler=minimal)
    yield "ladder", ladder()
    yield "oscillator", oscillator()


@functools.cache
def compiled_before():
    return dict(systems())


def everything(system) -> dict:
    """All that must not change: order, names, report and digest."""
    return {
        "states": system.states,
        "carried": system.carried,
        "algebraics": system.algebraics,
        "variables": system.variables,
        "parameters": system.parameters.names,
        "report": str(system.report),
        "digest": system.plan.digest,
    }


def broken(count) -> list[str]:
    """What becomes of random models, most of them broken: the error's text, or the report and the digest."""
    out = []
    for seed in range(count):
        recipe = draw_recipe(random.Random(seed))
        system, text = outcome(recipe, names_of(recipe))
        out.append(f"{system.report}\n{system.plan.digest}" if system else text)
    return out


# --- hash seeds --------------------------------------------------------------------------------------------------

COMPILED = """
import json, sys, jax
jax.config.update("jax_enable_x64", True)
from test_determinism import broken, everything, systems
from test_explained_structure import texts
found = {name: everything(system) for name, system in systems()}
found |= {"texts": texts(), "broken": broken(int(sys.argv[1]))}
"""
# A start and a slope of each system, to the last bit.
COMPUTED = """
from test_same_numbers import digits
found |= {f"numbers of {name}": digits(system) for name, system in systems()}
"""


def found_with_seed(seed, count, program=COMPILED):
    return subprocess.Popen(
        [sys.executable, "-c", program + "print(json.dumps(found))", str(count)],
        env=environment(PYTHONHASHSEED=str(seed)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def read(process):
    out, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return json.loads(out)


@pytest.mark.long("a Python that imports everything and compiles models of every kind")
def test_the_hash_seed_changes_nothing():
    """Another Python with a seed that is not this one's."""
    seed = "1" if os.environ.get("PYTHONHASHSEED") == "0" else "0"
    process = found_with_seed(seed, 10)
    here = {name: everything(system) for name, system in compiled_before().items()} | {"broken": broken(10)}
    found = read(process)
    assert found.pop("texts") == {name: text for name, (_, text) in CASES.items()}
    assert set(found) == set(here)
    for name, expected in here.items():
        assert found[name] == expected, name


@pytest.mark.slow
def test_many_hash_seeds_change_nothing():
    """The same with more models, and with numbers."""
    processes = [found_with_seed(seed, 40, COMPILED + COMPUTED) for seed in range(4)]
    first, *others = [read(process) for process in processes]
    assert first["texts"] == {name: text for name, (_, text) in CASES.items()}
    assert {f"numbers of {name}" for name, _ in systems()} <= set(first)
    for other in others:
        for name, expected in first.items():
            assert other[name] == expected, name


def test_compiling_twice_gives_equal_systems():
    for (_, first), (_, second) in zip(compiled_before().items(), systems(), strict=True):
        assert first.plan == second.plan and hash(first.plan) == hash(second.plan)
        assert str(first.report) == str(second.report)


# --- names -------------------------------------------------------------------------------------------------------


@functools.cache
def dragged(name):
    return pendulum(drag_on("vx"), name=name)


NAMES = ["lambda", "E", "I", "time", "q-1", "0"]
MORE_NAMES = ["a", "Z9", "_", "vx", "sin", "pi", "der", "Größe", "x-0"]


@pytest.mark.parametrize("name", [*NAMES, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE_NAMES)])
def test_a_components_name_changes_nothing(name):
    expected, renamed = dragged("pend"), dragged(name)

    def as_pend(text):
        return text.replace("pend", name)

    assert str(renamed.report) == as_pend(str(expected.report))
    for attribute in ("states", "carried", "algebraics", "variables", "inputs"):
        assert getattr(renamed, attribute) == [as_pend(n) for n in getattr(expected, attribute)]
    assert renamed.parameters.names == [as_pend(n) for n in expected.parameters.names]


def test_names_order_nothing():
    """Names in the opposite alphabetical order: every list keeps its order."""
    expected = ladder()
    plain = ["source", "ground", *(f"{kind}{k}" for k in range(3) for kind in ("l", "r", "c", "d"))]
    other = [f"n{99 - k}n" for k in range(len(plain))]
    renamed = ladder(other)

    def renamed_back(text):
        for new, old in zip(other, plain, strict=True):
            text = text.replace(new, old)
        return text

    assert renamed_back(str(renamed.report)) == str(expected.report)
    assert [renamed_back(n) for n in renamed.states] == expected.states
    assert [renamed_back(n) for n in renamed.variables] == expected.variables
    assert [*map(renamed_back, renamed.plan.quantity_name)] == list(expected.plan.quantity_name)


def test_equal_circuits_of_different_values_have_one_structure():
    assert rc_circuit(R=1.0).plan == rc_circuit(R=2.0).plan
    assert rc_circuit().plan != ladder(stages=1).plan


def _with(**given):
    """Two states and a relation between them, whose guesses cannot all hold."""

    class Part(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, y = self.variable("x", start=1.0, **given), self.variable("y", start=2.0, unit="m")
            z = self.variable("z", start=0.5, fixed=True)
            self.add_equations(der(x) + x, der(y) + y, z - x - y)

    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(Part(ev, "c")))()


def test_what_is_read_of_a_plan_tells_plans_apart():
    """Guesses of one unit are measured by the largest of them: of two models in one process that differed in `unit=`
    alone, the second one started where the first one would have."""
    plans = [_with(unit="m").plan, _with(unit="km").plan, _with(unit="m", nominal=10.0).plan]
    assert len(set(plans)) == len({plan.digest for plan in plans}) == 3
    assert _with(unit="m").plan == plans[0]
