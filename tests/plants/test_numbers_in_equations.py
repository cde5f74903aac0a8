"""Numbers that are written in equations: many instances with numbers of their own share one template."""

import functools
import random

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.compile.passes import lift_numbers
from jaxonomy_dae.write import Eq

FORWARD = diffrax.ForwardMode()  # whose programs compile fastest, where nothing is differentiated
N = 12
GAINS = 0.5 + 0.25 * np.arange(N)  # c2 has 1.0, a factor that is not there


def compiled(kind, gains=GAINS, **more):
    ev, diagram = EqnEnv(), AcausalDiagram()
    for k, gain in enumerate(gains):
        diagram.add(kind(ev, f"c{k}", gain.item(), **more))
    return AcausalCompiler(ev, diagram)()


def templates(system) -> int:
    return len({group.template.key for group in system.plan.flat.groups})


class Falling(Component):
    """x' = −c sin x: tan(x/2) falls exponentially."""

    def __init__(self, ev, name, c):
        super().__init__(ev, name)
        x = self.variable("x", start=1.5, fixed=True)
        self.add_equations(Eq(der(x), -c * sympy.sin(x)))


@pytest.mark.slow
def test_one_template_for_many_numbers(fallen):
    assert templates(compiled(Falling)) == 2  # one for all, and one for 1.0·sin x
    for k, c in enumerate(GAINS):
        true = 2 * np.arctan(np.tan(0.75) * np.exp(-c))
        np.testing.assert_allclose(fallen[f"f{k}.x"], true, rtol=1e-7)  # a hundred times the run's rtol


def test_few_numbers_stay_in_their_templates():
    assert templates(compiled(Falling, GAINS[:3])) == 3


class Thrown(Component):
    """p c x' = −x³, with a parameter beside a number in the coefficient: x = 1/√(1 + 2 t/(p c)); the switch at its own
    level of u is reported with it."""

    def __init__(self, ev, name, c):
        super().__init__(ev, name)
        x, p = self.variable("x", start=1.0, fixed=True), self.parameter("p", 1.0 + c)
        y = self.variable("y")
        on = self.discrete("on", 3.0)
        self.add_equations(Eq(p * c * der(x), -(x**3)))
        self.either(on > c, Eq(y, x), Eq(y, c * sympy.cos(x)))


@functools.cache
def falling_and_thrown():
    """f0, … fall and c0, … are thrown."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    for k, gain in enumerate(GAINS):
        diagram.add(Falling(ev, f"f{k}", gain.item()), Thrown(ev, f"c{k}", gain.item()))
    return AcausalCompiler(ev, diagram)()


def last(system, names, adjoint=FORWARD, **options):
    solution = simulate(system, 1.0, ts=jnp.array([1.0]), rtol=1e-9, atol=1e-11, adjoint=adjoint, **options)
    return solution[names][0]


@pytest.fixture(scope="module")
def fallen():
    """The last values by name."""
    names = [f"{n[0]}{k}.{n[1]}" for k in range(N) for n in ("fx", "cx", "cy")]
    return dict(zip(names, np.asarray(last(falling_and_thrown(), names)), strict=True))


@pytest.mark.slow
def test_numbers_beside_parameters_and_modes(fallen):
    report = str(falling_and_thrown().report)
    for k, c in enumerate(GAINS):
        x = 1 / np.sqrt(1 + 2 / (c * (1 + c)))
        np.testing.assert_allclose(fallen[f"c{k}.x"], x, rtol=1e-7)
        np.testing.assert_allclose(fallen[f"c{k}.y"], x if 3 > c else c * np.cos(x), rtol=1e-7)
        assert f"c{k}: " in report


@pytest.mark.slow
def test_gradients_through_them(fallen):
    system = falling_and_thrown()

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1))
    def slopes(p, start):
        changed = system.with_parameters({"c4.p": p})
        return last(changed, ["c4.x", "f3.x"], None, initial={"f3.x": start}).sum()

    c, p = GAINS[4], 1.0 + GAINS[4]
    by_parameter, by_start = slopes(p, 1.5)
    np.testing.assert_allclose(by_parameter, (1 + 2 / (c * p)) ** -1.5 / (c * p**2), rtol=1e-6)
    # dx/dx₀ = sin x / sin x₀
    np.testing.assert_allclose(by_start, np.sin(fallen["f3.x"]) / np.sin(1.5), rtol=1e-6)


class Cubic(Component):
    """y + c y³ + 2 z = x and z = d·sin(y) − 0.1 cos(3 y), a nonlinear block; x' = −y."""

    def __init__(self, ev, name, c):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        y, z = self.variable("y", start=0.5), self.variable("z")
        d = 0.2 * c + 0.1
        self.add_equations(
            Eq(der(x), -y), Eq(y + c * y**3 + 2 * z, x), Eq(z, d * sympy.sin(y) - 0.1 * sympy.cos(3 * y))
        )


