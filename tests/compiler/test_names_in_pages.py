"""What pages call by name exists: attributes of systems, solutions, fits, components and modules, and options."""

import importlib
import inspect
import pathlib
import re

import diffrax
import pytest

import jaxonomy_dae
from jaxonomy_dae import AcausalDiagram, Component, learning, simulate, solvers
from jaxonomy_dae.run.simulation.solution import Solution
from jaxonomy_dae.run.system.system import AcausalSystem

DOCS = pathlib.Path(__file__).parents[2] / "docs"
PAGES = [path.relative_to(DOCS).as_posix() for path in sorted(DOCS.rglob("*.md"))] + ["llms.txt", "../README.md"]
OWNERS = {
    "self": Component, "system": AcausalSystem, "solution": Solution, "fit": learning.Estimate,
    "problem": learning.Problem, "training": learning.Training, "diagram": AcausalDiagram, "learning": learning,
    "solvers": solvers, "diffrax": diffrax,
}  # fmt: skip
OTHER = {("training", "model"), ("training", "history"), ("solution", "ys")}  # of `minimize`, `solve_dae`


def code(page):
    """The code in a page: blocks, and what stands in backticks."""
    text = (DOCS / page).read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    return "\n".join([*blocks, *re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S))])


def has(owner, name):
    annotated = (getattr(c, "__annotations__", {}) for c in inspect.getmro(owner)) if inspect.isclass(owner) else ()
    return hasattr(owner, name) or any(name in names for names in annotated)


@pytest.mark.parametrize("page", PAGES)
def test_attributes_exist(page):
    called = set(re.findall(rf"(?<![\w./])({'|'.join(OWNERS)})\.([A-Za-z]\w*)", code(page))) - OTHER
    # In components of the pages, what they declare themselves is an attribute too.
    declared = set(re.findall(r'self\.\w+\("(\w+)"', code(page))) | set(re.findall(r"self\.(\w+) = ", code(page)))
    missing = [f"{o}.{n}" for o, n in called if not has(OWNERS[o], n) and not (o == "self" and n in declared)]
    assert not missing


@pytest.mark.parametrize("page", PAGES)
def test_imports_exist(page):
    for module, names in re.findall(r"from (jaxonomy_dae[\w.]*) import ([\w, ]+)", code(page)):
        found = importlib.import_module(module)
        for name in names.split(","):
            assert hasattr(found, name.strip()) or importlib.util.find_spec(f"{module}.{name.strip()}"), name


@pytest.mark.parametrize("page", PAGES)
def test_options_of_simulate_exist(page):
    known = {*inspect.signature(simulate).parameters}
    for call in re.findall(r"(?<![\w.])simulate\(((?:[^()]|\([^()]*\))*)\)", code(page)):
        given = re.findall(r"(?:^|,)\s*(\w+)=", re.sub(r"[\[({][^\[\](){}]*[\])}]", "", call))
        assert not {*given} - known, call


def test_public_names_are_not_taken_for_granted():
    assert not has(learning, "fit_least_squares") and has(learning.Estimate, "minimum") and has(Solution, "stats")
    assert hasattr(jaxonomy_dae, "simulate")
