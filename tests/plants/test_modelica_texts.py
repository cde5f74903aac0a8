"""Small flat texts, most of them on what happens at an instant, with answers by hand from the Modelica Language
Specification 3.6 (sections 3.7.5, 8.3.5, 8.5, 8.6, 11.2.7, 16.5, appendix B): values at times, or a refusal."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, ModelError, StructuralError, simulate
from jaxonomy_dae.modelica import FlatComponent, load

TEXTS = {c["name"]: c for c in json.loads((Path(__file__).parents[1] / "data" / "modelica_texts.json").read_text())}
QUICK = {"arrays_loops", "while_on_variables"}  # the others wait for slow tests


def compiled(case):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(FlatComponent(ev, "m", load("\n".join(case["text"])), outputs=case.get("outputs", ())))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.parametrize(
    "name",
    [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n, case in TEXTS.items() if "want" in case],
)
def test_a_text_has_the_answer_of_the_specification(name):
    case = TEXTS[name]
    system, times = compiled(case), jnp.array(case["times"])
    run = simulate(system, case["end"], t0=case["start"], ts=times, rtol=1e-9, atol=1e-11)
    for variable, want in case["want"].items():
        key = f"m.{variable}"
        found = run[key] if key in run else np.full(len(want), float(system.parameters[key]))
        np.testing.assert_allclose(found, want, rtol=case["tolerance"], atol=case["tolerance"], err_msg=variable)


@pytest.mark.parametrize("name", [n for n, case in TEXTS.items() if "refused" in case])
def test_a_text_is_refused_by_name(name):
    with pytest.raises((ModelError, StructuralError)) as error:
        compiled(TEXTS[name])
    assert TEXTS[name]["refused"] in str(error.value)