@pytest.mark.slow
@pytest.mark.parametrize("order", ["as written", "reversed"])
def test_nonlinear_blocks_with_numbers(order):
    gains = GAINS if order == "as written" else GAINS[::-1]
    system = compiled(Cubic, gains)
    assert templates(system) == 4  # x', the two of the block, and the one in which c is 1.0
    solution = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), rtol=1e-9, atol=1e-11, adjoint=FORWARD)
    for k, c in enumerate(gains):
        x, y, z = (np.asarray(solution[f"c{k}.{name}"]) for name in "xyz")
        d = 0.2 * c + 0.1
        # To rounding, as Newton's method leaves them.
        np.testing.assert_allclose(y + c * y**3 + 2 * z, x, atol=1e-9)
        np.testing.assert_allclose(z, d * np.sin(y) - 0.1 * np.cos(3 * y), atol=1e-9)

        def slope(_, y, c=c, d=d):  # by y as the state: x' = −y
            return -y / (1 + 3 * c * y**2 + 2 * (d * np.cos(y) + 0.3 * np.sin(3 * y)))

        true = scipy.integrate.solve_ivp(slope, (0, 1), [y[0]], rtol=1e-11, atol=1e-12).y[0, -1]
        np.testing.assert_allclose(y[1], true, rtol=1e-7)


class Pendulum(Component):
    """A pendulum whose length and mass are numbers: x² + y² = L² is differentiated twice."""

    def __init__(self, ev, name, length, mass=None):
        super().__init__(ev, name)
        mass = 1.0 + length if mass is None else mass
        x = self.variable("x", start=length * np.sin(0.5), fixed=True)
        y = self.variable("y", start=-length * np.cos(0.5))
        vx, vy = self.variable("vx", start=0.0, fixed=True), self.variable("vy", start=0.0)
        force = self.variable("force")
        self.add_equations(
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(mass * der(vx), -force * x / length),
            Eq(mass * der(vy), -force * y / length - mass * 9.81),
            Eq(x**2 + y**2, length**2),
        )


@pytest.mark.slow
def test_constraints_with_numbers():
    system = compiled(Pendulum)
    assert templates(system) == 7  # x' and y' share one; two forces and the rod, and the same for a length of 1.0
    solution = simulate(system, 1.0, ts=jnp.array([1.0]), rtol=1e-9, atol=1e-11, adjoint=FORWARD)
    ends = np.asarray(solution[[f"c{k}.x" for k in range(N)]][0])
    for k, length in enumerate(GAINS):

        def swing(_, state, length=length):
            return [state[1], -9.81 / length * np.sin(state[0])]

        angle = scipy.integrate.solve_ivp(swing, (0, 1), [0.5, 0.0], rtol=1e-11, atol=1e-12).y[0, -1]
        np.testing.assert_allclose(ends[k], length * np.sin(angle), atol=1e-7)


class Seesaw(Component):
    """Derivatives of x and y cancel in a combination whose weights are numbers, which leaves u to a constraint."""

    def __init__(self, ev, name, c):
        super().__init__(ev, name)
        x, y = self.variable("x"), self.variable("y", start=1.0, fixed=True)
        u = self.variable("u")
        self.add_equations(
            Eq(c * der(x) + c * der(y) + sympy.sin(u) / 3, u * 1.5),
            Eq(2 * c * der(x) + 2 * c * der(y) + sympy.sin(u) / 3, u * 2.5 - (x + y - c * sympy.sin(ev.t)) * 3.0),
            Eq(der(y), -y),
        )


