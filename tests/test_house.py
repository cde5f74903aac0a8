"""The rooms of the package import one way: docs/development.md draws them in this order."""

import ast
import graphlib
from pathlib import Path

import jaxonomy_dae

ROOT = Path(jaxonomy_dae.__file__).parent
ORDER = [
    "errors", "optional", "programs", "expressions", "units", "modeling", "structure", "linear", "adjoint", "solvers",
    "hybrid",
    "model", "diagnosis", "compiler", "lowering", "system", "initialization", "simulation", "learning", "analysis",
    "plotting", "testing", "library",
]  # fmt: skip
# Methods that hand over to a room above their own, when they are called.
DEFERRED = {("system", "initialization"), ("simulation", "plotting")}


def modules() -> dict[tuple[str, ...], Path]:
    return {path.relative_to(ROOT).with_suffix("").parts: path for path in sorted(ROOT.rglob("*.py"))}


def imports(name: tuple[str, ...], path: Path, everywhere: bool):
    """The package's own modules that a module imports; only when it is imported itself, unless `everywhere`."""
    tree = ast.parse(path.read_text())
    nodes = ast.walk(tree) if everywhere else _at_import(tree)
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.level:
            base = name[: len(name) - node.level] + tuple((node.module or "").split(".") if node.module else ())
            for alias in node.names:
                whole = (*base, alias.name)
                yield whole if whole in modules() else base


def _at_import(tree: ast.AST):
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        yield node
        yield from _at_import(node)


def test_every_room_is_in_the_order():
    assert {name[0] for name in modules()} - {"__init__"} == set(ORDER)


def test_imports_run_one_way():
    upward = [
        f"{'/'.join(name)} imports {'/'.join(target)}"
        for name, path in modules().items()
        if name[0] != "__init__"
        for target in imports(name, path, everywhere=True)
        if ORDER.index(target[0]) > ORDER.index(name[0]) and (name[0], target[0]) not in DEFERRED
    ]
    assert not upward


def test_no_circle_of_modules():
    packages = {name[:-1] for name in modules() if name[-1] == "__init__"}
    graph = {
        name: {t if t not in packages else (*t, "__init__") for t in imports(name, path, everywhere=False)} - {name}
        for name, path in modules().items()
        if name[-1] != "__init__"
    }
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError
