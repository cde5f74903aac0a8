"""Streams: what a flow carries through the ports of a junction, beside the mixture by hand and SciPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import sympy

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    Domain,
    Eq,
    EqnEnv,
    ModelError,
    actual_stream,
    der,
    in_stream,
    simulate,
)

Warm = Domain("Warm", across=(("p", "Pa"),), through=(("m_flow", "kg/s"),), streams=(("T", "K"),))


class Tank(Component):
    """A mass M of one temperature, from which as much flows over as flows in: its pressure is given, or its flow is
    (amplitude + steady part) times sin(2 t)."""

    def __init__(self, ev, name, T, M, amplitude=None):
        super().__init__(ev, name)
        a = self.port("a", Warm)
        mass = self.parameter("M", M)
        start = self.parameter("T0", T)
        T = self.variable("T", start=start, fixed=True)
        flow = a.p if amplitude is None else a.m_flow - self.parameter("A", amplitude) * sympy.sin(2 * ev.t)
        carried = a.m_flow * actual_stream(a, "T")
        self.add_equations(Eq(flow, 0), Eq(a.T, T), Eq(mass * der(T), carried - a.m_flow * T))
        self.output("offered", in_stream(a, "T"))


class Pipe(Component):
    """Hands on what enters, with its pressure."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.port("a", Warm), self.port("b", Warm)
        self.add_equations(Eq(a.p, b.p), Eq(a.m_flow + b.m_flow, 0))
        self.add_equations(Eq(a.T, in_stream(b, "T")), Eq(b.T, in_stream(a, "T")))


class Boxed(Component):
    """A tank behind a pipe, with a port of its own."""

    def __init__(self, ev, name, **of):
        super().__init__(ev, name)
        pipe, tank = self.add(Pipe(ev, "pipe")), self.add(Tank(ev, "tank", **of))
        a = self.port("a", Warm)
        self.connect(a, pipe.a)
        self.connect(pipe.b, tank.a)


def system_of(*parts):
    ev, diagram = EqnEnv(), AcausalDiagram()
    made = [part(ev) for part in parts]
    diagram.add(*made)
    diagram.connect(*(part.a for part in made))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.slow
def test_tanks_at_one_junction_exchange_heat_while_the_flow_turns():
    """Three tanks, one of them in a component behind a pipe. At the start nothing flows: each is offered the mean of
    the others. Later, two fill the third, or the third the two."""
    values = {
        "x.T0": 300.0,
        "x.M": 2.0,
        "x.A": 1.5,
        "y.tank.T0": 350.0,
        "y.tank.M": 1.0,
        "y.tank.A": 0.5,
        "z.T0": 290.0,
        "z.M": 4.0,
    }
    system = system_of(
        lambda ev: Tank(ev, "x", 300.0, 2.0, 1.5),
        lambda ev: Boxed(ev, "y", T=350.0, M=1.0, amplitude=0.5),
        lambda ev: Tank(ev, "z", 290.0, 4.0),
    )
    ts = np.array([0.0, 0.8, 2.0, 3.0, 4.0])
    names = ["x.T", "y.tank.T", "z.T"]
    offers = ["x.offered", "y.tank.offered", "z.offered"]

    def run(values):
        solution = simulate(system.with_parameters(values), 4.0, ts=jnp.asarray(ts), rtol=1e-9, atol=1e-9)
        found = jnp.stack([solution[n] for n in names])
        return found[:, -1].sum(), (found, jnp.stack([solution[n] for n in offers]))

    (_, (found, offered)), slopes = jax.jit(jax.value_and_grad(run, has_aux=True))(values)

    def reference(values):
        T0, M = (np.array([values[f"{c}.{n}"] for c in ("x", "y.tank", "z")]) for n in ("T0", "M"))
        A = np.array([values["x.A"], values["y.tank.A"], -values["x.A"] - values["y.tank.A"]])

        def slope(t, T):
            m = A * np.sin(2 * t)
            leaving = np.maximum(-m, 0.0)
            reach = [np.delete(leaving, k) / max(np.delete(leaving, k).sum(), 1e-300) for k in range(3)]
            into = np.array([reach[k] @ np.delete(T, k) for k in range(3)])
            return np.maximum(m, 0.0) * (into - T) / M

        at, T, out = [0.0, np.pi / 2, np.pi, 4.0], T0, {0.0: T0}
        for a, b in itertools.pairwise(at):
            part = scipy.integrate.solve_ivp(slope, (a, b), T, dense_output=True, rtol=1e-12, atol=1e-10)
            out |= {t: part.sol(t) for t in ts if a < t <= b}
            T = part.y[:, -1]
        return np.array([out[t] for t in ts]).T

    np.testing.assert_allclose(offered[:, 0], [320.0, 295.0, 325.0], rtol=1e-12)
    np.testing.assert_allclose(found, reference(values), rtol=1e-7)
    for name, value in values.items():
        up, down = (reference(values | {name: value * (1 + s * 1e-4)})[:, -1].sum() for s in (1, -1))
        assert slopes[name] == pytest.approx((up - down) / (2e-4 * value), rel=1e-5, abs=1e-7), name


def test_two_ports_hand_on_and_a_loose_port_receives_what_it_offers():
    system = system_of(lambda ev: Tank(ev, "x", 300.0, 2.0, 1.5), lambda ev: Tank(ev, "z", 290.0, 4.0))
    x = system.initialize()
    assert system.observe(["x.offered", "z.offered"], 0.0, x).tolist() == [290.0, 300.0]
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Tank(ev, "x", 300.0, 2.0))
    alone = AcausalCompiler(ev, diagram)()
    assert float(alone.observe("x.offered", 0.0, alone.initialize())) == 300.0


def test_streams_are_named_in_errors():
    with pytest.raises(ModelError, match="the domain 'Twice' has 2 through quantities: streams are carried by one"):
        Domain("Twice", (("p", ""),), (("a", ""), ("b", "")), streams=(("h", ""),))
    ev = EqnEnv()
    with pytest.raises(ModelError, match=r"x\.a: Warm port has no stream 'h': a Warm port has the streams T"):
        in_stream(Tank(ev, "x", 300.0, 2.0).a, "h")
