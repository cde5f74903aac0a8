"""Chains of semiLinear, whose inner variables nothing determines at zero flow.

At x = 0, the equations y = semiLinear(x, sa, s1), y = semiLinear(x, s1, s2), …, y = semiLinear(x, sN, sb) hold for any
s1, …, sN. The Modelica Language Specification (3.6, section 3.7.4.5, rule 1) selects a solution:

    s1 = if x >= 0 then sa else sb,    s2 = s1, …,    y = semiLinear(x, sa, sb).

Here x, y and s may have several names, as at the two ends of a connection, and opposite signs. Where three streams
meet, the rule has no answer.
"""

import collections
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import NamedTuple

from .tree import Binary, Call, Choice, Equality, Expression, Number, Reference, Statement, Unary


class _Link(NamedTuple):
    """An equation `y = semiLinear(x, …)`, at `place` among all equations. `forward` is false where x has the opposite
    sign of the chain's; `first` and `second` are then exchanged."""

    place: int
    equation: Equality
    y: Reference
    x: Reference
    forward: bool
    first: Expression
    second: Expression


def with_chains_solved(equations: Sequence[Statement], name_of: Callable[[Reference], str]) -> list[Statement]:
    """The equations, with the selected solution in the place of each chain."""
    if not any(isinstance(s, Equality) and _semi_linear(s) for s in equations):
        return list(equations)
    aliases = _Aliases(equations, name_of)
    groups: dict[Hashable, list[_Link]] = collections.defaultdict(list)
    for place, s in enumerate(equations):
        if not isinstance(s, Equality) or (found := _semi_linear(s)) is None:
            continue
        y, (x, a, b) = found
        (y_root, y_sign), (x_root, x_sign) = aliases.of(y), aliases.of(x)
        first, second = (a, b) if x_sign > 0 else (b, a)
        link = _Link(place, s, y, x, x_sign > 0, first, second)
        # y = semiLinear(x, a, b) is -y = semiLinear(-x, b, a): links differ by the product of both signs alone.
        groups[y_root, x_root, x_sign * y_sign].append(link)
    out = list(equations)
    for links in groups.values():
        for chain in _chains(links, aliases):
            for link, replaced in zip(chain, _solved(chain), strict=True):
                out[link.place] = replaced
    return out


def _semi_linear(s: Equality) -> tuple[Reference, tuple] | None:
    """(y, arguments) of an equation y = semiLinear(x, …) of variables x, y."""
    for y, call in ((s.left, s.right), (s.right, s.left)):
        if isinstance(call, Call) and call.function == "semiLinear" and isinstance(y, Reference):
            return (y, call.arguments) if isinstance(call.arguments[0], Reference) else None
    return None


def _chains(links: list[_Link], aliases: "_Aliases") -> Iterator[list[_Link]]:
    """Maximal chains of at least two links: the second variable of one, and of no other, is the first one of the next,
    and of no other."""
    first_of, second_of = collections.defaultdict(list), collections.defaultdict(list)
    for link in links:
        first_of[aliases.key(link.first)].append(link)
        second_of[aliases.key(link.second)].append(link)

    def follows(key: Hashable) -> bool:
        return len(first_of[key]) == len(second_of[key]) == 1

    for link in links:
        if follows(aliases.key(link.first)):
            continue
        chain = [link]
        while follows(aliases.key(chain[-1].second)):
            chain.append(first_of[aliases.key(chain[-1].second)][0])
        if len(chain) > 1:
            yield chain


def _solved(chain: list[_Link]) -> Iterator[Equality]:
    """What stands in the place of each link."""
    sa, sb = chain[0].first, chain[-1].second
    flows = Binary(">=" if chain[0].forward else "<=", chain[0].x, Number(0.0))
    value: Expression = Choice(((flows, sa),), sb)
    for link in chain[:-1]:
        yield link.equation._replace(left=link.second, right=value)
        value = chain[0].second
    last = chain[-1]
    ends = (sa, sb) if last.forward else (sb, sa)
    yield last.equation._replace(left=last.y, right=Call("semiLinear", (last.x, *ends), ()))


class _Aliases:
    """Variables that are equal or opposite: by a = b, and by a + b = 0, with variables that are zero left out."""

    def __init__(self, equations: Sequence[Statement], name_of: Callable[[Reference], str]):
        self.name_of = name_of
        self.parents: dict[str, tuple[str, int]] = {}
        sums = [t for s in equations if isinstance(s, Equality) and (t := _terms(s)) is not None]
        zero = {name_of(t[0][0]) for t in sums if len(t) == 1}
        for terms in sums:
            left = [(name_of(r), sign) for r, sign in terms if name_of(r) not in zero]
            if len(left) == 2:
                (a, a_sign), (b, b_sign) = left
                (a_root, a_here), (b_root, b_here) = self._root(a), self._root(b)
                if a_root != b_root:  # a_sign·a + b_sign·b = 0
                    self.parents[a_root] = b_root, -a_sign * b_sign * a_here * b_here

    def _root(self, name: str) -> tuple[str, int]:
        sign = 1
        while name in self.parents:
            name, step = self.parents[name]
            sign *= step
        return name, sign

    def of(self, e: Reference) -> tuple[str, int]:
        """(The variable that stands for all its aliases, the sign)."""
        return self._root(self.name_of(e))

    def key(self, e: Expression) -> Hashable:
        return self.of(e) if isinstance(e, Reference) else e


def _terms(s: Equality) -> list[tuple[Reference, int]] | None:
    """The variables with signs whose sum is zero; None for another equation."""
    out: list[tuple[Reference, int]] = []
    stack: list[tuple[Expression, int]] = [(s.left, 1), (s.right, -1)]
    while stack:
        e, sign = stack.pop()
        if isinstance(e, Reference):
            out.append((e, sign))
        elif isinstance(e, Unary) and e.operator == "-":
            stack.append((e.operand, -sign))
        elif isinstance(e, Binary) and e.operator in "+-":
            stack += [(e.left, sign), (e.right, sign if e.operator == "+" else -sign)]
        elif not (isinstance(e, Number) and e.value == 0):
            return None
    return out
