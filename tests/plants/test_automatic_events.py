"""Relations in equations are events: against SciPy, which is told where they turn, and against differences.

Tolerances: runs at rtol 1e-10 over some units of time are right to 1e-8; differences of such runs over 1e-5 are right
to 1e-4 by their noise and curvature, central ones of smooth functions to 1e-6.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from sympy import Abs, And, Heaviside, Max, Min, Mod, Piecewise, ceiling, floor, frac, log, sign, sin

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    ModelError,
    SimulationError,
    assign,
    der,
    pre,
    simulate,
    smooth,
    steady_state,
)
from jaxonomy_dae.write import Eq

TIGHT = {"rtol": 1e-10, "atol": 1e-12}
pytestmark = pytest.mark.long("a run with events, and often its gradient, is compiled for each law")


class Oscillator(Component):
    """x'' = −x + law."""

    def __init__(self, ev, name, law, start=0.2):
        super().__init__(ev, name)
        p = self.parameter("p", 0.3)
        x = self.variable("x", start=self.parameter("x0", start), fixed=True)
        v = self.variable("v", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), v), Eq(der(v), -x + law(x, v, p, ev.t)))


def compiled(component):
    diagram = AcausalDiagram()
    diagram.add(component)
    return AcausalCompiler(component.ev, diagram)()


def oscillator(law, **kwargs):
    return compiled(Oscillator(EqnEnv(), "c", law, **kwargs))


def in_pieces(branch, surfaces, p, end):
    """x(end) by SciPy's DOP853, from crossing to crossing: `branch(signs)` is the law where the surfaces have these
    signs, and one of them changes where it is crossed."""
    t, y = 0.0, np.array([0.2, 1.0])
    ahead = 1e-6
    signs = [np.sign(s(y[0] + ahead * y[1], y[1] - ahead, p, ahead)) for s in surfaces]
    while t < end:
        events = [lambda t, y, s=s: s(*y, p, t) for s in surfaces]
        for event, now in zip(events, signs, strict=True):
            event.terminal, event.direction = True, -now
        law = branch(signs)
        found = solve_ivp(
            lambda t, y, law=law: [y[1], -y[0] + law(*y, p, t)], (t, end), y, method="DOP853",
            rtol=1e-12, atol=1e-13, max_step=0.05, events=events,
        )  # fmt: skip
        t, y = found.t[-1], found.y[:, -1]
        signs = [-now if len(times) else now for now, times in zip(signs, found.t_events, strict=True)]
    return y[0]


def position(x, v, p, t):
    return x - p


def speed(x, v, p, t):
    return v


def wave(x, v, p, t):
    return np.sin(3 * t) - p


LAWS = {  # the law as it is written, surfaces, and the law where these have certain signs
    "max": (lambda x, v, p, t: 3 * Max(x - p, 0), [position], lambda s: lambda x, v, p, t: 3 * (x - p) * (s[0] > 0)),
    "min": (lambda x, v, p, t: Min(x, p), [position], lambda s: lambda x, v, p, t: p if s[0] > 0 else x),
    "abs": (lambda x, v, p, t: -v * Abs(v), [speed], lambda s: lambda x, v, p, t: -v * v * s[0]),
    "sign": (lambda x, v, p, t: sign(x - p), [position], lambda s: lambda x, v, p, t: s[0]),
    "heaviside": (lambda x, v, p, t: Heaviside(x - p), [position], lambda s: lambda x, v, p, t: 1.0 * (s[0] > 0)),
    "jump": (
        lambda x, v, p, t: Piecewise((1, x < p), (-v, True)),
        [position],
        lambda s: lambda x, v, p, t: -v if s[0] > 0 else 1.0,
    ),
    "two conditions": (
        lambda x, v, p, t: Piecewise((2, And(x > p, v > 0)), (0, True)),
        [position, speed],
        lambda s: lambda x, v, p, t: 2.0 * (s[0] > 0 and s[1] > 0),
    ),
    "root in a branch": (
        lambda x, v, p, t: Piecewise((sympy.sqrt(x - p + 1) * Max(v, 0), x > p), (Abs(v), True)),
        [position, speed],
        lambda s: lambda x, v, p, t: np.sqrt(x - p + 1) * v * (s[1] > 0) if s[0] > 0 else v * s[1],
    ),
    "time": (lambda x, v, p, t: sign(sin(3 * t) - p), [wave], lambda s: lambda x, v, p, t: s[0]),
}
QUICK = ("jump",)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in LAWS])
def test_runs_and_gradients(name):
    law, surfaces, branch = LAWS[name]
    system = oscillator(law)

    def final(p):
        return simulate(system.with_parameters({"c.p": p}), 3.0, **TIGHT)["c.x"][-1]

    value, slope = jax.value_and_grad(final)(0.3)
    assert float(value) == pytest.approx(in_pieces(branch, surfaces, 0.3, 3.0), abs=1e-8)
    h = 1e-4
    differences = (in_pieces(branch, surfaces, 0.3 + h, 3.0) - in_pieces(branch, surfaces, 0.3 - h, 3.0)) / (2 * h)
    assert float(slope) == pytest.approx(differences, rel=1e-6, abs=1e-6)


# x' of each, over time alone: what the integral from 0 to 2 is, and its derivative by p at 0.3.
STAIRS = {
    "floor": (lambda t, p: floor(2 * t + p), 0.5 * sum(range(4)) + 4 * 0.15, 2.0),
    "ceiling": (lambda t, p: ceiling(2 * t - p), 0.5 * sum(range(1, 5)) - 4 * 0.15, -2.0),
    "frac": (lambda t, p: frac(t / p), None, None),
    "mod": (lambda t, p: Mod(t, p), None, None),
}


def sawtooth(p, end=2.0):
    """∫ (t/p − ⌊t/p⌋) dt from 0 to the end."""
    n, rest = divmod(end, p)
    return n * p / 2 + rest**2 / (2 * p)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["floor", *(pytest.param(n, marks=pytest.mark.slow) for n in ("mod", "ceiling", "frac"))]
)
def test_whole_parts(name):
    law, value, slope = STAIRS[name]

    class Integral(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), law(ev.t, self.parameter("p", 0.3))))

    system = compiled(Integral(EqnEnv(), "c"))
    if value is None:
        factor = (lambda p: p) if name == "mod" else (lambda p: 1.0)
        h = 1e-5
        value = factor(0.3) * sawtooth(0.3)
        slope = (factor(0.3 + h) * sawtooth(0.3 + h) - factor(0.3 - h) * sawtooth(0.3 - h)) / (2 * h)

    def final(p):
        return simulate(system.with_parameters({"c.p": p}), 2.0, **TIGHT)["c.x"][-1]

    found, gradient = jax.value_and_grad(final)(0.3)
    assert float(found) == pytest.approx(value, abs=1e-9)
    assert float(gradient) == pytest.approx(slope, abs=1e-6)


@pytest.mark.slow
def test_smooth_leaves_a_relation_alone():
    system = oscillator(lambda x, v, p, t: smooth(3 * Max(x - p, 0)))
    assert system.plan.events is None
    events = oscillator(lambda x, v, p, t: 3 * Max(x - p, 0))
    assert len(events.plan.events) == 2
    expected = float(simulate(events, 3.0, **TIGHT)["c.x"][-1])
    assert float(simulate(system, 3.0, **TIGHT)["c.x"][-1]) == pytest.approx(expected, abs=1e-7)


def test_what_is_differentiated_stays_smooth():
    """w = d/dt of a smooth kink."""

    class Rate(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, w = self.variable("x", start=-1.0, fixed=True), self.variable("w")
            self.add_equations(Eq(der(x), 1 + 0 * x), Eq(w, der(smooth(Max(x, 0)) ** 2 + Abs(1 + x**2))))

    system = compiled(Rate(EqnEnv(), "c"))
    assert all("Max" not in text and "max" not in text for text in system.report.relations)


def test_equations_are_shown_as_written():
    system = oscillator(lambda x, v, p, t: Max(x, p) + floor(v))
    text = str(system.report)
    assert "c: x >= p" in text or "c: p >= x" in text
    assert "c: floor(v)" in text
    assert ":relation" not in text
    broken = Component(EqnEnv(), "c")
    assert broken.as_written == {}


@pytest.mark.slow
def test_relations_of_parameters_and_events_alone_are_not_watched():
    class Modes(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            p, on = self.parameter("p", 1.0), self.discrete("on", start=1)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), -Max(p, 2) * x * Piecewise((1, Eq(on, 1)), (2, True)) * Abs(p)))

    system = compiled(Modes(EqnEnv(), "c"))
    assert system.plan.events is None
    assert float(simulate(system, 1.0, **TIGHT)["c.x"][-1]) == pytest.approx(np.exp(-2), rel=1e-9)


@pytest.mark.slow
def test_a_solution_that_stays_where_a_relation_turns():
    class Stuck(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), self.parameter("push", 0.5) - sign(x)))

    system = compiled(Stuck(EqnEnv(), "c"))
    with pytest.raises(SimulationError, match=r"t=2: chattering. On both sides of 'x > 0' of component 'c'"):
        simulate(system, 3.0)
    free = system.with_parameters({"c.push": 0.0})
    np.testing.assert_allclose(simulate(free, 3.0, ts=jnp.array([0.5, 2.0, 3.0]))["c.x"], [0.5, 0.0, 0.0], atol=1e-12)
    pushed = system.with_parameters({"c.push": -2.0})
    assert float(simulate(pushed, 1.0)["c.x"][-1]) == pytest.approx(-2 / 3, abs=1e-8)  # −3 up to 1/3, −1 from there


class Flow(Component):
    """x' = sin 3t − q, where `law(x, q, r, k)` is zero."""

    def __init__(self, ev, name, law):
        super().__init__(ev, name)
        x, q = self.variable("x", start=0.2, fixed=True), self.variable("q", start=0.3)
        self.add_equations(
            Eq(der(x), sin(3 * ev.t) - q), *law(self, x, q, self.parameter("r", 0.3), self.parameter("k", 2.0))
        )


