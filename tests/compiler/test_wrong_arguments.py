"""What a user may give by mistake: errors name the component and the argument, what was found and what is expected."""

import functools
import json
import re
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import EV, compiled, component, drag_on, pendulum, rc_circuit, run

import jaxonomy_dae.library.battery as battery
import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.friction as friction
import jaxonomy_dae.library.hydraulic as hy
import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.thermal as th
import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, ModelError, NeuralDAEBlock, simulate
from jaxonomy_dae.learning import minimize
from jaxonomy_dae.library.electrical import Ground, Resistor
from jaxonomy_dae.library.transmissions import LeadScrew

SOC, OCV = [0.0, 1.0], [3.0, 4.0]
NESTED = [[1.0, 2.0], [3.0]]

# Signatures are checked by the tests before these messages can be raised, so both lists are tried without that check.
# (a component made of wrong arguments, the whole error)
REFUSED = [
    # Values of parameters.
    (lambda ev: tr.Mass(ev, "m", -1.0), "parameter 'm.m' must lie in (0, inf); got -1"),
    (lambda ev: rot.Inertia(ev, "J", 0.0), "parameter 'J.J' must lie in (0, inf); got 0"),
    (lambda ev: tr.Mass(ev, "m", None), "parameter 'm.m' must be a number; got NoneType"),
    (lambda ev: tr.Mass(ev, "m", True), "parameter 'm.m' must be a number; got True"),
    (lambda ev: el.TimedSwitch(ev, "s", True), "parameter 's.time' must be a number; got True"),
    (
        lambda ev: tr.Mass(ev, "m", "2"),
        "parameter 'm.m' must be a real number; got the string '2': write 2 without quotes",
    ),
    (lambda ev: el.Capacitor(ev, "c", "5uF"), "parameter 'c.C' must be a real number; got the string '5uF'"),
    (lambda ev: hy.Tank(ev, "t", np.nan), "parameter 't.A' must be finite; got nan"),
    (
        lambda ev: th.HeatCapacitor(ev, "h", [1.0, 2.0]),
        "parameter 'h.C' must be a number; got list. To vary or differentiate it, compile once and use "
        "`system.with_parameters({'h.C': value})`",
    ),
    (lambda ev: el.Diode(ev, "d", Vt=0.0), "parameter 'd.Vt' must lie in (0, inf); got 0"),
    (lambda ev: LeadScrew(ev, "s", lead=0.0), "parameter 's.lead' must lie in (0, inf); got 0"),
    (lambda ev: friction.Clutch(ev, "c", peak=0.5), "parameter 'c.peak' must lie in [1, inf); got 0.5"),
    (lambda ev: el.PulseVoltage(ev, "p", width=-0.5), "parameter 'p.width' must lie in [0, 1]; got -0.5"),
    (lambda ev: sig.Pulse(ev, "p", width=1.5), "parameter 'p.width' must lie in [0, 1]; got 1.5"),
    (lambda ev: sig.Noise(ev, "n", jax.random.key(0), -1.0), "parameter 'n.std' must lie in [0, inf); got -1"),
    # Values that belong together.
    (
        lambda ev: sig.Saturation(ev, "s", 1.0, -1.0),
        "'s': low must not be above high; got low=1 and high=-1: exchange them",
    ),
    (
        lambda ev: sig.PID(ev, "p", low=2.0, high=1.0),
        "'p': low must not be above high; got low=2 and high=1: exchange them",
    ),
    (
        lambda ev: sig.Hysteresis(ev, "h", 1.0, 0.0),
        "'h': lower must not be above upper; got lower=1 and upper=0: exchange them",
    ),
    (
        lambda ev: sig.DiscretePI(ev, "p", low=1.0, high=-1.0),
        "'p': low must not be above high; got low=1 and high=-1: exchange them",
    ),
    (
        lambda ev: friction.StickingFriction(ev, "f", 2.0, 1.0),
        "'f': sliding must not be above breakaway; got sliding=2 and breakaway=1: exchange them",
    ),
    # Rows, tables and matrices.
    (lambda ev: sig.Sum(ev, "s", 2.0), "'s': gains is a row of values, such as [1.0, 2.0]; got 2.0"),
    (lambda ev: th.Wall(ev, "w", 1.0, [2.0]), "'w': R is a row of values, such as [1.0, 2.0]; got 1.0"),
    (lambda ev: battery.Cell(ev, "c", SOC, 3.7), "'c': ocv is a row of values, such as [1.0, 2.0]; got 3.7"),
    (lambda ev: battery.Cell(ev, "c", SOC, OCV, R=0.1), "'c': R is a row of values, such as [1.0, 2.0]; got 0.1"),
    (lambda ev: battery.Pack(ev, "k", 2, 2, SOC, OCV, C="1"), "'k': C is a row of values, such as [1.0, 2.0]; got '1'"),
    (lambda ev: battery.Pack(ev, "k", 2, 2, SOC, [3, 4, 5]), "'k': ocv has 3 entries, soc has 2: they must agree"),
    (lambda ev: battery.Pack(ev, "k", 2, 2, [1, 0], OCV), "'k': soc must increase, but entry 1 (0) follows 1: sort it"),
    (
        lambda ev: sig.Table1D(ev, "t", [0, 1, 1], [0, 1, 2]),
        "'t': x must increase, but entry 2 (1) follows 1: part the two points a little, or write a jump as a Piecewise "
        "or a Step",
    ),
    (
        lambda ev: sig.Table1D(ev, "t", ["a", "b"], [0, 1]),
        "'t': x must be numbers, in rows of one length; got ['a', 'b']",
    ),
    (
        lambda ev: sig.Table2D(ev, "t", [0, 1], [0, 1], NESTED),
        f"'t': values must be numbers, in rows of one length; got {NESTED}",
    ),
    (lambda ev: sig.Table1D(ev, "t", [[0, 1]], [0, 1]), "'t': x needs a row of at least 2 points; got shape (1, 2)"),
    (
        lambda ev: sig.StateSpace(ev, "s", NESTED, [[1], [1]], [[1, 1]]),
        f"'s': A must be numbers, in rows of one length; got {NESTED}",
    ),
    (lambda ev: sig.StateSpace(ev, "s", [[np.nan]], [[1]], [[1]]), "'s': A is not finite at entry 0 (nan)"),
    (
        lambda ev: sig.TransferFunction(ev, "f", [], [1, 1]),
        "'f': the numerator needs at least one coefficient; got none",
    ),
    (
        lambda ev: sig.DiscreteTransferFunction(ev, "f", ["a"], [1, 1]),
        "'f': numerator must be numbers, in rows of one length; got ['a']",
    ),
    # Counts and choices.
    (lambda ev: sig.Product(ev, "p", 2.5), "'p': n must be at least 1, an integer; got 2.5"),
    (lambda ev: sig.PadeDelay(ev, "d", 1.0, 0), "'d': n must be at least 1, an integer; got 0"),
    (lambda ev: sig.SampledDelay(ev, "d", 2.0), "'d': samples must be at least 1, an integer; got 2.0"),
    (lambda ev: battery.Pack(ev, "k", 2.0, 2, SOC, OCV), "'k': series must be at least 1, an integer; got 2.0"),
    (lambda ev: el.TimedSwitch(ev, "s", opens="yes"), "'s': opens is True or False; got 'yes'"),
    (lambda ev: sig.Noise(ev, "n", 0), "'n': key is a key of random numbers, such as jax.random.key(0); got 0"),
    (
        lambda ev: sig.Noise(ev, "n", jax.random.key(0), 1.0, "a"),
        "'n': interval must be a number > 0; got 'a'",
    ),
    (
        lambda ev: pl.Body(ev, "b", initial_x="left"),
        "parameter 'b.initial_x' must be a real number; got the string 'left'",
    ),
]  # fmt: skip


