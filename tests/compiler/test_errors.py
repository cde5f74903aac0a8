"""Wrong models and wrong calls: each message names the part concerned and says what to do.

Every case is a function that raises, the error's type, and a pattern of names and advice. What only shows when a
simulation runs is in test_errors_of_runs.py, test_solution.py and test_initialization.py; wrong types are in
test_wrong_arguments.py; single precision is in test_precision.py.
"""

import math
import re

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from jax import device_put  # does not compile a program, as jnp.asarray of an array does
from problems import EV, compiled, component, drag_on, pendulum, quadratic, rc_circuit
from sympy import Eq

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    ModelError,
    NeuralDAEBlock,
    StructuralError,
    der,
    simulate,
)
from jaxonomy_dae.base.optional import optional_module
from jaxonomy_dae.library.electrical import Ground, Resistor
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.library.translational import Mass, Spring
from jaxonomy_dae.write import Eq as our_eq
from jaxonomy_dae.write import Hydraulic


def dense(inputs, outputs):
    """A linear network; its weights are NumPy's, so that nothing is compiled for it."""
    weights = np.ones((outputs, inputs))
    return lambda u: weights @ u


def decay(self, ev, *more):
    x = self.variable("x", start=1.0, fixed=True)
    self.add_equations(Eq(der(x), -x), *more)
    return x


def raises(error, message, call):
    with pytest.raises(error, match=message) as caught:
        call()
    assert caught.type is error or issubclass(caught.type, error)


def case(message, call, error=ModelError):
    return pytest.param(message, call, error, id=message[:40])


# --- writing a component -----------------------------------------------------------------------------------------


def declares_twice(self, ev):
    self.parameter("R", 1.0)
    self.variable("R")


def learned_twice(self, ev):
    x = self.variable("x")
    self.learned("law", dense(1, 2), inputs=[x])
    self.variable("law")


def stores_a_symbol(self, ev):
    self.position = self.variable("x")


def declares_afterwards():
    component(decay).variable("y")


def adds_equations_afterwards():
    c = component(decay)
    c.add_equations(Eq(c.x, 1))


class Forgetful(Component):
    def __init__(self, ev, name):
        self.variable("x")


class Empty(Component):
    def __init__(self, ev, name):
        pass


