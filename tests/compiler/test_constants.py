"""Numbers that were chosen say what they are: each named constant has a comment beside it or above it; and those by
which results are judged stand in one table."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import jaxonomy_dae

ROOT = Path(jaxonomy_dae.__file__).parent
CAPITALS = re.compile(r"^_?[A-Z][A-Z0-9_, ]* = ", re.MULTILINE)


def is_number(value: ast.AST | None) -> bool:
    """A number, a tuple or list of numbers, or arithmetic with numbers."""
    match value:
        case ast.Constant():
            return isinstance(value.value, int | float) and not isinstance(value.value, bool)
        case ast.UnaryOp():
            return is_number(value.operand)
        case ast.BinOp():
            return is_number(value.left) and is_number(value.right)
        case ast.Tuple() | ast.List():
            return bool(value.elts) and all(map(is_number, value.elts))
    return False


def constants(source: str) -> Iterator[tuple[str, int, int]]:
    """(name, first line, last line) of each statement `NAME = number` of a module."""
    if not CAPITALS.search(source):
        return
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign) or not is_number(node.value):
            continue
        targets = node.targets[0].elts if isinstance(node.targets[0], ast.Tuple) else node.targets
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        if names and all(name.strip("_").isupper() for name in names):
            yield ", ".join(names), node.lineno, node.end_lineno or node.lineno


def unexplained(source: str) -> Iterator[str]:
    """The constants without a comment on their lines, or above the group of lines that they belong to."""
    lines = source.split("\n")
    for name, first, last in constants(source):
        while first > 1 and lines[first - 2].strip():
            first -= 1
        if not any("#" in line for line in lines[first - 1 : last]):  # numbers have no other
            yield name


def test_every_constant_has_a_comment():
    bare = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted(ROOT.rglob("*.py"))
        for name in unexplained(path.read_text())
    ]
    assert not bare, "say in a comment what the number is, and why it has this value"


def test_what_counts_as_explained():
    source = "A = 1  # of steps\n\n# Both are times.\nB = 2.0\nC = (1, 2)\n\nD = 1e-3\nE = [0]\n\nF = 1\n"
    assert list(unexplained(source)) == ["D", "E", "F"]


# Small numbers elsewhere belong to methods, and decide how they proceed: steps, dampings, what is asked of a solver.
METHODS = {
    "solve/events/search": "where an interval is cut, and where the search in it ends",
    "fmi/calls": "what differences of an FMU move, and how near an event they are taken",
    "run/start/gauss_newton": "the least gain",
    "run/start/guessed_point": "where the search begins and ends",
    "run/start/homotopy": "the shortest step along a curve",
    "graph/judgement/sparse_rank": "a shift for inverse iteration",
    "solve/linear/sparse": "what stands for a zero in a factorization",
    "solve/linear/sparse_least_squares": "regularization of what is solved again with the rest",
    "compile/model/consistent_point": "where an iteration ends",
    "run/simulation/arguments": "sample times that lie outside the interval by their rounding",
    "run/simulation/solution": "tolerances of a run, by default",
    "run/simulation/step_sizes": "first steps",
    "solve/methods/solve": "tolerances of a run, by default",
}
APART = ("learning", "library", "write", "plotting", "testing", "graph/units")  # they judge no solution of equations
JUDGING = 1e-7  # a relative number below is no step, share or damping, in all but METHODS


def small_numbers(source: str) -> list[float]:
    numbers = [node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)]
    return [v for v in numbers if isinstance(v, float) and 0 < abs(v) <= JUDGING]


def test_what_judges_results_stands_in_one_table():
    found = set()
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT).with_suffix("").as_posix()
        if not name.startswith((*APART, "base/tolerances")) and small_numbers(path.read_text()):
            found.add(name)
    assert found == set(METHODS), "thresholds go into tolerances.py, with what they rest on"


def test_the_table_is_short():
    source = (ROOT / "base" / "tolerances.py").read_text()
    assert len(list(constants(source))) <= 30
    assert not list(unexplained(source))
