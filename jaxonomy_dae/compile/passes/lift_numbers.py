"""Equations that differ in numbers only share a template.

Given templates and what fills them, returns the same with numbers taken out of templates into coefficients, one for
each instance, where many templates would be equal but for them: coordinates and gains that were written as numbers cost
what parameters cost.
"""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...graph.expressions.node import Node, Number, constant, leaf, linear, multiply, number, postorder
from ...graph.expressions.substitute import rebuilt, substitute
from ..model.symbolic import SymbolicTemplate, number_label, template_of
from ..model.tables import EquationGroup

MANY = 8  # templates of one shape, from which on their numbers are taken out
KEPT = (-1, 0, 1)  # numbers that belong to a shape
_ANY = leaf(("number", "any"))


def lifted(rows: Sequence[EquationGroup]) -> list[EquationGroup]:
    """The rows in the same order, with numbers taken out of templates that differ in numbers only, if there are more
    than `MANY` of them."""
    out = list(rows)
    symbolic = [(k, r.template) for k, r in enumerate(rows) if isinstance(r.template, SymbolicTemplate)]
    # Few templates keep their numbers: there, these are folded into products.
    if len({template.key for _, template in symbolic}) <= MANY:
        return out
    shapes: dict[tuple[Any, ...], dict[str, _Variant]] = {}
    for k, template in symbolic:
        graph, numbers = _shape(template.graph)
        variants = shapes.setdefault((graph, template.slots, template.n_parameters), {})
        variants.setdefault(template.key, _Variant(numbers, [])).members.append(k)
    for (graph, slots, n_parameters), variants in shapes.items():
        if len(variants) <= MANY:
            continue
        columns = list(zip(*(v.numbers for v in variants.values()), strict=True))
        # Numbers that are the same in all variants stay in the template.
        differ = [j for j, column in enumerate(columns) if any(c != column[0] for c in column)]
        filled: dict[Hashable, Node] = {_label(j): constant(column[0]) for j, column in enumerate(columns)}
        filled |= {_label(j): leaf(number_label(k)) for k, j in enumerate(differ)}
        template = template_of(substitute(graph, filled), slots, n_parameters, len(differ))
        for numbers, members in variants.values():
            for k in members:
                coefficients = np.tile([float(numbers[j]) for j in differ], (len(rows[k]), 1))
                out[k] = dataclasses.replace(rows[k], template=template, coefficient=coefficients)
    return out


class _Variant(NamedTuple):
    """A template of some shape: its numbers, and the rows that have it."""

    numbers: list[Number]
    members: list[int]


def _label(k: int) -> tuple[str, int]:
    return ("of shape", k)


def _shape(graph: Node) -> tuple[Node, list[Number]]:
    """(the graph with a leaf for each of its numbers, these numbers), in an order that does not depend on them."""
    # Terms of a sum are sorted by digests, in which the numbers take part: two equations of one shape would list their
    # numbers in different orders. So terms are sorted by what they are without numbers.
    anonymous: dict[Node, Node] = {}
    for n in postorder([graph]):
        anonymous[n] = _without_numbers(n, n.arguments, anonymous, lambda _: _ANY)

    def ordered(n: Node) -> list[Node]:
        return sorted(n.arguments, key=lambda a: anonymous[a].digest) if n.operation == "sum" else list(n.arguments)

    numbers: list[Number] = []

    def taken(value: Number) -> Node:
        numbers.append(value)
        return leaf(_label(len(numbers) - 1))

    named: dict[Node, Node] = {}
    for n in postorder([graph], ordered):
        named[n] = _without_numbers(n, ordered(n), named, taken)
    return named[graph], numbers


def _without_numbers(n: Node, order: Sequence[Node], known: dict[Node, Node], taken: Callable[[Number], Node]) -> Node:
    """A node whose arguments are `known`, the numbers in it taken out in the given order of its arguments."""
    value = number(n)
    if value is not None:
        return n if value in KEPT else taken(value)
    if n.operation == "leaf":
        return n
    if n.operation != "sum":
        return rebuilt(n, [known[a] for a in n.arguments])
    start, coefficients = n.data
    factor = dict(zip(n.arguments, coefficients, strict=True))
    terms = [(factor[a], known[a]) if factor[a] in KEPT else (1, multiply(taken(factor[a]), known[a])) for a in order]
    if start not in KEPT:
        terms.append((1, taken(start)))
        start = 0
    return linear(terms, start)
