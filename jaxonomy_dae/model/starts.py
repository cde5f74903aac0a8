"""Start values of variables, as expressions in parameters."""

import dataclasses
from collections.abc import Sequence
from typing import overload

import numpy as np

from .symbolic import SymbolicTemplate


@dataclasses.dataclass(frozen=True)
class Start:
    """A start value: an expression in parameters, as a template without slots, and the parameters it reads."""

    template: SymbolicTemplate
    parameters: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class StartGroup:
    """The starts of several variables that one template computes, each from its own parameters."""

    template: SymbolicTemplate
    variable: np.ndarray  # (n,)
    parameter: np.ndarray  # (n, parameters of the template)


class Starts(Sequence[Start | None]):
    """The start of every variable, None where there is none."""

    def __init__(self, n: int, groups: Sequence[StartGroup]):
        self.groups = tuple(groups)
        self._place = np.full((n, 2), -1, np.int64)
        for k, group in enumerate(self.groups):
            self._place[group.variable] = np.stack([np.full(len(group.variable), k), np.arange(len(group.variable))], 1)

    @property
    def is_given(self) -> np.ndarray:
        """True for variables that have a start."""
        return self._place[:, 0] >= 0

    @property
    def is_number(self) -> np.ndarray:
        """True for variables that have a start which no parameter changes."""
        number = [group.parameter.shape[1] == 0 for group in self.groups]
        return np.array([*number, False], bool)[self._place[:, 0]]

    @property
    def is_zero(self) -> np.ndarray:
        """True for variables whose start is the number zero."""
        most = max((int(group.parameter.max(initial=-1)) for group in self.groups), default=-1)
        return self.is_number & (self.values(np.ones(most + 1)) == 0.0)

    def values(self, parameters: np.ndarray) -> np.ndarray:
        """The starts of all variables, zero where there is none."""
        out = np.zeros(len(self))
        for group in self.groups:
            columns = list(parameters[group.parameter].T)
            out[group.variable] = group.template.residual([], columns, [], 0.0, None, backend="numpy")
        return out

    def padded(self, extra: int) -> "Starts":
        """A copy with `extra` more variables, which have no start."""
        return Starts(len(self) + extra, self.groups)

    def __len__(self):
        return len(self._place)

    @overload
    def __getitem__(self, index: int) -> "Start | None": ...
    @overload
    def __getitem__(self, index: slice) -> "list[Start | None]": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        group, place = self._place[index].tolist()
        if group < 0:
            return None
        return Start(self.groups[group].template, tuple(self.groups[group].parameter[place].tolist()))
