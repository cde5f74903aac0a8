"""Parts that meet and part, against closed forms: the index changes with the mode, and speeds and charges jump.

Runs are made at rtol = atol = 1e-10. What is integrated between events is a parabola, an exponential or a pendulum, so
that states are right to some tens of tolerances, and gradients to some hundreds: 1e-8, unless a comment says more.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from component_references import checks, measured
from hybrid_models import Bob
from hybrid_references import AT_1_5, BOUNCES, BY_V0, HEIGHT, SLACK, SLOPES, TAUT
from problems import compiled
from sympy import sqrt

import jaxonomy_dae as jd
import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.planar as planar
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import Component, EqnEnv, SimulationError, der, simulate
from jaxonomy_dae.library.contacts import DogClutch, HardStop, Rope
from jaxonomy_dae.solvers import BDF, Rodas5P, StoredAdjoint
from jaxonomy_dae.write import Eq

TIGHT = dict(rtol=1e-10, atol=1e-10)
ORIGIN = "some tens of tolerances of 1e-10"
SMOOTH = 1e-8


def central(f, p, h):
    return (f(p + h) - f(p - h)) / (2 * h)


# --- a string that goes slack ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bob():
    return compiled(Bob(EqnEnv(), "bob"))


def flown(system, v0, **options):
    solution = simulate(system.with_parameters({"bob.v0": v0}), 1.5, **TIGHT | options)
    return jnp.stack([solution["bob.x"][-1], solution["bob.y"][-1]]), solution.events.ts[:2]


SOLVERS = {"Tsit5": None, "Rodas5P": Rodas5P()}


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_string_by_every_solver(bob, solver):
    end, times = flown(bob, 5.2, solver=SOLVERS[solver])
    # Two events, a pendulum and a parabola at tolerances of 1e-10.
    np.testing.assert_allclose(times, [SLACK, TAUT], rtol=0, atol=1e-10)
    np.testing.assert_allclose(end, AT_1_5, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_string_by_bdf(bob):
    end, times = flown(bob, 5.2, solver=BDF())
    # A multistep method restarts twice, and keeps its tolerance a step, not over the run.
    np.testing.assert_allclose(times, [SLACK, TAUT], rtol=0, atol=1e-5)
    np.testing.assert_allclose(end, AT_1_5, rtol=0, atol=1e-5)


ADJOINTS = {"stored": StoredAdjoint(), "forward": diffrax.ForwardMode()}


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [*ADJOINTS])
def test_derivatives_of_a_string(bob, adjoint):
    jacobian = jax.jacfwd if adjoint == "forward" else jax.jacrev
    found = jax.jit(jacobian(lambda v0: flown(bob, v0, adjoint=ADJOINTS[adjoint])[0]))(5.2)
    np.testing.assert_allclose(found, BY_V0, rtol=1e-8)


@pytest.mark.slow
def test_a_string_stays_taut_for_long(bob):
    """Slow enough it never goes slack: a pendulum, held to the circle for many periods."""
    solution = simulate(bob.with_parameters({"bob.v0": 3.0}), 60.0, rtol=1e-6, atol=1e-6)
    x, y, vx, vy = (np.asarray(solution[f"bob.{n}"]) for n in ("x", "y", "vx", "vy"))
    assert len(solution.events) == 0
    # Projected after every step: to rounding, squared in what is left.
    np.testing.assert_allclose(np.hypot(x, y), 1.0, atol=1e-10)
    np.testing.assert_allclose(x * vx + y * vy, 0.0, atol=1e-8)


@pytest.mark.slow
def test_a_batch_of_strings(bob):
    """Members with no event and with two: each is its own run."""
    speeds = jnp.array([1.0, 3.0, 4.6, 5.0, 5.2, 6.0, 8.0])
    ends = jax.jit(jax.vmap(lambda v: flown(bob, v)[0]))(speeds)
    np.testing.assert_allclose(ends, [flown(bob, v)[0] for v in speeds], atol=1e-9)


def test_the_report_tells_the_index(bob):
    assert bob.report.index_changes == ["bob: L - sqrt(x**2 + y**2) = 0 while Eq(taut, 1): index 3 while it does"]


@pytest.mark.slow
@checks(
    {planar.String: ("pendulum and parabola of a string that goes slack, by mpmath", "place", "events")},
    origin=ORIGIN,
)
def test_a_string_between_frames():
    ev = EqnEnv()
    world, string = planar.World(ev, "world"), planar.String(ev, "string", 1.0, taut=True)
    bob = planar.Body(
        ev, "bob", 2.0, 1.0, initial_x=0.0, initial_y=-1.0, initial_angle=0.0, initial_vx=5.2, initial_vy=0.0,
        initial_speed=0.0,
    )  # fmt: skip
    system = compiled(world, string, bob, connect=[(world.frame, string.frame_a), (string.frame_b, bob.frame)])
    solution = simulate(system, 1.5, **TIGHT)
    measured("place", [solution["bob.x"][-1], solution["bob.y"][-1]], AT_1_5, 1e-9)
    measured("events", solution.events.ts[:2], [SLACK, TAUT], 1e-9)


@pytest.mark.slow
def test_a_string_whose_ends_meet():
    """A body thrown from the hook of its string flies along a parabola until the string is taut; then only the speed
    across the string is left."""
    ev, v0, g = EqnEnv(), 0.5, 9.81
    world, string = planar.World(ev, "world"), planar.String(ev, "string", 1.0)
    bob = planar.Body(
        ev, "bob", 2.0, 1.0, initial_x=0.0, initial_y=0.0, initial_angle=0.0, initial_vx=v0, initial_vy=0.0,
        initial_speed=0.0,
    )  # fmt: skip
    system = compiled(world, string, bob, connect=[(world.frame, string.frame_a), (string.frame_b, bob.frame)])
    t = scipy.optimize.brentq(lambda t: (v0 * t) ** 2 + (g * t**2 / 2) ** 2 - 1, 0.1, 1.0)
    solution = simulate(system, t + 1e-6, **TIGHT)
    np.testing.assert_allclose(solution.events.ts[:1], [t], rtol=1e-9)
    x, y, vx, vy = (solution.events.after[f"bob.{name}"][0] for name in ("x", "y", "vx", "vy"))
    np.testing.assert_allclose([x, y], [v0 * t, -g * t**2 / 2], rtol=1e-9)
    across = (x * -g * t - y * v0) / (x**2 + y**2)
    np.testing.assert_allclose([vx, vy], [-across * y, across * x], rtol=1e-8)


# --- stops and ropes -------------------------------------------------------------------------------------------------


def falling(*parts, connect=(), M=1.0, height=1.0, velocity=0.0):
    """A mass that falls, above the ground at 0, with parts between."""
    ev = parts[0].ev
    ground, mass, weight = (
        line.FixedPosition(ev, "ground"),
        line.Mass(ev, "mass", M, height, velocity),
        line.Force(ev, "w"),
    )
    between = [(ground.flange, parts[0].flange_a), (parts[0].flange_b, mass.flange, weight.flange), *connect]
    return compiled(*parts, ground, mass, weight, connect=between)


@pytest.mark.slow
@checks(
    {HardStop: ("closed form of a bouncing ball", "height", "bounces", "by restitution", "by height")}, origin=ORIGIN
)
def test_a_ball_on_a_stop():
    system = falling(HardStop(EqnEnv(), "stop", restitution=0.8, rest_speed=0.0))
    given = dict(inputs={"w.f": -9.81}, **TIGHT)

    def height(e, h):
        return simulate(system.with_parameters({"stop.restitution": e, "mass.initial_position": h}), 3.0, **given)[
            "mass.s"
        ][-1]

    solution = simulate(system, 3.0, **given)
    measured("height", solution["mass.s"][-1], HEIGHT, SMOOTH)
    measured("bounces", solution.events.ts[:6], BOUNCES, 1e-10)
    by = jax.jit(jax.grad(height, (0, 1)))(0.8, 1.0)
    measured("by restitution", by[0], SLOPES[0], SMOOTH)
    measured("by height", by[1], SLOPES[2], SMOOTH)


@pytest.mark.slow
def test_a_ball_comes_to_rest():
    """It bounces while e·v is above the rest speed, then stays, carried by its weight."""
    M, e, rest = 2.0, 0.5, 0.1
    system = falling(HardStop(EqnEnv(), "stop", restitution=e, rest_speed=rest), M=M)
    solution = simulate(system, 5.0, inputs={"w.f": -9.81 * M}, **TIGHT)
    speed, count = np.sqrt(2 * 9.81), 0
    while e * speed > rest:
        speed, count = e * speed, count + 1
    assert len(solution.events) == count + 1 and float(solution["stop.touching"][-1]) == 1
    t0 = np.sqrt(2 / 9.81)
    times = t0 + np.concatenate([[0.0], np.cumsum(2 * t0 * e ** np.arange(1, count + 1))])
    np.testing.assert_allclose(solution.events.ts[: count + 1], times, atol=1e-9)
    assert abs(float(solution["mass.s"][-1])) < 1e-12 and abs(float(solution["mass.v"][-1])) < 1e-12
    np.testing.assert_allclose(solution["stop.f"][-1], 9.81 * M, rtol=1e-12)


@pytest.mark.slow
def test_a_mass_is_lifted_off_and_set_down():
    """A force 15·sin t on 1 kg that rests on the ground: it lifts at sin t = g/15, flies, and lands. Between, x is the
    twice integrated force."""
    g, a = 9.81, 15.0
    system = falling(HardStop(EqnEnv(), "stop", touching=True), height=0.0)
    ts = jnp.linspace(0.0, 6.0, 61)

    def run(g):
        return simulate(system, 6.0, ts=ts, inputs={"w.f": lambda t: a * jnp.sin(t) - g}, **TIGHT)

    solution = run(g)
    lift = np.arcsin(g / a)

    def flight(t):
        s = t - lift
        return a * (np.sin(lift) - np.sin(t)) + a * np.cos(lift) * s - g * s**2 / 2

    land = scipy.optimize.brentq(flight, lift + 0.5, 6.0, xtol=1e-15)
    assert len(solution.events) == 2
    np.testing.assert_allclose(solution.events.ts[:2], [lift, land], atol=1e-9)
    inside = (ts > lift) & (ts < land)
    # The flight begins where all of x, v and the acceleration are zero.
    np.testing.assert_allclose(solution["mass.s"], np.where(inside, flight(np.asarray(ts)), 0.0), atol=SMOOTH)
    np.testing.assert_allclose(solution["stop.f"], np.where(inside, 0.0, g - a * np.sin(ts)), atol=1e-7)
    found = jax.jit(jax.jacrev(lambda g: run(g).events.ts[:2]))(g)
    lift_by = 1 / np.sqrt(a**2 - g**2)
    h = 1e-5
    expected = central(lambda g: np.asarray(run(g).events.ts[:2]), g, h)
    np.testing.assert_allclose(found[0], lift_by, rtol=1e-8)
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # of differences with a step of 1e-5


@pytest.mark.slow
@checks({Rope: ("momentum of two masses that a rope joins", "speeds", "events", "by mass")}, origin=ORIGIN)
def test_a_rope_between_two_carts():
    """A cart that runs away at 3 m/s tows another of mass 2 after 0.5 s: both go on at 3·m/(m + 2)."""
    ev = EqnEnv()
    first, second = line.Mass(ev, "first", 1.0, 0.5, 3.0), line.Mass(ev, "second", 2.0, 0.0, 0.0)
    rope = Rope(ev, "rope", 2.0)
    system = compiled(rope, first, second, connect=[(second.flange, rope.flange_a), (rope.flange_b, first.flange)])

    def run(m):
        return simulate(system.with_parameters({"first.m": m}), 2.0, **TIGHT)

    solution = run(1.0)
    measured("events", solution.events.ts[:1], [0.5], 1e-10)
    measured("speeds", [solution["first.v"][-1], solution["second.v"][-1]], [1.0, 1.0], SMOOTH)
    # x(2) = 2 + 1.5·3m/(m + 2), its derivative 9/(m + 2)².
    measured("by mass", jax.jit(jax.grad(lambda m: run(m)["first.s"][-1]))(1.0), 1.0, SMOOTH)


@pytest.mark.slow
def test_equal_masses_exchange_their_speeds():
    """Three carts in a row, restitution 1: the last runs off with the speed of the first."""
    ev = EqnEnv()
    carts = [line.Mass(ev, f"m{k}", 1.0, float(k), 2.0 if k == 0 else 0.0) for k in range(3)]
    stops = [HardStop(ev, f"s{k}", restitution=1.0) for k in range(2)]
    joints = [
        (carts[0].flange, stops[0].flange_a), (stops[0].flange_b, carts[1].flange, stops[1].flange_a),
        (stops[1].flange_b, carts[2].flange),
    ]  # fmt: skip
    solution = simulate(compiled(*carts, *stops, connect=joints), 2.0, **TIGHT)
    np.testing.assert_allclose(solution.events.ts[:2], [0.5, 1.0], atol=1e-10)
    np.testing.assert_allclose([solution[f"m{k}.v"][-1] for k in range(3)], [0.0, 0.0, 2.0], atol=1e-9)
    np.testing.assert_allclose([solution[f"m{k}.s"][-1] for k in range(3)], [1.0, 2.0, 4.0], atol=1e-8)


@pytest.mark.slow
def test_a_jerk_lifts_what_rests_on_the_ground():
    """A mass of 2 kg rests on the ground; a rope of 1 m from it to another of 1 kg, shot upwards at 6 m/s from 0.5 m,
    becomes taut. The ground does not pull: both go on with their common momentum."""
    g, ev = 9.81, EqnEnv()
    ground, stop = line.FixedPosition(ev, "ground"), HardStop(ev, "stop", touching=True)
    low, high = line.Mass(ev, "low", 2.0, 0.0, 0.0), line.Mass(ev, "high", 1.0, 0.5, 6.0)
    rope, weights = Rope(ev, "rope", 1.0), [line.Force(ev, "w1"), line.Force(ev, "w2")]
    joints = [
        (ground.flange, stop.flange_a), (stop.flange_b, low.flange, rope.flange_a, weights[0].flange),
        (rope.flange_b, high.flange, weights[1].flange),
    ]  # fmt: skip
    system = compiled(ground, stop, low, high, rope, *weights, connect=joints)
    solution = simulate(system, 0.3, inputs={"w1.f": -2 * g, "w2.f": -g}, **TIGHT)
    jerk = (6 - np.sqrt(36 - 2 * g * 0.5)) / g
    common = np.sqrt(36 - 2 * g * 0.5) / 3
    np.testing.assert_allclose(solution.events.ts[0], jerk, atol=1e-10)
    assert float(solution["stop.touching"][-1]) == 0
    since = 0.3 - jerk
    np.testing.assert_allclose(solution["low.s"][-1], common * since - g * since**2 / 2, atol=1e-9)
    np.testing.assert_allclose(solution["high.s"][-1], 1 + common * since - g * since**2 / 2, atol=1e-9)


# --- shafts and capacitors that are joined ---------------------------------------------------------------------------


@pytest.mark.slow
@checks({DogClutch: ("momentum of shafts that are joined", "speeds", "later", "by inertia")}, origin=ORIGIN)
def test_a_dog_clutch():
    """Joined from 0.5 to 1.5 s, with a torque of 3 N·m on the first shaft."""
    ev = EqnEnv()
    one, two = rot.Inertia(ev, "one", 1.0, 0.0, 10.0), rot.Inertia(ev, "two", 2.0, 0.0, -1.0)
    clutch, torque = DogClutch(ev, "clutch"), rot.Torque(ev, "torque")
    joints = [(torque.flange, one.flange_a), (one.flange_b, clutch.flange_a), (clutch.flange_b, two.flange_a)]
    system = compiled(one, two, clutch, torque, connect=joints)
    inputs = {"torque.tau": 3.0, "clutch.u": lambda t: 0.5 + jnp.sin(jnp.pi * (t - 0.5))}

    def run(J, t1):
        return simulate(system.with_parameters({"one.J": J}), t1, inputs=inputs, **TIGHT)

    joined = (11.5 - 2.0) / 3 + 0.5  # at 1 s
    solution = run(1.0, 1.0)
    measured("speeds", [solution["one.w"][-1], solution["two.w"][-1]], [joined, joined], SMOOTH)
    np.testing.assert_allclose(solution.events.ts[0], 0.5, atol=1e-10)
    later = run(1.0, 2.0)
    measured("later", [later["one.w"][-1], later["two.w"][-1]], [joined + 0.5 + 1.5, joined + 0.5], SMOOTH)
    # (10·J + 1.5 − 2 + 1.5)/(J + 2) by J.
    by = jax.jit(jax.grad(lambda J: run(J, 1.0)["two.w"][-1]))(1.0)
    measured("by inertia", by, (10 * 3 - (10 + 1.0)) / 9, SMOOTH)


SHAFTS = {"J": (1.0, 2.0, 0.5, 3.0), "w": (10.0, -1.0, 4.0, 0.5)}


@pytest.mark.slow
@pytest.mark.parametrize("closed", [(1, 1, 1), (1, 0, 1)])
def test_dog_clutches_that_close_at_once(closed):
    """Four shafts; those joined at the start turn with their common momentum, whatever the order."""
    ev = EqnEnv()
    shafts = [rot.Inertia(ev, f"j{k}", J, 0.0, w) for k, (J, w) in enumerate(zip(*SHAFTS.values(), strict=True))]
    clutches = [DogClutch(ev, f"c{k}") for k in range(3)]
    joints = [(shafts[k].flange_b, c.flange_a) for k, c in enumerate(clutches)]
    joints += [(c.flange_b, shafts[k + 1].flange_a) for k, c in enumerate(clutches)]
    system = compiled(*shafts, *clutches, connect=joints)
    solution = simulate(system, 0.1, inputs={f"c{k}.u": float(u) for k, u in enumerate(closed)}, **TIGHT)
    J, w = (np.array(v) for v in SHAFTS.values())
    part = np.cumsum([0, *(1 - np.array(closed))])
    expected = (np.bincount(part, J * w) / np.bincount(part, J))[part]
    np.testing.assert_allclose([solution[f"j{k}.w"][-1] for k in range(4)], expected, atol=1e-9)


@pytest.mark.slow
@checks({el.JoiningSwitch: ("charge of two capacitors that are joined", "voltage", "discharge", "by C")}, origin=ORIGIN)
def test_two_capacitors_joined():
    """1 mF at 10 V and 3 mF at 2 V are joined at 0.5 s: 4 V, then a discharge through 100 Ω."""
    ev = EqnEnv()
    c1, c2 = el.Capacitor(ev, "c1", 1e-3, 10.0), el.Capacitor(ev, "c2", 3e-3, 2.0)
    switch, load, g = el.JoiningSwitch(ev, "s"), el.Resistor(ev, "r", 100.0), el.Ground(ev, "g")
    joints = [(c1.p, switch.p, load.p), (switch.n, c2.p), (c1.n, c2.n, load.n, g.p)]
    system = compiled(c1, c2, switch, load, g, connect=joints)
    ts = jnp.array([0.25, 0.5, 0.9])

    def run(C):
        return simulate(system.with_parameters({"c1.C": C}), 1.0, ts=ts, inputs={"s.u": lambda t: t}, **TIGHT)["c2.v"]

    def closed_form(C):
        joined = (C * 10 * jnp.exp(-0.5 / (100 * C)) + 6e-3) / (C + 3e-3)
        return jnp.stack([jnp.array(2.0), joined, joined * jnp.exp(-0.4 / (100 * (C + 3e-3)))])

    found, expected = run(1e-3), closed_form(1e-3)
    measured("voltage", found[:2], expected[:2], SMOOTH)
    measured("discharge", found[2], expected[2], SMOOTH)
    # Volt per farad: some hundreds.
    by = jax.jit(jax.jacrev(run))(1e-3)
    measured("by C", by, jax.jacfwd(closed_form)(1e-3), 1e-5)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_that_cannot_begin_in_its_mode(bob):
    with pytest.raises(jd.InitializationError, match=r"cannot begin at t=0 in the mode of 'bob: L - sqrt"):
        simulate(bob, 1.0, initial={"bob.y": -0.7})
    with pytest.raises(jd.InitializationError, match=r"where 'bob: L - sqrt.* has no finite derivatives"):
        simulate(bob.with_parameters({"bob.taut": 0.0}), 1.0, initial={"bob.y": 0.0})
    stop = falling(HardStop(EqnEnv(), "stop", touching=True))
    with pytest.raises(jd.InitializationError, match="it is 1, its derivative 0"):
        simulate(stop, 1.0)


@pytest.mark.slow
def test_a_run_that_begins_beyond_a_stop():
    stop = falling(HardStop(EqnEnv(), "stop"), height=-0.5)
    with pytest.raises(SimulationError, match="entered a mode whose constraint does not hold at that instant"):
        simulate(stop, 1.0)


class Square(Component):
    """A capacitor whose charge grows with the square of its voltage."""

    def __init__(self, ev, name, v0):
        super().__init__(ev, name)
        p, n = self.port("p", jd.Electrical), self.port("n", jd.Electrical)
        q = self.variable("q", start=v0**2, fixed=True)
        self.add_equations(Eq(der(q), p.i), Eq(p.i + n.i, 0), Eq(p.v - n.v, sqrt(q)))


@pytest.mark.slow
def test_nonlinear_capacitors_are_joined():
    """Charge is conserved, 9 + 1, and voltages √q are equal: 5 each; by the first voltage, with q = v², v."""
    ev = EqnEnv()
    c1, c2 = Square(ev, "c1", 3.0), Square(ev, "c2", 1.0)
    switch, g = el.JoiningSwitch(ev, "s"), el.Ground(ev, "g")
    system = compiled(c1, c2, switch, g, connect=[(c1.p, switch.p), (switch.n, c2.p), (c1.n, c2.n, g.p)])

    def charges(q1):
        solution = simulate(system, 1.0, inputs={"s.u": lambda t: t}, initial={"c1.q": q1})
        return solution[["c1.q", "c2.q"]][-1]

    np.testing.assert_allclose(charges(9.0), [5.0, 5.0], rtol=1e-9)
    np.testing.assert_allclose(jax.jacrev(charges)(9.0), [0.5, 0.5], rtol=1e-9)
