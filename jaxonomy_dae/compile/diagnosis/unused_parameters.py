"""Parameters that nothing reads.

A value that changes nothing cannot be estimated, and is often a slip: a symbol that was meant to stand in an equation.
"""

import numpy as np

from ..model.tables import FlatModel
from .wording import listed


def unused_parameters(flat: FlatModel) -> list[int]:
    """The declared parameters that no equation, start, event or account of energy reads, nor another that is read."""
    table = flat.parameters
    used = np.zeros(len(table), bool)
    for group in (*flat.groups, *flat.accounts, *flat.variables.start.groups):
        used[group.parameter.ravel()] = True
    for start in (s for event in flat.events.events for s in event.clock or () if s):
        used[list(start.parameters)] = True
    for dependents in reversed(table.dependents):  # each reads only those before it
        read = dependents.parameter[used[dependents.target]]
        used[read.ravel()] = True
    # Discrete variables are results as well.
    used[table.discrete] = True
    return np.flatnonzero(~used[: table.n_declared]).tolist()


def note_unused(flat: FlatModel) -> tuple[str, ...]:
    """A note in the report, if there are any."""
    names = [flat.parameters.names[p] for p in unused_parameters(flat)]
    if not names:
        return ()
    what = (
        "a parameter that nothing in the model reads"
        if len(names) == 1
        else "parameters that nothing in the model reads"
    )
    return (f"{listed(names, 12)}: {what}",)
