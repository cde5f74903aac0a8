"""Nodes of expression graphs.

A node is immutable and unique: equal expressions are the same object, so that whatever occurs twice is computed,
differentiated and stored once. Nodes are made by the functions below, which keep two normal forms: a linear combination
("sum": constant + Σ coefficient·node) and a monomial ("product": Π node^exponent, exponents are numbers). Numbers are
`int`, `Fraction` or `float`; exact ones stay exact.
"""

import hashlib
import math
import weakref
from collections.abc import Callable, Hashable, Iterable, Sequence
from fractions import Fraction
from operator import attrgetter
from typing import Any, TypeVar

Number = int | Fraction | float


class Node:
    """One operation on other nodes: `operation`, its `arguments`, and what else it consists of, `data`.

    `leaves` are the labels of the leaves below it. Compare nodes with `is`.
    """

    __slots__ = ("__weakref__", "arguments", "data", "digest", "leaves", "operation")

    operation: str
    arguments: tuple["Node", ...]
    data: Any
    digest: bytes
    leaves: frozenset

    def __reduce__(self):
        # Pickle would recurse through arguments, and deep graphs exceed its limit. A table has no depth, and reading it
        # by `make` keeps nodes unique in the process that reads.
        order: list[Node] = postorder([self])
        place = {n: k for k, n in enumerate(order)}
        rows = tuple((n.operation, tuple(place[a] for a in n.arguments), n.data) for n in order)
        return _restored, (rows,)

    def __repr__(self):
        return f"Node({self.operation}, {self.data!r}, {len(self.arguments)} arguments)"


# Held weakly, so that nodes go with the last graph that uses them.
_unique: "weakref.WeakValueDictionary[bytes, Node]" = weakref.WeakValueDictionary()
_NONE: frozenset = frozenset()


def make(operation: str, arguments: tuple[Node, ...] = (), data: Any = None) -> Node:
    """The one node of this content, as it is: no simplification."""
    # A digest of content rather than Python's hash, which differs between processes: arguments are sorted by it, and
    # the order of a sum decides its rounding.
    text = f"{operation}|{data!r}|".encode()
    digest = hashlib.blake2b(text + b"".join(a.digest for a in arguments), digest_size=20).digest()
    found = _unique.get(digest)
    if found is not None:
        return found
    node = Node()
    node.operation, node.arguments, node.data, node.digest = operation, arguments, data, digest
    if operation == "leaf":
        node.leaves = frozenset([data])
    else:
        # A set is shared with an argument wherever it is the same: sets of their own would take memory quadratic in the
        # length of a chain.
        leaves = _NONE
        for argument in arguments:
            if not argument.leaves <= leaves:
                leaves = argument.leaves | leaves if leaves else argument.leaves
        node.leaves = leaves
    return _unique.setdefault(digest, node)


def _restored(rows: tuple) -> Node:
    """Rebuilds a pickled node, the last of `rows` = (operation, positions of arguments, data)."""
    nodes: list[Node] = []
    for operation, positions, data in rows:
        nodes.append(make(operation, tuple(nodes[k] for k in positions), data))
    return nodes[-1]


def leaf(label: Hashable) -> Node:
    """An unknown; its label's `repr` identifies it."""
    return make("leaf", (), label)


