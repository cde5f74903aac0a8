"""When conditions become true: at the start, and where what they are made of jumps.

References: truths of the conditions evaluated in NumPy, and integrals of nested waveforms by quadrature with a point in
each of many small cells, which is off by a cell where the waveform jumps.
"""

import functools
import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, component
from sympy import Abs, And, Heaviside, Max, Min, Mod, Or, Piecewise, ceiling, floor, sign

from jaxonomy_dae import Eq, assign, der, pre, reinit, simulate, terminate

TIGHT = dict(rtol=1e-10, atol=1e-10)
pytestmark = pytest.mark.long("runs of models with events are compiled")

# --- a start on the level --------------------------------------------------------------------------------------------

CONDITIONS = {
    "x > 0": lambda x: x > 0,
    "x >= 0": lambda x: x >= 0,
    "x < 0": lambda x: x < 0,
    "x <= 0": lambda x: x <= 0,
}


@functools.cache
def ramp():
    def write(self, ev):
        rate, x0 = self.parameter("rate", 0.0), self.parameter("x0", 0.0)
        x = self.variable("x", start=x0, fixed=True)
        self.add_equations(Eq(der(x), rate))
        for k, condition in enumerate(CONDITIONS.values()):
            for at_start in (0, 1):
                n = self.discrete(f"n{k}{at_start}")
                self.when(condition(x), assign(n, pre(n) + 1), at_start=bool(at_start))
            y = self.variable(f"y{k}", start=0.0, fixed=True)
            self.add_equations(Eq(der(y), Piecewise((1, condition(x)), (0, True))))

    return compiled(component(write))


@functools.cache
def on_a_ramp():
    names = [f"c.n{k}{s}" for k in range(4) for s in (0, 1)] + [f"c.y{k}" for k in range(4)]
    cases = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=2)))

    @jax.jit
    @jax.vmap
    def run(case):
        changed = ramp().with_parameters({"c.x0": case[0], "c.rate": case[1]})
        solution = simulate(changed, 2.0, ts=jnp.array([0.0, 2.0]))
        return solution[names], solution.events.count

    values, counts = jax.tree.map(np.asarray, run(cases))
    return cases, values[:, 0, :8].reshape(-1, 4, 2), values[:, 1, :8].reshape(-1, 4, 2), values[:, 1, 8:], counts


@pytest.mark.slow
@pytest.mark.parametrize("k", range(4), ids=CONDITIONS)
def test_where_a_condition_is_at_the_start(k):
    """x = x0 + rate·t, x0 and rate −1, 0, 1. An event is a condition that is false at some time and true right after:
    `x > 0` from x = 0 upwards at once, `x >= 0` there not at all, for it holds. With `at_start`, it happens at the
    initial time, too, if the condition holds there. A strict condition on its level was taken for one that holds, and
    one that is not strict for one that does not, where x rests."""
    truth = list(CONDITIONS.values())[k]
    cases, first, last, integrals, _ = on_a_ramp()
    for (x0, rate), at_first, at_last, integral in zip(cases, first, last, integrals, strict=True):
        t = np.array([0.0, *np.geomspace(1e-9, 2.0, 4001)])
        held = truth(np.where(np.isclose(x0 + rate * t, 0.0, atol=1e-12), 0.0, x0 + rate * t))
        becomes = int((held[1:] & ~held[:-1]).sum())
        assert at_last[k, 0] == becomes, (x0, rate)
        later = int((held[2:] & ~held[1:-1]).sum())
        assert at_last[k, 1] == (held[0] or held[1]) + later, (x0, rate)
        assert (at_first[k, 0], at_first[k, 1]) == (0, held[0] or held[1]), (x0, rate)
        during = np.mean(truth(x0 + rate * (np.arange(2000) + 0.5) / 1000))
        np.testing.assert_allclose(integral[k], 2 * during, atol=1e-9)


