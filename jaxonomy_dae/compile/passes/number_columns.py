"""Which variables the incidence of a model has columns for.

Given the aliases, returns the variables that are left as columns, unknowns before inputs. A variable that was replaced
has no column. Where it equals a derivative, `least` keeps the order, so that index reduction provides that derivative.
"""

import dataclasses

import numpy as np

from ..model.tables import ZERO, AliasTable, FlatModel


@dataclasses.dataclass(frozen=True)
class Columns:
    """The variables that stand in equations after alias elimination, numbered as columns, unknowns before inputs."""

    with_inputs: np.ndarray  # the column of every variable; −1 of one that equals another
    variable: np.ndarray  # of every column
    n_unknown: int
    is_input: np.ndarray  # of every variable
    least: np.ndarray  # of every column: the highest derivative of it that a variable is equal to

    @property
    def number(self) -> np.ndarray:
        """The column of every variable that is unknown, −1 of inputs, too: these have no equation of their own."""
        return np.where(self.is_input, -1, self.with_inputs)

    @property
    def unknown(self) -> np.ndarray:
        """The variables of the columns that are unknown."""
        return self.variable[: self.n_unknown]

    @property
    def least_of_unknown(self) -> np.ndarray:
        """The highest derivatives of the unknowns that variables are equal to."""
        return self.least[: self.n_unknown]


def number_columns(flat: FlatModel, alias: AliasTable) -> Columns:
    """Numbers the roots of the alias classes."""
    is_input, n = flat.variables.is_input, len(flat.variables)
    is_root = np.arange(n) == alias.root
    unknown = np.flatnonzero(is_root & ~is_input)
    variable = np.concatenate([unknown, np.flatnonzero(is_root & is_input)])
    number = np.full(n, -1, np.int64)
    number[variable] = np.arange(len(variable))
    named = np.flatnonzero(alias.root != ZERO)
    # A variable that equals a derivative occurs in no equation any more, and may still be read: nothing else would make
    # index reduction provide that derivative.
    least = np.zeros(n, np.int64)
    np.maximum.at(least, alias.root[named], alias.order[named])
    return Columns(number, variable, len(unknown), is_input, least[variable])