def as_float(value: Number) -> float:
    """The number in floating point: infinite where an exact one is too large."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def constant(value: Number) -> Node:
    if value == 0:
        value = 0  # what cancels in floats is the same zero
    if isinstance(value, Fraction) and value.denominator == 1:
        value = value.numerator
    if math.isinf(as_float(value)):
        value = as_float(value)  # beside floats, Python raises an error where an exact number is larger than they are
    return make("constant", (), value)


ZERO = constant(0)
ONE = constant(1)
TRUE = make("true")
FALSE = make("false")


def number(node: Node) -> Number | None:
    """The value of a constant, else None."""
    return node.data if node.operation == "constant" else None


def split(node: Node) -> tuple[Number, Node]:
    """The node as coefficient·rest."""
    if node.operation == "sum" and len(node.arguments) == 1 and node.data[0] == 0:
        return node.data[1][0], node.arguments[0]
    if node.operation == "constant":
        return node.data, ONE
    return 1, node


def linear(terms: Iterable[tuple[Number, Node]], start: Number = 0) -> Node:
    """start + Σ coefficient·node."""
    collected: dict[Node, Number] = {}
    sums: list[tuple[Number, Node]] = []

    def collect(c: Number, node: Node):
        collected[node] = collected[node] + c if node in collected else c

    for c, node in terms:
        if c == 0:
            continue
        inner, rest = split(node)
        if rest is ONE:
            start = start + c * inner
        elif rest.operation == "sum":
            sums.append((c * inner, rest))
        else:
            collect(c * inner, rest)
    members = [frozenset(s.arguments) for _, s in sums]
    for k, (c, inner) in enumerate(sums):
        # A sum within a sum stays, shared, unless its terms meet others.
        meets = any(a in collected for a in inner.arguments) or any(
            members[k] & members[j] for j in range(len(sums)) if j != k
        )
        if meets or not collected and len(sums) == 1 and (c == 1 or start != 0):
            start = start + c * inner.data[0]
            for coefficient, node in zip(inner.data[1], inner.arguments, strict=True):
                collect(c * coefficient, node)
        else:
            collect(c, inner)
    kept = sorted(((n, c) for n, c in collected.items() if c != 0), key=lambda pair: pair[0].digest)
    if not kept:
        return constant(start)
    if len(kept) == 1 and start == 0 and kept[0][1] == 1:
        return kept[0][0]
    return make("sum", tuple(n for n, _ in kept), (_exact(start), tuple(_exact(c) for _, c in kept)))


def _exact(value: Number) -> Number:
    return value.numerator if isinstance(value, Fraction) and value.denominator == 1 else value


def add(*nodes: Node) -> Node:
    return linear((1, n) for n in nodes)


def scale(factor: Number, node: Node) -> Node:
    return linear([(factor, node)])


def multiply(*nodes: Node) -> Node:
    factor: Number = 1
    bases: dict[Node, Number] = {}
    for node in nodes:
        c, rest = split(node)
        factor = factor * c
        if rest.operation == "product":
            for base, exponent in zip(rest.arguments, rest.data, strict=True):
                bases[base] = bases.get(base, 0) + exponent
        elif rest is not ONE:
            bases[rest] = bases.get(rest, 0) + 1
    if factor == 0:
        return ZERO
    return scale(factor, _monomial(bases))


def _monomial(bases: dict[Node, Number]) -> Node:
    kept = sorted(((b, e) for b, e in bases.items() if e != 0), key=lambda pair: pair[0].digest)
    if not kept:
        return ONE
    if len(kept) == 1 and kept[0][1] == 1:
        return kept[0][0]
    return make("product", tuple(b for b, _ in kept), tuple(_exact(e) for _, e in kept))


def power(base: Node, exponent: Number | Node) -> Node:
    """base^exponent, where a negative base with a fractional exponent is not a number."""
    if isinstance(exponent, Node):
        value = number(exponent)
        if value is None:
            return make("power", (base, exponent))
        exponent = value
    exponent = _exact(exponent)
    # Exponents that are written as floats are made exact: as such they merge with others, and √x is evaluated as a
    # root.
    if isinstance(exponent, float) and exponent.is_integer() and abs(exponent) < 1e6:
        exponent = int(exponent)
    if isinstance(exponent, float) and exponent in (0.5, -0.5, 1.5, -1.5):
        exponent = Fraction(exponent)
    if exponent == 0:
        return ONE
    if exponent == 1:
        return base
    value = number(base)
    if value is not None:
        return constant(_power_of_numbers(value, exponent))
    if isinstance(exponent, int):
        c, rest = split(base)
        if rest.operation == "product":
            raised = _monomial({b: e * exponent for b, e in zip(rest.arguments, rest.data, strict=True)})
        else:
            raised = _monomial({rest: exponent})
        return scale(_power_of_numbers(c, exponent), raised)
    # Only whole exponents distribute over factors: √(x²) is |x|, and √(x·y) is real for two negative factors.
    return _monomial({base: exponent})


def _power_of_numbers(base: Number, exponent: Number) -> Number:
    # Python raises an error here, where NumPy and JAX return an infinity.
    if base == 0 and exponent < 0:
        return math.inf
    if isinstance(exponent, int) and isinstance(base, int | Fraction):
        return Fraction(base) ** exponent
    if base < 0 and not isinstance(exponent, int):
        return math.nan
    try:
        return as_float(base) ** as_float(exponent)
    except OverflowError:
        return -math.inf if base < 0 and exponent % 2 else math.inf


def divide(numerator: Node, denominator: Node) -> Node:
    return multiply(numerator, power(denominator, -1))


def select(condition: Node, yes: Node, no: Node) -> Node:
    """yes where the condition holds, else no."""
    if condition is TRUE or yes is no:
        return yes
    return no if condition is FALSE else make("select", (condition, yes, no))


def negate(condition: Node) -> Node:
    if condition is TRUE:
        return FALSE
    if condition is FALSE:
        return TRUE
    return condition.arguments[0] if condition.operation == "not" else make("not", (condition,))


def both(*conditions: Node) -> Node:
    return _junction("and", conditions, TRUE, FALSE)


def either(*conditions: Node) -> Node:
    return _junction("or", conditions, FALSE, TRUE)


def _junction(operation: str, conditions: Sequence[Node], neutral: Node, absorbing: Node) -> Node:
    kept = [c for c in dict.fromkeys(conditions) if c is not neutral]
    if absorbing in kept:
        return absorbing
    if len(kept) < 2:
        return kept[0] if kept else neutral
    return make(operation, tuple(sorted(kept, key=lambda n: n.digest)))


_COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "less": lambda a, b: a < b,
    "less_equal": lambda a, b: a <= b,
    "equal": lambda a, b: a == b,
}


def compare(operation: str, a: Node, b: Node) -> Node:
    """A comparison: "less", "less_equal" or "equal"."""
    x, y = number(a), number(b)
    if x is not None and y is not None:
        return TRUE if _COMPARISONS[operation](x, y) else FALSE
    return make(operation, (a, b))


N = TypeVar("N", bound=Hashable)


def postorder(roots: Iterable[N], before: Callable[[N], Iterable[N]] = attrgetter("arguments")) -> list[N]:
    """All nodes reachable from the roots, each once, after the nodes that `before` returns for it (by default its
    arguments)."""
    seen: set[N] = set()
    out: list[N] = []
    for root in roots:
        # A stack of its own, since graphs are deeper than Python's limit of recursion.
        stack: list[tuple[N, bool]] = [(root, False)]
        while stack:
            node, finished = stack.pop()
            if finished:
                out.append(node)
            elif node not in seen:
                seen.add(node)
                stack.append((node, True))
                stack.extend((a, False) for a in before(node) if a not in seen)
    return out
