"""Parameters that are expressions in others: set, trained and differentiated through what they depend on."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import compiled
from sympy import Eq, ImmutableMatrix, Matrix, sqrt

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, ModelError, der
from jaxonomy_dae.learning import minimize
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.write import Electrical


class Halves(Component):
    """A resistance R in two halves; the second takes its value from the first."""

    def __init__(self, ev, name, R=10.0):
        super().__init__(ev, name)
        total = self.parameter("R", R)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        a = self.add(Resistor(ev, "a", R=total / 2))
        b = self.add(Resistor(ev, "b", R=a.R))
        self.connect(p, a.p), self.connect(a.n, b.p), self.connect(b.n, n)


class Net(Component):
    """Every value follows R: k = R², resistance R + k, capacity 1/k, initial voltage R, source 2·R."""

    def __init__(self, ev, name, R=6.0):
        super().__init__(ev, name)
        total = self.parameter("R", R)
        k = self.parameter("k", total**2)
        source, h = self.add(VoltageSource(ev, "s", V=2 * total)), self.add(Halves(ev, "h", R=total + k))
        c = self.add(Capacitor(ev, "c", C=1 / k, initial_voltage=total))
        g = self.add(Ground(ev, "g"))
        self.connect(source.p, h.p), self.connect(h.n, c.p), self.connect(c.n, source.n, g.p)


def values(R):
    return {
        "net.R": R, "net.k": R**2, "net.h.R": R + R**2, "net.h.a.R": (R + R**2) / 2, "net.h.b.R": (R + R**2) / 2,
        "net.s.V": 2 * R, "net.c.C": R**-2, "net.c.initial_voltage": R,
    }  # fmt: skip


def slope(R, v):
    """dv/dt = (2R − v)/((R + R²)·C)."""
    return (2 * R - v) * R**2 / (R + R**2)


@pytest.fixture(scope="module")
def net():
    return compiled(Net(EqnEnv(), "net"))


@jax.jit
def read(system):
    """Parameters by name, the start, and the field at 1.5."""
    return dict(system.parameters.items()), system.initialize(), system.vector_field(0.0, jnp.array([1.5]))


@pytest.mark.parametrize("R", [6.0, 4.0, 0.5])
def test_values_follow(net, R):
    system = net.with_parameters({"net.R": R})
    found, start, field = read(system)
    assert {n: float(v) for n, v in found.items()} == pytest.approx(values(R), rel=1e-14)
    assert float(found["net.h.b.R"]) == pytest.approx((R + R**2) / 2, rel=1e-14)
    np.testing.assert_allclose(start, [R], rtol=1e-14)
    np.testing.assert_allclose(field, [slope(R, 1.5)], rtol=1e-13)
    assert system.parameters.table == net.parameters.table and system.plan is net.plan


@pytest.mark.slow
def test_gradients_reach_the_roots(net):
    """d/dR of (2R − v)·R/(1 + R), in closed form, by the parameter's name and through `partition`."""

    def field(R):
        return net.with_parameters({"net.R": R}).vector_field(0.0, jnp.array([1.5]))[0]

    R, v = 6.0, 1.5
    exact = ((4 * R - v) * (1 + R) - (2 * R - v) * R) / (1 + R) ** 2
    trainable, frozen = net.partition("net.R")

    @jax.jit
    def slopes(R, trainable):
        trained = jax.grad(lambda t: eqx.combine(t, frozen).vector_field(0.0, jnp.array([v]))[0])(trainable)
        start = jax.grad(lambda R: net.with_parameters({"net.R": R}).initialize()[0])(R)
        return jax.grad(field)(R), jax.jvp(field, (R,), (1.0,))[1], trained.parameters.free[0], start

    np.testing.assert_allclose(slopes(R, trainable), [exact, exact, exact, 1.0], rtol=1e-12)


def test_dependent_parameters_are_not_set(net):
    message = r"parameter 'net\.h\.a\.R' is net\.h\.R/2, computed from others: set or train 'net\.R' instead"
    for call in (
        lambda: net.with_parameters({"net.h.a.R": 1.0}),
        lambda: net.partition("net.h.a.R"),
        lambda: net.initialize(solve_for=["net.h.a.R"]),
        lambda: minimize(net, lambda s: 0.0, optax.sgd(1.0), 1, train="net.h.a.R", progress=False),
    ):
        with pytest.raises(ModelError, match=message):
            call()


def test_bounds_hold_for_values_that_follow(net):
    with pytest.raises(ModelError, match=r"parameter 'net\.c\.C' is 1/net\.k and must lie in \(0, inf\); got inf"):
        net.with_parameters({"net.R": 0.0})
    with pytest.raises(ModelError, match=r"parameter 'c\.C' is -r\.R and must lie in \(0, inf\); got -3"):
        r = Resistor(ev := EqnEnv(), "r", 3.0)
        compiled(r, Capacitor(ev, "c", C=-r.R))