def through(q_of, p, end=3.0):
    """x(end) of x' = sin 3t − q(x, p)."""
    found = solve_ivp(
        lambda t, x: np.sin(3 * t) - q_of(x, p), (0, end), [0.2], "DOP853", rtol=1e-12, atol=1e-13, max_step=0.005
    )
    return found.y[0, -1]


def turbulent(x, k):
    """r·q + k·q·|q| = x, solved for q."""
    return np.sign(x) * (np.sqrt(0.09 + 4 * k * np.abs(x)) - 0.3) / (2 * k)


NONLINEAR = {
    "in one equation": lambda self, x, q, r, k: [Eq(x, r * q + k * q * Abs(q))],
    "with branches": lambda self, x, q, r, k: [Eq(x, r * q + k * q**2 * Piecewise((1, q > 0), (-1, True)))],
    "in a block": lambda self, x, q, r, k: [Eq(self.variable("amount"), Abs(q)), Eq(x, r * q + k * q * self.amount)],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NONLINEAR)
def test_relations_that_nonlinear_equations_need_as_they_are(name):
    """Beyond q = 0 the branch before may have no solution: k·q² = Δp for Δp < 0. In one equation q·|q| is seen to be
    smooth; in a block, |q| stands alone. Steps over its kinks are right to 1e-7 at rtol 1e-9; so are derivatives to
    1e-4."""
    system = compiled(Flow(EqnEnv(), "c", NONLINEAR[name]))
    assert system.plan.events is None
    report = system.report
    smooth_there = name != "in a block"
    assert any("is no event: nonlinear equations" in note for note in report.notes) != smooth_there
    assert bool(report.left_alone) == smooth_there

    def final(k):
        return simulate(system.with_parameters({"c.k": k}), 3.0, rtol=1e-9, atol=1e-11)["c.x"][-1]

    value, slope = jax.value_and_grad(final)(2.0)
    assert float(value) == pytest.approx(through(turbulent, 2.0), abs=1e-7)
    h = 1e-4
    expected = (through(turbulent, 2 + h) - through(turbulent, 2 - h)) / (2 * h)
    assert float(slope) == pytest.approx(expected, rel=1e-3, abs=1e-4)


