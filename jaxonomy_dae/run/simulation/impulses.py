"""Impulses of the constraints that begin to hold at an event.

While an impulse acts, e' + ρ = 0 takes the place of e' = 0, with the rate ρ at which it takes e away: the lowest
derivative of the constraint that may jump. Forces grow beyond all others, so that states move along ∂f/∂ρ alone, from
where they are to where e is gone: the limit of a stiff contact, or of a resistor that vanishes. Where what jumps enters
linearly (speeds, charges of linear capacitors) the path is straight; else it is followed (`path_end`).

Contacts push and do not pull: of those that strike or are closed, some act, with impulses p ≥ 0, and the others part,
w = e⁺ − (1 − strength)·e ≥ 0 (Moreau 1988; Newton's law of restitution). Which ones act is found by exchanging the
first that pulls or does not part, until there is none (Murty 1974: finite where all impulses have energies, as of
independent contacts; from those that were closed, so that one that repeats others never acts).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, State, Time
from ...base.tolerances import LEFT, NOISE, PULL, solved, spacing
from ...compile.lowering.plan_events import HeldPlan
from ...solve.adjoint.resting import still
from ...solve.events.first_order import constant_once
from ...solve.events.path import path_end
from ..system.nonlinear import Refinement
from ..system.system import AcausalSystem

# Contacts are exchanged at most this many times, for each of them, while one impact is resolved. If an impulse would
# still have to pull, the event fails.
TRIES = 4


class _Impact(eqx.Module):
    """The states before the impulses, with the discrete values after the event, and what is asked of each constraint:
    `strength` times its level `e` is to be taken away."""

    system: AcausalSystem
    t: Time
    x: State
    q: Array
    strength: Array
    e: Array
    args: Args

    @property
    def held(self) -> HeldPlan:
        """The constraints that come and go."""
        assert self.system.plan.held is not None
        return self.system.plan.held

    def after(self, acting: Array) -> tuple[Array, State, Array, Array, Array]:
        """(q with the constraints that act, the states after their impulses, these, e⁺, whether they were found)."""
        table, system, t, args = self.held.table, self.system, self.t, self.args
        place, pushes, n = table.impulse, table.closed >= 0, len(system.plan.states)
        closed = table.closed[pushes]
        # Contacts that do not act part, so that their constraints do not hold while the others push.
        q = self.q.at[closed].set(jnp.where(acting[pushes], self.q[closed], 0.0))
        strength = jnp.where(acting, self.strength, 0.0)
        acts, rate = q.at[place].set(strength), strength * self.e

        def direction(y: Array, guess: Array | None) -> tuple[Array, Array | None]:
            here = system.holding(acts)
            x = y[:n] if guess is None else here.at(t, args).refined(jnp.append(y[:n], guess), Refinement.ROOT)

            def responds(rate: Array) -> tuple[Array, Array]:
                on = system.holding(acts.at[table.rate].set(rate))
                return on.vector_field(t, x, args), on.at(t, args).held_forces(x)

            _, (change, pushed) = jax.jvp(responds, (jnp.zeros_like(rate),), (rate,))
            return jnp.concatenate([change[:n], pushed]), None if guess is None else x[n:]

        typical = jax.lax.stop_gradient(system.typical_sizes[system.plan.states])
        begin = jnp.concatenate([self.x[:n], jnp.zeros_like(rate)])

        def allowed(change: Array) -> Array:
            states = jnp.maximum(jnp.abs(self.x[:n]), typical)
            pushed = jnp.broadcast_to(jnp.max(jnp.abs(change[n:]), initial=0.0), change[n:].shape)
            return solved(change.dtype) * jnp.concatenate([states, pushed])

        moves = jnp.any(strength != 0)
        # Not an array without entries: XLA (jaxlib 0.10.2) passes those on through nested loops, one at a time, gives
        # up after ten, and then compiles no call of LAPACK that it has not come to.
        guess = self.x[n:] if len(self.x) > n else None
        end, guess, found = path_end(direction, begin, guess, allowed, moves)
        after = end[:n] if guess is None else jnp.append(end[:n], guess)
        q = q.at[place].set(0.0)
        return q, after, end[n:], system.holding(q).at(t, args).held(after)[1][self.held.last], found

    def acting(self, strikes: Array, may_change: Array) -> tuple[Array, Array]:
        """Which contacts act, and whether that could not be found; not differentiated."""
        impact = still(constant_once(self))
        strength, e, n = impact.strength, impact.e, len(may_change)
        speed = PULL * jnp.max(jnp.abs(strength * e), initial=0.0)

        def exchanged(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            acting, _, count = carry
            _, _, pushed, after, _ = impact.after(acting)
            pulls = acting & (pushed < -PULL * jnp.max(jnp.abs(pushed)))
            meets = ~acting & (after - (1 - strength) * e < -speed)
            wrong = may_change & (pulls | meets)
            # One at a time, the first (Murty's rule of least index): exchanging all that are wrong at once may go in
            # circles.
            first = jnp.arange(n) == jnp.argmax(wrong)
            return jnp.where(wrong & first, ~acting, acting), jnp.any(wrong), count + 1

        # One that strikes alone acts, and is tried first.
        alone = jnp.sum(strikes) == 1
        begin = ~strikes | alone, jnp.ones((), bool), jnp.zeros((), int)
        acting, wrong, _ = jax.lax.while_loop(lambda c: c[1] & (c[2] < TRIES * n), exchanged, begin)
        return acting, wrong


def struck(system: AcausalSystem, t: Time, x: State, before: Array, q: Array, args: Args) -> tuple[Array, Array, Array]:
    """Applies the impulses of the constraints that begin to hold with q, which did not with `before`, or that q asks
    for. Returns (x, q, whether the impulses do what they should)."""
    held = system.plan.held
    assert held is not None
    place, pushes = held.table.impulse, held.table.closed >= 0
    held_before, _ = system.holding(before).at(t, args).held(x)
    now = system.holding(q).at(t, args)
    holds, levels = now.held(x)
    e = levels[held.last]
    strength = jnp.where(q[place] == 0, holds * (1 - held_before), q[place])
    impact = _Impact(system, t, x, q, strength, e, args)
    acting, wrong = jnp.ones(len(pushes), bool), jnp.zeros((), bool)
    if len(pushes) > 1 and pushes.any():
        strikes = jnp.asarray(pushes) & (strength > 0)
        acting, wrong = impact.acting(strikes, strikes | (jnp.asarray(pushes) & (holds > 0)))
    q, after, _, left, found = impact.after(acting)
    # A level that is rounding itself need not vanish to digits of its own.
    sizes = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x), system.typical_sizes[np.append(*_entries(system))]))
    terms = now.level_magnitudes(x, sizes)[held.last]
    noise = NOISE * spacing(terms.dtype) * jnp.where(jnp.isfinite(terms), terms, 0.0)
    done = jnp.abs(left - (1 - strength) * e) <= LEFT * jnp.abs(strength * e) + noise
    return after, q, jnp.all(done | (strength == 0) | ~acting) & found & ~wrong


def _entries(system: AcausalSystem) -> tuple[np.ndarray, np.ndarray]:
    """The quantities in the state array."""
    return system.plan.states, system.plan.carried
