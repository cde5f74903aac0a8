"""Variables that equations determine without any state: pins at constant places, prescribed motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq, sin

from jaxonomy_dae import Component, Domain, EqnEnv, der

Planar = Domain("Planar", across=(("x", "m"), ("y", "m")), through=(("fx", "N"), ("fy", "N")))
G, MASS, LENGTH = 9.81, 1.7, 2.0


class Pin(Component):
    """A point at a constant place."""

    def __init__(self, ev, name, x=0.5, y=-0.25):
        super().__init__(ev, name)
        p = self.port("p", Planar)
        self.add_equations(Eq(p.x, self.parameter("x0", x)), Eq(p.y, self.parameter("y0", y)))


class Shaken(Component):
    """A point whose place is prescribed, in two steps: s = a·sin(3 t), x = 2 s."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p = self.port("p", Planar)
        s, a = self.variable("s"), self.parameter("a", 0.3)
        self.add_equations(Eq(s, a * sin(3 * ev.t)), Eq(p.x, 2 * s), Eq(p.y, 1.5))


class Rod(Component):
    """A massless rod of constant length; it pulls with lam times its extent."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.port("a", Planar), self.port("b", Planar)
        lam = self.variable("lam")
        self.add_equations(
            Eq((a.x - b.x) ** 2 + (a.y - b.y) ** 2, self.parameter("L", LENGTH) ** 2),
            Eq(a.fx, lam * (a.x - b.x)),
            Eq(a.fy, lam * (a.y - b.y)),
            Eq(b.fx, -a.fx),
            Eq(b.fy, -a.fy),
        )


class Bob(Component):
    """A point mass under gravity."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p, m = self.port("p", Planar), self.parameter("m", MASS)
        vx, vy = self.variable("vx"), self.variable("vy")
        self.add_equations(Eq(der(p.x), vx), Eq(der(p.y), vy), Eq(m * der(vx), p.fx), Eq(m * der(vy), p.fy - m * G))


def hung_from(pivot, **options):
    ev = EqnEnv()
    held, rod, bob = pivot(ev, "pivot"), Rod(ev, "rod"), Bob(ev, "bob")
    return compiled(held, rod, bob, connect=[(held.p, rod.a), (rod.b, bob.p)], **options)


def place(pivot, t, p):
    """The pivot's place."""
    return jnp.array([p["x0"], p["y0"]]) if pivot is Pin else jnp.array([2 * p["a"] * jnp.sin(3 * t), 1.5])


def acceleration(pivot, t, position, velocity, p):
    """By hand: r = position − pivot, m·(r'' + pivot'') = m·g − μ·r with r·r'' = −|r'|²."""
    at, rate, bend = (
        f(jnp.asarray(t)) for f in (
            lambda t: place(pivot, t, p),
            jax.jacfwd(lambda t: place(pivot, t, p)),
            jax.jacfwd(jax.jacfwd(lambda t: place(pivot, t, p))),
        )
    )  # fmt: skip
    r, v, g = position - at, velocity - rate, jnp.array([0.0, -G])
    mu = MASS * (v @ v + r @ (g - bend)) / (r @ r)
    return g - mu * r / MASS


@pytest.mark.slow
@pytest.mark.parametrize("pivot", [Shaken, pytest.param(Pin, marks=pytest.mark.slow)])
def test_what_is_known_is_not_a_state(pivot):
    """Four states for a pin: its place and velocity were integrated, and projected, beside those of the mass."""
    system = hung_from(pivot)
    assert len(system.states) == 4 and all(name.startswith("bob.") for name in system.states)
    assert system.plan.n_constraints == 2
    t, p = 0.7, {"x0": 0.5, "y0": -0.25} if pivot is Pin else {"a": 0.3}
    names = ["bob.p.x", "bob.p.y", "bob.vx", "bob.vy"]

    @jax.jit
    def computed(p):
        known = place(pivot, t, p)
        rate = jax.jacfwd(lambda t: place(pivot, t, p))(t)
        position = known + LENGTH * jnp.array([np.sin(0.4), -np.cos(0.4)])
        velocity = rate + 1.3 * jnp.array([np.cos(0.4), np.sin(0.4)])
        moving = jnp.concatenate([position, velocity])
        x = system.initialize(t0=t, initial=dict(zip(names, moving, strict=True)))

        def bent(p):
            changed = system.with_parameters({f"pivot.{name}": value for name, value in p.items()})
            return changed.observe(["der(bob.vx)", "der(bob.vy)"], t, x)

        def by_hand(p):
            return acceleration(pivot, t, position, velocity, p)

        seen = system.observe([*names, "pivot.p.x", "pivot.p.y"], t, x)
        expected = jnp.concatenate([moving, known])
        return seen, expected, bent(p), by_hand(p), jax.jacrev(bent)(p), jax.jacfwd(by_hand)(p)

    seen, expected, found, true, slopes, true_slopes = computed(p)
    np.testing.assert_allclose(seen, expected, rtol=1e-12)
    np.testing.assert_allclose(seen[4:], expected[4:], rtol=1e-14)
    np.testing.assert_allclose(found, true, rtol=1e-12)
    for name, slope in slopes.items():
        np.testing.assert_allclose(slope, true_slopes[name], rtol=1e-9, atol=1e-12)


def test_a_preferred_state_that_is_known_is_noted():
    system = hung_from(Pin, prefer_states=["pivot.p.x"])
    assert any("was preferred as a state, but equations without states determine it" in n for n in system.report.notes)
    assert len(system.states) == 4


def test_projection_keeps_all_candidates():
    system = hung_from(Pin, state_selection="projection")
    assert len(system.states) == 8


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_chains_of_known_variables(seed):
    """x₁ = p·sin(t), xₖ₊₁ = cₖ·xₖ + dₖ, written in any order; the last one prescribes y through p·y + y³ = xₙ."""
    rng = np.random.default_rng(seed)
    n = 6
    slope, shift = rng.uniform(0.5, 1.5, n), rng.uniform(-1, 1, n)

    class Model(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            p = self.parameter("p", 0.8)
            x = self.vector("x", n)
            y, f = self.variable("y"), self.variable("f")
            equations = [Eq(x[0], p * sin(ev.t))]
            equations += [Eq(x[k + 1], float(slope[k]) * x[k] + float(shift[k])) for k in range(n - 1)]
            equations += [Eq(der(der(y)), f), Eq(p * y + y**3, x[n - 1])]
            self.add_equations(*(equations[k] for k in rng.permutation(len(equations))))

    system = compiled(Model(EqnEnv(), "m"))
    settled = {system.plan.quantity_name[q] for q in system.plan.selection.settled}
    assert {f"m.x[{k}]" for k in range(n)} <= settled
    last = 0.8 * np.sin(0.3)
    for k in range(n - 1):
        last = slope[k] * last + shift[k]
    names = ["m.y", f"m.x[{n - 1}]"]
    y, found = jax.jit(lambda: system.observe(names, 0.3, system.initialize(t0=0.3)))()
    assert abs(0.8 * y + y**3 - last) < 1e-10
    np.testing.assert_allclose(found, last, rtol=1e-13)
