"""From explicit steps to implicit ones: found out while running.

An explicit method whose steps are limited by stability rather than accuracy takes |λ|·T/3.5 of them, whatever the
tolerance. `Watch` counts steps near the boundary of the stability region (Hairer & Wanner 1996, Solving Ordinary
Differential Equations II, IV.2): for two points at the same time, the last two stages of a step,
h·‖f(y₁) − f(y₁')‖ / ‖y₁ − y₁'‖ estimates h·|λ|. Such a run ends with `STIFF`, and is then made with an implicit solver.
Where the user chose the explicit one, and inside jit, it fails with that code, if its steps would not suffice.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...base.aliases import Numeric, Result, Time

# Diffrax has no code of its own for this. `breakdown` means nothing else here; an event that writes a value that is not
# finite ends with `nonlinear_divergence`, too, and its run was made once more with an implicit solver.
STIFF: Result = diffrax.RESULTS.breakdown
# Nine tenths of the way to the boundary of Tsit5's stability region, which along the negative real axis is at −3.5.
BOUNDARY = 0.9 * 3.5
PATIENCE = 15  # limited steps in a row, as in Hairer's DOPRI5: a transient that passes is not stiffness
# The solver is changed only if so many steps of the present size are still to be taken: fewer cost less than compiling
# another solver (test_default_solver.py::test_fast_decay_before_a_short_end_stays_explicit).
MANY = 2000
# Where no other solver may be chosen, a run is given up if the steps to its end are more than this part of those that
# it may take. While stability limits steps, near a fifth of them are rejected
# (test_default_solver.py::test_explicit_steps_that_do_not_suffice: 3,735 of 20,894).
SHARE = 0.75


class Watch(eqx.Module):
    """Counts steps that stability limits.

    - `end`: the end of the integration.
    - `floor`: sizes below which changes of y do not count, shape () or (n,).
    - `many`: with more steps still to be taken, of the size at hand, the run is stiff.
    - `of_run`: whether `many` includes the steps taken before.
    """

    end: Time
    floor: Numeric
    many: int = eqx.field(static=True, default=MANY)
    of_run: bool = eqx.field(static=True, default=False)

    def start(self) -> Int[Array, "2"]:
        """The counts before the first step: of limited steps, and of all."""
        return jnp.zeros((2,), jnp.int32)

    def after(
        self,
        counts: Int[Array, "2"],
        t0: Time,
        t1: Time,
        y: tuple[Float[Array, " n"], Float[Array, " n"]],
        k: tuple[Float[Array, " n"], Float[Array, " n"]],
    ) -> Int[Array, "2"]:
        """The counts after a step from t0 to t1, whose last two stages are at points y with increments k = h·f(y)."""
        end, floor, t0, t1, y, k = jax.lax.stop_gradient((self.end, self.floor, t0, t1, y, k))
        weight = floor + jnp.abs(y[1])
        # One sum rather than two norms that are compared: a small step costs as much as it has kernels.
        excess = jnp.sum(((k[1] - k[0]) ** 2 - BOUNDARY**2 * (y[1] - y[0]) ** 2) / weight**2)
        count, steps = counts[0], counts[1]
        left = (self.many - steps if self.of_run else jnp.full_like(steps, self.many)).astype(jnp.asarray(t1).dtype)
        limited = (excess > 0) & (end - t1 > left * (t1 - t0))
        # A step that is not limited takes two back, so that steps near the boundary, which alternate, do not add up.
        count = jnp.where(limited, count + 1, jnp.maximum(count - 2, 0))
        return jnp.stack([count, steps + 1])

    def result(self, counts: Int[Array, "2"]) -> Result:
        """`STIFF` once enough steps in a row were limited."""
        return diffrax.RESULTS.where(counts[0] < PATIENCE, diffrax.RESULTS.successful, STIFF)