@pytest.mark.slow
def test_siblings_share_in_a_diagram():
    ev = EqnEnv()
    source, ground = VoltageSource(ev, "s", 1.0), Ground(ev, "g")
    a = Resistor(ev, "a", R=3.0)
    b = Resistor(ev, "b", R=2 * a.R + source.V)
    diagram = AcausalDiagram().connect(source.p, a.p).connect(a.n, b.p).connect(b.n, source.n, ground.p)
    system = AcausalCompiler(ev, diagram)()
    assert float(system.parameters["b.R"]) == 7.0

    @jax.jit
    def found():
        _, solved = system.initialize(initial={"a.i": 0.25}, solve_for=["a.R"])
        return system.observe("a.i", 0.0, jnp.zeros(0)), solved.parameters["a.R"], solved.parameters["b.R"]

    # Solved for: i = V/(3·a.R + V).
    np.testing.assert_allclose(found(), [0.1, 1.0, 3.0], rtol=1e-12)


class Rate(Component):
    """der(x) = −k·x with a = √k its own dependent parameter; names collide with those of the parent on purpose."""

    def __init__(self, ev, name, k=1.0, a=2.0, b=0.5):
        super().__init__(ev, name)
        own_a, own_k = self.parameter("a", a), self.parameter("k", k)
        self.parameter("b", b), self.parameter("root", sqrt(own_k) * own_a)
        x = self.variable("x", start=own_a, fixed=True)
        self.add_equations(Eq(der(x), -own_k * x))


def test_equal_names_in_parent_and_child_are_two_parameters():
    class Parent(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            a, k = self.parameter("a", 5.0), self.parameter("k", 9.0)
            self.add(Rate(ev, "c", k=a, a=k, b=a * k))

    system = compiled(Parent(EqnEnv(), "p"))
    found = {n: float(v) for n, v in system.parameters.items()}
    expected = {"p.a": 5.0, "p.k": 9.0, "p.c.a": 9.0, "p.c.k": 5.0, "p.c.b": 45.0, "p.c.root": 9.0 * 5.0**0.5}
    assert found == pytest.approx(expected)
    np.testing.assert_allclose(system.initialize(), [9.0])


class Named(NamedTuple):
    first: Any


@pytest.mark.parametrize(
    "hold",
    [lambda s: [s], lambda s: np.array([s]), lambda s: np.array([[s]]).ravel(), Matrix, ImmutableMatrix, Named],
)
def test_containers_of_the_parents_symbols(hold):
    """In whatever a symbol is handed down, it is the parent's, though the child has one of its name."""

    class Child(Component):
        def __init__(self, ev, name, given):
            super().__init__(ev, name)
            R = self.parameter("R", 7.0)
            self.parameter("seen", given[0] - R)

    class Parent(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), 1))
            R = self.parameter("R", 3.0)
            self.add(Child(ev, "c", hold([R]) if hold in (Matrix, ImmutableMatrix) else hold(R)))

    assert compiled(Parent(EqnEnv(), "p")).parameters["p.c.seen"] == 3.0 - 7.0


def test_an_argument_may_stand_in_equations_as_it_is():
    class Plain(Component):
        """der(x) = −k·x, where k was never declared here."""

        def __init__(self, ev, name, k):
            super().__init__(ev, name)
            x = self.variable("x", start=2 * k, fixed=True)
            self.add_equations(Eq(der(x), -k * x))

    class Parent(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            rates = [self.parameter("k1", 3.0), self.parameter("k2", 4.0)]
            for j, k in enumerate(rates):
                self.add(Plain(ev, f"c{j}", k))

    system = compiled(Parent(EqnEnv(), "p"))
    names = ["p.c0.x", "p.c1.x", "der(p.c0.x)", "der(p.c1.x)"]
    found = jax.jit(lambda: system.observe(names, 0.0, system.initialize()))()
    np.testing.assert_allclose(found, [6.0, 8.0, -18.0, -32.0])


def test_many_instances_make_one_group():
    ev = EqnEnv()
    first = Rate(ev, "r0", k=2.0)
    others = [Rate(ev, f"r{j}", k=first.k + 1) for j in range(1, 40)]
    system = compiled(first, *others)
    assert len(system.parameters.table.dependents) <= 3  # k of all but one; √k·a of the first, and of all others
    np.testing.assert_allclose([system.parameters[f"r{j}.k"] for j in (1, 20, 39)], 3.0)
    batch = jax.jit(jax.vmap(lambda k: system.with_parameters({"r0.k": k}).parameters["r7.k"]))(np.array([1.0, 8.0]))
    np.testing.assert_allclose(batch, [2.0, 9.0])


def test_training_a_root():
    system = compiled(Rate(EqnEnv(), "c", k=1.0, a=1.0))

    # √k − 3 falls by the factor 1 − 6 / (2·3) of a step near its end.
    steps = minimize(
        system, lambda s: (s.parameters["c.root"] - 3) ** 2, optax.sgd(6.0), 60, train="c.k", progress=False
    )
    assert float(steps.model.parameters["c.k"]) == pytest.approx(9.0, rel=1e-6)


def test_training_says_if_a_value_that_follows_leaves_its_bounds():
    ev = EqnEnv()
    a, g = Resistor(ev, "a", 3.0), Ground(ev, "g")
    c = Capacitor(ev, "c", C=a.R)
    system = compiled(a, c, g, connect=[(a.p, c.p), (a.n, c.n, g.p)])
    with pytest.warns(RuntimeWarning, match=r"parameter 'c\.C' is a\.R and must lie in \(0, inf\); got -2"):
        minimize(system, lambda s: (s.parameters["a.R"] + 2) ** 2, optax.sgd(0.5), 1, train="a.R", progress=False)


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda ev, c: c.parameter("k", 2 * c.variable("x")),
            r"value of parameter 'c\.k' may use parameters only.*'x'",
        ),
        (lambda ev, c: c.parameter("k", 2 * ev.t), r"value of parameter 'c\.k' may use parameters only.*'time'"),
    ],
)
def test_what_a_value_cannot_be(make, message):
    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            make(ev, self)

    with pytest.raises(ModelError, match=message):
        Written(EqnEnv(), "c")


