"""The rooms of the package import one way: docs/development.md draws them in this order."""

import ast
import fnmatch
import functools
import graphlib
from pathlib import Path

import jaxonomy_dae

ROOT = Path(jaxonomy_dae.__file__).parent
ORDER = [
    "errors", "optional", "aliases", "tolerances", "private_names", "programs", "expressions", "units", "modeling",
    "structure", "judgement", "linear", "adjoint", "solvers", "hybrid", "model", "diagnosis", "compiler", "lowering",
    "system", "initialization", "simulation", "learning", "analysis", "plotting", "testing", "library", "modelica",
]  # fmt: skip
# Methods that hand over to a room above their own, when they are called.
DEFERRED = {("system", "initialization"), ("simulation", "plotting"), ("analysis", "plotting")}
# Imports inside a function, or for types alone, that close a circle of modules; and why they are there. Patterns stand
# for several modules.
CLOSING = {
    ("simulation/solution", "simulation/energy_balance"): "the balance of a solution is that of a second run",
    ("learning/*", "learning/estimate"): "an estimate's methods call the modules that read it",
    ("learning/estimate", "learning/problem"): "a problem makes the estimates that know it",
    ("learning/estimate", "learning/posterior"): "an estimate's method, with an optional package",
}


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


@functools.cache
def graph(everywhere: bool) -> dict[str, frozenset[str]]:
    """Modules by the modules that they import, `room/module`."""
    packages = {name[:-1] for name in modules() if name[-1] == "__init__"}

    def targets(name: tuple[str, ...], tree: ast.AST):
        found = imports(name, tree, everywhere)
        return frozenset("/".join((*t, "__init__") if t in packages else t) for t in found) - {"/".join(name)}

    return {"/".join(name): targets(name, tree) for name, tree in modules().items() if name[-1] != "__init__"}


def test_no_circle_of_modules():
    list(graphlib.TopologicalSorter(graph(everywhere=False)).static_order())  # raises CycleError


def test_no_circle_but_those_that_are_listed():
    """Imports inside functions, and those for types alone, count too: they hide a circle, and do not open it."""
    used = set()

    def is_listed(name: str, target: str) -> bool:
        for pair in CLOSING:
            if all(fnmatch.fnmatch(a, b) for a, b in zip((name, target), pair, strict=True)):
                used.add(pair)
                return True
        return False

    at_import = graph(everywhere=False)
    opened = {
        name: {t for t in targets if t in at_import[name] or not is_listed(name, t)}
        for name, targets in graph(everywhere=True).items()
    }
    list(graphlib.TopologicalSorter(opened).static_order())
    assert used == set(CLOSING), "listed, but no longer there"
