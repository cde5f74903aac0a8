"""Numbers that are expressions in parameters: dependent parameters, and start values of variables."""

import dataclasses
from collections.abc import Sequence
from typing import overload

import jax.numpy as jnp
import numpy as np

from ...base.aliases import Numeric, Time
from .group import Group
from .symbolic import SymbolicTemplate


@dataclasses.dataclass(frozen=True)
class Start:
    """A start value: an expression in parameters, as a template without slots, and the parameters it reads."""

    template: SymbolicTemplate
    parameters: tuple[int, ...]

    def value(self, parameters: np.ndarray) -> float:
        """Its value for all parameters."""
        return float(self.template.residual([], [*parameters[list(self.parameters)]], [], 0.0, None, backend="numpy"))


@dataclasses.dataclass(frozen=True)
class Formulas(Group):
    """Numbers that one template without slots computes, each from its own parameters."""

    target: np.ndarray  # (n,): what the numbers are of

    @classmethod
    def of(cls, template: SymbolicTemplate, target: Numeric, parameter: Numeric) -> "Formulas":
        """Formulas by rows."""
        n = len(target)
        read = np.array(parameter, np.int64).reshape(n, template.n_parameters)
        return cls(template, np.zeros((n, 0)), read, np.zeros((n, 0)), np.array(target, np.int64))

    def put(self, array: Numeric, parameters: Numeric, t: Time = 0.0) -> Numeric:
        """The array with the numbers at their targets, in its last axis; in NumPy it is changed. Numbers that are not
        finite are named by those who call."""
        given = self.numbers(parameters)
        if isinstance(array, np.ndarray):
            with np.errstate(all="ignore"):
                array[..., self.target] = self.template.residual([], *given, t, None, backend="numpy")
            return array
        return array.at[..., self.target].set(jnp.asarray(self.template.residual([], *given, t, None), array.dtype))


def formulas_of(starts: Sequence[Start | None]) -> list[Formulas]:
    """Expressions as formulas whose targets are their places in the sequence."""
    found = []
    for template in dict.fromkeys(start.template for start in starts if start):
        rows = [(k, start.parameters) for k, start in enumerate(starts) if start and start.template is template]
        found.append(Formulas.of(template, *zip(*rows, strict=True)))
    return found


class Starts(Sequence[Start | None]):
    """The start of every variable, None where there is none."""

    def __init__(self, n: int, groups: Sequence[Formulas]):
        self.groups = tuple(groups)
        # An object for each start would take more memory than all other tables of a large model.
        self._place = np.full((n, 2), -1, np.int32)
        for k, group in enumerate(self.groups):
            self._place[group.target] = np.stack([np.full(len(group.target), k), np.arange(len(group.target))], 1)

    @property
    def is_given(self) -> np.ndarray:
        """True for variables that have a start."""
        return self._place[:, 0] >= 0

    @property
    def is_number(self) -> np.ndarray:
        """True for variables that have a start which no parameter changes."""
        # Variables without a start have the place −1, which reads the last entry.
        number = [group.parameter.shape[1] == 0 for group in self.groups]
        return np.array([*number, False], bool)[self._place[:, 0]]

    @property
    def is_zero(self) -> np.ndarray:
        """True for variables whose start is the number zero."""
        most = max((int(group.parameter.max(initial=-1)) for group in self.groups), default=-1)
        # Only starts that read no parameters count, so any values of parameters will do.
        return self.is_number & (self.values(np.ones(most + 1)) == 0.0)

    def values(self, parameters: np.ndarray) -> np.ndarray:
        """The starts of all variables, zero where there is none."""
        out = np.zeros(len(self))
        for group in self.groups:
            group.put(out, parameters)
        return out

    def of(self, variables: np.ndarray) -> list[Start]:
        """The starts of variables that have one."""
        place, row = self._place[variables].T.tolist()
        listed = [group.parameter.tolist() for group in self.groups]
        return [Start(self.groups[k].template, tuple(listed[k][i])) for k, i in zip(place, row, strict=True)]

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
