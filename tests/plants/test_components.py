"""Every component of the library is checked against something that this package did not compute."""

import functools
import pathlib

import numpy as np
import pytest
from component_references import CHECKS, Measurement, checks, import_checks, measured
from library_pages import classes_of, domains

from jaxonomy_dae import Component
from jaxonomy_dae.library.signal import Gain

TESTS = pathlib.Path(__file__).parents[1]
COMPONENTS = [cls for domain in domains() for cls in classes_of(domain)]


@functools.cache
def declared() -> dict[type[Component], list[str]]:
    """The checks of each component; test files are imported for what they declare."""
    import_checks()
    found: dict[type[Component], list[str]] = {}
    for name, check in CHECKS.items():
        for cls in check.references:
            found.setdefault(cls, []).append(name)
    return found


@pytest.mark.parametrize("cls", COMPONENTS, ids=lambda cls: f"{cls.__module__.split('.')[2]}.{cls.__name__}")
def test_every_component_has_a_reference(cls):
    assert declared().get(cls), f"no test declares a reference for {cls.__module__}.{cls.__name__}: see `checks`"


def test_every_reference_is_of_a_component():
    assert {*declared()} <= {*COMPONENTS}


def test_the_table_has_every_reference():
    """docs/components.md is written by `python -m benchmarks.components`."""
    declared()
    page = (TESTS.parent / "docs" / "components.md").read_text()
    for name, check in CHECKS.items():
        if name.startswith("test_"):
            assert f"`{name}`: {check.origin}." in page, f"{name} is not in the table: write it again"
            for cls, (text, _) in check.references.items():
                domain = cls.__module__.split(".")[2]
                assert f"| [{cls.__name__}](library/{domain}.md#{cls.__name__.lower()}) | {text} |" in page


def test_a_declaration_that_nothing_measures():
    def test():
        measured("seen", [1.0, 2.0], [1.0, 2.5], 0.6)

    before = dict(CHECKS)
    try:
        kept = checks({Gain: ("arithmetic", "seen")}, origin="none")(test)
        kept()
        assert CHECKS[f"{__name__}.test"].run() == {"seen": Measurement(0.2, 0.24)}
        with pytest.raises(AssertionError, match=r"declares \['unseen'\] but does not measure it"):
            checks({Gain: ("arithmetic", "seen", "unseen")}, origin="none")(test)()
    finally:
        CHECKS.clear()
        CHECKS.update(before)


def test_an_error_beyond_its_tolerance():
    with pytest.raises(AssertionError, match="voltage"):
        measured("voltage", 1.0 + 1e-8, 1.0, 1e-9)
    with pytest.raises(AssertionError, match="say what its error is relative to"):
        measured("voltage", 0.0, np.zeros(3), 1e-9)