def valve_behind_a_resistance(self, x, q, r, k):
    drop = self.variable("drop")
    return [Eq(x, r * q + drop), Eq(q, Piecewise((k * drop, drop > 0), (k * drop / 10, True)))]


def valve_by_a_nonlinear_sensor(self, x, q, r, k):
    """What the relation compares is a nonlinear function of the block's unknowns, which reads no relation itself."""
    drop, sensed = self.variable("drop"), self.variable("sensed")
    valve = Eq(q, Piecewise((k * drop, sensed > 0), (k * drop / 10, True)))
    return [Eq(x, r * q + drop), valve, Eq(sensed, smooth(Piecewise((drop**3, drop > -1), (drop, True))))]


def test_a_block_that_falls_apart_once_relations_are_known_keeps_their_events():
    """Beside a nonlinear equation of the same block, relations of its linear part were no events."""
    system = compiled(Flow(EqnEnv(), "c", valve_by_a_nonlinear_sensor))
    assert len(system.plan.events) == 2 and not system.report.notes


@pytest.mark.slow
@pytest.mark.parametrize("law", [valve_behind_a_resistance, valve_by_a_nonlinear_sensor])
def test_relations_between_linear_branches_are_events_in_blocks_too(law):
    """A valve that lets ten times as much through in one direction, behind a resistance."""
    system = compiled(Flow(EqnEnv(), "c", law))
    assert len(system.plan.events) == 2 and not system.report.notes

    def final(k):
        return simulate(system.with_parameters({"c.k": k}), 3.0, **TIGHT)["c.x"][-1]

    def valve(x, k):
        return np.where(x > 0, x / (0.3 + 1 / k), x / (0.3 + 10 / k))

    value, slope = jax.value_and_grad(final)(2.0)
    assert float(value) == pytest.approx(through(valve, 2.0), abs=1e-8)
    h = 1e-4
    assert float(slope) == pytest.approx((through(valve, 2 + h) - through(valve, 2 - h)) / (2 * h), abs=1e-6)