@pytest.mark.parametrize(
    "message, call, error",
    [
        case(r"'c' uses the name 'R' twice: it is a parameter already; rename the variable",
             lambda: component(declares_twice)),
        case(r"'c' uses the name 'law' twice: it is a learned term already", lambda: component(learned_twice)),
        case(r"cannot store the symbol 'x' as attribute 'position'.*component\[\"x\"\]",
             lambda: component(stores_a_symbol)),
        case(r"'c' is complete: declare its variable 'y' inside __init__", declares_afterwards),
        case(r"'c' is complete: add its equations inside __init__", adds_equations_afterwards),
        case(r"name is a non-empty string without dots or spaces; got 'a\.b'", lambda: Ground(EV, "a.b")),
        case(r"variable's name is a non-empty string without dots or spaces; got 'a\.b'",
             lambda: component(lambda self, ev: self.variable("a.b"))),
        case(r"parameter 'r\.R' must be finite; got nan", lambda: Resistor(EV, "r", np.nan)),
        case(r"parameter 'c\.k' must lie in \[0.*1.*\]; got 2",
             lambda: component(lambda self, ev: self.parameter("k", 2.0, bounds=(0.0, 1.0)))),
        case(r"'c\.x' is fixed at the start but has no start value: give `start=`",
             lambda: component(lambda self, ev: self.variable("x", fixed=True))),
        case(r"start value of 'c\.x' must be finite", lambda: component(lambda s, ev: s.variable("x", start=np.inf))),
        case(r"start value of 'c\.y' may use parameters only; it uses 'x'",
             lambda: component(lambda s, ev: s.variable("y", start=2 * s.variable("x")))),
        case(r"nominal value of 'c\.x' must be a positive number; got -1\.0",
             lambda: component(lambda s, ev: s.variable("x", nominal=-1.0))),
        case(r"an equation is always True.*Eq\(a, b\)",
             lambda: component(lambda s, ev: s.add_equations(Eq(s.variable("x"), s.x)))),
        case(r"an equation is always False.*Eq\(a, b\)",
             lambda: component(lambda s, ev: s.add_equations(s.variable("x") == s.variable("y")))),
        case(r"`x == 2` compares the symbol.*Piecewise\(\(a, Eq\(x, 2\)\).*an equation Eq\(x, 2\)",
             lambda: component(lambda s, ev: s.add_equations(s.variable("x") == 2))),
        case(r"`k != 0\.0` compares the symbol",
             lambda: component(lambda s, ev: 1 if s.parameter("k", 1.0) != 0.0 else 2)),
        case(r"`x == 0` compares the symbol", lambda: component(lambda s, ev: 0 in [s.variable("x")])),
        case(r"contains no variable", lambda: component(lambda s, ev: s.add_equations(s.parameter("k", 1.0) - 1))),
        case(r"no variable or parameter 'z'", lambda: component(decay)["z"]),
        case(r"no attribute 'z'", lambda: component(decay).z, AttributeError),
        case(r"Electrical port 'r\.p' has no 'x': it has v, i", lambda: Resistor(EV, "r").p.x, AttributeError),
        case(r"der\(.*\): the symbol 'k' was declared by no component.*self\.parameter",
             lambda: der(sympy.Symbol("k") * component(decay).x)),
        case(r"learned term 'c\.law': the network must be callable; got 3",
             lambda: component(lambda s, ev: s.learned("law", 3, inputs=[s.variable("x")]))),
        case(r"learned term 'c\.law': inputs are symbols of variables or ev\.t; got 'x\*\*2'",
             lambda: component(lambda s, ev: s.learned("law", dense(1, 1), inputs=[s.variable("x") ** 2]))),
        case(r"learned term 'c\.law': calling network\(u\) with u of shape \(2,\) failed",
             lambda: component(lambda s, ev: s.learned("law", dense(1, 1), inputs=[s.variable("x"), ev.t]))),
        case(r"learned term 'c\.law': expected 3 outputs, but the network returns 2",
             lambda: component(lambda s, ev: s.learned("law", dense(1, 2), inputs=[s.variable("x")], outputs=3))),
        case(r"must return a vector of shape \(outputs,\); got shape \(\)",
             lambda: component(lambda s, ev: s.learned("law", jnp.sum, inputs=[s.variable("x")]))),
        case(r"parameter 'c\.k' must be a real number; got the string '2': write 2 without quotes",
             lambda: component(lambda s, ev: s.parameter("k", "2"))),
        case(r"parameter 'c\.k' must be a real number; got the complex number 2j",
             lambda: component(lambda s, ev: s.parameter("k", 2j))),
        case(r"parameter 'm\.m' must lie in \(0, inf\); got -1", lambda: Mass(EV, "m", -1.0)),
        case(r"parameter 's\.c' must lie in \[0, inf\); got -2", lambda: Spring(EV, "s", -2.0)),
        case(r"parameter 'c\.k': the bounds \[2, 1\] contain no number",
             lambda: component(lambda s, ev: s.parameter("k", 1.5, bounds=(2.0, 1.0)))),
        case(r"start value of 'c\.x' must be a real number; got the string '1'",
             lambda: component(lambda s, ev: s.variable("x", start="1"))),
        case(r"default of input 'c\.u' must be finite; got nan",
             lambda: component(lambda s, ev: s.input("u", default=np.nan))),
        case(r"complex coefficient", lambda: component(lambda s, ev: s.add_equations(sympy.I * s.variable("x") - 1))),
        *(
            case(rf"a variable's name cannot (contain|begin with) .* got '{re.escape(name)}'",
                 lambda name=name: component(lambda s, ev: s.variable(name)))
            for name in ("der(x)", "x:physics", "r[0]", "-x", "a/b")
        ),
        case(r"a component's name cannot contain '\('", lambda: Ground(EV, "der(g)")),
        case(r"`diff` by ev\.t does not see that variables change.*der\(x\)",
             lambda: component(lambda s, ev: s.variable("x").diff(ev.t))),
        case(r"write der\(x\)", lambda: component(lambda s, ev: sympy.diff(s.variable("x") ** 2 * ev.t, ev.t))),
        case(r"cannot compare them with if.*Piecewise",
             lambda: component(lambda s, ev: 1 if s.variable("x") > 0 else 2)),
        case(r"cannot compare.*Max or Min", lambda: component(lambda s, ev: max(s.variable("x"), 0))),
        case(r"floor\(x\)", lambda: component(lambda s, ev: int(s.variable("x")))),
        case(r"floor\(x\)", lambda: component(lambda s, ev: round(s.variable("x")))),
        case(r"return a tuple of symbols.*y\[0\]", lambda: component(lambda s, ev: -s.vector("x", 1))),
        case(r"a string stands where a number", lambda: component(lambda s, ev: s.variable("x") + "1")),
        case(r"sides of an equation.*of type ndarray: write one equation for each entry",
             lambda: component(lambda s, ev: our_eq(s.variable("x"), np.ones(2)))),
        case(r"sides of an equation.*'c' of type str.*component\[\"name\"\]",
             lambda: component(lambda s, ev: our_eq(s.variable("x"), s.name))),
        case(r"made of symbols and numbers.*component\[\"name\"\]",
             lambda: component(lambda s, ev: s.output("y", s.name))),
        case(r"der takes one expression; got \(x\[0\], x\[1\]\)",
             lambda: component(lambda s, ev: der(s.vector("x", 2)))),
        case(r"der takes an expression in variables; got x > 0",
             lambda: component(lambda s, ev: der(s.variable("x") > 0))),
        case(r"one of them is nan or not real",
             lambda: component(lambda s, ev: s.add_equations(Eq(s.variable("x"), sympy.nan)))),
        case(r"contains no variable: use the symbols that self\.variable",
             lambda: component(lambda s, ev: s.add_equations(Eq(sympy.Function("x")(ev.t), 1)))),
        case(r"'c': 0 = .*: it contains -oo, which is not a finite number",
             lambda: compiled(component(lambda s, ev: s.add_equations(Eq(s.variable("x"), np.inf * s.input("u")))))),
        case(r"function 'c\.f' computes with NumPy or math, which JAX cannot trace: use jax\.numpy",
             lambda: component(lambda s, ev: s.function("f", math.sin, [s.variable("x")]))),
        case(r"function 'c\.f' decides by its input with a Python `if`",
             lambda: component(lambda s, ev: s.function("f", lambda x: x if x > 0 else -x, [s.variable("x")]))),
        case(r"function 'c\.f' failed when called with its 2 inputs: TypeError",
             lambda: component(lambda s, ev: s.function("f", jnp.sin, [s.variable("x"), ev.t]))),
        case(r"parameter 'c\.k' must be a real number; got the complex number I",
             lambda: component(lambda s, ev: s.parameter("k", sympy.I))),
        case(r"parameter 'c\.k' must be a number; got NoneType$",
             lambda: component(lambda s, ev: s.parameter("k", None))),
        case(r"SymPy's functions", lambda: component(lambda s, ev: math.sin(s.variable("x")))),
        case(r"SymPy's functions", lambda: component(lambda s, ev: np.sin(s.variable("x")))),
        case(r"SymPy's functions", lambda: component(lambda s, ev: jnp.sin(s.variable("x")))),
        case(r"Forgetful: its __init__ must begin with super\(\)\.__init__", lambda: Forgetful(EV, "c")),
        case(r"Empty: its __init__ must begin with super\(\)\.__init__", lambda: Empty(EV, "c")),
    ],
)  # fmt: skip
def test_writing_a_component(message, call, error):
    raises(error, message, call)