@pytest.mark.slow
def test_events_at_once_are_listed():
    """Upwards from 0, x > 0 becomes true for two events, one of which happens at the start; from −1, all four do."""
    cases, *_, counts = on_a_ramp()
    known = {(0.0, 1.0): 1, (0.0, -1.0): 1, (-1.0, 1.0): 4, (1.0, -1.0): 4}
    assert [int(n) for n in counts] == [known.get((x0, rate), 0) for x0, rate in cases]


# --- relations within relations --------------------------------------------------------------------------------------

# As functions of u = w·t (or of a state that is) and SymPy's functions.
NESTED = {
    "a wave of a whole part": lambda u: 1 - 2 * Mod(floor(2 * u), 2),
    "a whole part of a remainder": lambda u: floor(3 * Mod(u, 1)),
    "a sign": lambda u: Piecewise((1, sign(u - 1.1) > 0), (0, True)),
    "a remainder": lambda u: Piecewise((1, Mod(u, 1) > 0.4), (0, True)),
    "steps that add up": lambda u: Piecewise((1, floor(u) + floor(2 * u) > 3.2), (0, True)),
    "steps and a ramp": lambda u: Piecewise((1, 2 * floor(u) - u > 0.3), (0, True)),
    "two remainders": lambda u: Piecewise((1, Mod(2 * u, 1) + Mod(u, 1) > 0.7), (0, True)),
    "steps onto a level": lambda u: Piecewise((1, Heaviside(u - 1.1) + Heaviside(u - 2.1) >= 2), (0, True)),
    "one of two": lambda u: Piecewise((1, Or(sign(u - 2) > 0, floor(u) + floor(u + 0.5) >= 3)), (0, True)),
    "signs that cancel": lambda u: Abs(sign(u - 1) + sign(2 - u)),
    "the larger of a jump": lambda u: Max(2 * sign(u - 1.3), u - 2),
    "a step in a step": lambda u: ceiling(Max(floor(u), Min(u, 1.5)) / 2),
}
SPEED, END = 1.53, 2.0


@functools.cache
def nested():
    """The integrals of all waves of time, and of a state, and their derivatives by w."""

    def write(self, ev):
        w = self.parameter("w", SPEED)
        u = self.variable("u", start=0.0, fixed=True)
        self.add_equations(Eq(der(u), w))
        for k, wave in enumerate(NESTED.values()):
            for kind, of in (("t", w * ev.t), ("u", u)):
                x = self.variable(f"{kind}{k}", start=0.0, fixed=True)
                self.add_equations(Eq(der(x), wave(of)))

    system = compiled(component(write))
    names = [f"c.{kind}{k}" for k in range(len(NESTED)) for kind in "tu"]

    def run(w):
        changed = system.with_parameters({"c.w": w})
        found = simulate(changed, END, ts=jnp.array([END]), adjoint=diffrax.ForwardMode(), throw=False, **TIGHT)
        found = found[names][-1]
        return found, found

    slopes, values = jax.jit(jax.jacfwd(run, has_aux=True))(SPEED)
    return values.reshape(-1, 2), slopes.reshape(-1, 2)


def evaluated(wave):
    """A wave as a function of arrays, by NumPy."""
    u = sympy.Symbol("u", real=True)
    many = {
        name: lambda *a, f=f: f.reduce(np.broadcast_arrays(*a))
        for name, f in (("Max", np.maximum), ("Min", np.minimum))
    }
    return sympy.lambdify(u, wave(u), [many, "numpy"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", NESTED)
def test_relations_within_relations(kind):
    """∫ f(w·t) dt = ∫₀^{wT} f(u) du / w, whose derivative by w is f(wT)·T/w minus itself over w. A relation that jumps
    onto its level with another one, as Mod(floor(…)) does, did not turn: −38.75 for 0.25. One whose sides jump turned
    at the right time, but its derivative was left out."""
    k, f, cells = list(NESTED).index(kind), evaluated(NESTED[kind]), 600_000
    width = SPEED * END / cells
    integral = np.sum(np.broadcast_to(f((np.arange(cells) + 0.5) * width), cells)) * width / SPEED
    slope = float(f(np.array(SPEED * END))) * END / SPEED - integral / SPEED
    values, slopes = nested()
    np.testing.assert_allclose(values[k], integral, atol=1e-4)  # some cells
    np.testing.assert_allclose(slopes[k], slope, atol=1e-4)


def random_wave(rng, atoms, depth):
    """A random nesting of relations."""
    if not depth:
        return atoms[rng.integers(len(atoms))]
    a, b = (random_wave(rng, atoms, depth - 1) for _ in range(2))
    c = [sympy.Rational(1, 2), sympy.Rational(1, 3), sympy.Rational(3, 4), sympy.Integer(1)][rng.integers(4)]
    return [
        lambda: floor(2 * a + c) / 2, lambda: Mod(a, c + 1), lambda: c * sign(a - c), lambda: Max(a, b - c),
        lambda: Min(a, b + c), lambda: Abs(a - c), lambda: Piecewise((a, b > c), (b - c, True)),
        lambda: Piecewise((a, And(b >= c, b < 3 * c)), (1 - a, True)), lambda: ceiling(a - c) + c * a,
    ][rng.integers(9)]()  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(s, marks=pytest.mark.slow) if s else s for s in range(6)])
