"""Singular or regular: one verdict, on every kernel of BLAS, and with every entry of the start off by some roundings.

A parallelogram in line was accepted or refused by the processor's kernels: entries that were rounding errors were
scaled to size one.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from problems import component
from verdicts import MODELS, verdict

import jaxonomy_dae
from jaxonomy_dae import AcausalDiagram, der
from jaxonomy_dae.compile.lowering.lower import lower
from jaxonomy_dae.compile.passes.flatten import flatten
from jaxonomy_dae.compile.passes.pipeline import compile_flat
from jaxonomy_dae.run.start.singular_blocks import examine_blocks

CASES = [(name, mode) for name, model in MODELS.items() for mode in model.modes]


@pytest.mark.parametrize("name, mode", CASES)
def test_roundings_do_not_decide(name, mode):
    model = MODELS[name]
    assert {verdict(model.make(), mode, seed) for seed in (None, 0)} == {model.expected}


@pytest.mark.slow
@pytest.mark.parametrize("name, mode", CASES)
def test_other_roundings_do_not_decide(name, mode):
    model = MODELS[name]
    assert {verdict(model.make(), mode, seed) for seed in range(1, 6)} == {model.expected}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kernel", ["Haswell", *(pytest.param(name, marks=pytest.mark.slow) for name in ("Nehalem", "Zen", "Sandybridge"))]
)
def test_the_processor_does_not_decide(kernel):
    """OpenBLAS has kernels for each processor, whose results differ in the last digits; those that this processor does
    not have the instructions for end the process."""
    package = Path(jaxonomy_dae.__file__).parents[1]
    path = os.pathsep.join(map(str, (package, Path(__file__).parents[2] / "benchmarks")))
    environment = os.environ | {"OPENBLAS_CORETYPE": kernel, "JAX_ENABLE_X64": "1", "PYTHONPATH": path}
    script = Path(__file__).with_name("verdicts.py")
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True)
    if done.returncode < 0:
        pytest.skip(f"this processor does not run OpenBLAS' kernels for {kernel}: signal {-done.returncode}")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert set(found.values()) == {"refused"} and len(found) > 10


@pytest.mark.parametrize("k", [1.0, 1e6])
def test_causes_do_not_depend_on_units(k):
    """The null vectors of the scaled matrix were taken for those of the block itself: with unknowns of different sizes,
    a parameter that only multiplies an equation was said to make the block singular, and the variable that does was
    not."""

    def write(self, ev):
        z, x, y = self.variable("z", start=3.0, fixed=True), self.variable("x"), self.variable("y")
        self.add_equations(der(z) + z, self.parameter("p", 2.0) * (x + k * y) - 1, x + (k + z - 3) * y - 2)

    flat = flatten(AcausalDiagram().add(component(write)))
    plan = lower(compile_flat(flat, "auto", ()))
    (finding,) = examine_blocks(plan, flat.declares.values, (), 0.0, np.array([3.0]), lambda: np.zeros(0))
    assert finding.singular and set(finding.variables) == {"c.x", "c.y"}
    assert finding.causes == (("c.z", 3.0),)
