"""Counts the classes of the Modelica Standard Library that tests of plants use.

    python -m benchmarks.modelica_classes_in_tests

The tests run with a library and a diagram that note what is asked for and answer with stand-ins, up to the point where
a model would be compiled.
"""

import collections
import importlib
import re
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

TESTS = Path(__file__).parent.parent / "tests"
MODULES = sorted(file.stem for file in (TESTS / "plants").glob("test_standard_library*.py"))


class Noted:
    """Stands for a library, and notes the classes that are asked for."""

    def __init__(self):
        self.names: set[str] = set()

    def __getitem__(self, name: str) -> MagicMock:
        return self.component(name)

    def component(self, name: str, *texts: str, source: str | None = None, **modifications) -> MagicMock:
        inside = re.findall(r"\bModelica(?:\.\w+)+(?=\s*(?:\([^;]*\)\s*)?\w*\s*[(;])", source or "")
        self.names |= set(inside) if source is not None else {name}
        return MagicMock()


class _Compiled(Exception):
    pass


def _compile(*arguments, **options):
    raise _Compiled


def main() -> int:
    sys.path[:0] = [str(TESTS), str(TESTS / "plants")]
    noted = Noted()
    for module in MODULES:
        _asked_for(importlib.import_module(module), noted)
    classes = sorted(n for n in noted.names if n.startswith("Modelica."))
    packages = collections.Counter(".".join(n.split(".")[1:3]) for n in classes)
    for package, count in sorted(packages.items()):
        print(f"{count:4} {package}")
    print(f"{len(classes)} classes of {len(packages)} packages")
    return 0


def _asked_for(tests: Any, noted: Noted) -> None:
    """Runs the tests of a module up to what they compile."""
    tests.AcausalCompiler = _compile
    for name in (
        "AcausalDiagram",
        "EqnEnv",
        "Constant",
        "Integrator",
        "Ramp",
        "Step",
        "electrical",
        "rotational",
        "thermal",
        "translational",
    ):
        if hasattr(tests, name):
            setattr(tests, name, MagicMock())
    for name, test in vars(tests).copy().items():
        if name.startswith("test_"):
            try:
                test(noted)
            except _Compiled:
                pass
            except Exception as error:
                print(f"{name} ends with {type(error).__name__} {error}".rstrip())


if __name__ == "__main__":
    sys.exit(main())