KNOTS = np.linspace(0.0, 1.0, 3)
# (a pattern of the error, a call)
WRONG_TYPES = [
    (r"the system is a batch, its parameters have shape \(3, 4\).*equinox\.filter_vmap",
     lambda: simulate(jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), rc_circuit()), 1.0)),
    (r"first argument of a component is an EqnEnv; got str", lambda: Ground("ground", "g")),
    (r"parameter 'r\.R' must be a number; got list.*with_parameters\(\{'r\.R'", lambda: Resistor(EV, "r", [1.0])),
    (r"function 'c\.f': the function must be callable; got LinearInterp.*give its method \.evaluate",
     lambda: component(lambda s, ev: s.function("f", diffrax.LinearInterpolation(KNOTS, KNOTS), [s.variable("x")]))),
    (r"function 'c\.f': inputs is a list of symbols; write inputs=\[x\]",
     lambda: component(lambda s, ev: s.function("f", jnp.sin, s.variable("x")))),
    (r"'c\.x': bounds are a pair", lambda: component(lambda s, ev: s.variable("x", bounds=("0", "1")))),
    (r"neural block's name cannot contain '\['", lambda: pendulum(drag_on("vx", name="a[0]"))),
    (r"optimizer must be one of Optax.*got 'adam'", lambda: minimize(rc_circuit(), lambda s: 0.0, "adam", 1)),
    (r"'c\.x': fixed is True or False; got 'no'", lambda: component(lambda s, ev: s.variable("x", 1.0, fixed="no"))),
    (r"parameter 'c\.k': unit is a text such as 'kg'; got 1",
     lambda: component(lambda s, ev: s.parameter("k", 1.0, 1))),
    (r"the constant 'g' of EqnEnv must be a real number; got the string '9\.81'", lambda: EqnEnv(g="9.81")),
    (r"Resistor: the environment comes first, then the name: Resistor\(ev, \"name\"", lambda: Resistor("r")),
    (r"got a list: write diagram\.add\(\*components\)", lambda: AcausalDiagram().add([Ground(EV, "g")])),
    (r"got the class Ground: make a component of it, Ground\(ev", lambda: AcausalDiagram().add(Ground)),
    (r"initial is a dictionary by names.*got list", lambda: simulate(rc_circuit(), 1.0, initial=[1.0])),
    (r"initial is a dictionary by names.*got list", lambda: rc_circuit().initialize(initial=[1.0])),
    (r"parameters are given by names.*got list", lambda: rc_circuit().with_parameters([1.0])),
    (r"port 'c\.p' needs a Domain such as Electrical; got 'electrical'",
     lambda: component(lambda s, ev: s.port("p", "electrical"))),
    (r"is not an equation", lambda: component(lambda s, ev: s.add_equations(sympy.Matrix([s.variable("x")])))),
    (r"only components can be added to a diagram; got str", lambda: AcausalDiagram().add("r")),
    (r"needs an EqnEnv and an AcausalDiagram", lambda: AcausalCompiler(AcausalDiagram(), EV)),
    (r"'auto', 'dummy_derivatives' or 'projection'; got 'best'",
     lambda: AcausalCompiler(EV, AcausalDiagram(), state_selection="best")),
    (r"inject is 'equation' or 'row'; got 'force'", lambda: pendulum(drag_on("vx", inject="force"))),
    (r"must be callable", lambda: NeuralDAEBlock(jnp.ones(3), targets=["pend.vx"], name="drag")),
    (r"needs an AcausalSystem.*got AcausalDiagram", lambda: simulate(AcausalDiagram(), 1.0)),
    (r"solver must be a Diffrax solver.*got 'tsit5'", lambda: simulate(rc_circuit(), 1.0, solver="tsit5")),
]  # fmt: skip


