"""The rooms of the package import one way: docs/development.md draws them in this order."""

import ast
import functools
import graphlib
from pathlib import Path

import jaxonomy_dae

ROOT = Path(jaxonomy_dae.__file__).parent
ORDER = [
    "errors", "optional", "private_names", "programs", "expressions", "units", "modeling", "structure", "judgement",
    "linear", "adjoint", "solvers", "hybrid", "model", "diagnosis", "compiler", "lowering", "system", "initialization",
    "simulation", "learning", "analysis", "plotting", "testing", "library",
]  # fmt: skip
# Methods that hand over to a room above their own, when they are called.
DEFERRED = {("system", "initialization"), ("simulation", "plotting"), ("analysis", "plotting")}


@functools.cache
def modules() -> dict[tuple[str, ...], ast.AST]:
    return {p.relative_to(ROOT).with_suffix("").parts: ast.parse(p.read_text()) for p in sorted(ROOT.rglob("*.py"))}


def imports(name: tuple[str, ...], tree: ast.AST, everywhere: bool):
    """The package's own modules that a module imports; only when it is imported itself, unless `everywhere`."""
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
        for name, tree in modules().items()
        if name[0] != "__init__"
        for target in imports(name, tree, everywhere=True)
        if ORDER.index(target[0]) > ORDER.index(name[0]) and (name[0], target[0]) not in DEFERRED
    ]
    assert not upward


def test_no_circle_of_modules():
    packages = {name[:-1] for name in modules() if name[-1] == "__init__"}
    graph = {
        name: {t if t not in packages else (*t, "__init__") for t in imports(name, tree, everywhere=False)} - {name}
        for name, tree in modules().items()
        if name[-1] != "__init__"
    }
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError
