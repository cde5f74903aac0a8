"""Files that publish the package say the same: its version, what it needs, where it is."""

import json
import re
import tomllib

import pytest
from problems import ROOT

import jaxonomy_dae

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RECIPE = (ROOT / "conda" / "meta.yaml").read_text()
CITATION = (ROOT / "CITATION.cff").read_text()
ZENODO = json.loads((ROOT / ".zenodo.json").read_text())
HOME = PROJECT["urls"]["Homepage"]


@pytest.mark.parametrize(
    "version",
    [
        re.findall(r'set version = "(.*)"', RECIPE),
        re.findall(r"^version: (.*)", CITATION, re.MULTILINE),
        [ZENODO["version"]],
        re.findall(r"^## (\d.*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[:1],
    ],
    ids=["conda", "citation", "zenodo", "changelog"],
)
def test_one_version(version):
    assert version == [jaxonomy_dae.__version__]


def test_the_recipe_needs_what_the_package_needs():
    needed = re.findall(r"^    - (\S+) >=(\S+)$", RECIPE.partition("  run:\n")[2].partition("test:\n")[0], re.MULTILINE)
    python = PROJECT["requires-python"].removeprefix(">=")
    assert sorted(needed) == sorted([("python", python), *(tuple(d.split(">=")) for d in PROJECT["dependencies"])])


def test_one_address():
    documentation = PROJECT["urls"]["Documentation"]
    assert all(url.startswith((HOME, documentation)) for url in PROJECT["urls"].values())
    assert f"home: {HOME}" in RECIPE and f"doc_url: {documentation}" in RECIPE
    assert f"repository-code: {HOME}" in CITATION and f"url: {documentation}" in CITATION
    assert ZENODO["related_identifiers"][0]["identifier"] == HOME
    assert f"site_url: {documentation}" in (ROOT / "mkdocs.yml").read_text()
    assert HOME.endswith(re.findall(r'^REPOSITORY = "(.*)"', (ROOT / "docs/gallery.py").read_text(), re.MULTILINE)[0])


def test_every_python_that_is_named_is_tried():
    said = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)}
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    assert said == set(json.loads(re.findall(r"python: (\[.*\])", workflow)[0])) and "3.14" in said


def test_the_section_of_a_first_version_is_short():
    section = (ROOT / "CHANGELOG.md").read_text().partition("## 0.1.0")[2].partition("\n## ")[0]
    assert 1_000 < len(section.encode()) <= 9_000
