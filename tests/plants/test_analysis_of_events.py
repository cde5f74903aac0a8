"""Steady states and linear models of systems with modes, events and clocks, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Abs, Eq, Max, Min, Ne, Piecewise

import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import (
    Component,
    EqnEnv,
    ModelError,
    SteadyStateError,
    assign,
    der,
    frequency_response,
    linearize,
    pre,
    reinit,
    steady_state,
    terminate,
)
from jaxonomy_dae.library.friction import StickingFriction
from jaxonomy_dae.library.signal import DiscretePI

ROUNDING = 1e-11


def one(build):
    """A system of one component `c`, whose declarations `build(c)` makes."""

    class Built(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            build(self)

    return compiled(Built(EqnEnv(), "c"))


def test_discrete_equations_that_read_a_clock_are_refused():
    """It was said that there is no steady state. At x = u = 1 there is one."""

    def build(self):
        x, u, ticks = self.variable("x", start=0.2, fixed=True), self.discrete("u"), self.discrete("ticks")
        self.add_equations(Eq(der(x), u - x))
        self.when(self.sampled(0.1), assign(ticks, pre(ticks) + 1))
        self.discrete_equation(u, Piecewise((pre(u) + 1 - x, Ne(ticks, pre(ticks))), (pre(u), True)))

    with pytest.raises(ModelError, match="discrete equations of 'c' read by 'c.ticks' when a clock ticks"):
        steady_state(one(build), drifting=["c.ticks"])


def lag(c, drive):
    """x' = −x + drive, from 0."""
    x = c.variable("x", start=0.0, fixed=True)
    c.add_equations(Eq(der(x), -x + drive))
    return x


# --- clocks ------------------------------------------------------------------------------------------------------


@functools.cache
def held_at_one():
    """A sampled PI controller that holds x' = −x + u at 1."""
    ev = EqnEnv()

    class Plant(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            u, x = self.input("u"), self.variable("x", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), -x + u))
            self.output("e", 1.0 - x)

    plant, pi = Plant(ev, "pl"), DiscretePI(ev, "pi", kp=0.5, ki=1.0, period=0.1)
    return compiled(plant, pi, connect=[(plant.e, pi.u), (pi.y, plant.u)])


@functools.cache
def sampled_proportional():
    """x' = −x + u with u = 3·(r − x), sampled every T."""

    def build(c):
        u, r, T = c.discrete("u"), c.input("r", default=1.0), c.parameter("T", 0.1)
        x = lag(c, u)
        c.when(c.sampled(T), assign(u, 3 * (r - x)))

    return one(build)


