"""Which quantities should be states: what the user asks for, and what has a start."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from ...base.errors import ModelError, nearest
from ..diagnosis.wording import listed
from ..model.quantities import ReducedModel
from ..model.tables import FlatModel


def merits(model: ReducedModel, prefer_states: Sequence[str]) -> Int[np.ndarray, "quantities 3"]:
    """For each quantity, how strongly it was asked for as a state, whether it is fixed at the start, and has a start:
    of quantities that compete, those with larger rows are kept.

    **Raises:**

    - `ModelError` if a preferred name is not that of a variable.
    """
    flat, variables = model.flat, model.variables
    n = model.extended.quantities.n
    asked, fixed, started = np.zeros((3, n), int)
    chosen = flat.variables.start.is_given & (variables.quantity >= 0)
    started[variables.quantity[chosen]] = 1
    fixed[variables.quantity[chosen & flat.variables.fixed]] = 1
    wanted = _entries(flat, prefer_states)
    index = flat.variables.index if wanted else {}
    for k, name in enumerate(wanted):
        if name not in index:
            raise ModelError(f"prefer_states: '{name}' is not a variable: " + nearest(name, index))
        q, _ = variables[index[name]]
        if q >= 0 and not asked[q]:
            # Earlier names are preferred to later ones.
            asked[q] = len(wanted) - k
    return np.stack([asked, fixed, started], axis=1)


def note_not_followed(model: ReducedModel, prefer_states: Sequence[str], states: np.ndarray) -> tuple[str, ...]:
    """Notes on names in `prefer_states` that did not become states: the states and inputs determine them, for others
    were better pivots, or no equation differentiates them."""
    chosen = set(states.tolist())
    wanted = _entries(model.flat, prefer_states)
    index = model.flat.variables.index if wanted else {}
    left = [n for n in wanted if model.variables[index[n]][0] not in chosen]
    if not left:
        return ()
    is_none, it = ("is no state", "it") if len(left) == 1 else ("are no states", "them")
    return (f"prefer_states: {listed(left, 12)} {is_none}: the states and inputs determine {it}",)


def _entries(flat: FlatModel, names: Sequence[str]) -> list[str]:
    """Names of variables, with those of the entries in place of an array's."""
    out = []
    for name in names:
        ids = flat.arrays.variables(name)
        out += [name] if ids is None else [flat.variables.names[v] for v in ids.ravel().tolist()]
    return out