@pytest.mark.slow
def test_weights_that_are_numbers(monkeypatch):
    def run():
        system = compiled(Seesaw, GAINS)
        options = {"rtol": 1e-9, "atol": 1e-11, "adjoint": FORWARD}
        solution = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), **options)
        return templates(system), solution[[f"c{k}.{v}" for k in range(N) for v in "xyu"]]

    shared, together = run()
    monkeypatch.setattr(lift_numbers, "MANY", 10**9)
    each, alone = run()  # each has its numbers in its own template
    assert shared < each
    np.testing.assert_allclose(together, alone, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        solution = simulate(compiled(Falling), 1.0, ts=jnp.array([1.0]), adjoint=FORWARD)
        assert solution["c3.x"].dtype == jnp.float32
        true = 2 * np.arctan(np.tan(0.75) * np.exp(-GAINS[3]))
        np.testing.assert_allclose(solution["c3.x"][0], true, rtol=1e-4)


def drawn(r, atoms, depth):
    """A random expression as nested tuples, with places for numbers."""
    if depth == 0 or r.random() < 0.15:
        return r.choice([*atoms, "number"])
    kind = r.choice(["sum", "product", "quotient", "sin", "exp", "power", "exponential", "atan2", "max", "branches"])
    parts = {"sum": 2, "product": 2, "quotient": 2, "atan2": 2, "max": 2, "branches": 3}.get(kind, 1)
    kind = ("power", r.choice([2, 3, -1, 0.5])) if kind == "power" else kind
    return (kind, *(drawn(r, atoms, depth - 1) for _ in range(parts)))


def read(tree, symbols, number):
    if tree == "number":
        return number()
    if isinstance(tree, str):
        return symbols[tree]
    kind, a, b, c = tree[0], *(read(part, symbols, number) for part in tree[1:]), *[None] * (4 - len(tree))
    if isinstance(kind, tuple):
        return (1 + a**2) ** kind[1]
    return {
        "sum": lambda: number() * a + number() * b,
        "product": lambda: a * b,
        "quotient": lambda: a / (2 + number() / 10 * sympy.sin(b)),
        "sin": lambda: sympy.sin(number() * a),
        "exp": lambda: sympy.exp(-number() * sympy.tanh(a)),
        "exponential": lambda: (abs(number()) + 0.1) ** sympy.tanh(a),
        "atan2": lambda: sympy.atan2(a, 3 + sympy.cos(b)),
        "max": lambda: sympy.Max(a, b, number()),
        "branches": lambda: sympy.Piecewise((a, b < number()), (c, True)),
    }[kind]()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(7))
def test_random_laws(seed, monkeypatch):
    """Laws whose numbers are taken out give what each gives with its own template: values, slopes, names."""
    r = random.Random(seed)
    slope, block, output = (drawn(r, ["x", "y", "p", "t"], 4) for _ in range(3))

    class Law(Component):
        def __init__(self, ev, name, seed):
            super().__init__(ev, name)
            q = random.Random(seed)

            def number():
                special = special_too and q.random() < 0.2
                return q.choice([0, 1, -1, 2]) if special else q.choice([round(q.uniform(-2, 2), 1), q.uniform(-2, 2)])

            x = self.variable("x", start=round(q.uniform(-1, 1), 1), fixed=True)
            y, z, p = self.variable("y", start=0.1), self.variable("z"), self.parameter("p", q.uniform(0.5, 2))
            symbols = {"x": x, "y": y, "t": ev.t, "p": p}
            self.add_equations(
                Eq(der(x), -x + sympy.tanh(read(slope, symbols, number))),
                Eq(y + number() / 100 * sympy.sin(y), sympy.tanh(read(block, {**symbols, "y": x}, number))),
                Eq(z, sympy.tanh(read(output, symbols, number))),
            )

    special_too = r.random() < 0.5
    taken = compiled(Law, 1000 * seed + np.arange(N))
    monkeypatch.setattr(lift_numbers, "MANY", 10**9)
    each = compiled(Law, 1000 * seed + np.arange(N))
    assert templates(taken) <= templates(each) - (seed == 0)  # some fold to too many shapes
    names = list(taken.variables)
    assert names == list(each.variables)
    assert taken.states == each.states
    order = [[*taken.states, *taken.carried].index(n) for n in [*each.states, *each.carried]]

    def computed(system):
        @jax.jit
        def values(x, t):
            return system.observe(names, t, x), jax.jacfwd(lambda x: system.vector_field(t, x, None))(x)

        x = jax.jit(lambda: system.initialize())()
        return [[np.asarray(v) for v in values(x + away, t)] for t, away in ((0.0, 0.0), (0.7, 0.05))]

    for (values, one), (same, other) in zip(computed(taken), computed(each), strict=True):
        assert np.all(np.isfinite(values))
        # Both are computed from the same numbers in the same way, up to the order of sums.
        np.testing.assert_allclose(values, same, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(one[np.ix_(order, order)], other, rtol=1e-10, atol=1e-10)