EMPTYING = {
    "as a sign": lambda x: -sign(x) * sympy.sqrt(Abs(x)),
    "as a maximum": lambda x: -sympy.sqrt(Max(x, 0)),
    "as a branch": lambda x: Piecewise((-sympy.sqrt(x), x > 0), (0, True)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EMPTYING)
def test_a_root_that_ends_where_a_relation_turns(name):
    """A tank runs empty: x' = −√x, x = (1 − t/2)², and stays so. Near the end the root is as steep as can be."""

    class Tank(Component):
        def __init__(self, ev, name, law):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), law(x)))

    ts = jnp.array([1.0, 1.9, 2.5, 4.0])
    system = compiled(Tank(EqnEnv(), "c", EMPTYING[name]))
    found = simulate(system, 4.0, ts=ts, rtol=1e-8, atol=1e-10)["c.x"]
    np.testing.assert_allclose(found, [0.25, 0.0025, 0.0, 0.0], rtol=0, atol=1e-7)


ENDING = {  # laws without a value beyond where a relation turns
    "a root": lambda x, v, p, t: Piecewise((sympy.sqrt(x - p), x > p), (0, True)),
    "a root of a jump": lambda x, v, p, t: sympy.sqrt(Piecewise((x - p + 1, x > p), (0.25, True))),
    "a logarithm": lambda x, v, p, t: Piecewise((log(1 + p - x), x < p), (0, True)),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) for n in ENDING])
def test_branches_without_a_value_beyond_their_end(name):
    """Against SciPy with the law as it is written, whose small steps across a jump are right to 1e-5."""
    law = ENDING[name]
    written = sympy.lambdify(sympy.symbols("x v p t"), law(*sympy.symbols("x v p t")), "numpy")

    def rate(t, y):
        with np.errstate(invalid="ignore"):
            return [y[1], -y[0] + float(written(y[0], y[1], 0.3, t))]

    expected = solve_ivp(rate, (0, 3), [0.2, 1.0], "RK45", rtol=1e-9, atol=1e-11, max_step=1e-3).y[0, -1]
    system = oscillator(law)
    assert float(simulate(system, 3.0, **TIGHT)["c.x"][-1]) == pytest.approx(expected, abs=2e-5)


@pytest.mark.slow
def test_a_root_without_a_value_is_told_in_a_branch_too():
    system = oscillator(lambda x, v, p, t: Piecewise((sympy.sqrt(0.1 - x), x > p), (0, True)))
    with pytest.raises(SimulationError, match=r"'sqrt\(0\.1 - c\.x\)' leaves its domain in c"):
        simulate(system, 3.0)