def said(call: Callable) -> str:
    """What is said of a call."""
    try:
        call()
        return "accepted"
    except ModelError as error:
        return str(error)


def refusals() -> list[str]:
    """What is said of each of them, in order."""
    return [said(lambda make=make: make(EqnEnv())) for make, _ in REFUSED] + [said(call) for _, call in WRONG_TYPES]


@functools.cache
def refusals_of_users() -> list[str]:
    """The same in a new Python: tests check the types of arguments when they are called, users do not."""
    return json.loads(run("import json, test_wrong_arguments as t; print(json.dumps(t.refusals()))"))


@pytest.mark.parametrize("k", range(len(REFUSED)), ids=[message for _, message in REFUSED])
def test_arguments(k):
    assert refusals_of_users()[k] == REFUSED[k][1]


@pytest.mark.parametrize("k", range(len(WRONG_TYPES)), ids=[message for message, _ in WRONG_TYPES])
def test_wrong_types(k):
    assert re.search(WRONG_TYPES[k][0], refusals_of_users()[len(REFUSED) + k])


def test_what_rows_may_be():
    """Tuples, arrays of NumPy, and expressions in parameters."""
    ev = EqnEnv()
    wall = th.Wall(ev, "wall", np.array([1.0, 2.0]), (3.0, 4.0), np.array([280.0, 290.0]))
    assert [wall.parameters[n].value for n in ("R1", "R2", "C1", "C2")] == [1.0, 2.0, 3.0, 4.0]
    assert len(sig.Sum(ev, "sum", np.ones(3)).parameters) == 3
    gains = sig.Sum(ev, "more", (2 * wall.R1, 1.0)).parameters
    assert gains["k1"].value.free_symbols and gains["k2"].value == 1.0


