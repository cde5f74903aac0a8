"""What the components of the library are checked against.

A test that checks components against something that this package did not compute says so, with `checks`, and hands what
it compares to `measured`. `python -m benchmarks.components` runs these tests and writes docs/components.md.
"""

import functools
import importlib
import pathlib
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxonomy_dae import Component


class Measurement(NamedTuple):
    """A comparison: the largest error and the error allowed, both relative to the largest value of the reference."""

    error: float
    allowed: float


class Check(NamedTuple):
    """A test with independent references.

    `references` maps components to what they are compared with, and to the measurements that depend on them. `origin`
    says where the tolerance comes from. `arguments` make those of the test, for whoever runs it without pytest.
    """

    test: Callable[..., None]
    references: Mapping[type[Component], tuple[str, tuple[str, ...]]]
    origin: str
    arguments: Mapping[str, Callable[[], Any]]

    @property
    def name(self) -> str:
        return f"{self.test.__module__}.{self.test.__name__}"

    def run(self) -> dict[str, Measurement]:
        """Runs the test; returns what it measured."""
        self.test(**{name: make() for name, make in self.arguments.items()})
        return MEASURED[self.name]


CHECKS: dict[str, Check] = {}
MEASURED: dict[str, dict[str, Measurement]] = {}
_running: list[dict[str, Measurement]] = []


def checks(
    references: Mapping[type[Component], tuple[str, ...]], *, origin: str, **arguments: Callable[[], Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Declares what a test checks: {component: (reference, measurement, …)}.

    The test fails if it ends without one of the measurements. Every component that is declared in another check too
    has a row for each.
    """

    def declare(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def run(*args: Any, **kwargs: Any) -> None:
            found: dict[str, Measurement] = {}
            _running.append(found)
            try:
                test(*args, **kwargs)
            finally:
                _running.pop()
            missing = {label for _, labels in check.references.values() for label in labels} - {*found}
            assert not missing, f"{check.name} declares {sorted(missing)} but does not measure it"
            MEASURED[check.name] = found

        split = {cls: (text, tuple(labels)) for cls, (text, *labels) in references.items()}
        assert all(text and labels for text, labels in split.values())
        check = Check(run, split, origin, arguments)
        CHECKS[check.name] = check
        return run

    return declare


def import_checks() -> None:
    """Imports the test files of all rooms that declare references."""
    here = pathlib.Path(__file__).parent
    for path in sorted(here.rglob("test_*.py")):
        if "from component_references import checks" in path.read_text():
            if str(path.parent) not in sys.path:
                sys.path.append(str(path.parent))
            importlib.import_module(path.stem)


def measured(label: str, found: Any, true: Any, atol: Any, scale: float | None = None) -> None:
    """Asserts that `found` is `true` to `atol`, and keeps the error for the table.

    `scale` is what errors are relative to in the table: the largest value of the reference, if left out.
    """
    found, true, atol = np.asarray(found, float), np.asarray(true, float), np.asarray(atol, float)
    error = np.abs(found - true)
    assert (error <= atol).all(), f"{label}: off by up to {np.max(error):.3g}, where {np.max(atol):.3g} is allowed"
    size = float(np.abs(true).max()) if scale is None else scale
    assert size > 0, f"{label}: the reference is zero; say what its error is relative to"
    if _running:
        one = Measurement(float(error.max()) / size, float(atol.max()) / size)
        _running[-1][label] = max(_running[-1].get(label, one), one)