class Planetary(Component):
    """Two shafts turn against each other, and the planet between them stands still, up to rounding."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        sun, ring, angle = (self.variable(n, start=0.0, fixed=True) for n in ("sun", "ring", "angle"))
        planet = self.variable("planet")
        torque = sin(ev.t) + Piecewise((0, ev.t < 0.5), (20, True))
        turns = Piecewise((sun + planet, planet > 0), (sun - planet, planet < 0), (sun, True))
        self.add_equations(
            Eq(der(sun), 1.5 * torque), Eq(der(ring), -torque), Eq(planet, (sun + 1.5 * ring) / 2.5),
            Eq(der(angle), turns),
        )  # fmt: skip


def test_a_relation_of_what_is_zero_up_to_rounding_does_not_turn():
    """The sign of rounding means nothing. Steps were halved where it changed until none were left: 571 of 600."""
    solution = simulate(compiled(Planetary(EqnEnv(), "gear")), 1.0, **TIGHT)
    assert solution.stats["num_steps"] < 100
    assert solution["gear.sun"][-1] == pytest.approx(1.5 * (1 - np.cos(1.0) + 10.0), rel=1e-9)
    angle = 1.5 * (1.0 - np.sin(1.0)) + 1.5 * 20 * 0.125
    assert solution["gear.angle"][-1] == pytest.approx(angle, rel=1e-8)


def test_ticks_do_not_count_against_the_largest_number_of_steps():
    class Counter(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, n = self.variable("x", start=1.0, fixed=True), self.discrete("n", start=0.0)
            self.when(self.sampled(self.parameter("T", 0.01)), assign(n, pre(n) + 1))
            self.add_equations(Eq(der(x), -x))

    system = compiled(Counter(EqnEnv(), "c"))
    solution = simulate(system, 3.0, ts=jnp.array([2.995]), max_steps=30)
    assert solution["c.n"][0] == 300
    assert solution["c.x"][0] == pytest.approx(np.exp(-2.995), rel=1e-5)


@pytest.mark.slow
def test_many_relations_turn_at_once():
    """A hundred equal ones, and a hundred that turn at times of their own."""

    class Ramp(Component):
        def __init__(self, ev, name, at):
            super().__init__(ev, name)
            x = self.variable("x", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), Max(ev.t - self.parameter("at", at), 0)))

    ev, diagram = EqnEnv(), AcausalDiagram()
    at = np.concatenate([np.full(100, 0.5), np.linspace(0.1, 0.9, 100)])
    diagram.add_array(ev, "r", Ramp, 200, at=at)
    system = AcausalCompiler(ev, diagram)()
    found = simulate(system, 1.0, rtol=1e-9, atol=1e-12)["r.x"][-1]
    np.testing.assert_allclose(found, (1 - at) ** 2 / 2, atol=1e-10)


@pytest.mark.slow
def test_batches_and_points():
    """Members of a batch turn at times of their own; points of rest and linearizations see the relation as it is."""
    system = oscillator(lambda x, v, p, t: Piecewise((1, x < p), (-v, True)))
    ps = jnp.array([0.1, 0.3, 5.0])

    def final(p):
        return simulate(system.with_parameters({"c.p": p}), 3.0, **TIGHT)["c.x"][-1]

    np.testing.assert_allclose(jax.vmap(final)(ps), [final(p) for p in ps], rtol=1e-9)
    damped = oscillator(lambda x, v, p, t: -v + 2 * Max(p - x, 0))
    assert float(steady_state(damped)["c.x"]) == pytest.approx(0.2, abs=1e-9)  # −x + 2(0.3 − x) = 0


@pytest.mark.slow
def test_second_derivatives_are_refused_and_possible_when_smooth():
    def second(system):
        def final(p):
            return simulate(system.with_parameters({"c.p": p}), 1.0)["c.x"][-1]

        return jax.jacfwd(jax.grad(final))(0.3)

    with pytest.raises(ModelError, match=r"smooth\(\.\.\.\)"):
        second(oscillator(lambda x, v, p, t: p**2 * Max(x, 0)))
    assert np.isfinite(second(oscillator(lambda x, v, p, t: p**2 * smooth(Max(x, 0)))))


def test_what_smooth_takes():
    with pytest.raises(ModelError, match="smooth takes an expression; got 'x'"):
        smooth("x")
    assert smooth(2.0) == 2.0 and Max(smooth(Abs(sympy.Symbol("x"))).subs("x", -2.0), 1.0) == 2.0