def test_random_relations_within_relations(seed):
    """Of time, of sines of it, and of states that are these."""
    rng, t, p = np.random.default_rng(seed), sympy.Symbol("t", real=True), sympy.Symbol("p", real=True)
    atoms = [t, t * sympy.Rational(7, 5) - 1, p, 2 * sympy.cos(2 * t)]
    waves = []
    while len(waves) < 6:
        wave = random_wave(rng, atoms, int(rng.integers(2, 4)))
        if wave.has(floor, Mod, sign, Max, Min, Abs, Piecewise, ceiling):
            waves.append(wave)

    def write(self, ev):
        a, b = self.variable("a", start=0.0, fixed=True), self.variable("b", start=1.0, fixed=True)
        w = self.variable("w", start=0.0, fixed=True)
        self.add_equations(Eq(der(a), 3 * b), Eq(der(b), -3 * a), Eq(der(w), 1))
        for k, wave in enumerate(waves):
            x = self.variable(f"x{k}", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), wave.xreplace({p: a, t: w if k % 2 else ev.t})))

    end, cells = 3.0, 300_000
    ts = np.linspace(0.0, end, 13)
    solution = simulate(compiled(component(write)), end, ts=ts, rtol=1e-9, atol=1e-10)
    middles = (np.arange(cells) + 0.5) * end / cells
    for k, wave in enumerate(waves):
        f = evaluated(lambda u, wave=wave: wave.xreplace({p: sympy.sin(3 * t)}).xreplace({t: u}))
        sums = np.concatenate([[0], np.cumsum(np.broadcast_to(f(middles), cells))]) * end / cells
        found = solution[f"c.x{k}"]
        np.testing.assert_allclose(found, sums[:: cells // 12], atol=2e-4, err_msg=str(wave))


@pytest.mark.slow
def test_conditions_of_events_whose_sides_jump():
    """Each turns on a clock n' of its own: the events' times over w, and what moves with w."""
    w, end = 1.53, 2.0
    at = {0: [0.4, 1.4, 2.4], 1: [0.4, 1.4, 2.4], 2: [1.5], 3: [1.0], 4: [1.5], 5: [0.7, 1.7, 2.7]}

    def write(self, ev):
        speed, u = self.parameter("w", w), self.variable("u", start=0.0, fixed=True)
        self.add_equations(Eq(der(u), speed))
        v = speed * ev.t
        conditions = [
            Mod(u, 1) > 0.4, Mod(v, 1) > 0.4, floor(u) + floor(2 * u) > 3.2, And(floor(u) >= 1, u < 1.5),
            Or(sign(u - 2) > 0, floor(v) + floor(v + 0.5) >= 3), sympy.Not(Mod(u, 1) < 0.7),
        ]  # fmt: skip
        for k, condition in enumerate(conditions):
            n, x = self.discrete(f"n{k}"), self.variable(f"x{k}", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), n))
            self.when(condition, assign(n, pre(n) + 1))

    system = compiled(component(write))

    def run(w):
        changed = system.with_parameters({"c.w": w})
        found = simulate(changed, end, ts=jnp.array([end]), adjoint=diffrax.ForwardMode(), throw=False, **TIGHT)
        found = found[[f"c.x{k}" for k in range(6)]][-1]
        return found, found

    slopes, values = jax.jit(jax.jacfwd(run, has_aux=True))(w)
    np.testing.assert_allclose(values, [sum(end - a / w for a in times) for times in at.values()], atol=1e-10)
    np.testing.assert_allclose(slopes, [sum(a / w**2 for a in times) for times in at.values()], atol=1e-9)
    assert not [name for name in system.variables if ":" in name]


