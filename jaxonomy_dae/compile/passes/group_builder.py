"""Rows of equations, collected and joined by template."""

from collections.abc import Sequence

from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance, Provenances
from ..model.tables import EquationGroup


def linear_equation(terms: Sequence[tuple[int, int, float]], provenance: Provenance) -> EquationGroup:
    """Σ coefficient·variable^(order) = 0."""
    variable, order, coefficient = zip(*terms, strict=True)
    provenances = Provenances.of([provenance])
    return EquationGroup.of(LinearTemplate(len(terms)), [variable], [order], provenances, coefficient=[coefficient])


def joined_by_template(groups: Sequence[EquationGroup]) -> tuple[EquationGroup, ...]:
    """One group for each template, in the order in which the templates first occur."""
    # A dictionary keeps the order of insertion: the order of equations, and with it every choice among equals, follows
    # the order of declaration.
    alike: dict[str, list[EquationGroup]] = {}
    for group in groups:
        alike.setdefault(group.template.key, []).append(group)
    return tuple(map(EquationGroup.joined, alike.values()))
