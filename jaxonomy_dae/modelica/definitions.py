"""Which statement of a flat model determines which Boolean, Integer or enumeration variable."""

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

from ..base.errors import ModelError
from . import tree


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
    - `whens`: the `when`s among equations; `sections`: the algorithms with a `when`.
    - `initial`: initial equations.
    - `algorithms`, `assigned`: the other algorithms, and the names that each assigns.
    """

    of: dict[str, tree.Expression | int]
    stored: set[str]
    followed: list[str]
    equations: list[tree.Statement]
    whens: list[tree.Branches]
    sections: list[tuple[tree.Statement, ...]]
    initial: list[tree.Statement]
    algorithms: list[tuple[tree.Statement, ...]]
    assigned: list[list[str]]


def find_definitions(model: tree.Class, is_discrete: Callable[[str], bool]) -> DiscreteDefinitions:
    """Splits the statements of a model."""
    whens = list(whens_in(model.equations))
    rest = [s for s in model.equations if s not in whens] if whens else list(model.equations)

    def by_entries(statements: Iterable[tree.Statement]) -> Iterator[tree.Statement]:
        return _by_entries(statements, model, is_discrete)

    others = _with_choices(by_entries(rest), is_discrete, by_entries)
    sections = [section for section in model.algorithms if any(whens_in(section))]
    by_when = set(with_entries(assigned_in((*whens, *(w for section in sections for w in whens_in(section)))), model))
    # In an algorithm with a when, what stands outside of it is kept, too: statements before and after read each other.
    by_when |= {n for section in sections for n in with_entries(assigned_in(section), model) if is_discrete(n)}
    algorithms = []
    for section in model.algorithms:
        rest = section
        if section in sections:
            rest = tuple(s for s in section if not set(with_entries(assigned_in((s,)), model)) <= by_when)
        if any(not isinstance(s, tree.Effect) for s in rest):
            algorithms.append(rest)
    bindings = [
        tree.Equality(tree.Reference((d.name,)), d.value, d.line)
        for d in model.declarations
        if d.value is not None and is_discrete(d.name)
    ]
    given = by_when | {n for section in algorithms for n in with_entries(assigned_in(section), model)}
    types = {d.name: d.type for d in model.declarations}
    candidates = [(s, _definable(s, is_discrete, given, types)) for s in [*others, *bindings]]
    equations: list[tree.Statement] = [s for s, sides in candidates if not sides]
    found, left = matched([(s, sides) for s, sides in candidates if sides], is_discrete)
    of: dict[str, tree.Expression | int] = {**found}
    equations += left
    assigned = []
    for k, section in enumerate(algorithms):
        names = with_entries(assigned_in(section), model)
        assigned.append(names)
        for name in names:
            if name in by_when:
                continue
            if is_discrete(name):
                of[name] = k
            else:
                equations.append(tree.Equality(tree.Reference((name,)), OfAlgorithm(k, name), section[0].line))  # type: ignore[arg-type]
    read = set(with_entries(read_before((model.equations, model.algorithms, tuple(bindings))), model))
    for section in algorithms:
        read |= {n for n in remembered(section, model) if is_discrete(n)}
    followed = [name for name in of if name in read and name not in by_when]
    return DiscreteDefinitions(
        of=of, stored=by_when | set(followed), followed=followed, equations=equations, whens=whens, sections=sections,
        initial=list(model.initial_equations), algorithms=algorithms, assigned=assigned,
    )  # fmt: skip


def whens_in(statements: Iterable[tree.Statement]) -> Iterator[tree.Branches]:
    return (s for s in statements if isinstance(s, tree.Branches) and s.kind == "when")


def _by_entries(
    statements: Iterable[tree.Statement], model: tree.Class, is_discrete: Callable[[str], bool]
) -> Iterator[tree.Statement]:
    """The statements with an equation for each entry of a discrete array that stands alone on the left, and for each
    discrete result of a function."""
    places: dict[str, list[str]] = {}
    for d in model.declarations:
        array, _, place = d.name.rpartition("[")
        if array and is_discrete(d.name):
            places.setdefault(array, []).append(place[:-1])
    for s in _by_results(statements, lambda name: is_discrete(name) or name in places):
        if not (isinstance(s, tree.Equality) and isinstance(s.left, tree.Reference)):
            yield s
            continue
        if any(s.left.subscripts) or s.left.path not in places:
            yield s
            continue
        for place in places[s.left.path]:
            other = s.right.path if isinstance(s.right, tree.Reference) and not any(s.right.subscripts) else ""
            if place in places.get(other, ()):
                entry: tree.Expression = tree.Reference((f"{other}[{place}]",))
            else:
                entry = _entry_of(s.right, [int(k) for k in place.split(",")])
            yield tree.Equality(tree.Reference((f"{s.left.path}[{place}]",)), entry, s.line)


def _by_results(
    statements: Iterable[tree.Statement], is_discrete: Callable[[str], bool]
) -> Iterator[tree.Statement]:  # fmt: skip
    for s in statements:
        if not (isinstance(s, tree.Equality) and isinstance(s.left, tree.Several)):
            yield s
            continue
        others: list[tree.Expression | None] = []
        for k, e in enumerate(s.left.entries):
            if isinstance(e, tree.Reference) and is_discrete(_name(e)):
                others.append(None)
                yield tree.Equality(e, tree.Result(s.right, k), s.line)
            else:
                others.append(e)
        if any(e is not None for e in others):
            yield s._replace(left=tree.Several(tuple(others)))


def _entry_of(e: tree.Expression, place: list[int]) -> tree.Expression:
    """One entry of an array."""
    if not place:
        return e
    if isinstance(e, tree.Array) and not any(isinstance(x, tree.Comprehension) for x in e.entries):
        if place[0] <= len(e.entries):
            return _entry_of(e.entries[place[0] - 1], place[1:])
    return tree.Part(e, None, tuple(map(tree.Number, place)))


def _with_choices(
    statements: Iterable[tree.Statement], is_discrete: Callable[[str], bool],
    by_entries: Callable[[Iterable[tree.Statement]], Iterable[tree.Statement]],
) -> list[tree.Statement]:  # fmt: skip
    """The statements with an equation for each discrete variable that all branches of an `if` determine."""
    out: list[tree.Statement] = []
    for s in statements:
        if not (isinstance(s, tree.Branches) and s.kind == "if"):
            out.append(s)
            continue
        conditions = [c for c, _ in s.branches]
        bodies = [_with_choices(by_entries(body), is_discrete, by_entries) for _, body in s.branches]
        values = [
            {_name(e.left): e.right for e in body
             if isinstance(e, tree.Equality) and isinstance(e.left, tree.Reference) and is_discrete(_name(e.left))}
            for body in bodies
        ]  # fmt: skip
        # Without an else, nothing says what a variable is where no condition holds.
        names = [n for n in values[0] if all(n in v for v in values)] if conditions[-1] == tree.Truth(True) else []
        for n in names:
            branches = tuple((c, v[n]) for c, v in zip(conditions[:-1], values, strict=False))
            out.append(tree.Equality(tree.Reference((n,)), tree.Choice(branches, values[-1][n]), s.line))
        rest = tuple(
            (c, tuple(e for e in body if not (isinstance(e, tree.Equality) and _given(e) in names)))
            for c, body in zip(conditions, bodies, strict=True)
        )
        if any(body for _, body in rest):
            out.append(s._replace(branches=rest))
    return out


def _definable(
    s: tree.Statement, is_discrete: Callable[[str], bool], given: set[str], types: Mapping[str, str]
) -> list[tuple[str, tree.Expression]]:
    """The variables that an equation can determine, each with its value; `given` are those that whens and algorithms
    determine. A Real variable determines no Integer one, as in y = u of a block with an Integer input."""
    if not isinstance(s, tree.Equality):
        return []
    out = []
    for side, other in ((s.left, s.right), (s.right, s.left)):
        if isinstance(side, tree.Reference):
            name = _name(side)
            real = isinstance(other, tree.Reference) and types.get(_name(other)) == "Real"
            if is_discrete(name) and name not in given and not (real and types.get(name) in ("Integer", "Boolean")):
                out.append((name, other))
    return out


def matched(
    candidates: list[tuple[tree.Statement, list[tuple[str, tree.Expression]]]], is_discrete: Callable[[str], bool]
) -> tuple[dict[str, tree.Expression], list[tree.Statement]]:
    """(One equation for each variable, by augmenting paths; equations that are left, of continuous variables)."""
    owner: dict[str, int] = {}
    left: list[tree.Statement] = []

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
        return len(candidates[k][1]) == 1 and isinstance(other, tree.Reference) and not is_discrete(_name(other))

    # Equations that may serve a continuous variable instead come last: they are left over only where no discrete
    # variable needs them.
    for k in sorted(range(len(candidates)), key=may_be_left):
        if not place(k, set()):
            s, sides = candidates[k]
            if not may_be_left(k):
                raise ModelError(f"line {s.line}: the equation of '{sides[0][0]}' is one too many")
            left.append(s)
    return {name: dict(candidates[k][1])[name] for name, k in sorted(owner.items(), key=lambda item: item[1])}, left


def assigned_in(statements: tuple[tree.Statement, ...]) -> Iterator[str]:
    """The names that equations or assignments determine by standing on their left."""
    for s in statements:
        if isinstance(s, tree.Equality | tree.Assignment):
            for each in s.left.entries if isinstance(s.left, tree.Several) else (s.left,):
                if isinstance(each, tree.Reference):
                    yield _name(each)
        elif isinstance(s, tree.Branches):
            for _, body in s.branches:
                yield from assigned_in(body)
        elif isinstance(s, tree.Loop):
            yield from assigned_in(s.body)


def _given(e: tree.Equality) -> str:
    """The name of the variable that stands alone on the left; "" if there is none."""
    return _name(e.left) if isinstance(e.left, tree.Reference) else ""


def _name(e: tree.Reference) -> str:
    """The name of what a reference stands for; a subscript that is not a number is '?' in it."""
    numbers = [",".join(str(getattr(x, "value", "?")) for x in s) for s in e.subscripts]
    return ".".join(f"{part}[{n}]" if n else part for part, n in zip(e.parts, numbers, strict=True))


def remembered(section: tuple[tree.Statement, ...], model: tree.Class) -> set[str]:
    """The variables of an algorithm whose value before it matters: they are read before they are assigned, or not
    assigned in every case (Modelica Language Specification 3.6, 11.1.2).

    **Raises:**

    - `ModelError` for a `break` or `return` outside of a loop.
    """
    own = set(with_entries(assigned_in(section), model))
    found: set[str] = set()

    def entries(names: Iterable[str]) -> set[str]:
        return set(with_entries(names, model)) & own

    def read(part: object, done: set[str]) -> None:
        found.update(entries(_name(e) for e in tree.each_part(part) if isinstance(e, tree.Reference)) - done)

    def carried_out(statements: tuple[tree.Statement, ...], done: set[str], looped: bool = False) -> set[str]:
        """The variables that are assigned for sure after statements; `done` are those before."""
        for s in statements:
            if isinstance(s, tree.Assignment | tree.Equality):
                read(s.right, done)
                done = done | entries(assigned_in((s,)))
            elif isinstance(s, tree.Loop):
                carried_out(s.body, done, True)
                done = done | entries(assigned_in((s,)))  # at the end of loops that are carried out at least once
            elif isinstance(s, tree.Branches):
                read(tuple(c for c, _ in s.branches), done)
                ends = [carried_out(body, done, looped) for _, body in s.branches]
                ends += [] if s.branches[-1][0] == tree.Truth(True) else [done]
                done = set.intersection(*ends)
                found.update(entries(assigned_in((s,))) - done)
            elif isinstance(s, tree.Jump) and not looped:
                raise ModelError(
                    f"line {s.line}: '{s.kind}' stands outside of a loop: which statements it leaves out is lost where "
                    "the loop has been written out"
                )
        return done

    found |= own - carried_out(section, set())
    return found


def with_entries(names: Iterable[str], model: tree.Class) -> list[str]:
    """The names, with those of all entries for an array and where a name has a '?'."""
    out: dict[str, None] = {}
    declared = {d.name for d in model.declarations}
    for name in names:
        if name in declared:
            out[name] = None
            continue
        entry = re.compile(re.escape(name).replace(r"\?", r"\d+") + r"(\[[\d,]+\])?")
        out.update({d.name: None for d in model.declarations if entry.fullmatch(d.name)})
    return list(out)


def read_before(statement: object) -> Iterator[str]:
    """The names in pre(…), edge(…) and change(…)."""
    for e in tree.each_part(statement):
        if (
            isinstance(e, tree.Call)
            and e.function in ("pre", "edge", "change")
            and isinstance(e.arguments[0], tree.Reference)
        ):
            yield _name(e.arguments[0])
