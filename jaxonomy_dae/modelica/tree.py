"""The syntax tree of flat Modelica: expressions, statements, declarations, classes.

Named tuples, since a model of a megabyte has a few hundred thousand nodes and they are made in half the time of frozen
dataclasses.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

BUILT_IN = ("Real", "Integer", "Boolean", "String")


class Number(NamedTuple):
    """A literal: `value` is a float, or an int where the text has neither point nor exponent."""

    value: float | int


class Truth(NamedTuple):
    """`true` or `false`."""

    truth: bool


class Text(NamedTuple):
    """A string literal, without its quotes."""

    text: str


class Reference(NamedTuple):
    """A component reference: `parts` are its names, `subscripts` those of each part."""

    parts: tuple[str, ...]
    subscripts: tuple[tuple["Expression", ...], ...] = ((),)

    @property
    def path(self) -> str:
        """The names, joined by dots, without subscripts."""
        return ".".join(self.parts)


class Whole(NamedTuple):
    """The subscript `:`, which takes all entries of a dimension."""

    colon: str = ":"


class End(NamedTuple):
    """`end` in a subscript: the last entry of the dimension."""

    end: str = "end"


class Call(NamedTuple):
    """A call of a function; `named` are its named arguments."""

    function: str
    arguments: tuple["Expression", ...]
    named: tuple[tuple[str, "Expression"], ...]


class Unary(NamedTuple):
    """`-a` or `not a`."""

    operator: str
    operand: "Expression"


class Binary(NamedTuple):
    """`a operator b`. Operators on entries, as `.*`, keep their dot."""

    operator: str
    left: "Expression"
    right: "Expression"


class Choice(NamedTuple):
    """`if c1 then a1 elseif c2 then a2 else b`: `branches` are pairs of condition and value."""

    branches: tuple[tuple["Expression", "Expression"], ...]
    otherwise: "Expression"


class Array(NamedTuple):
    """`{a, b, c}`."""

    entries: tuple["Expression", ...]


class Matrix(NamedTuple):
    """`[a, b; c, d]`: rows of entries that are concatenated."""

    rows: tuple[tuple["Expression", ...], ...]


class Several(NamedTuple):
    """`(a, b, c)`: the results of a function; None where one is left out."""

    entries: tuple["Expression | None", ...]


class Range(NamedTuple):
    """`first : step : last`."""

    first: "Expression"
    step: "Expression"
    last: "Expression"


class Comprehension(NamedTuple):
    """`value for i in range, …`: `iterators` are pairs of name and range."""

    value: "Expression"
    iterators: tuple[tuple[str, "Expression | None"], ...]


class Part(NamedTuple):
    """`expression.field` or `expression[subscripts]`, of what is not a reference."""

    whole: "Expression"
    field: str | None
    subscripts: tuple["Expression", ...]


class Result(NamedTuple):
    """The result of a function with this number, counted from 0."""

    call: "Expression"
    number: int


Expression: TypeAlias = (
    Number | Truth | Text | Reference | Whole | End | Call | Unary | Binary | Choice | Array | Matrix
    | Several | Range | Comprehension | Part | Result
)  # fmt: skip


class Equality(NamedTuple):
    """An equation `left = right`, on a line of the text."""

    left: Expression
    right: Expression
    line: int


class Assignment(NamedTuple):
    """`left := right` in an algorithm."""

    left: Expression
    right: Expression
    line: int


class Effect(NamedTuple):
    """A call that stands alone, such as `reinit(v, 0)`, `assert(…)` or `terminate(…)`."""

    call: Call
    line: int


class Branches(NamedTuple):
    """`if` or `when` (the `kind`) with its branches: pairs of condition and statements. The `else` of an `if` has the
    condition `true`."""

    kind: str
    branches: tuple[tuple[Expression, tuple["Statement", ...]], ...]
    line: int


class Loop(NamedTuple):
    """`for` with its iterators, or `while` with its condition."""

    iterators: tuple[tuple[str, Expression | None], ...]
    condition: Expression | None
    body: tuple["Statement", ...]
    line: int


class Jump(NamedTuple):
    """`return` or `break`."""

    kind: str
    line: int


Statement: TypeAlias = Equality | Assignment | Effect | Branches | Loop | Jump
Modifiers: TypeAlias = dict[str, Any]  # by name: an expression, modifiers, or the declaration of a redeclared class


class Declaration(NamedTuple):
    """A declared component: `prefixes` such as parameter or output, and `conditional` for one with a condition, `type`
    and `name` as written, its `dimensions`, its modifiers, and its binding `value`."""

    prefixes: frozenset[str]
    type: str
    name: str
    dimensions: tuple[Expression, ...]
    modifiers: Modifiers
    value: Expression | None
    comment: str
    line: int


class Class(NamedTuple):
    """A model, function, record, package or type.

    - `classes`: those inside, by name. Those of a package that are in files of their own are added when they are looked
        up, from its `folder`.
    - `bases`: what it extends: names, with modifiers and the redeclared classes among them.
    - `imports`: pairs (local name, full name); `*` is the local name of all that a package holds.
    - `literals`: of an enumeration. `alias`: what a short definition stands for.
    - `external`: the called C function, if there is one.
    - `continues`: true for `redeclare function extends f`: it continues the inherited class of its name.
    """

    kind: str
    name: str
    declarations: tuple[Declaration, ...] = ()
    equations: tuple[Statement, ...] = ()
    initial_equations: tuple[Statement, ...] = ()
    algorithms: tuple[tuple[Statement, ...], ...] = ()
    initial_algorithms: tuple[tuple[Statement, ...], ...] = ()
    classes: dict[str, "Class"] = {}
    bases: tuple[tuple[str, Modifiers], ...] = ()
    imports: tuple[tuple[str, str], ...] = ()
    annotation: Modifiers = {}
    literals: tuple[str, ...] = ()
    alias: Declaration | None = None
    external: str | None = None
    comment: str = ""
    continues: bool = False
    folder: Path | None = None

    @property
    def made_of(self) -> str | None:
        """The name of the type that a type stands for or extends."""
        return self.alias.type if self.alias else self.bases[0][0] if self.bases else None


def each_part(tree: object) -> Iterator[Any]:
    """All parts of a tree, itself among them."""
    stack = [tree]
    while stack:
        part = stack.pop()
        yield part
        if isinstance(part, tuple):
            stack.extend(part)
        elif isinstance(part, dict):
            stack.extend(part.values())


def entry_name(name: str, place: Iterable[object]) -> str:
    """The name of an entry of an array, as x[1,2]."""
    return f"{name}[{','.join(map(str, place))}]"