@pytest.mark.slow
def test_a_sampled_loop_rests_where_a_tick_changes_nothing():
    """Discrete variables were constants for a steady state: it cut the loop without a word, and said 0 for 1."""
    names = ["pl.x", "pl.u", "pi.held", "pi.total", "pl.e"]
    np.testing.assert_allclose(steady_state(held_at_one())[names], [1.0, 1.0, 1.0, 1.0, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(jax.jit(lambda s: steady_state(s)["pi.total"])(held_at_one()), 1.0, rtol=ROUNDING)


@pytest.mark.slow
def test_a_sampled_loop_has_no_continuous_state_space():
    """The controller's output was held constant, and the poles were those of the plant alone."""
    with pytest.raises(ModelError, match=r"'c\.u', which 'c: when\(sampled\(T\)\)' writes.*sampled=True"):
        linearize(sampled_proportional(), [], ["c.x"])
    inside = jax.jit(lambda s: linearize(s, [], ["c.x"]).A)(sampled_proportional())
    assert np.isnan(inside).all()


@pytest.mark.slow
def test_the_change_from_tick_to_tick():
    """x after a period is e·x + (1 − e)·u with e = exp(−T), u = 3·(r − x)."""
    T = 0.1
    e = np.exp(-T)
    space = linearize(sampled_proportional(), ["c.r"], ["c.x"], sampled=True)
    assert space.states == ("c.x", "c.u") and space.inputs == ("c.r",)
    np.testing.assert_allclose(space.A, [[e - 3 * (1 - e), 0.0], [-3.0, 0.0]], atol=ROUNDING)
    np.testing.assert_allclose(space.B, [[3 * (1 - e)], [3.0]], atol=ROUNDING)
    np.testing.assert_allclose([*space.x0, *space.y0, space.dt], [0.75, 0.75, 0.75, T], rtol=ROUNDING)
    np.testing.assert_allclose(space.dx0, 0.0, atol=ROUNDING)
    np.testing.assert_allclose(space.poles(), [e - 3 * (1 - e), 0.0], atol=ROUNDING)
    constant = space.frequency_response([0.0])["c.x", "c.r"]
    np.testing.assert_allclose(constant, 0.75, rtol=ROUNDING)  # 3/(1 + 3), the gain of the steady state

    def pole(T):
        system = sampled_proportional().with_parameters({"c.T": T})
        return linearize(system, [], ["c.x"], sampled=True).A[0, 0]

    np.testing.assert_allclose(jax.jit(jax.grad(pole))(T), -4 * e, rtol=ROUNDING)


@pytest.mark.slow
def test_clocks_with_a_common_period():
    """u = w − 2·x every 0.1, w grows by 0.1·(r − x) every 0.3, 0.05 later: the product of ticks and flows."""

    def build(c):
        u, w, r = c.discrete("u"), c.discrete("w"), c.input("r", default=1.0)
        x = lag(c, u)
        c.when(c.sampled(0.1), assign(u, w - 2 * x))
        c.when(c.sampled(0.3, 0.05), assign(w, pre(w) + 0.1 * (r - x)))

    space = linearize(one(build), ["c.r"], ["c.x"], sampled=True)

    def flow(d):
        return np.array([[np.exp(-d), 1 - np.exp(-d), 0], [0, 1, 0], [0, 0, 1]])

    u, w = np.array([[1, 0, 0], [-2, 0, 1], [0, 0, 1]]), np.array([[1, 0, 0], [0, 1, 0], [-0.1, 0, 1]])
    known = flow(0.1) @ u @ flow(0.1) @ u @ flow(0.05) @ w @ flow(0.05) @ u
    assert space.states == ("c.x", "c.u", "c.w")
    np.testing.assert_allclose(space.A, known, atol=ROUNDING)
    np.testing.assert_allclose(space.dt, 0.3, rtol=ROUNDING)


@pytest.mark.slow
def test_clocks_without_a_common_period_are_refused():
    def build(c):
        u, w = c.discrete("u"), c.discrete("w")
        x = lag(c, u + w)
        c.when(c.sampled(0.1), assign(u, -x))
        c.when(c.sampled(0.1 * np.pi), assign(w, -x))

    with pytest.raises(ModelError, match="do not tick together again"):
        linearize(one(build), [], ["c.x"], sampled=True)


@pytest.mark.slow
def test_a_counter_does_not_rest_unless_it_may_go_on():
    def build(c):
        n = c.discrete("n")
        lag(c, 2)
        c.when(c.sampled(1.0), assign(n, pre(n) + 1))

    system = one(build)
    with pytest.raises(SteadyStateError, match=r"the change of c\.n = 1.*drifting=\['c\.n'\]"):
        steady_state(system)
    point = steady_state(system, drifting=["c.n"])
    np.testing.assert_allclose(point[["c.x", "c.n"]], [2.0, 0.0], rtol=ROUNDING)
    # What only counts is not part of the linear model, and does not stand in its way.
    np.testing.assert_allclose(linearize(system, [], ["c.x"], at=point).A, [[-1.0]], rtol=ROUNDING)


# --- modes -------------------------------------------------------------------------------------------------------


@functools.cache
def rectifier():
    """A source of E behind 10 Ω and an ideal diode, a capacitor of 1 mF with a load of 500 Ω."""

    def build(c):
        E, v = c.parameter("E", 5.0), c.variable("v", start=0.0, fixed=True)
        i, vd = c.variable("i"), c.variable("vd")
        c.complementary(-vd, i)
        c.add_equations(Eq(E - 10 * i - vd, v), Eq(1e-3 * der(v), i - v / 500))

    return one(build)


@pytest.mark.slow
def test_the_operating_point_of_a_rectifier():
    """Conducts for E > 0, v = E·500/510, and blocks for E < 0; which is found, inside jit and vmap alike. The mode was
    that of the declaration."""

    def voltages(E):
        point = steady_state(rectifier().with_parameters({"c.E": E}))
        return point["c.v"], point[["c.vd", "c.active"]]

    by_E, others = jax.jit(jax.vmap(jax.grad(voltages, has_aux=True)))(jnp.array([5.0, -5.0]))
    np.testing.assert_allclose(by_E, [500 / 510, 0.0], atol=ROUNDING)
    np.testing.assert_allclose(others, [[0.0, 1.0], [-5.0, 0.0]], atol=ROUNDING)


@pytest.mark.slow
def test_a_rectifier_between_its_modes_is_not_linear():
    """At E = 0 small deviations of one sign conduct: the linear model is that of neither side."""
    with pytest.raises(ModelError, match=r"'c: when\(.*turns.*beside it"):
        linearize(rectifier().with_parameters({"c.E": 0.0}), [], ["c.v"])
    conducting = linearize(rectifier(), [], ["c.v"])
    np.testing.assert_allclose(conducting.A, [[-(1 / 10 + 1 / 500) / 1e-3]], rtol=ROUNDING)


@pytest.mark.slow
def test_a_limiter_with_two_diodes():
    """E behind 10 Ω, 100 Ω to ground, and ideal diodes to ±1 V: v = min(max(E·100/110, −1), 1)."""

    def build(c):
        E, v, w = c.parameter("E", 0.5), c.variable("v"), c.variable("w", start=0.0, fixed=True)
        up, down = c.variable("up"), c.variable("down")
        c.complementary(1 - v, up, name="high")
        c.complementary(v + 1, down, name="low")
        c.add_equations(Eq((E - v) / 10, v / 100 + up - down), Eq(der(w), v - w))

    system, E = one(build), np.array([0.5, 5.0, -5.0])
    found = [steady_state(system.with_parameters({"c.E": e}))[["c.w", "c.up", "c.high", "c.low"]] for e in E]
    known = [[0.5 / 1.1, 0, 0, 0], [1, 0.4 - 0.01, 1, 0], [-1, 0, 0, 1]]
    np.testing.assert_allclose(found, known, atol=ROUNDING)


@pytest.mark.slow
def test_a_ball_rests_on_the_floor():
    """Without the floor there is no equilibrium: the contact that lets there be one is found."""

    def build(c):
        h, v = c.variable("h", start=1.0, fixed=True), c.variable("v", start=0.0, fixed=True)
        f = c.variable("f")
        c.complementary(h, f, order=2, restitution=0.5)
        c.add_equations(Eq(der(h), v), Eq(2 * der(v), f - 2 * 9.81))

    point = steady_state(one(build))
    np.testing.assert_allclose(point[["c.h", "c.v", "c.f", "c.active"]], [0.0, 0.0, 2 * 9.81, 1.0], atol=ROUNDING)


@pytest.mark.slow
def test_friction_that_sticks():
    """A mass under 2 N behind friction of 3 to 5 N stays where it starts; nothing else says where, which the error
    says, with all that must be kept. Under 6 N it slides and does not rest."""
    ev = EqnEnv()
    mass, wall = tr.Mass(ev, "mass", 1.0, initial_position=0.3), tr.FixedPosition(ev, "wall")
    friction, force = StickingFriction(ev, "friction", sliding=3.0, breakaway=5.0), tr.Force(ev, "force")
    joined = [(wall.flange, friction.flange_a), (friction.flange_b, mass.flange, force.flange)]
    system = compiled(mass, wall, friction, force, connect=joined)
    with pytest.raises(SteadyStateError, match=r"drifting=\['mass\.s', 'mass\.v'\]"):
        steady_state(system, inputs={"force.f": 2.0})
    point = steady_state(system, inputs={"force.f": 2.0}, drifting=["mass.s", "mass.v"])
    names = ["mass.s", "mass.v", "friction.f", "friction.mode"]
    np.testing.assert_allclose(point[names], [0.3, 0.0, 2.0, 0.0], atol=ROUNDING)
    with pytest.raises(SteadyStateError, match=r"der\(mass\.v\) = 3"):
        steady_state(system, inputs={"force.f": 6.0})


# --- events and relations ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "what, match",
    [
        pytest.param("thermostat", r"no steady state.*without end.*drifting=\['c\.on'\]", marks=pytest.mark.slow),
        ("neuron", r"no steady state.*without end, as 'c: when\(x >= 1\)'"),
        pytest.param("fuse", r"holds at the equilibrium, where it ends the run \('hot'\)", marks=pytest.mark.slow),
    ],
)
def test_what_events_do_not_let_rest(what, match):
    """Each has an equilibrium of its equations, to which no run comes: discrete variables were constants there."""

    def build(c):
        if what == "thermostat":
            on = c.discrete("on", start=1)
            x = lag(c, 100 * on)
            c.when(x < 49, assign(on, 1))
            c.when(x > 51, assign(on, 0))
            return
        x = lag(c, 2)
        c.when(x >= 1, reinit(x, 0) if what == "neuron" else terminate("hot"))

    system = one(build)
    with pytest.raises(SteadyStateError, match=match):
        steady_state(system)
    assert np.isnan(steady_state(system, throw=False).x).all()


@pytest.mark.slow
def test_an_event_on_the_way_has_happened():
    """x' = −x + 2 + l; above 1, l becomes 2·w, and stays: x = 2 + 2·w, with the derivative 2 by w."""

    def build(c):
        latched, w = c.discrete("l"), c.parameter("w", 3.0)
        x = lag(c, 2 + latched)
        c.when(x > 1, assign(latched, 2 * w))

    system = one(build)

    def rest(w):
        point = steady_state(system.with_parameters({"c.w": w}))
        return point["c.x"], point["c.l"]

    by_w, latched = jax.jit(jax.grad(rest, has_aux=True))(3.0)
    np.testing.assert_allclose([by_w, latched], [2.0, 6.0], rtol=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("x, total", [(0.0, 5.0), (3.0, -5.0)])
def test_a_saturated_start(x, total):
    """A PI controller bounded by ±0.5 holds x' = −x + u at 0.4. Where it starts at a bound, no slope depends on its
    integral, and no search for a root leads away; a run does."""

    def build(c):
        position, integral = c.variable("x", start=0.0), c.variable("I", start=0.0)
        u = Max(Min(2 * (0.4 - position) + integral, 0.5), -0.5)
        c.add_equations(Eq(der(position), -position + u), Eq(der(integral), 0.4 - position))

    point = steady_state(one(build), initial={"c.x": x, "c.I": total})
    np.testing.assert_allclose(point[["c.x", "c.I"]], [0.4, 0.4], rtol=1e-9)


def test_a_kink_has_no_linear_model():
    """x' = −|x| − x rests at 0, with slopes −2 and 0 on its sides; of x·|x| both sides are alike."""

    def build(law):
        def equation(c):
            x = c.variable("x", start=0.5, fixed=True)
            c.add_equations(Eq(der(x), -law(x) - x))

        return one(equation)

    with pytest.raises(ModelError, match=r"'c: when\(x >= 0\)' turns"):
        linearize(build(Abs), [], ["c.x"])
    np.testing.assert_allclose(linearize(build(lambda x: x * Abs(x)), [], ["c.x"]).A, [[-1.0]], rtol=ROUNDING)


def test_frequencies_of_a_sampled_loop():
    """x(z)/r(z) = b/(z − a) at z = exp(jωT)."""
    e, omega = np.exp(-0.1), np.array([0.3, 5.0, 20.0])
    found = frequency_response(sampled_proportional(), inputs=["c.r"], outputs=["c.x"], omega=omega, sampled=True)
    known = 3 * (1 - e) / (np.exp(1j * omega * 0.1) - (e - 3 * (1 - e)))
    np.testing.assert_allclose(found["c.x", "c.r"], known, rtol=1e-10)
