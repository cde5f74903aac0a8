"""Linear DAEs of known index and as many known modes, mixed (`shared_models.Pencil`): what their structure tells."""

import dataclasses

import hypothesis
import hypothesis.strategies as st
import pytest
from pencils import pencils
from shared_models import written

from jaxonomy_dae import AcausalDiagram, Component
from jaxonomy_dae.compile.lowering.lower import lower
from jaxonomy_dae.compile.passes.flatten import flatten
from jaxonomy_dae.compile.passes.pipeline import compile_flat
from jaxonomy_dae.run.system.report import SystemReport


def plan_of(component: Component):
    """The plan, without anything compiled by XLA."""
    diagram = AcausalDiagram().add(component)
    return lower(compile_flat(flatten(diagram), "auto", ()))


EXAMPLES = pytest.mark.parametrize("examples", [5, pytest.param(25, marks=pytest.mark.slow)])


@EXAMPLES
def test_index_and_freedom_of_permuted_pencils(examples):
    """Where nothing cancels, the structure tells the index and the degrees of freedom."""
    check = hypothesis.given(pencils(mixed=False, largest=7))(check_permuted)
    hypothesis.settings(max_examples=examples)(check)()


def check_permuted(pencil):
    report = SystemReport(plan_of(written(pencil)))
    assert report.degrees_of_freedom == pencil.dynamic
    assert report.index == max(pencil.blocks, default=0)


@EXAMPLES
def test_freedom_of_mixed_pencils(examples):
    """Whatever cancels, there are as many states as dynamic modes; order and names of anything change nothing."""
    check = hypothesis.given(pencils(), st.randoms(use_true_random=False))(check_mixed)
    hypothesis.settings(max_examples=examples)(check)()


def check_mixed(pencil, rng):
    report = SystemReport(plan_of(written(pencil)))
    assert report.degrees_of_freedom == len(report.states) == pencil.dynamic
    shuffled = dataclasses.replace(
        pencil,
        rows=tuple(rng.sample(range(pencil.n), pencil.n)),
        columns=tuple(rng.sample(range(pencil.n), pencil.n)),
    )
    names = [f"{'zabq'[k % 4]}{rng.randrange(1000)}_{k}" for k in range(pencil.n)]
    other = SystemReport(plan_of(written(shuffled, "other", names)))
    assert other.degrees_of_freedom == len(other.states) == pencil.dynamic
    assert other.index == report.index
