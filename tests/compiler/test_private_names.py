"""Everything private of Diffrax and Equinox passes through one file, and only versions that were tried are trusted."""

import ast
import importlib.metadata
from pathlib import Path

import diffrax
import pytest

import jaxonomy_dae
from jaxonomy_dae.adjoint import private_names

PACKAGE = Path(jaxonomy_dae.__file__).parent
LIBRARIES = ("diffrax", "equinox", "optimistix", "lineax", "jax")


@pytest.mark.parametrize("name", LIBRARIES)
def test_version_was_tried(name):
    found = importlib.metadata.version(name)
    assert found in private_names.TRIED[name], (
        f"{name} {found} is new: run all tests, look at what adjoint/private_names.py takes from it, add it to TRIED"
    )


def imported(tree: ast.AST):
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def is_private(name: str) -> bool:
    library, *rest = name.split(".")
    return library in LIBRARIES and any(part.startswith("_") or part == "internal" for part in rest)


def test_no_other_file_imports_them():
    found = {
        (path.relative_to(PACKAGE).as_posix(), name)
        for path in PACKAGE.rglob("*.py")
        for name in imported(ast.parse(path.read_text()))
        if is_private(name)
    }
    assert {path for path, _ in found} == {"adjoint/private_names.py"}, found


def test_what_has_no_name_is_as_expected():
    assert callable(getattr(diffrax.RecursiveCheckpointAdjoint(), "_loop"))  # noqa: B009
    saved = set(private_names.SaveState.__dataclass_fields__)
    assert {"ts", "ys", "save_index", "saveat_ts_index"} <= saved
    assert callable(private_names.equinox_errors.branched_error_if)