# --- writing a diagram -------------------------------------------------------------------------------------------


def added_elsewhere():
    child = Resistor(EV, "r")
    component(lambda self, ev: self.add(child), "parent")
    AcausalDiagram().add(child)


def a_child_twice():
    child = Resistor(EV, "r")
    component(lambda self, ev: self.add(child), "one")
    component(lambda self, ev: self.add(child), "two")


def block_named_as_component():
    bob = PlanarPendulum(EV, "pend")
    block = NeuralDAEBlock(quadratic, targets=[(bob, "vx")], name="pend")
    AcausalDiagram().add(bob).add_neural_correction_block(block)


def two_environments():
    AcausalDiagram().add(Resistor(EV, "r"), Ground(EqnEnv(), "g"))


def a_child_of_another_environment():
    component(lambda self, ev: self.add(Resistor(EqnEnv(), "r")))


def a_foreign_environment():
    AcausalCompiler(EqnEnv(), AcausalDiagram().add(Ground(EV, "g")))


def connects_a_grandchild():
    inner = component(lambda self, ev: self.add(Resistor(ev, "r")), "inner")

    def outer(self, ev):
        self.add(inner)
        self.connect(inner.r.p, inner.r.n)

    compiled(component(outer, "outer"))


def connects_what_is_not_there():
    outside = Resistor(EV, "outside")

    def inside(self, ev):
        r = self.add(Resistor(ev, "r"))
        self.connect(r.p, outside.p)

    compiled(component(inside))