def test_a_component_whose_parameters_are_elsewhere():
    ev = EqnEnv()
    a = Resistor(ev, "a", 1.0)
    with pytest.raises(
        ModelError, match=r"'b' was given an expression in the parameter 'a\.R', which is not known in the"
    ):
        compiled(Resistor(ev, "b", R=a.R))


# --- signals -----------------------------------------------------------------------------------------------------


class Integrator(Component):
    """der(y) = k·u."""

    def __init__(self, ev, name, k=1.0, y0=0.0, default=None):
        super().__init__(ev, name)
        gain, u = self.parameter("k", k), self.input("u", default=default)
        y = self.variable("y", start=y0, fixed=True)
        self.add_equations(Eq(der(y), gain * u))


def loop(*connections, default=None):
    """Two integrators: a drives b, b drives a."""
    ev = EqnEnv()
    a, b = Integrator(ev, "a", 2.0, 1.0, default), Integrator(ev, "b", -3.0, 0.5)
    diagram = AcausalDiagram().add(a, b)
    for ends in connections:
        diagram.connect(*ends(a, b))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.parametrize("default", [7.0, pytest.param(None, marks=pytest.mark.slow)])
def test_signals_join_blocks(default):
    system = loop(lambda a, b: (a.y, b.u), lambda a, b: (b, "y", a, "u"), default=default)
    assert system.inputs == []
    names = ["a.u", "b.u", "der(a.y)", "der(b.y)"]
    observed = jax.jit(lambda: system.observe(names, 0.0, system.initialize()))()
    found = dict(zip(names, observed, strict=True))
    expected = {"a.u": 0.5, "b.u": 1.0, "der(a.y)": 2.0 * 0.5, "der(b.y)": -3.0 * 1.0}
    assert {n: float(v) for n, v in found.items()} == pytest.approx(expected)


def test_signals_inside_a_component():
    class Plant(Component):
        """Its own input drives both children; their sum is its output."""

        def __init__(self, ev, name):
            super().__init__(ev, name)
            u = self.input("u")
            a, b = self.add(Integrator(ev, "a", 2.0)), self.add(Integrator(ev, "b", 5.0))
            self.connect(u, a.u, b.u)
            self.output("sum", a.y + b.y)

    system = compiled(Plant(EqnEnv(), "plant"))
    assert system.inputs == ["plant.u"]
    inputs, names = {"plant.u": 3.0}, ["der(plant.a.y)", "der(plant.b.y)"]
    slopes = jax.jit(lambda: system.observe(names, 0.0, system.initialize(inputs=inputs), inputs))()
    np.testing.assert_allclose(slopes, [6.0, 15.0])


@pytest.mark.parametrize(
    "connections, message",
    [
        ([lambda a, b: (a.u, b.u)], r"diagram: connect\('a\.u', 'b\.u'\).*none of them drives"),
        ([lambda a, b: (a.y, b.y)], r"more than one is not an input.*Eq\(a\.x, b\.x\)"),
        ([lambda a, b: (a.y, b.u), lambda a, b: (b.y, b.u)], r"input 'b\.u' is driven by 'a\.y' already, so 'b\.y'"),
        ([lambda a, b: (a.y,)], r"connect needs at least two ends; got 'a\.y' only"),
        ([lambda a, b: (a.y, 3.0)], r"connect takes ports, symbols of variables, or a component and a name; got 3\.0"),
        ([lambda a, b: (a.k, b.u)], r"connect takes ports, symbols of variables.*got a\.k"),
        ([lambda a, b: (a.y, "u", b)], r"connect takes ports"),
        ([lambda a, b: (a, "z", b, "u")], r"component 'a' has no variable 'z'"),
        ([lambda a, b: (Integrator(a.ev, "c").y, a.u)], r"diagram: 'c\.y' is connected.*add it"),
    ],
)
def test_signals_that_cannot_be(connections, message):
    with pytest.raises(ModelError, match=message):
        loop(*connections)
