"""What is taken from Diffrax and Equinox beyond their public interfaces: every such name passes through this file.

`TRIED` lists the versions on which the tests were run; tests/test_private_names.py fails on others, so that an upgrade
is looked at. Beside the names below, `StoredAdjoint` relies on three things that have no name of their own:
`AbstractAdjoint._loop` (the loop over steps, with the inner and outer while loop as arguments), the fields of
the loop's state, and the arguments that `diffeqsolve` hands to `AbstractAdjoint.loop`.
"""

import equinox._errors as equinox_errors
import equinox.internal as eqxi
from diffrax._heuristics import is_sde as is_sde
from diffrax._integrate import SaveState as SaveState
from diffrax._integrate import _clip_to_end
from diffrax._root_finder import use_stepsize_tol as use_stepsize_tol

__all__ = ["equinox_errors"]

clip_to_end = _clip_to_end
while_loop = eqxi.while_loop
prevbefore = eqxi.prevbefore
unvmap_any = eqxi.unvmap_any
unvmap_max = eqxi.unvmap_max

TRIED = {
    "diffrax": ("0.7.2",),
    "equinox": ("0.13.6", "0.13.8"),
    "jax": ("0.9.1", "0.10.2"),
    "lineax": ("0.1.0", "0.1.1"),
    "optimistix": ("0.1.0",),
}