@pytest.mark.parametrize(
    "message, call, error",
    [
        case(r"two components are named 'r': rename one",
             lambda: AcausalDiagram().add(Resistor(EV, "r"), Ground(EV, "r"))),
        case(r"name 'pend' is used twice: rename the neural block", block_named_as_component),
        case(r"'parent\.r' is part of 'parent': add that one", added_elsewhere),
        case(r"'r' already belongs to 'one'", a_child_twice),
        case(r"'r' has no port 'q'", lambda: AcausalDiagram().connect(Resistor(EV, "r"), "q", Ground(EV, "g"), "p")),
        case(r"'m' has no port 'flang': did you mean 'flange'",
             lambda: AcausalDiagram().connect(Mass(EV, "m"), "flang", Spring(EV, "s"), "flange_a")),
        case(r"cannot connect 'm\.flange' \(Translational\) to 'r\.p' \(Electrical\): ports must have the same domain",
             lambda: AcausalDiagram().connect(Resistor(EV, "r").p, Mass(EV, "m").flange)),
        case(r"at least two ports; got .r\.p. only", lambda: AcausalDiagram().connect(Resistor(EV, "r").p)),
        case(r"needs a port name after 'g'", lambda: AcausalDiagram().connect(Resistor(EV, "r").p, Ground(EV, "g"))),
        case(r"takes ports, symbols of variables, or a component and a name; got 'p'",
             lambda: AcausalDiagram().connect("p", "n")),
        case(r"'outer' connects outer\.inner\.r\.p.*its own ports and its children's", connects_a_grandchild),
        case(r"outside\.p.*not part of the diagram: add it", connects_what_is_not_there),
        case(r"components 'r' and 'g' were made with two EqnEnvs", two_environments),
        case(r"its child 'r' was made with another EqnEnv; give it self\.ev", a_child_of_another_environment),
        case(r"'g' was made with another EqnEnv than the compiler", a_foreign_environment),
        case(r"no components: add some", lambda: AcausalCompiler(EV, AcausalDiagram())()),
        case(r"prefer_states=\['pend\.x'\]", lambda: AcausalCompiler(EV, AcausalDiagram(), prefer_states="pend.x")),
        case(r"prefer_states: 'pend\.z' is not a variable: did you mean",
             lambda: pendulum(compiler={"prefer_states": ["pend.z"]})),
        case(r"nothing has been compiled yet", lambda: AcausalCompiler(EV, AcausalDiagram()).report),
    ],
)  # fmt: skip
def test_writing_a_diagram(message, call, error):
    raises(error, message, call)


# --- equations and unknowns --------------------------------------------------------------------------------------


def undeclared(self, ev):
    decay(self, ev, Eq(self.variable("y"), sympy.Symbol("k")))


def of_another(self, ev):
    decay(self, ev, Eq(self.variable("y"), Resistor(ev, "elsewhere").v))


def one_too_many(self, ev):
    x = decay(self, ev)
    y = self.variable("y")
    self.add_equations(Eq(y, 2 * x), Eq(y**2, 3 + x))


@pytest.mark.parametrize(
    "message, call, error",
    [
        case(r"'c': the symbol 'k' was declared by no component.*self\.parameter",
             lambda: compiled(component(undeclared))),
        case(r"'c': the symbol 'elsewhere\.v' in its equations is not a variable of it",
             lambda: compiled(component(of_another))),
    ],
)  # fmt: skip
def test_equations_and_unknowns(message, call, error):
    raises(error, message, call)


def test_the_over_determined_part_is_named_and_nothing_else():
    def write(self, ev):
        one_too_many(self, ev)
        innocent = self.variable("innocent", start=0.0, fixed=True)
        self.add_equations(Eq(der(innocent), 1 - innocent))

    with pytest.raises(StructuralError) as caught:
        compiled(component(write))
    assert "innocent" not in str(caught.value)


# --- neural blocks -----------------------------------------------------------------------------------------------

MINIMAL = {"state_selection": "dummy_derivatives", "prefer_states": ["pend.vx", "pend.x"]}


