"""Passes that the user adds: functions from a flattened model to another one, before all others.

A pass is a function of a `FlatModel` that returns one. Equations are in `groups`: row i of a group is one equation, in
which slot k is factor[i, k] times the order[i, k]-th derivative of the variable variable[i, k]. The variable ZERO, with
order and factor 0, is the constant zero. Equations and unknowns must be as many after the pass as they were before.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import numpy as np

from ...base.errors import ModelError
from ..model.tables import EquationGroup, FlatModel

ModelPass: TypeAlias = Callable[[FlatModel], FlatModel]


@dataclasses.dataclass(frozen=True)
class PassResult:
    """The model before and after a pass that the user added."""

    name: str
    does: str  # the first line of its docstring
    before: FlatModel
    after: FlatModel

    @property
    def lines(self) -> list[str]:
        """The equations that it removed (−), added (+) or changed (~)."""
        return list(_changes(self.before.groups, self.after.groups))


def run_passes(flat: FlatModel, passes: Sequence[ModelPass]) -> tuple[FlatModel, tuple[PassResult, ...]]:
    """Runs passes one after the other. Returns the last model, and what each pass did.

    **Raises:**

    - `ModelError` for a pass that returns anything but a model.
    """
    results = []
    for each in passes:
        name = getattr(each, "__name__", type(each).__name__)
        after = each(flat)
        if not isinstance(after, FlatModel):
            raise ModelError(f"the pass '{name}' must return a FlatModel; got {type(after).__name__}")
        does = (each.__doc__ or "a pass without a docstring").strip().split("\n")[0]
        results.append(PassResult(name, does, flat, after))
        flat = after
    return flat, tuple(results)


def _changes(before: Sequence[EquationGroup], after: Sequence[EquationGroup]) -> Iterator[str]:
    """The groups are compared one by one: a pass keeps those that it does not touch."""
    kept = {id(group) for group in after} & {id(group) for group in before}
    old, new = ([group for group in groups if id(group) not in kept] for groups in (before, after))
    if len(old) != len(new) or any(len(a) != len(b) for a, b in zip(old, new, strict=True)):
        yield from (f"− {text}" for group in old for text in group.provenance)
        yield from (f"+ {text}" for group in new for text in group.provenance)
        return
    for a, b in zip(old, new, strict=True):
        columns = ("variable", "order", "factor", "parameter", "coefficient")
        pairs = [(getattr(a, name), getattr(b, name)) for name in columns]
        alike = a.template.key == b.template.key and all(x.shape == y.shape for x, y in pairs)
        changed = np.ones(len(a), bool)
        if alike:
            changed = np.any([(x != y).any(axis=1) for x, y in pairs], axis=0)
        yield from (f"~ {b.provenance[row]}" for row in np.flatnonzero(changed).tolist())
