"""Which statement of a flat model determines which Boolean, Integer or enumeration variable."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from ..errors import ModelError
from .tree import Assignment, Branches, Call, Class, Effect, Equality, Expression, Loop, Reference, Several, Statement


class OfAlgorithm(NamedTuple):
    """Stands for what an algorithm assigns to a variable: the number of the algorithm, and the variable's name."""

    number: int
    name: str


@dataclasses.dataclass
class DiscreteDefinitions:
    """How the discrete variables of a model are determined.

    - `of`: an expression, or the number of an algorithm, by name.
    - `stored`: those that are kept from event to event: a `when` assigns them, or their value before an event is read.
    - `followed`: those of `stored` that no `when` assigns, in the order of their definitions.
    - `equations`: what is left, for the continuous variables.
    - `whens`: the `when`s of equations and algorithms.
    - `initial`: initial equations and what initial algorithms assign.
    - `algorithms`, `assigned`: the other algorithms, and the names that each assigns.
    """

    of: dict[str, Any]
    stored: set[str]
    followed: list[str]
    equations: list[Statement]
    whens: list[Branches]
    initial: list[Statement]
    algorithms: list[tuple[Statement, ...]]
    assigned: list[list[str]]


def find_definitions(model: Class, is_discrete: Callable[[str], bool]) -> DiscreteDefinitions:
    """Splits the statements of a model."""
    whens = [s for s in model.equations if isinstance(s, Branches) and s.kind == "when"]
    others = [s for s in model.equations if s not in whens] if whens else list(model.equations)
    algorithms = []
    for section in model.algorithms:
        inside = [s for s in section if isinstance(s, Branches) and s.kind == "when"]
        rest = tuple(s for s in section if not (isinstance(s, Branches) and s.kind == "when"))
        whens += inside
        if any(not isinstance(s, Effect) for s in rest):
            algorithms.append(rest)
    by_when = {name for s in whens for _, body in s.branches for name in assigned_in(body)}
    bindings = [
        Equality(Reference((d.name,), ((),)), d.value, d.line)
        for d in model.declarations
        if d.value is not None and is_discrete(d.name)
    ]
    candidates = [(s, _definable(s, is_discrete, by_when)) for s in [*others, *bindings]]
    equations: list[Statement] = [s for s, sides in candidates if not sides]
    of: dict[str, Any]
    of, left = _matched([(s, sides) for s, sides in candidates if sides], is_discrete)
    equations += left
    assigned = []
    for k, section in enumerate(algorithms):
        names = list(dict.fromkeys(assigned_in(section)))
        assigned.append(names)
        for name in names:
            if is_discrete(name):
                of[name] = k
            else:
                equations.append(Equality(Reference((name,), ((),)), OfAlgorithm(k, name), section[0].line))  # type: ignore[arg-type]
    read_before = {name for s in [*model.equations, *model.algorithms, *bindings] for name in _read_before(s)}
    followed = [name for name in of if name in read_before and name not in by_when]
    return DiscreteDefinitions(
        of, by_when | set(followed), followed, equations, whens,
        [*model.initial_equations, *(s for a in model.initial_algorithms for s in a)], algorithms, assigned,
    )  # fmt: skip


def _definable(s: Statement, is_discrete: Callable[[str], bool], by_when: set[str]) -> list[tuple[str, Expression]]:
    """The variables that an equation can determine, each with its value."""
    if not isinstance(s, Equality):
        return []
    out = []
    for side, other in ((s.left, s.right), (s.right, s.left)):
        if isinstance(side, Reference):
            name = side.path
            if is_discrete(name) and name not in by_when:
                out.append((name, other))
    return out


def _matched(
    candidates: list[tuple[Any, list[tuple[str, Expression]]]], is_discrete: Callable[[str], bool]
) -> tuple[dict[str, Expression], list[Statement]]:
    """(One equation for each variable, by augmenting paths; equations that are left, of continuous variables)."""
    owner: dict[str, int] = {}
    left: list[Statement] = []

    def place(k: int, seen: set[str]) -> bool:
        for name, _ in candidates[k][1]:
            if name in seen:
                continue
            seen.add(name)
            if name not in owner or place(owner[name], seen):
                owner[name] = k
                return True
        return False

    def may_be_left(k: int) -> bool:
        other = candidates[k][1][0][1]
        return len(candidates[k][1]) == 1 and isinstance(other, Reference) and not is_discrete(other.path)

    for k in sorted(range(len(candidates)), key=may_be_left):
        if not place(k, set()):
            s, sides = candidates[k]
            if not may_be_left(k):
                raise ModelError(f"line {s.line}: the equation of '{sides[0][0]}' is one too many")
            left.append(s)
    return {name: dict(candidates[k][1])[name] for name, k in sorted(owner.items(), key=lambda item: item[1])}, left


def assigned_in(statements: tuple[Statement, ...]) -> Iterator[str]:
    """The names that equations or assignments determine by standing on their left."""
    for s in statements:
        if isinstance(s, Equality | Assignment):
            target = s.left if isinstance(s, Equality) else s.target
            for each in target.entries if isinstance(target, Several) else (target,):
                if isinstance(each, Reference):
                    yield _name(each)
        elif isinstance(s, Branches):
            for _, body in s.branches:
                yield from assigned_in(body)
        elif isinstance(s, Loop):
            yield from assigned_in(s.body)


def _name(e: Reference) -> str:
    if not any(e.subscripts):
        return e.path
    numbers = [getattr(x, "value", "?") for x in e.subscripts[0]]
    return f"{e.parts[0]}[{','.join(map(str, numbers))}]"


def _read_before(statement: Any) -> Iterator[str]:
    """The names in pre(…), edge(…) and change(…)."""
    stack = [statement]
    while stack:
        e = stack.pop()
        if isinstance(e, Call) and e.function in ("pre", "edge", "change") and isinstance(e.arguments[0], Reference):
            yield _name(e.arguments[0])
        if isinstance(e, tuple):
            stack.extend(e)
