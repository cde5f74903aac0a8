"""Which modes a system rests in.

Given are a search for the equilibrium with modes as they are, and a start. Events that happen at the initial time do
so first. Then the equilibrium is found, the first event whose condition holds there and that would change something
happens, and so on until none is left. Where there is no equilibrium, or events lead back to where they were, modes that
equations choose (`complementary`) are changed, few at once, and it all begins again.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..base.aliases import Args, Time
from ..base.tolerances import solved
from ..run.system.system import AcausalSystem
from .events_at_rest import RestingEvents, after_event, next_event

# Equilibria that are tried from one set of modes, and as many for each event: independent modes need one search each.
ROUNDS, FOR_EACH = 16, 4


class Point(NamedTuple):
    """A point: states, discrete values, the action that wrote each of these (−1 for none), and whether one did."""

    x: Array
    q: Array
    writer: Array
    changed: Array


class Root(NamedTuple):
    """What a search found: the unknowns, the rows' Jacobian, the largest residuals that count as rounding, the
    unknowns' sizes, and whether it is a root."""

    w: Array
    jacobian: Array
    limit: Array
    unit: Array
    good: Array


class _Search(NamedTuple):
    """The state of the loop: the point to search from, what was found at last, the event that is left there, the set of
    modes tried, the rounds with it, a point and an event of an earlier round, what came out of the first set."""

    at: Point
    root: Root
    event: Array
    modes: Array
    rounds: Array
    before: tuple[Point, Array]
    first: tuple[Point, Root, Array]
    goes_on: Array


def settle(
    system: AcausalSystem, t: Time, inputs: Args, events: RestingEvents, begin: Point,
    search: Callable[[Point], tuple[Point, Root]],
) -> tuple[Point, Root, Array]:  # fmt: skip
    """Returns (the point, what the search found there, the event that does not let it rest or −1)."""
    limit = ROUNDS + FOR_EACH * int(events.acting.sum())
    flips = jnp.asarray(events.flips)

    def following(event: Array, at: Point) -> Point:
        x, q, writer = after_event(system, t, inputs, events, event, at.x, at.q, at.writer)
        return Point(x, q, writer, at.changed | (q != at.q) | (writer != at.writer))

    def at_start(carry: tuple[Array, Array, Point]) -> tuple[Array, Array, Point]:
        count, event, at = carry
        at = following(event, at)
        return count + 1, next_event(system, t, inputs, events, at.x, at.q, True), at

    event = next_event(system, t, inputs, events, begin.x, begin.q, True)
    unfinished = jnp.array(0), event, begin
    _, _, begin = jax.lax.while_loop(lambda c: (c[1] >= 0) & (c[0] < limit), at_start, unfinished)

    def once(state: _Search) -> _Search:
        here, root = search(state.at)
        event = jnp.where(root.good, next_event(system, t, inputs, events, here.x, here.q, False), -1)
        after = following(event, here)
        settled = root.good & (event < 0)
        # Brent's method: rounds are compared with one whose number is a power of two.
        earlier, last = state.before
        moved = jnp.abs(after.x - earlier.x) > solved(after.x.dtype) * jnp.maximum(jnp.abs(after.x), jnp.abs(earlier.x))
        again = (event == last) & ~jnp.any(moved) & jnp.all(after.q == earlier.q)
        fails = ~settled & (~root.good | again | (state.rounds >= limit))
        keep = (state.rounds & (state.rounds - 1)) == 0
        before = jax.tree.map(lambda a, b: jnp.where(keep, a, b), (after, event), state.before)
        modes = state.modes + jnp.where(fails, 1, 0)
        # After the last set has failed, this is computed too, and not used.
        flipped = flips[jnp.minimum(modes, len(flips) - 1)]
        anew = begin._replace(q=jnp.where(flipped, 1 - begin.q, begin.q), changed=begin.changed | flipped)
        at = jax.tree.map(lambda a, b, c: jnp.where(settled, a, jnp.where(fails, b, c)), here, anew, after)
        found = here, root, event
        first = jax.tree.map(lambda a, b: jnp.where(state.modes == 0, a, b), found, state.first)
        rounds = jnp.where(fails, 1, state.rounds + 1)
        return _Search(
            at=at,
            root=root,
            event=event,
            modes=modes,
            rounds=rounds,
            before=before,
            first=first,
            goes_on=~settled & (modes < len(flips)),
        )

    shapes = jax.eval_shape(search, begin)
    # A loop needs values before the first search; they decide nothing.
    here, root = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    nothing = here, root, jnp.array(-1)
    state = _Search(
        at=begin,
        root=root,
        event=nothing[2],
        modes=jnp.array(0),
        rounds=jnp.array(1),
        before=(here, nothing[2]),
        first=nothing,
        goes_on=jnp.array(True),
    )
    state = jax.lax.while_loop(lambda s: s.goes_on, once, state)
    settled = state.root.good & (state.event < 0)
    last = state.at, state.root, state.event
    # Of a search that failed, the outcome with the modes of the start is returned: messages name its events.
    return jax.tree.map(lambda a, b: jnp.where(settled, a, b), last, state.first)