@pytest.mark.parametrize(
    "message, call, error",
    [
        case(r"neural block 'drag': its target 'pend\.vz' is not a variable: did you mean 'pend\.v[xy]'",
             lambda: pendulum(drag_on("vz"))),
        case(r"neural block 'drag': its input 'pend\.speed' is not a variable",
             lambda: pendulum(drag_on("vx", inputs=["pend.speed"]))),
        case(r"its target 'pend\.lam' is differentiated in no equation.*'pend\.vx', 'pend\.vy'",
             lambda: pendulum(drag_on("lam"))),
        case(r"its target 'pend\.vy' is not a state.*The states are 'pend\..*prefer_states=\['pend\.vy'\].*'equation'",
             lambda: pendulum(drag_on("vy", inject="row"), compiler=MINIMAL)),
        case(r"inject='row'.*needs state_selection='dummy_derivatives'; this compiler has 'auto'",
             lambda: pendulum(drag_on("vx", inject="row"))),
        case(r"its target 'other\.vx' belongs to a component that is not part of the diagram",
             lambda: pendulum(lambda bob: NeuralDAEBlock(quadratic, targets=[(PlanarPendulum(EV, "other"), "vx")],
                                                         name="drag"))),
        case(r"expected one output for each of its 2 targets, shape \(2,\), but the network returns shape \(3,\)",
             lambda: pendulum(drag_on("vx", "vy", network=dense(2, 3)))),
        case(r"calling network\(u\) with u of shape \(1,\) failed",
             lambda: pendulum(drag_on("vx", network=dense(2, 1)))),
        case(r"calling network\(t, u, theta\) with u of shape \(1,\) failed",
             lambda: pendulum(drag_on("vx", network=lambda t, u, theta: theta["w"] * u, theta=device_put(np.ones(3))))),
        case(r"must return a vector of shape \(outputs,\); got shape \(\)",
             lambda: pendulum(drag_on("vx", network=lambda u: u[0]))),
        case(r"targets is a non-empty list.*got \[\]", lambda: NeuralDAEBlock(quadratic, targets=[], name="drag")),
        case(r"targets is a non-empty list.*got 'pend\.vx'",
             lambda: NeuralDAEBlock(quadratic, targets="pend.vx", name="drag")),
        case(r"expected \(component, \"variable\"\).*got \('pend', 'vx'\)",
             lambda: NeuralDAEBlock(quadratic, targets=[("pend", "vx")], name="drag")),
        case(r"string without dots or spaces; got 'a\.b'",
             lambda: NeuralDAEBlock(quadratic, targets=["pend.vx"], name="a.b")),
    ],
)  # fmt: skip
def test_neural_blocks(message, call, error):
    raises(error, message, call)


# --- using a system ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rc():
    return rc_circuit()


def use(message, call, error=ModelError):
    return case(message, call, error)


