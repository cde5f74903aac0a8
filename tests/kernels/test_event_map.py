"""The map of an event at a frozen time, and the search for the first crossing in a step."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from affine_events import CLOCKS, EVENTS, GUARDS, MAX_EVENTS, STATES, Affine, Event, Numbers, affine

from jaxonomy_dae import ModelError
from jaxonomy_dae.solve.events.event_map import handle
from jaxonomy_dae.solve.events.instant import Arrival
from jaxonomy_dae.solve.events.iteration import Iteration
from jaxonomy_dae.solve.events.search import first_crossing
from jaxonomy_dae.solve.events.start import start

MEMBERS = 16


def random_problem(seed: int) -> tuple[Numbers, np.ndarray]:
    """A problem whose first guard falls through zero at the point given, and what that event writes is random."""
    rng = np.random.default_rng(seed)
    numbers, _ = affine({}, [])
    width = numbers.rates.shape[1]
    numbers.rates[:] = rng.normal(size=(STATES, width))
    numbers.guards[0] = rng.normal(size=width)
    numbers.writes[CLOCKS] = rng.normal(size=numbers.writes.shape[1:])
    numbers.q[:] = rng.normal(size=numbers.q.shape)
    x = rng.normal(size=STATES)
    point = np.concatenate([x, numbers.q, numbers.q, [1.0]])
    falls = numbers.guards[0, :STATES] @ (numbers.rates @ point)
    numbers.guards[0] *= -np.sign(falls) * max(1.0, 1 / abs(falls))  # not slower than one a second
    numbers.guards[0, -1] -= numbers.guards[0] @ point
    return numbers, x


def after(x, numbers):
    """x after the events of an instant at which the first guard has reached zero, and the time that is logged."""
    numbers = jax.tree.map(jnp.asarray, numbers)
    problem = Affine(numbers, jnp.asarray(1e-14))
    t = jnp.asarray(1.0)
    state = start(problem, jnp.zeros(()), x, numbers.q, None, MAX_EVENTS, False)
    due = jnp.arange(EVENTS) == CLOCKS
    slope = problem.slope(t, x, state.q, None)
    arrival = Arrival(
        slope, jnp.zeros((GUARDS,)), due, jnp.zeros((GUARDS,), bool), jnp.ones((GUARDS,)), jnp.asarray(1e-6),
        jnp.asarray(1.0),
    )  # fmt: skip
    new, _, noted, _ = handle(problem, t, eqx.tree_at(lambda s: s.x, state, x), arrival, None, state.table)
    return new.x, noted.log[0, 0]


@functools.cache
def mapped():
    """The map and its Jacobian, of all members at once."""

    def both(x, numbers):
        def f(x):
            value = jnp.append(*after(x, numbers))
            return value, value

        jacobian, value = jax.jacrev(f, has_aux=True)(x)
        return value, jacobian

    problems, points = zip(*(random_problem(k) for k in range(MEMBERS)), strict=True)
    numbers = jax.tree.map(lambda *leaves: np.stack(leaves), *problems)
    points = np.stack(points)
    return numbers, points, jax.tree.map(np.asarray, jax.jit(jax.vmap(both))(points, numbers))


@pytest.mark.long("the map is written out twice in its Jacobian")
def test_the_derivative_is_the_saltation_matrix():
    """S = R + (f⁺ − R·f⁻)·∇gᵀ/(∇g·f⁻), and the time moves by −∇gᵀ/(∇g·f⁻): Aizerman & Gantmacher (1958)."""
    numbers, points, (values, jacobians) = mapped()
    for k in range(MEMBERS):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], numbers)
        point = np.concatenate([points[k], one.q, one.q, [1.0]])
        new = one.writes[CLOCKS] @ point
        before, behind = one.rates @ point, one.rates @ np.concatenate([new, new[STATES:], [1.0]])
        R, normal = one.writes[CLOCKS, :STATES, :STATES], one.guards[0, :STATES]
        time = -normal / (normal @ before)
        saltation = R - np.outer(behind - R @ before, time)
        np.testing.assert_allclose(values[k], [*new[:STATES], 1.0], rtol=1e-12, atol=1e-12)  # rounding, here and below
        np.testing.assert_allclose(jacobians[k], np.vstack([saltation, time]), rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_second_derivatives_are_refused():
    """The map at an event has the flow's first derivative only."""
    numbers, x = random_problem(0)
    for twice in (jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))):
        with pytest.raises(ModelError, match="second derivatives through events"):
            jax.eval_shape(twice(lambda x: after(x, numbers)[0][0]), jnp.asarray(x))


# --- the search ------------------------------------------------------------------------------------------------------