def test_names_that_a_component_lacks():
    r = el.Resistor(EqnEnv(), "r")
    with pytest.raises(AttributeError, match=r"^Resistor 'r' has no attribute 'plus': known names: 'p', 'n', 'v', 'i'"):
        r.plus  # noqa: B018
    with pytest.raises(AttributeError, match=r"^MassiveLink 'k' has no attribute 'frame_c': did you mean 'frame_b' or"):
        pl.MassiveLink(EqnEnv(), "k").frame_c  # noqa: B018


def circuit(*parts, connect):
    ground = el.Ground(parts[0].ev, "ground")
    return compiled(*parts, ground, connect=[*connect, (parts[0].n, ground.p)])


def series(first, second):
    """A source of 5 V and two resistors."""
    ev = EqnEnv()
    source, r, q = el.VoltageSource(ev, "source", 5.0), el.Resistor(ev, "r", first), el.Resistor(ev, "q", second)
    return circuit(source, r, q, connect=[(source.p, r.p), (r.n, q.p), (q.n, source.n)])


def coupled(mutual):
    """Two coils of 1 H on a resistor each."""
    ev = EqnEnv()
    coils = el.MutualInductor(ev, "coils", 1.0, 1.0, mutual, 0.0, 0.0)
    r, q, ground = el.Resistor(ev, "r"), el.Resistor(ev, "q"), el.Ground(ev, "ground")
    joined = [(coils.p1, r.p), (coils.p2, q.p), (coils.n1, coils.n2, r.n, q.n, ground.p)]
    return compiled(coils, r, q, ground, connect=joined)


def ring():
    """Four diodes in a ring, with a source across: two nodes that only blocking diodes hold."""
    ev = EqnEnv()
    a, b, c, d = (el.IdealDiode(ev, n) for n in "abcd")
    source, load, ground = el.SineVoltage(ev, "source", 10.0, 50.0), el.Resistor(ev, "load"), el.Ground(ev, "ground")
    joints = [(a.n, b.p), (b.n, c.p, load.p), (c.n, d.p), (d.n, a.p, source.n, ground.p), (source.p, load.n)]
    return compiled(a, b, c, d, source, load, ground, connect=joints)


