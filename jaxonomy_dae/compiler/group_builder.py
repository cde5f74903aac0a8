"""Equation rows, collected by template."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance, Provenances
from ..model.tables import EquationGroup
from ..model.template import AbstractTemplate


@dataclasses.dataclass
class _CollectedRows:
    """A group under construction."""

    template: AbstractTemplate
    variable: list[np.ndarray] = dataclasses.field(default_factory=list)
    order: list[np.ndarray] = dataclasses.field(default_factory=list)
    parameter: list[np.ndarray] = dataclasses.field(default_factory=list)
    coefficient: list[np.ndarray] = dataclasses.field(default_factory=list)
    provenance: list[Provenances] = dataclasses.field(default_factory=list)


class GroupBuilder:
    """Collects equation rows by template."""

    def __init__(self):
        self._rows: dict[str, _CollectedRows] = {}

    def add(self, template: AbstractTemplate, variable, order, parameter, coefficient, provenance: Provenances):
        """Adds n instances: arrays of shape (n, slots), (n, slots), (n, parameters), (n, coefficients)."""
        rows = self._rows.setdefault(template.key, _CollectedRows(template))
        n = len(provenance)
        rows.variable.append(np.asarray(variable, np.int64).reshape(n, -1))
        rows.order.append(np.asarray(order, np.int64).reshape(n, -1))
        rows.parameter.append(np.asarray(parameter, np.int64).reshape(n, template.n_parameters))
        rows.coefficient.append(np.asarray(coefficient, np.float64).reshape(n, template.n_coefficients))
        rows.provenance.append(provenance)

    def add_linear(self, terms: Sequence[tuple[int, int, float]], provenance: Provenance):
        """Adds Σ coefficient·variable^(order) = 0."""
        variable, order, coefficient = zip(*terms, strict=True)
        self.add(
            LinearTemplate(len(terms)),
            [variable],
            [order],
            np.zeros((1, 0)),
            [coefficient],
            Provenances.of([provenance]),
        )

    def groups(self) -> tuple[EquationGroup, ...]:
        out = []
        for rows in self._rows.values():
            variable = np.concatenate(rows.variable)
            out.append(
                EquationGroup(
                    rows.template,
                    variable,
                    np.concatenate(rows.order),
                    np.ones(variable.shape),
                    np.concatenate(rows.parameter),
                    np.concatenate(rows.coefficient),
                    Provenances.joined(rows.provenance),
                )
            )
        return tuple(out)
