"""The rooms of the package import one way: docs/development.md draws them in this order."""

import ast
import fnmatch
import functools
import graphlib
import re
from pathlib import Path

import jaxonomy_dae

ROOT = Path(jaxonomy_dae.__file__).parent
# A room, or a part of one; rooms stand together, the lowest first.
ORDER = [
    "base/errors", "base/optional", "base/aliases", "base/tolerances", "base/private_names",
    "host",
    "graph/expressions", "graph/units", "graph/structure", "graph/judgement",
    "write",
    "solve/linear", "solve/adjoint", "solve/methods", "solve/events",
    "compile/model", "compile/diagnosis", "compile/passes", "compile/lowering",
    "run/system", "run/start", "run/simulation",
    "learning", "analysis", "plotting", "testing", "library", "modelica", "fmi",
]  # fmt: skip
FACES = {"__init__", "names", "errors", "linear", "solvers"}  # public names of the rooms below, under short paths
# Methods that hand over to a room above their own, when they are called.
DEFERRED = {
    ("run/system", "run/start"), ("run/simulation", "plotting"), ("analysis", "plotting"), ("run/system", "fmi"),
}  # fmt: skip
# Imports inside a function, or for types alone, that close a circle of modules; and why they are there. Patterns stand
# for several modules.
CLOSING = {
    ("run/system/system", "fmi/export"): "a method of a system writes it as an FMU",
    ("run/system/system", "fmi/plain_c"): "a method of a system writes it as C code",
    ("run/system/system", "fmi/to_casadi"): "a method of a system makes a function of CasADi",
    ("run/simulation/solution", "run/simulation/energy_balance"): "the balance of a solution is that of a second run",
    ("learning/*", "learning/estimate"): "an estimate's methods call the modules that read it",
    ("learning/estimate", "learning/problem"): "a problem makes the estimates that know it",
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


def room(name: tuple[str, ...]) -> str:
    """The entry of `ORDER` that a module stands in; empty for faces, and for a folder that only holds such entries."""
    return next((entry for entry in ("/".join(name[:2]), name[0]) if entry in ORDER), "")


def test_every_module_stands_in_a_room():
    folders = {entry.split("/")[0] for entry in ORDER if "/" in entry}
    apart = {"/".join(name) for name in modules() if not room(name)}
    assert apart == FACES | {f"{folder}/__init__" for folder in folders}
    assert {room(name) for name in modules()} - {""} == set(ORDER)


def test_imports_run_one_way():
    upward = [
        f"{'/'.join(name)} imports {'/'.join(target)}"
        for name, tree in modules().items()
        if room(name)
        for target in imports(name, tree, everywhere=True)
        if (room(name), room(target)) not in DEFERRED
        and (not room(target) or ORDER.index(room(target)) > ORDER.index(room(name)))
    ]
    assert not upward


def test_a_room_stands_in_one_place():
    """Parts of one room follow each other in the order, so that rooms as wholes import one way, too."""
    whole = [entry.split("/")[0] for entry in ORDER]
    assert len([w for w, before in zip(whole, ["", *whole], strict=False) if w != before]) == len(set(whole))


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


def test_the_core_is_what_its_page_says():
    """Files exist, lengths are those given, and the whole can be read in a day."""
    page = (ROOT.parent / "docs" / "core.md").read_text()
    total = 0
    for said, files in re.findall(r"^\| \*\*[^*]+\*\* \(([\d,]+)\) \|([^|]+)\|", page, re.M):
        paths = [ROOT / path for path in re.findall(r"`([^`]+\.py)`", files)]
        lines = sum(len(path.read_text().splitlines()) for path in paths)
        assert abs(lines - int(said.replace(",", ""))) <= 0.05 * lines, f"{lines} lines, the page says {said}: {files}"
        total += lines
    assert 5_000 < total < 11_000


def test_whether_a_value_is_known_is_asked_in_one_place():
    """`host/staging.py` asks it; rooms that compute do not look at JAX' tracers themselves."""
    asking = [
        "/".join(name)
        for name, tree in modules().items()
        if name[0] in ("solve", "run", "learning", "analysis")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "jax.core" and "Tracer" in {a.name for a in node.names}
    ]
    assert not asking


def test_structure_is_found_without_jax():
    """Analysis of structure, passes and diagnoses are plain Python, NumPy and SciPy: nothing is traced there."""
    plain = {"graph/units", "graph/structure", "graph/judgement", "compile/passes", "compile/diagnosis"}
    found = [
        f"{'/'.join(name)} imports {module}"
        for name, tree in modules().items()
        if room(name) in plain
        for node in ast.walk(tree)
        for module in (
            [a.name for a in node.names] if isinstance(node, ast.Import)
            else [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level
            else []
        )
        if module.split(".")[0] in ("jax", "equinox", "diffrax", "lineax", "optimistix", "optax")
    ]  # fmt: skip
    assert not found
