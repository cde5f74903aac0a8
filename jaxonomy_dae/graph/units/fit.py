"""Whether the units in an expression graph fit together.

Given the graph of an equation, a condition or a value, and the units of its leaves (None where a unit is not known),
returns a sentence for each operation whose arguments do not fit. What has no known unit fits everything, so no sentence
rests on one. Constants are numbers without unit where they multiply, and fit what they are added to or compared with.
Functions of time and numbers alone, such as sin(100*time), have no known unit: nothing else in them could have one.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from fractions import Fraction
from typing import Any

import sympy

from ..expressions.node import Node, Number, leaf, linear, postorder, scale
from ..expressions.to_sympy import shortened, write
from .unit import NUMBER, Unit, interval, is_close, product

UnitOf = Callable[[tuple], Unit | None]

TIME = frozenset([("time",)])  # the leaves of functions of time
LARGEST_PLAIN = 4  # whole numbers up to this one, and their quotients, do not convert units: 1/2, 4/3
KEEP_UNIT = ("abs", "max", "min", "hypot", "mod")
TO_NUMBER = ("sign", "heaviside")
RATIO = "atan2"
CONDITIONS = ("true", "false", "not", "and", "or")
COMPARISONS = ("less", "less_equal", "equal")
ONE_UNIT = {
    "sum": "terms of a sum must have one unit",
    "select": "branches need one unit",
    "less": "sides of a comparison need one unit",
    "less_equal": "sides of a comparison need one unit",
    "equal": "sides of a comparison need one unit",
}


@dataclasses.dataclass(frozen=True)
class UnitOfValue:
    """The unit of a value, with what else decides whether it fits.

    - `number`: the product of plain numbers in front of it, which may convert units.
    - `is_constant`: it is a number and nothing else.
    - `is_loose`: temperatures with a zero of their own count as differences in it.
    """

    unit: Unit
    number: float = 1.0
    is_constant: bool = False
    is_loose: bool = False


@dataclasses.dataclass(frozen=True)
class Term:
    """A term coefficient·value of a sum, with its name in messages."""

    name: Callable[[], str]
    value: UnitOfValue | None
    coefficient: float = 1.0


def misfits_of_equation(graph: Node, unit_of: UnitOf) -> list[str]:
    """Unit mismatches in the equation 0 = graph. Branches of an equation are equations themselves."""
    return _Walk(unit_of).run(graph, ("select",), is_zero=True)


def misfits_of_condition(graph: Node, unit_of: UnitOf) -> list[str]:
    """Unit mismatches in a guard, which falls through zero where its condition becomes true: relations joined by min,
    max and branches."""
    return _Walk(unit_of).run(graph, ("select", "min", "max"), is_zero=True)


def misfits_of_value(graph: Node, unit_of: UnitOf, expected: Unit | None, name: str) -> list[str]:
    """Unit mismatches in `name = expression`; `expected` is the unit of the left side."""
    target = leaf(("value", name))
    walk = _Walk(lambda label: expected if label == target.data else unit_of(label))
    return walk.run(linear([(1, target), (-1, graph)]), (), is_zero=True)


def misfit_of_units(named: Sequence[tuple[str, Unit | None]]) -> str | None:
    """The first mismatch between the units of equal quantities, in a sentence; None if they agree."""
    known = [(name, unit) for name, unit in named if unit is not None]
    for (a, first), (b, second) in zip(known, known[1:], strict=False):
        if first.dimension != second.dimension:
            return f"'{a}' is in {first} and '{b}' in {second}"
        if not is_close(first.scale, second.scale) or first.zero != second.zero:
            return f"'{a}' is in {first} and '{b}' in {second} ({_conversion(first, second)})"
    return None


class _Walk:
    """Walks through a graph, finds the units of all nodes, and notes what does not fit."""

    def __init__(self, unit_of: UnitOf):
        self.unit_of = unit_of
        self.known: dict[Node, UnitOfValue | None] = {}
        self.found: list[str] = []

    def run(self, root: Node, open_above: tuple[str, ...], is_zero: bool) -> list[str]:
        """Walks through the graph; operations `open_above` at its top join what need not agree, but what they join
        `is_zero`, each for itself."""
        # Branches of one equation may be in different units, since only one of them is zero at a time.
        tops, joints, stack = set(), set(), [root]
        while stack:
            node = stack.pop()
            if node.operation in open_above:
                joints.add(node)
                stack.extend(node.arguments[1:] if node.operation == "select" else node.arguments)
            else:
                tops.add(node)
        for node in postorder([root]):
            self.known[node] = None if node in joints else self._measure(node, is_zero and node in tops)
        return self.found

    def _measure(self, node: Node, is_zero: bool) -> UnitOfValue | None:
        operation = node.operation
        inside = [self.known[a] for a in node.arguments]
        if operation == "leaf":
            unit = self.unit_of(node.data)
            return None if unit is None else UnitOfValue(unit)
        if node.leaves == TIME:
            return None
        if operation == "constant":
            value = float(node.data)
            return UnitOfValue(NUMBER, value, is_constant=True) if value and math.isfinite(value) else None
        if operation == "sum":
            start, coefficients = node.data
            terms = [
                # Texts are made when a misfit is found: most equations have none, and SymPy prints slowly.
                Term(lambda c=c, a=a: _text(a, c), None if a.leaves == TIME and abs(c) != 1 else known, float(c))
                for c, a, known in zip(coefficients, node.arguments, inside, strict=True)
            ]
            if start:
                terms.append(Term(lambda: str(start), UnitOfValue(NUMBER, is_constant=True), float(start)))
            return self.agree(terms, ONE_UNIT["sum"], is_zero)
        if operation == "product":
            # The exponent 0.3333333333333333 is meant as 1/3.
            return self._product(node, inside, [Fraction(e).limit_denominator(10**6) for e in node.data])
        if operation == "power":
            # An exponent that is constant has become a product's power before.
            self._needs_number(node.arguments[1], "an exponent is a number")
            self._needs_number(node.arguments[0], "what is raised to an exponent that is not constant is a number")
            return None if inside[0] is None else UnitOfValue(NUMBER)
        if operation in CONDITIONS:
            return None
        if operation in COMPARISONS:
            sides = [
                Term(lambda a=a: _text(a), k, c) for a, k, c in zip(node.arguments, inside, (1.0, -1.0), strict=True)
            ]
            self.agree(sides, ONE_UNIT[operation], is_zero=True)
            return None
        if operation == "select":
            return self._same(node.arguments[1:], inside[1:], ONE_UNIT["select"])
        if operation in KEEP_UNIT:
            return self._same(node.arguments, inside, f"arguments of {operation} need one unit")
        if operation == RATIO:
            self._same(node.arguments, inside, f"arguments of {operation} need one unit")
            return UnitOfValue(NUMBER)
        if operation not in TO_NUMBER:
            for argument in node.arguments:
                self._needs_number(argument, f"{operation} takes a number (or an angle in rad)")
        return UnitOfValue(NUMBER)

    def _product(self, node: Node, inside: Iterable[UnitOfValue | None], powers: list[Fraction]) -> UnitOfValue | None:
        factors: list[tuple[UnitOfValue, Fraction]] = []
        known = True
        for argument, value, power in zip(node.arguments, inside, powers, strict=True):
            if value is None:
                known = False
                continue
            # 20 degC squared is not 400 of anything: values on such a scale are no multiples of its unit.
            if value.unit.zero and power != 1:
                self.found.append(
                    f"{value.unit} has a zero of its own, so '{_text(argument)}' cannot stand in a power or quotient: "
                    "use K"
                )
                known = False
            factors.append((value, power))
        if not known:
            return None
        # Signs are left out: −1000 converts units as 1000 does.
        number = math.prod(abs(v.number) ** float(p) for v, p in factors)
        is_loose = any(v.is_loose or v.unit.zero for v, _ in factors)
        return UnitOfValue(product((v.unit, p) for v, p in factors), number, is_loose=is_loose)

    def _needs_number(self, node: Node, rule: str) -> None:
        value = self.known[node]
        if value is None or value.is_constant or node.leaves == TIME:
            return
        if value.unit.dimension:
            self.found.append(f"{rule}, but '{_text(node)}' is in {value.unit}")
        elif not _fits(value, 1.0):
            self.found.append(
                f"{rule}, but '{_text(node)}' is in {value.unit} (1 {value.unit} is {value.unit.scale:.6g})"
            )

    def _same(self, nodes: Sequence[Node], values: Iterable[UnitOfValue | None], rule: str) -> UnitOfValue | None:
        values = list(values)
        # A maximum of two temperatures in degC is one, where a sum of two is none.
        points = {v.unit for v in values if v is not None and v.unit.zero}
        terms = [Term(lambda a=a: _text(a), v) for a, v in zip(nodes, values, strict=True)]
        others = [v for v in values if v is not None and not v.unit.zero]
        if points and others:
            named = [(t.name(), t.value.unit) for t in terms if t.value is not None]
            wrong = misfit_of_units(named)
            if wrong is not None:
                self.found.append(f"{rule}, but {wrong}")
            return None
        found = self.agree(terms, rule, is_zero=False)
        return found if not points or found is None else dataclasses.replace(found, unit=next(iter(points)))

    def agree(self, terms: Sequence[Term], rule: str, is_zero: bool) -> UnitOfValue | None:
        """The unit of a sum of terms, which may be zero; where they do not fit, a sentence is noted."""
        known = [(t, t.value) for t in terms if t.value is not None]
        if not known:
            return None
        all_known = len(known) == len(terms)
        zero = 0.0
        points = [(t, v) for t, v in known if v.unit.zero]
        if points:
            unit = points[0][1].unit
            # One temperature in degC and one in degF: neither zero is that of the sum.
            if any(v.unit != unit for _, v in points):
                named = [(t.name(), v.unit) for t, v in points]
                self.found.append(f"{rule}, but {misfit_of_units(named)}")
                return None
            weight = sum(t.coefficient for t, _ in points)
            start = sum(t.coefficient * v.number for t, v in known if v.is_constant)
            quantities = sum(not v.is_constant for _, v in known)
            # T + 273.15 converts T to K: the number stands for the zero of the scale and is no term.
            if weight and start and is_close(start * unit.scale, weight * unit.zero):
                known = [(t, v) for t, v in known if not v.is_constant]  # T + 273.15
            elif is_zero:
                # The zeros of a scale cancel in T1 − T2. A quantity by itself stands beside numbers, which are on its
                # scale.
                cancels = abs(weight) < 1e-9 or quantities == 1
                if all_known and not cancels and not any(v.is_loose for _, v in known):
                    other = next((t for t, v in known if not v.unit.zero), points[0][0])
                    self.found.append(
                        f"{rule}, but the zero of '{points[0][0].name()}', in {unit}, does not cancel: convert it to "
                        f"K, or take a difference, in '{other.name()}'"
                    )
                    return None
            elif is_close(abs(weight), 1.0):
                # A mean such as T1/2 + T2/2 is a temperature on the scale again.
                zero = unit.zero
        values = [
            (t, dataclasses.replace(v, unit=interval(v.unit), number=abs(v.number * t.coefficient)))
            for t, v in known
            if not v.is_constant
        ]
        if not values:
            return UnitOfValue(NUMBER, is_constant=True) if all_known else None
        dimensions = [v.unit.dimension for _, v in values]
        if any(d != dimensions[0] for d in dimensions):
            self._note(rule, values, _most_common(dimensions), lambda v: v.unit.dimension)
            return None
        common = _common_scale([v for _, v in values])
        if common is None:
            self._note(rule, values, _most_common([v.unit.scale for _, v in values]), lambda v: v.unit.scale)
            return None
        text = next((v.unit.text for _, v in values if is_close(v.unit.scale, common)), "")
        numbers = [v.number for _, v in values]
        has_one = all(is_close(n, numbers[0]) for n in numbers) and not any(v.is_constant for _, v in known)
        number = numbers[0] if has_one else 1.0
        is_loose = any(v.is_loose for _, v in values)
        return UnitOfValue(Unit(dimensions[0], common, zero, text), number, is_loose=is_loose)

    def _note(
        self,
        rule: str,
        values: list[tuple[Term, UnitOfValue]],
        usual: Hashable,
        aspect: Callable[[UnitOfValue], Hashable],
    ) -> None:
        """Notes that an aspect of the values, which is `usual` for most of them, is not the same for all."""
        named = sorted(((t.name(), v) for t, v in values), key=lambda row: (len(row[0]), row[0]))
        one = next(row for row in named if aspect(row[1]) == usual)
        odd = next(row for row in named if aspect(row[1]) != usual)
        (a, first), (b, second) = sorted((one, odd), key=named.index)
        factor = ""
        if first.unit.dimension == second.unit.dimension:
            factor = f" ({_conversion(first.unit, second.unit)})"
        self.found.append(f"{rule}, but '{a}' is in {first.unit} and '{b}' in {second.unit}{factor}")


def _most_common(items: Sequence[object]) -> object:
    return max(items, key=lambda item: (items.count(item), -items.index(item)))


def _common_scale(values: Sequence[UnitOfValue]) -> float | None:
    """The factor of a unit in which all values may be read; None if there is none."""
    # The units as they are come first: numbers convert only where units differ.
    candidates = [v.unit.scale for v in values]
    candidates += [v.unit.scale / v.number for v in values if v.number]
    return next((s for s in candidates if all(_fits(v, s) for v in values)), None)


def _fits(value: UnitOfValue, scale: float) -> bool:
    """True if a value can be read in units of factor `scale`: its unit has that factor, or the number in front of it
    converts it, alone or with a plain factor such as 1/2."""
    if is_close(value.unit.scale, scale):
        return True
    rest = value.number * scale / value.unit.scale
    return is_close(rest, 1.0) or _is_plain(rest) and not _is_plain(value.number)


def _is_plain(number: float) -> bool:
    whole = range(1, LARGEST_PLAIN + 1)
    return any(is_close(number, p / q) for p, q in itertools.product(whole, whole))


def _conversion(a: Unit, b: Unit) -> str:
    """The conversion between two units, in words: how much one of the coarser unit is in the other, or where the zero
    of a temperature scale lies."""
    if is_close(a.scale, b.scale):
        own = a if a.zero else b
        return f"0 {own} is {own.zero:.6g} K"
    fine, coarse = sorted((a, b), key=lambda u: u.scale)
    ratio = f"{coarse.scale / fine.scale:.6g}"
    return f"1 {coarse} is {ratio} {fine}" if coarse.text and fine.text else f"a factor of {ratio}"


def _text(node: Node, coefficient: Number = 1) -> str:
    return shortened(write(scale(abs(coefficient), node), lambda label: sympy.Symbol(name_of(label))))


def name_of(label: Any) -> str:
    """The name of a leaf, given its label ("variable", path, order), (kind, name) or ("time",)."""
    if label[0] == "variable":
        return "der(" * label[2] + label[1] + ")" * label[2]
    return label[-1]