def test_the_first_of_several_crossings():
    """Random cubics of time, of which some fall through zero: the first zero, by NumPy's roots."""

    @jax.jit
    @jax.vmap
    def search(coefficients, high):
        def guards(t):
            return jax.vmap(lambda c: jnp.polyval(c, t))(coefficients)

        falling = (guards(0.0) > 0) & (guards(high) <= 0)
        return first_crossing(guards, falling, 0.0 * high, high, guards(0.0), guards(high), jnp.any(falling))

    rng, rows, highs, expected = np.random.default_rng(0), [], [], []
    while len(rows) < 200:
        coefficients, high = rng.normal(size=(3, 4)), rng.uniform(0.1, 2.0)
        if rng.uniform() < 0.3:
            coefficients[0, -1] = 1e-9  # as of a guard whose event has just been
        firsts = []
        for c in coefficients:
            roots = np.roots(c)
            inside = np.sort(roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0) & (roots.real < high)])
            if np.polyval(c, 0.0) > 0 and np.polyval(c, high) <= 0:
                firsts.append(inside)
        # One crossing each, so that its place does not depend on where the search looks.
        if firsts and all(len(inside) == 1 for inside in firsts):
            rows.append(coefficients)
            highs.append(high)
            expected.append(min(inside[0] for inside in firsts))
    found = search(np.stack(rows), np.array(highs))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("power", [1, 3, 5, 9])
def test_a_guard_may_meet_zero_flatly(power):
    """Signs decide, so that the place is as exact for a ninth power as for a line. Bisection to 1e-13 takes 44 looks,
    ITP one more, and the rounding of the last bracket another one."""
    looks = []

    def guards(t):
        jax.debug.callback(looks.append, t)
        return jnp.stack([(0.3 - t) ** power])

    low, high, yes = jnp.zeros(()), jnp.ones(()), jnp.ones((1,), bool)
    found = first_crossing(guards, yes, low, high, guards(low), guards(high), jnp.array(True))
    jax.effects_barrier()
    np.testing.assert_allclose(found, 0.3, rtol=0, atol=2e-13)
    assert len(looks) - 2 <= (10 if power == 1 else 46)


def test_an_iteration_that_comes_to_values_again_goes_round_in_a_circle():
    """Whatever leads to the circle, and however long it is: Brent's method needs no more than three times as many
    turns as there are different values. What moves on for ever, or starts states anew, is no circle."""

    @functools.partial(jax.jit, static_argnums=2)
    def iterated(values, follows, moved):
        def turn(iteration, _):
            state, found = iteration
            state = follows[state]
            return (state, found.after(values[state], jnp.array(moved))), found.count

        begin = jnp.array(0), Iteration.begin(values.shape[1], values.dtype)
        (_, last), counts = jax.lax.scan(turn, begin, length=3 * len(values) + 3)
        return last.count, last.turning, counts

    n, rng = 12, np.random.default_rng(0)
    for _ in range(20):
        tail, circle = rng.integers(0, 6), rng.integers(1, 6)
        follows = np.append(np.arange(1, n), 0)
        follows[tail + circle - 1] = tail
        values = rng.integers(0, 3, (n, 4)).astype(float)
        values[:, 0] = np.arange(n)  # all states differ
        count, turning, _ = iterated(values, follows, False)
        assert 0 < -float(count) <= 3 * (tail + circle) + 1
        round_it = values[tail : tail + circle]
        np.testing.assert_array_equal(turning > 0, (round_it != round_it[0]).any(axis=0))
        assert float(iterated(values, follows, True)[0]) > 0
    values = np.arange(60.0)[:, None]
    assert iterated(values, np.minimum(np.arange(1, 61), 59), False)[2][50] == 50


def test_a_search_that_is_not_wanted_costs_nothing():
    """Members of a batch in which nothing crosses end where the step does."""

    @jax.jit
    def search(going):
        def guards(t):
            return jnp.stack([0.5 - t])

        return first_crossing(guards, guards(1.0) < 0, jnp.zeros(()), jnp.ones(()), guards(0.0), guards(1.0), going)

    assert abs(float(search(True)) - 0.5) < 1e-12 and float(search(False)) == 1.0


def test_clocks_and_immediate_events_at_the_start():
    """A clock with offset 0 ticks when the run begins, what is immediate happens if its guard is below zero there, and
    neither is logged."""
    immediate = Event({"a": {"pre a": 1.0, "1": 10.0}}, {"x": 1.0, "1": -2.0}, immediate=True)
    clock = Event({"b": {"pre b": 1.0, "1": 1.0}, "a": {"a": 1.0, "1": 1.0}}, clock=(0.5, 0.0))
    numbers, names = affine({"x": {"1": 1.0}}, [immediate, clock], at={"x": 1.0}, discrete={"a": 0.5, "b": 0.0})

    @jax.jit
    def begin(numbers, t0, x0):
        problem = Affine(numbers, jnp.asarray(1e-14))
        return start(problem, t0, x0, numbers.q, None, MAX_EVENTS, False)

    held = begin(numbers, 0.0, numbers.x)
    np.testing.assert_allclose(held.q[:2], [10.5, 1.0])  # both read what was before them
    assert float(held.count) == 0 and float(held.due[0]) == 0.5
    later = begin(numbers, 0.7, numbers.x + 2.0)  # between two ticks, and the guard is above zero
    np.testing.assert_allclose(later.q[:2], [0.5, 0.0])
    assert float(later.due[0]) == 1.0 and names.targets[4] == "a"