# --- several events at one instant -----------------------------------------------------------------------------------


def at_one_instant(order):
    """At t = 1 a state reaches a level and starts anew, a clock ticks, and others read what these write."""

    def write(self, ev):
        x, v = self.variable("x", start=0.0, fixed=True), self.variable("v", start=1.0, fixed=True)
        last, n, m, k, s = (self.discrete(name, start=int(name == "k")) for name in ("last", "n", "m", "k", "s"))
        d = self.variable("d")
        self.add_equations(Eq(der(x), v), Eq(der(v), 0), Eq(d, 3 * n))
        declared = [
            lambda: self.when(x >= 1, reinit(v, -0.5 * v), reinit(x, 0.9)),
            lambda: self.when(x >= 1, assign(last, 10 * pre(x) + v)),
            lambda: self.when(ev.t >= 1, assign(n, pre(n) + 1)),
            lambda: self.when(x >= 1, assign(m, d + 100 * pre(n))),
            lambda: self.when(self.sampled(0.5, 0.5), assign(s, pre(s) + x), assign(k, 2 * pre(k))),
            lambda: self.when(n >= 1, assign(k, pre(k) + 100)),
        ]
        for place in order:
            declared[place]()

    return compiled(component(write))


@pytest.mark.slow
@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0), (3, 1, 0, 5, 2, 4)])
def test_events_at_one_instant_in_any_order(order):
    """All read the states before any of them, discrete variables with `pre` as before all, and without as assigned at
    the instant; what one of them makes true comes after them. A state that an event declared before had reset was read
    as it was then. The last row is an event at t1."""
    system = at_one_instant(order)
    names = ["c.x", "c.v", "c.last", "c.n", "c.m", "c.k", "c.s"]
    known = [0.9, -0.5, 11.0, 1.0, 3.0, 104.0, 1.5]
    solution = simulate(system, 1.5, ts=jnp.array([0.75, 1.0, 1.25]), **TIGHT)
    np.testing.assert_allclose(solution[names][1:], [known, [0.775, *known[1:]]], atol=1e-9)
    np.testing.assert_allclose(simulate(system, 1.0, ts=jnp.array([1.0]), **TIGHT)[names], [known], atol=1e-9)


# --- what a log says --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_log_of_a_run_that_ends_and_of_one_without_events():
    """Two events end the run at s = t = 0.8, where w = p·s. Without an event, gradients of what is on both sides of it
    are zero."""

    def write(self, ev):
        s, w = self.variable("s", start=0.0, fixed=True), self.variable("w")
        p, end = self.parameter("p", 0.5), self.parameter("end", 0.8)
        self.add_equations(Eq(der(s), 1), Eq(w, p * s))
        self.when(s >= end, terminate("the end"))
        self.when(2 * s >= 2 * end, assign(self.discrete("beside"), 1))

    system = compiled(component(write))

    def run(p, end):
        found = simulate(system.with_parameters({"c.p": p, "c.end": end}), 1.0, max_events=3, save_events=True)
        events = found.events
        return jnp.sum(jnp.where(jnp.isfinite(events.ts), events.before["c.w"], 0.0)), found

    run = jax.jit(jax.value_and_grad(run, has_aux=True))
    (value, found), slope = run(0.5, 0.8)
    np.testing.assert_allclose([value, slope], [0.8, 1.6], rtol=1e-9)
    assert found.events.terminated == "the end"
    (value, found), slope = run(0.5, 9.0)
    assert not len(found.events) and found.events.terminated is None and value == slope == 0