@pytest.mark.parametrize(
    "message, call, error",
    [
        use(r"'r\.r' is not a parameter: did you mean 'r\.R'", lambda s: s.with_parameters({"r.r": 1.0})),
        use(r"'r\.r' is not a parameter: did you mean 'r\.R'", lambda s: s.parameters["r.r"]),
        use(r"parameter 'r\.R' must be finite; got inf", lambda s: s.with_parameters({"r.R": np.inf})),
        use(r"parameter 'r\.R' must be a real number; got the string", lambda s: s.with_parameters({"r.R": "2"})),
        use(r"parameter 'r\.R' must be a real number; got the complex", lambda s: s.with_parameters({"r.R": 1j})),
        use(r"parameter 'c\.C' must lie in \(0, inf\); got 0", lambda s: s.with_parameters({"c.C": 0.0})),
        use(r"parameter 'r\.R' is a scalar; got shape \(3,\).*filter_vmap",
            lambda s: s.with_parameters({"r.R": np.ones(3)})),
        use(r"'c\.vv' is not a variable: did you mean 'c\.v'",
            lambda s: s.observe("c.vv", 0.0, device_put(np.zeros(1)))),
        use(r"'net' is neither a network nor a parameter: known names: 'source\.V'", lambda s: s.partition("net")),
        use(r"initial: 'r\.R' is a parameter; use system\.with_parameters\(\{'r\.R': value\}\)",
            lambda s: simulate(s, 1.0, initial={"r.R": 1.0})),
        use(r"'c\.u' is not a variable: did you mean", lambda s: simulate(s, 1.0, initial={"c.u": 1.0})),
        use(r"initial: 'c\.v' needs a scalar; got shape \(2,\)",
            lambda s: simulate(s, 1.0, initial={"c.v": np.ones(2)})),
        use(r"initial: 'ground\.p\.v' is identically zero", lambda s: simulate(s, 1.0, initial={"ground.p.v": 1.0})),
        use(r"'r\.u' is not an input of this system: there are none", lambda s: simulate(s, 1.0, inputs={"r.u": 1.0})),
        use(r"BacksolveAdjoint\(\) is wrong for constrained systems.*RecursiveCheckpointAdjoint",
            lambda s: simulate(s, 1.0, adjoint=diffrax.BacksolveAdjoint())),
        use(r"ConstantStepSize\(\) needs a step: use diffrax\.StepTo\(ts=",
            lambda s: simulate(s, 1.0, stepsize_controller=diffrax.ConstantStepSize())),
        use(r"max_steps must be a positive integer; got 0", lambda s: simulate(s, 1.0, max_steps=0)),
        use(r"ts must be sorted; ts\[1\]=0\.5 is followed by ts\[2\]=0\.2: use jnp\.sort",
            lambda s: simulate(s, 1.0, ts=np.array([0.1, 0.5, 0.2]))),
        use(r"ts must lie between t0=0\.0 and t1=1\.0; 1\.5 does not", lambda s: simulate(s, 1.0, ts=[0.5, 1.5])),
        use(r"ts must lie between t0=0\.0 and t1=1\.0; -0\.5 does not", lambda s: simulate(s, 1.0, ts=[-0.5, 0.5])),
        use(r"ts must have shape \(n,\), n ≥ 1; got \(0,\)", lambda s: simulate(s, 1.0, ts=np.zeros(0))),
        use(r"t1 must be a finite number; got the string '1': leave the quotes out", lambda s: simulate(s, "1")),
        use(r"rtol must be a number ≥ 0; got the string '1e-3'", lambda s: simulate(s, 1.0, rtol="1e-3")),
        use(r"dtmax must be positive; got 0", lambda s: simulate(s, 1.0, dtmax=0.0)),
        use(r"initial: 'c\.v' must be finite; got nan", lambda s: simulate(s, 1.0, initial={"c.v": np.nan})),
        use(r"initial: 'c\.v' must be finite; got nan", lambda s: s.initialize(initial={"c.v": np.nan})),
        use(r"t1 must be a finite number; got None", lambda s: simulate(s, None)),
        use(r"ts must be numbers; got <U3", lambda s: simulate(s, 1.0, ts=["0.5", "1"])),
        use(r"ts must be finite", lambda s: simulate(s, 1.0, ts=[0.5, np.nan])),
        use(r"needs t0 < t1; got t0=0\.0, t1=-1\.0", lambda s: simulate(s, -1.0)),
        use(r"t1 must be a finite number; got nan", lambda s: simulate(s, np.nan)),
        use(r"rtol=1e-16 cannot be reached in float64.*rtol ≥ 3e-15", lambda s: simulate(s, 1.0, rtol=1e-16)),
        use(r"atol must be a number ≥ 0; got -1", lambda s: simulate(s, 1.0, atol=-1.0)),
    ],
)  # fmt: skip
def test_using_a_system(rc, message, call, error):
    raises(error, message, lambda: call(rc))


def test_bounds_hold_later_too():
    def write(self, ev):
        decay(self, ev, Eq(self.variable("y"), self.parameter("k", 0.5, bounds=(0.0, 1.0))))

    system = compiled(component(write))
    with pytest.raises(ModelError, match=r"'c\.k' must lie in \[0, 1\]; got 2"):
        system.with_parameters({"c.k": 2.0})


@pytest.mark.parametrize("t0", [{"pend.x": 0.1}, "0", [0.0, 1.0]])
def test_a_start_time_is_a_number(t0):
    with pytest.raises(ModelError, match=r"t0 must be a time, a number; got .* Values at the start go to initial="):
        pendulum().initialize(t0)


def test_a_package_that_is_missing():
    with pytest.raises(ImportError, match=r"plans need planes: pip install 'jaxonomy_dae\[flight\]'"):
        optional_module("no_such_planes", "flight", "plans need planes")


def test_sizes_of_a_port_are_by_its_variables():
    """A name that the domain lacks was left out, without a word."""

    class Piped(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            self.port("a", Hydraulic, nominal={"m_flwo": 1e-6})

    with pytest.raises(ModelError, match=r"port 'p\.a': nominal names 'm_flwo': did you mean 'm_flow'"):
        Piped(EqnEnv(), "p")


@pytest.mark.parametrize("start", [np.array([1.0, 2.0]), device_put(np.array([1.0, 2.0])), [1, 2]])
def test_lengths_and_starts_of_vectors(start):
    """Numbers of NumPy and JAX count as Python's do."""

    class Two(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            self.vector("x", np.int64(2), start=start)

    assert [v.start for v in Two(EqnEnv(), "t").variables.values()] == [1.0, 2.0]
