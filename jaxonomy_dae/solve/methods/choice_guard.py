"""Steps that would carry a minimal set of states through a point where it is a singular choice.

Where nonlinear equations g(x, z) = 0 give the variables z that are left out of the states x, a zero of det ∂g/∂z is a
branch point: the equations hold on both branches, before and behind, and no residual tells them apart. Near it z varies
like the root of x, so an error of 1e-8 in x, small under usual tolerances, is 1e-4 in z.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...base.aliases import Args, PyTree, Result, State, Time, Tolerance

Determinants = Float[Array, " blocks"]

SINGULAR_CHOICE: Result = diffrax.RESULTS.singular
# A branch point is near where a determinant has fallen to this part of its largest value so far. The determinant is as
# near to zero as z is to the branch point, and an error of 1e-8 in x, the default tolerance, is one of 1e-4 in z (see
# above).
NEAREST = 1e-4
IN_DOUBT = 30.0  # absolute tolerances: a variable this close to the branch point may have passed it
REFUSED = 0.5  # of the nearest: a step that goes further is not accepted, so that the end is found from one side


class Verdict(eqx.Module):
    """The judgement of a step: whether it may be kept, whether the run goes on if it is, and the largest determinants
    so far."""

    allowed: Bool[Array, ""]
    goes_on: Bool[Array, ""]
    largest: Determinants

    def result(self, other: Result) -> Result:
        """The solver's own result, or `SINGULAR_CHOICE`."""
        return diffrax.RESULTS.where(self.goes_on, other, SINGULAR_CHOICE)


class ChoiceGuard(eqx.Module):
    """Ends a run where a determinant has nearly vanished, and rejects steps at whose end one has changed its sign.

    - `measure`: `(t, y, args) -> determinants`, about 1 where regular.
    - `atol`: the absolute tolerance of the run in units of the nominal values, which says what "nearly" is.
    - `ends_near`: False to reject such steps alone, where z is solved for with the states: a method that extrapolates z
        steps over a branch point of g(x, z) = 0, and goes on along one of the branches.
    """

    measure: Callable[[PyTree, PyTree, PyTree], Determinants]
    atol: Tolerance
    ends_near: bool = eqx.field(static=True, default=True)

    def judge(self, largest: Determinants, t: Time, y: State, args: Args) -> Verdict:
        """Judges a step by its end."""
        found = self.measure(t, y, args)
        if not self.ends_near:
            # Only the sign counts: the last determinants stand for the largest.
            return Verdict(jnp.all((found * jnp.sign(largest) > 0) | (largest == 0)), jnp.array(True), found)
        along, size = jnp.sign(largest) * found, jnp.abs(largest)
        nearest = jnp.maximum(NEAREST * size, jnp.minimum(IN_DOUBT * self.atol, 0.1))
        return Verdict(
            jnp.all(along > REFUSED * nearest), jnp.all(along > nearest), jnp.where(along > size, found, largest)
        )