@pytest.mark.slow
def test_strict_relations_beside_others():
    """At t = 1/2 an event sets y from 1 onto 0, where it rests, beside x = 1 and z = 0. `Or(x < 0, y <= 0)` becomes
    true, and was missed: a guard knew only whether one of its relations is strict. A ball at 1 − t² bounces as ever."""

    def write(self, ev):
        y, x, z = (self.variable(k, start=s, fixed=True) for k, s in (("y", 1.0), ("x", 1.0), ("z", 0.0)))
        h, v = self.variable("h", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        self.add_equations(*(Eq(der(k), 0) for k in (x, y, z)), Eq(der(h), v), Eq(der(v), -2))
        self.when(ev.t >= 0.5, reinit(y, 0.0))
        conditions = (
            Or(x < 0, y <= 0), Or(x <= 0, y < 0), And(x > 0, y <= 0), And(x >= 0, y < 0), Or(z < 0, y <= -1),
            sympy.Not(And(x >= 0, y > 0)),
        )  # fmt: skip
        for k, condition in enumerate(conditions):
            n = self.discrete(f"n{k}")
            self.when(condition, assign(n, pre(n) + 1))
        bounces = self.discrete("bounces")
        self.when(And(h <= 0, v < 0), reinit(v, -v / 2), assign(bounces, pre(bounces) + 1))

    run = simulate(compiled(component(write)), 2.25, ts=jnp.array([2.25]), **TIGHT)
    assert [int(run[f"c.n{k}"][0]) for k in range(6)] == [1, 0, 1, 0, 0, 1]
    assert int(run["c.bounces"][0]) == 2  # h = 1 − t², then t' − t'² with t' = t − 1
    assert float(run["c.h"][0]) == pytest.approx(0.125 - 0.25**2, abs=1e-8)


@pytest.mark.slow
def test_guards_that_meet_zero_flatly():
    """h falls by one a second from h0: each of these guards is zero where h is, at t = h0. Steps are not used up."""

    def write(self, ev):
        h = self.variable("h", start=self.parameter("h0", 1.0), fixed=True)
        self.add_equations(Eq(der(h), -1))
        forms = h**3, (h / 10) ** 3, h**3 + 1e-9 * h, h**5, h * Abs(h), sympy.tanh(h) ** 3, 1e-9 * h, 1e9 * h
        for k, form in enumerate(forms):
            self.when(form <= 0, assign(self.discrete(f"at{k}"), ev.t))

    system = compiled(component(write))
    names = [f"c.at{k}" for k in range(8)]

    def times(h0):
        of = system.with_parameters({"c.h0": h0})
        return simulate(of, 2.0, ts=jnp.array([2.0]), max_steps=40, **TIGHT)[names][0]  # 24 are taken

    np.testing.assert_allclose(times(1.0), 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacrev(times))(1.0), 1.0, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_condition_whose_sides_the_equations_keep_equal_is_named():
    """s = a + b: `s - a - b <= 0` was silently never true. Beside it, a level that a does not reach, and a value that
    rests on its level, but need not."""

    def write(self, ev):
        a, b = self.variable("a", start=1.0, fixed=True), self.variable("b", start=2.0, fixed=True)
        s, rests = self.variable("s"), self.variable("rests", start=0.0, fixed=True)
        d, n = self.discrete("d"), self.discrete("n")
        self.add_equations(Eq(der(a), -1), Eq(der(b), -2), Eq(der(rests), 0), Eq(s, a + b))
        for condition in (s - a - b <= 0, a >= 5, rests <= 0, d >= 0):
            self.when(condition, assign(n, pre(n) + 1))

    with pytest.warns(RuntimeWarning) as said:
        simulate(compiled(component(write)), 1.0)
    (text,) = [str(w.message) for w in said]
    assert text.startswith("'c: when(-a - b + s <= 0)' never happens: from t=0 to t=1 both sides")
