"""The same model gives the same system: whatever the hash seed, whatever the names."""

import json
import random
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from problems import drag_on, environment, oscillator, pendulum, rc_circuit
from shared_models import ladder
from test_broken_models import draw_recipe, names_of, outcome
from test_explained_structure import CASES


def systems():
    """One system for each kind of lowering: projected, minimal with a row injection, linear blocks, plain."""
    minimal = {"state_selection": "dummy_derivatives", "prefer_states": ["pend.vx"]}
    yield "pendulum", pendulum(drag_on("vx", "vy"))
    yield "row", pendulum(drag_on("vx", inject="row"), compiler=minimal)
    yield "ladder", ladder()
    yield "oscillator", oscillator()


@eqx.filter_jit
def numbers(system, x):
    """A consistent start and a slope."""
    return system.initialize(), system.vector_field(0.25, x)


def everything(system) -> dict:
    """All that must not change: order, names, report, digest, and numbers to the last bit."""
    x = 0.3 + 0.1 * jnp.arange(system.plan.n_state, dtype=float)
    return {
        "states": system.states,
        "carried": system.carried,
        "algebraics": system.algebraics,
        "variables": system.variables,
        "parameters": system.parameters.names,
        "report": str(system.report),
        "digest": system.plan.digest,
        "numbers": [v.hex() for array in numbers(system, x) for v in np.asarray(array).tolist()],
    }


def broken() -> list[str]:
    """What becomes of random models, most of them broken: the error's text, or the report and the digest."""
    out = []
    for seed in range(40):
        recipe = draw_recipe(random.Random(seed))
        system, text = outcome(recipe, names_of(recipe))
        out.append(f"{system.report}\n{system.plan.digest}" if system else text)
    return out


# --- hash seeds --------------------------------------------------------------------------------------------------

PROGRAM = """
import json, jax
jax.config.update("jax_enable_x64", True)
from test_determinism import broken, everything, systems
from test_explained_structure import texts
found = {name: everything(system) for name, system in systems()}
print(json.dumps(found | {"texts": texts(), "broken": broken()}))
"""


def start_with_seed(seed):
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        env=environment(PYTHONHASHSEED=str(seed)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    "seeds", [pytest.param((0, 1), id="two"), pytest.param((0, 1, 2, 3, 4), id="five", marks=pytest.mark.slow)]
)
def test_the_hash_seed_changes_nothing(seeds):
    processes = [start_with_seed(seed) for seed in seeds]
    outputs = [process.communicate(timeout=300) for process in processes]
    for process, (_, errors) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, errors
    results = [json.loads(out) for out, _ in outputs]
    assert set(results[0]) == {name for name, _ in systems()} | {"texts", "broken"}
    assert results[0]["texts"] == {name: text for name, (_, text) in CASES.items()}
    assert results[0]["broken"] == broken()
    for other in results[1:]:
        for name, expected in results[0].items():
            assert other[name] == expected, name


def test_compiling_twice_gives_equal_systems():
    for (_, first), (_, second) in zip(systems(), systems(), strict=True):
        assert first.plan == second.plan and hash(first.plan) == hash(second.plan)
        assert str(first.report) == str(second.report)


# --- names -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["a", "Z9", "_", "vx", "lambda", "E", "sin", "I", "pi", "time", "der", "q-1", "Größe", "x-0", "0"]
)
@pytest.mark.parametrize("mode", ["auto", "dummy_derivatives"])
def test_a_components_name_changes_nothing(name, mode):
    options = {"compiler": {"state_selection": mode}}
    expected, renamed = pendulum(drag_on("vx"), **options), pendulum(drag_on("vx"), name=name, **options)

    def as_pend(text):
        return text.replace("pend", name)

    assert str(renamed.report) == as_pend(str(expected.report))
    for attribute in ("states", "carried", "algebraics", "variables", "inputs"):
        assert getattr(renamed, attribute) == [as_pend(n) for n in getattr(expected, attribute)]
    assert renamed.parameters.names == [as_pend(n) for n in expected.parameters.names]
    x = 0.3 + 0.1 * jnp.arange(expected.plan.n_state, dtype=float)
    if name == "lambda":  # the numbers cost a compilation
        for found, wanted in zip(numbers(renamed, x), numbers(expected, x), strict=True):
            np.testing.assert_array_equal(found, wanted)


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
    assert [renamed_back(n) for n in renamed.plan.quantity_name] == expected.plan.quantity_name


def test_equal_circuits_of_different_values_have_one_structure():
    assert rc_circuit(R=1.0).plan == rc_circuit(R=2.0).plan
    assert rc_circuit().plan != ladder(stages=1).plan
