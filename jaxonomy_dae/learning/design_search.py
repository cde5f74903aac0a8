"""The experiment that tells most, among all of a parametrised kind."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Float

from ..base.errors import ModelError, SimulationError, explained_keywords
from .design import informations, known_of
from .estimate import Estimate
from .experiment import Planned
from .problem import Problem

STEP = 1e-3  # of a parameter's range: runs at rtol 1e-6 have differences good to 1e-3
TOLERANCE = 1e-4  # nats that a step must gain


@dataclasses.dataclass(frozen=True, repr=False)
class Design:
    """The result of `design_experiment`: the parameters found, `values`; their experiment, `planned`; the expected
    information `gain`, in nats, and that at the `start`; the `history` of gains; and the reason for the end of the
    search."""

    values: Float[np.ndarray, " p"]
    planned: Planned
    gain: float
    history: list[float]
    message: str

    def __repr__(self):
        values = np.array2string(self.values, precision=6)
        return f"Design({values}: {self.gain:.4g} nat, {self.history[0]:.4g} at the start; {self.message})"


@explained_keywords()
def design_experiment(
    source: Problem | Estimate,
    make: Callable[[Float[np.ndarray, " p"]], Planned],
    start: Any,
    bounds: Any,
    names: Sequence[str] | str | None = None,
    *,
    alone: bool = False,
    steps: int = 40,
) -> Design:
    """Finds the most informative experiment among those that `make` describes. The search follows the gradient of the
    gain (see `next_experiment`) within bounds, by quasi-Newton steps (L-BFGS-B).

    Central differences give the gradient; their points are candidates of one batch, so that the search needs one
    compiled program. Exact second derivatives of runs would need a program that compiles for minutes.

    **Arguments:**

    - `source`, `names`, `alone`: as for `next_experiment`.
    - `make`: `make(p)` is the `Planned` experiment of parameters p, shape `(p,)`: times, amplitudes and switching times
        of inputs, starts. Its shapes do not depend on p.
    - `start`: the start of the search, shape `(p,)`. It ends at a local optimum.
    - `bounds`: `(low, high)` of each, finite.
    - `steps`: the largest number of steps.

    **Raises:**

    - `ModelError` for shapes and bounds that do not fit; `SimulationError` if the run at the start fails.
    """
    known = known_of(source, names, alone)
    p0 = np.atleast_1d(np.asarray(start, float))
    ends = np.asarray(bounds, float)
    ends = ends[None] if ends.ndim == 1 else ends
    if p0.ndim != 1 or ends.shape != (len(p0), 2) or not np.isfinite(ends).all() or not (ends[:, 0] < ends[:, 1]).all():
        raise ModelError(
            f"bounds are finite pairs (low, high), one for each parameter of the start, shape ({len(p0)}, 2); got "
            f"{np.asarray(bounds).tolist()}"
        )
    if (p0 < ends[:, 0]).any() or (p0 > ends[:, 1]).any():
        raise ModelError(f"the start must lie inside the bounds; got {p0.tolist()}")
    width, now = ends[:, 1] - ends[:, 0], known.worth(known.information)
    history: list[float] = []

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        p = ends[:, 0] + width * z
        moved = np.repeat(p[None], 2 * len(p), axis=0)
        for j in range(len(p)):
            moved[2 * j, j] = max(p[j] - STEP * width[j], ends[j, 0])
            moved[2 * j + 1, j] = min(p[j] + STEP * width[j], ends[j, 1])
        try:
            plans = [make(q) for q in (p, *moved)]
        except ModelError:
            if not history:
                raise
            return 1e10, np.zeros(len(p))  # such as times that cross
        named = [dataclasses.replace(one, name=f"{k}") for k, one in enumerate(plans)]
        gained = informations(known, named)[1]
        gains = np.array([0.5 * (known.worth(known.information + m) - now) for m in gained])
        if not np.isfinite(gains[0]):
            if not history:
                raise SimulationError(f"the run of the experiment at the start, {p.tolist()}, fails")
            return 1e10, np.zeros(len(p))
        history.append(float(gains[0]))
        apart = moved[1::2][np.diag_indices(len(p))] - moved[::2][np.diag_indices(len(p))]
        slope = (gains[2::2] - gains[1::2]) / apart * width
        return -gains[0], -np.where(np.isfinite(slope), slope, 0.0)

    found = scipy.optimize.minimize(
        cost, (p0 - ends[:, 0]) / width, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(p0),
        options={"maxiter": steps, "ftol": TOLERANCE * 1e-2, "gtol": TOLERANCE},
    )  # fmt: skip
    values = ends[:, 0] + width * np.asarray(found.x)
    return Design(values, make(values), -float(found.fun), history, str(found.message))
