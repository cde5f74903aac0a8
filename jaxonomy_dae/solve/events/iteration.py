"""The iteration of repeated events at one instant: how far it is, and whether it goes round in a circle.

An iteration ends where the events happen that wait for all others. What comes next depends on the discrete values alone
then, unless states are started anew, so an iteration that arrives at values for the second time has no end. Such values
are found by R. P. Brent's method (1980, *An improved Monte Carlo factorization algorithm*): they are compared with
those at the last power of two.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float


class Iteration(eqx.Module):
    """How far the iteration of an instant is, in one array: compiled programs pay for each that a state has.

    - `count`: how many iterations there were, negative once one has arrived at values for the second time.
    - `moved`: 1 if states were started anew since the anchor.
    - `anchor`: the discrete values after one of the iterations; `turning`: 1 for those that have been different since.
    """

    packed: Float[Array, "*batch n"]

    @classmethod
    def begin(cls, n: int, dtype: DTypeLike) -> "Iteration":
        """Before the first iteration, of n discrete values."""
        return cls(jnp.zeros((2 + 2 * n,), dtype))

    count = property(lambda self: self.packed[..., 0])
    moved = property(lambda self: self.packed[..., 1])
    anchor = property(lambda self: self.packed[..., 2 : 1 + self.packed.shape[-1] // 2])
    turning = property(lambda self: self.packed[..., 1 + self.packed.shape[-1] // 2 :])

    def after(self, q: Float[Array, " q"], moved: Bool[Array, ""]) -> "Iteration":
        """This after one more iteration, which has left the discrete values q, and `moved` states or not."""
        q, count = lax.stop_gradient(q), self.count.astype(int)
        moved = moved | (self.moved > 0)
        circles = (count > 0) & ~moved & jnp.all(q == self.anchor)
        turning = jnp.maximum(self.turning, (q != self.anchor).astype(q.dtype))
        moves_on = ~circles & ((count & (count - 1)) == 0)  # at 0, 1, 2, 4, …
        anchor, turning = jnp.where(moves_on, q, self.anchor), jnp.where(moves_on, 0.0, turning)
        numbers = jnp.where(circles, -(count + 1), count + 1), moved & ~moves_on
        after = jnp.concatenate([jnp.stack([number.astype(q.dtype) for number in numbers]), anchor, turning])
        return Iteration(jnp.where(count < 0, self.packed, after))

    def anew(self, where: Bool[Array, ""]) -> "Iteration":
        """Before the first iteration, where time has gone on."""
        return Iteration(jnp.where(where, jnp.zeros_like(self.packed), self.packed))