def port_of_another_domain():
    ev = EqnEnv()
    shaft, body = rot.Inertia(ev, "shaft"), pl.Body(ev, "body")
    return compiled(shaft, body, connect=[(shaft.flange_a, body.frame)])


def boost():
    """Where both the switch and the diode block, the inductor's current has no way."""
    ev = EqnEnv()
    v, g, coil = el.VoltageSource(ev, "v", 12.0), el.Ground(ev, "g"), el.Inductor(ev, "L", 1e-4, initial_current=0.0)
    switch, diode = el.Switch(ev, "switch"), el.IdealDiode(ev, "diode")
    c, r = el.Capacitor(ev, "C", 47e-6, initial_voltage=12.0), el.Resistor(ev, "R", 20.0)
    off = sig.Constant(ev, "off", 0.0)
    return compiled(
        off, connect=[
            (v.p, coil.p), (coil.n, switch.p, diode.p), (diode.n, c.p, r.p), (v.n, switch.n, c.n, r.n, g.p),
            (off.y, switch.u),
        ],
    )  # fmt: skip


def port_for_a_signal():
    ev = EqnEnv()
    r, gain = el.Resistor(ev, "r"), sig.Gain(ev, "gain")
    return compiled(r, gain, connect=[(r.p, gain.u)])


@pytest.mark.parametrize(
    "build, parts",
    [
        (
            lambda: series(0.0, 0.0),
            ("singular for r.R = 0, q.R = 0, though not in general. Give a value other than zero to r.R or q.R, or",),
        ),
        (
            lambda: coupled(1.0),
            ("'coils': M² must be below L1·L2; got M=1 with L1=1 and L2=1", "take IdealTransformer"),
        ),
        (
            boost,
            (
                "in the mode switch.closed = 0, diode.active = 0",
                "Give a value other than zero to switch.Goff or diode.Goff",
            ),
        ),
        (ring, ("in the mode a.active = 0, b.active = 0", "Give a value other than zero to a.Goff or b.Goff, or")),
        (
            port_of_another_domain,
            ("'shaft.flange_a' (Rotational)", "'body.frame' (Planar)", "ports must have the same domain"),
        ),
        (port_for_a_signal, ("connect joins ports, or a variable and inputs; got both: 'r.p', 'gain.u'",)),
    ],
    ids=[
        "zero resistances",
        "perfectly coupled coils",
        "boost converter",
        "ring of diodes",
        "domains",
        "port and signal",
    ],
)
def test_models(build, parts):
    with pytest.raises(ModelError) as caught:
        build()
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (lambda x: jnp.where(x > 0, 1, 0), "floating-point numbers.*got int"),
        (lambda x: x > 0, "floating-point numbers.*got bool"),
        (lambda x: jax.lax.complex(x, x), "real numbers; got complex"),
        (lambda x: jnp.ones((2, 2)) * x, "shape"),
        (lambda x: "one", "law"),
    ],
)
def test_what_functions_return_is_checked(law, said):
    """Kind: what a user's function returns is checked as what users declare, where the model is written."""

    with pytest.raises(ModelError, match=said):
        compiled(component(lambda self, ev: self.function("law", law, [self.variable("x")])))


def test_classes_and_lists_where_objects_and_names_belong():
    """`solver=diffrax.Tsit5` printed the class; `prefer_states=[["c.v"]]` was "unhashable type: 'list'"."""
    system = rc_circuit()
    with pytest.raises(ModelError, match=r"got the class Tsit5: write Tsit5\(\)"):
        simulate(system, 1.0, solver=diffrax.Tsit5)
    with pytest.raises(ModelError, match=r"got 'Radau'. For stiff models give solvers.Rodas5P\(\)"):
        simulate(system, 1.0, solver="Radau")
    with pytest.raises(ModelError, match=r"entry 0 is \['c.v'\]"):
        AcausalCompiler(EqnEnv(), AcausalDiagram(), prefer_states=[["c.v"]])
