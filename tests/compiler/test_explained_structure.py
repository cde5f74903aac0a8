"""What the compiler says of models whose equations and unknowns do not fit together, word for word.

`CASES` are wrong models with the whole text of their errors. `texts` collects what is found; test_determinism.py
does so in processes with other hash seeds.
"""

import random

import numpy as np
import pytest
from problems import EV, FreeMass, compiled, component, without_lines
from sympy import Eq, exp, sin

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, ModelError, StructuralError, der
from jaxonomy_dae.graph.structure.dulmage_mendelsohn import dulmage_mendelsohn
from jaxonomy_dae.graph.structure.incidence import Incidence, compress
from jaxonomy_dae.graph.structure.matching import maximum_matching
from jaxonomy_dae.library.electrical import (
    Capacitor,
    CurrentSource,
    Ground,
    Inductor,
    Resistor,
    VoltageSensor,
    VoltageSource,
)
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.library.thermal import FixedTemperature, HeatCapacitor, ThermalConductor
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Rod, Spring
from jaxonomy_dae.write import Domain, Electrical

KINDS = {
    cls.__name__: cls
    for cls in (
        Capacitor, CurrentSource, Ground, Inductor, Resistor, VoltageSource, FixedTemperature, HeatCapacitor,
        ThermalConductor, Damper, FixedPosition, Mass, FreeMass, Rod, Spring,
    )
}  # fmt: skip


def model(parts: dict[str, str], *nodes: str, order=None, rename=lambda name: name, **options):
    """A diagram from "name": "Class" and nodes such as "s.p r.p"."""
    ev = EqnEnv()
    names = list(parts) if order is None else order
    made = {n: KINDS[parts[n]](ev, rename(n), **options.get(n, {})) for n in names}
    connect = [[getattr(made[n], p) for n, p in (end.split(".") for end in node.split())] for node in nodes]
    return compiled(*made.values(), connect=connect)


def law(names: str, *equations, **starts):
    """A model of one component with these variables, from functions of the component."""

    def write(self, ev):
        for name in names.split():
            start = starts.get(name)
            self.variable(name, start=start, fixed=start is not None)
        self.add_equations(*(e(self) for e in equations))

    return compiled(component(write))


# --- models ------------------------------------------------------------------------------------------------------

CIRCUIT = {"s": "VoltageSource", "r": "Resistor", "g": "Ground"}


def hollow():
    """A sub-circuit whose port was forgotten inside."""

    def write(self, ev):
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        r = self.add(Resistor(ev, "r"))
        assert p.name == "p"
        self.connect(r.n, n)

    sub, ev = component(write, "sub"), EV
    s, g, r = VoltageSource(ev, "s"), Ground(ev, "g"), Resistor(ev, "r")
    return compiled(s, sub, g, r, connect=[(s.p, sub.p, r.p), (s.n, sub.n, r.n, g.p)])


def loose():
    """A source of power: the product of voltage and a factor; nothing but its unconnected pin is missing."""

    def write(self, ev):
        p, gain, level = self.port("p", Electrical), self.variable("gain"), self.variable("level")
        self.add_equations(Eq(p.v, gain * level), Eq(p.i, gain - level))

    return compiled(component(write))


def a_start_of_an_input():
    def write(self, ev):
        x, y, u = self.variable("x", start=1.0, fixed=True), self.variable("y"), self.input("u")
        self.add_equations(Eq(x, u), Eq(der(y), x))

    return compiled(component(write))


def inputs_only():
    def write(self, ev):
        x, u = self.variable("x"), self.input("u")
        self.add_equations(Eq(x, u), Eq(u, 3))

    return compiled(component(write))


def own_domain():
    """A user's domain, for which there are no special words."""
    shaft = Domain("Shaft", across=(("phi", "rad"),), through=(("tau", "N*m"),))

    def write(self, ev):
        a, b = self.port("a", shaft), self.port("b", shaft)
        self.add_equations(Eq(a.tau, 2 * (a.phi - b.phi)), Eq(a.tau + b.tau, 0))

    one, two = component(write, "one"), component(write, "two")
    return compiled(one, two, connect=[(one.b, two.a)])


def cut_set():
    """Four nodes, each tied to each other by a resistor, and to the rest by two current sources alone."""
    parts = {"i1": "CurrentSource", "i2": "CurrentSource", **{f"r{k}": "Resistor" for k in range(8)}, "g": "Ground"}
    return model(
        parts, "i1.n r0.p r1.p r2.p", "i2.n r0.n r3.p r4.p", "r1.n r3.n r5.p", "r2.n r4.n r5.n",
        "i1.p r6.p", "i2.p r7.p", "r6.n r7.n g.p",
    )  # fmt: skip


CASES = {
    "no ground": (
        lambda: model({"s": "VoltageSource", "r": "Resistor"}, "s.p r.p", "s.n r.n"),
        "the circuit of 's' and 'r' has no ground, so nothing determines its potentials. Connect a Ground to one of "
        "its nodes.",
    ),
    "an isolated circuit beside a grounded one": (
        lambda: model(
            CIRCUIT | {"a": "VoltageSource", "b": "Resistor", "c": "Capacitor"},
            "s.p r.p", "s.n r.n g.p", "a.p b.p", "b.n c.p", "c.n a.n",
        ),
        "the circuit of 'a', 'b' and 'c' has no ground, so nothing determines its potentials. Connect a Ground to one "
        "of its nodes.",
    ),
    "a forgotten connection": (
        lambda: model(CIRCUIT | {"q": "Resistor"}, "s.p r.p", "s.n r.n g.p"),
        "'q' is connected to nothing: connect 'q.p' and 'q.n', or leave it out.",
    ),
    "springs without a mass": (
        lambda: model({"a": "Spring", "b": "Spring", "d": "Damper"}, "a.flange_b b.flange_a d.flange_a"),
        "nothing holds 'a', 'b' and 'd': no mass and no fixed position is connected. Connect a Mass or a FixedPosition "
        "('a.flange_a', 'b.flange_b' and 'd.flange_b' are not connected).",
    ),
    "conductors without a capacity": (
        lambda: model({"a": "ThermalConductor", "b": "ThermalConductor"}, "a.port_a b.port_a", "a.port_b b.port_b"),
        "nothing determines the temperatures of 'a' and 'b': no heat capacitor and no fixed temperature is connected. "
        "Connect a HeatCapacitor or a FixedTemperature.",
    ),
    "a user's domain": (
        own_domain,
        "nothing determines the level of 'phi' at the Shaft ports of 'one' and 'two': only its differences matter. "
        "Connect a component that fixes 'phi' ('one.a' and 'two.b' are not connected).",
    ),
    "two sources in parallel": (
        lambda: model(CIRCUIT | {"t": "VoltageSource"}, "s.p t.p r.p", "s.n t.n r.n g.p"),
        "'s' and 't' form a loop, and each of them fixes a voltage: one too many. Remove one of them, or put a "
        "resistor into the loop.",
    ),
    "a loop of sources away from the ground": (
        lambda: model(
            CIRCUIT | {"t": "VoltageSource", "u": "VoltageSource"}, "s.p u.n r.p", "s.n t.p", "t.n u.p", "r.n g.p"
        ),
        "'s', 't' and 'u' form a loop, and each of them fixes a voltage: one too many. Remove one of them, or put a "
        "resistor into the loop.",
    ),
    "a short circuit": (
        lambda: model(CIRCUIT, "s.p s.n r.p", "r.n g.p"),
        "the ports 's.p' and 's.n' of 's' are connected with each other, but 's' fixes the voltage between them. "
        "Remove the connection, or put a resistor into it.",
    ),
    "two grounds": (
        lambda: model(CIRCUIT | {"h": "Ground"}, "s.p r.p", "s.n r.n g.p h.p"),
        "'g' and 'h' both fix the potential of one node. Keep one of them, or put a resistor between them.",
    ),
    "two walls": (
        lambda: model({"a": "FixedPosition", "b": "FixedPosition"}, "a.flange b.flange"),
        "'a' and 'b' both fix the position of one node. Keep one of them, or put a spring between them.",
    ),
    "a rod between two walls": (
        lambda: model(
            {"a": "FixedPosition", "b": "FixedPosition", "rod": "Rod"}, "a.flange rod.flange_a", "b.flange rod.flange_b"
        ),
        "'a', 'b' and 'rod' form a loop, and each of them fixes a distance: one too many. Remove one of them, or put a "
        "spring into the loop.",
    ),
    "two rods side by side": (
        lambda: model(
            {"m": "Mass", "n": "Mass", "a": "Rod", "b": "Rod"},
            "m.flange a.flange_a b.flange_a", "n.flange a.flange_b b.flange_b",
        ),
        "'a' and 'b' form a loop, and each of them fixes a distance: one too many. Remove one of them, or put a spring "
        "into the loop.",
    ),
    "two temperatures": (
        lambda: model({"a": "FixedTemperature", "b": "FixedTemperature"}, "a.heat b.heat"),
        "'a' and 'b' both fix the temperature of one node. Keep one of them, or put a thermal conductor between them.",
    ),
    "current sources in series": (
        lambda: model(
            {"i": "CurrentSource", "j": "CurrentSource", "r": "Resistor", "g": "Ground"},
            "i.p j.n", "i.n r.p", "r.n j.p g.p",
        ),
        "'i' and 'j' are in series and both fix the current: one too many. Remove one of them, or connect a resistor "
        "in parallel with one of them.",
    ),
    "current sources that meet": (
        lambda: model(
            {"i": "CurrentSource", "j": "CurrentSource", "k": "CurrentSource", "r": "Resistor", "g": "Ground"},
            "i.p j.p k.p", "i.n j.n k.n r.p", "r.n g.p",
        ),
        "'i', 'j' and 'k' meet, and each of them fixes its current: one too many. Remove one of them, or connect a "
        "resistor in parallel with one of them.",
    ),
    "a cut set of current sources": (
        cut_set,
        "'i1' and 'i2' fix every current between two parts of the model: one too many. Remove one of them, or connect "
        "a resistor in parallel with one of them.",
    ),
    "an open current source": (
        lambda: model({"i": "CurrentSource", "r": "Resistor", "g": "Ground"}, "i.n r.p", "r.n g.p"),
        "nothing is connected to 'i.p', so no current flows there, but 'i' fixes it. Connect 'i.p'.",
    ),
    "two faults": (
        lambda: model(
            CIRCUIT | {"h": "Ground", "a": "FixedPosition", "b": "FixedPosition"},
            "s.p r.p", "s.n r.n g.p h.p", "a.flange b.flange",
        ),
        "the equations do not fit together:\n"
        "- 'g' and 'h' both fix the potential of one node. Keep one of them, or put a resistor between them.\n"
        "- 'a' and 'b' both fix the position of one node. Keep one of them, or put a spring between them.",
    ),
    "one equation too many": (
        lambda: law("x y", lambda c: Eq(der(c.x), -c.x), lambda c: Eq(c.y, 2 * c.x), lambda c: Eq(c.y**2, 3 + c.x)),
        "component 'c' has 3 equations, but needs 2, for its 2 variables. Remove one of:\n"
        "  c: 0 = der(x) + x\n"
        "  c: 0 = -2*x + y\n"
        "  c: 0 = -x + y**2 - 3",
    ),
    "one equation too few": (
        lambda: law("x y z", lambda c: Eq(der(c.x), -c.x), lambda c: Eq(c.y + c.z, 2 * c.x)),
        "only 1 equation for 2 unknowns, 'c.y' and 'c.z': add an equation, or declare one of them as an input.",
    ),
    "an unused variable": (
        lambda: law("x y", lambda c: Eq(der(c.x), -c.x)),
        "nothing determines 'c.y': add an equation for it, declare it as an input, or leave it out.",
    ),
    "as many, but": (
        lambda: law("x y z", lambda c: Eq(der(c.x), -c.x), lambda c: Eq(c.x**2, 1 + c.x), lambda c: Eq(c.y * c.z, c.x)),
        "the equations do not fit together:\n"
        "- 2 equations determine only 1 unknown, 'c.x'. Remove one of:\n"
        "  c: 0 = der(x) + x\n"
        "  c: 0 = x**2 - x - 1\n"
        "- only 1 equation for 2 unknowns, 'c.y' and 'c.z': add an equation, or declare one of them as an input.",
    ),
    "an equation twice": (
        lambda: law("x y", lambda c: Eq(c.x + c.y, 1), lambda c: Eq(2 * c.x + 2 * c.y, 3)),
        "one of these equations repeats or contradicts the others. Remove or change one of:\n"
        "  c: 0 = x + y - 1\n"
        "  c: 0 = 2*x + 2*y - 3",
    ),
    "zero twice over": (
        lambda: law("x y", lambda c: Eq(c.x, c.y), lambda c: Eq(c.x, -c.y), lambda c: Eq(der(c.x), exp(c.y) - 1)),
        "component 'c' has 3 equations, but needs 2, for its 2 variables. Remove one of:\n"
        "  c: 0 = x - y\n"
        "  c: 0 = x + y\n"
        "  c: 0 = der(x) - exp(y) + 1",
    ),
    "inputs only": (
        inputs_only,
        "this equation contains no unknown: c: 0 = u - 3. Remove it, or declare its input as a variable.",
    ),
    "a port forgotten inside": (
        hollow,
        "inside 'sub' nothing uses 'sub.p': connect it there, or write its equations.",
    ),
    "a port that may be meant to be connected": (
        loose,
        "only 1 equation for 2 unknowns, 'c.p.v' and 'c.gain': is 'c.p' meant to be connected?",
    ),
    "numerically dependent equations": (
        lambda: law(
            "x y z", lambda c: Eq(c.x + c.y + c.z, sin(c.x)), lambda c: Eq(c.x + 2 * c.y + c.z, 0),
            lambda c: Eq(2 * c.x + 4 * c.y + 2 * c.z, 0),
        ),
        "these equations depend on each other, or contradict each other. Remove or change one of:\n"
        "  c: 0 = x + 2*y + z\n"
        "  c: 0 = 2*x + 4*y + 2*z",
    ),
    "a mass of zero": (
        lambda: model({"m": "FreeMass"}, m={"M": 0.0}),
        "the equation m: 0 = M*der(v) - flange.f determines nothing for m.M = 0: the coefficient of what it should "
        "determine is zero. Give other values, or leave the component out.",
    ),
    "a switch that fixes a state": (
        lambda: law("x y", lambda c: [c.either(Eq(c.discrete("d"), 0), c.x, c.y + c.x), Eq(der(c.x), c.y)][1]),
        "the equation c: 0 = Piecewise((x, Eq(d, 0)), (x + y, True)) determines nothing in the mode c.d = 0: the "
        "coefficient of what it should determine is zero. If it fixes a state there, put storage between what switches "
        "and that state (a capacitor, a volume of fluid), or let the mode hold the state back, with "
        "self.complementary(state, other, order=1) or self.either(…, order=1)",
    ),
    "masses that cancel": (
        lambda: model({"a": "Mass", "b": "FreeMass"}, "a.flange b.flange", a={"m": 1.0}, b={"M": -1.0}),
        "these equations are singular for a.m = 1, b.M = -1, though not in general. Change the parameters, or "
        "state the constraint that follows as an equation of its own:\n"
        "  a: 0 = m*der(v) - flange.f\n"
        "  b: 0 = M*der(v) - flange.f",
    ),
    "starts that contradict": (
        lambda: law("x y", lambda c: Eq(c.x, c.y), lambda c: Eq(der(c.x), -c.x), x=1.0, y=2.0),
        "'c.x' and 'c.y' are equal, but their starts are fixed at 1 and 2. Free one of them (fixed=False).",
    ),
    "starts that contradict an equation": (
        lambda: law(
            "x y z", lambda c: Eq(der(c.x), -c.x), lambda c: Eq(der(c.y), c.x), lambda c: Eq(c.z, c.x + c.y),
            x=1.0, y=2.0, z=4.0,
        ),
        "the fixed starts of 'c.x', 'c.y' and 'c.z' contradict the equation c: 0 = -x - y + z. Free one of them "
        "(fixed=False), or give values that agree.",
    ),
    "a start of an input": (
        a_start_of_an_input,
        "the start of 'c.x' is fixed, but its value comes from the input 'c.u'. Free the start (fixed=False).",
    ),
    "a start of what is zero": (
        lambda: law("x y", lambda c: Eq(c.x, 0), lambda c: Eq(der(c.y), c.x), x=1.0),
        "the start of 'c.x' is fixed at 1, but the equations say that it is always zero. Free the start (fixed=False).",
    ),
}  # fmt: skip


def text_of(call) -> str:
    with pytest.raises(StructuralError) as caught:
        call()
    return without_lines(caught.value)


def texts() -> dict[str, str]:
    return {name: text_of(call) for name, (call, _) in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_the_whole_text(name):
    call, expected = CASES[name]
    assert text_of(call) == expected


# --- what texts do not depend on ---------------------------------------------------------------------------------

PARTS = {"s": "VoltageSource", "t": "VoltageSource", "u": "VoltageSource", "r": "Resistor", "g": "Ground"}
LOOP = ("s.p u.n r.p", "s.n t.p", "t.n u.p", "r.n g.p")


def test_names_change_nothing_but_names():
    def rename(name):
        return "zyxwvut"["stug".index(name)] if name in "stug" else "a"

    found = text_of(lambda: model(PARTS, *LOOP, rename=rename))
    assert found == text_of(lambda: model(PARTS, *LOOP)).replace("'s', 't' and 'u'", "'z', 'y' and 'x'")


def test_the_order_of_adding_changes_the_order_of_names_alone():
    expected = sorted(text_of(lambda: model(PARTS, *LOOP)))
    for seed in range(6):
        rng = random.Random(seed)
        order, loop = rng.sample(sorted(PARTS), len(PARTS)), rng.sample(LOOP, len(LOOP))
        assert sorted(text_of(lambda order=order, loop=loop: model(PARTS, *loop, order=order))) == expected


# --- large parts -------------------------------------------------------------------------------------------------


def chain(n: int, *more, drop: int = 0):
    """x₀·x₁ = 1, x₁·x₂ = 1, …: n − 1 equations in n unknowns."""

    def write(self, ev):
        x = [self.variable(f"x{k}") for k in range(n)]
        self.add_equations(*(Eq(a * b, 1) for a, b in zip(x[: n - drop], x[1 : n - drop], strict=False)))
        self.add_equations(*(e(x) for e in more))

    return compiled(component(write))


def test_a_long_part_is_shortened():
    n = 40
    assert text_of(lambda: chain(n, lambda x: Eq(x[0] * x[-1], x[3]), lambda x: Eq(x[0] ** 2, x[-1]))) == (
        "component 'c' has 41 equations, but needs 40, for its 40 variables. Remove one of:\n"
        + "".join(f"  c: 0 = x{k}*x{k + 1} - 1\n" for k in range(6))
        + "  … and 35 more, of 'c'"
    )
    assert text_of(lambda: chain(n)) == (
        "only 39 equations for 40 unknowns, 'c.x0', 'c.x1', 'c.x2', 'c.x3', 'c.x4', 'c.x5' and 34 more: add an "
        "equation, or declare one of them as an input."
    )
    several = text_of(lambda: chain(n, lambda x: Eq(x[0], 1), drop=9))
    assert several.count("\n") == 5 and several.endswith("\n- … and 5 more.")


def test_many_faults_are_counted():
    pairs = {f"{kind}{k}": "FixedPosition" for k in range(30) for kind in "ab"}
    assert text_of(lambda: model(pairs, *(f"a{k}.flange b{k}.flange" for k in range(30)))) == "\n".join(
        [
            "the equations do not fit together:",
            *(
                f"- 'a{k}' and 'b{k}' both fix the position of one node. Keep one of them, or put a spring between "
                "them."
                for k in range(4)
            ),
            "- … and 26 more.",
        ]
    )


def test_parts_of_a_hundred_thousand_equations():
    """The decomposition alone, on an over-determined and an under-determined chain with a sound one between."""
    n = 100_000
    k = np.arange(n)
    rows = np.concatenate([k, k[:-1], [n], n + 1 + k, n + 1 + k, [2 * n + 1]])
    columns = np.concatenate([k, k[1:], [0], n + k, n + k + 1, [2 * n + 1]])
    pattern = Incidence(*compress(rows, columns, np.zeros_like(rows), 2 * n + 2), 2 * n + 2)
    over, under = dulmage_mendelsohn(pattern, maximum_matching(pattern.pointer, pattern.variable, pattern.n_variables))
    assert [(len(r), len(c)) for r, c in over] == [(n + 1, n)]
    assert [(len(r), len(c)) for r, c in under] == [(n, n + 1)]


# --- legal models ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "call, notes",
    [
        (lambda: model({"m": "Mass", "s": "Spring", "n": "Mass"}, "m.flange s.flange_a", "n.flange s.flange_b"), []),
        (lambda: model({"a": "HeatCapacitor", "g": "ThermalConductor"}, "a.heat g.port_a"),
         ["nothing is connected to 'g.port_b': nothing flows there"]),
        (lambda: model(CIRCUIT, "s.p r.p", "s.n g.p"), ["nothing is connected to 'r.n': nothing flows there"]),
        (lambda: model({"i": "CurrentSource", "l": "Inductor", "r": "Resistor", "g": "Ground"},
                       "i.n l.p", "l.n r.p", "r.n i.p g.p"), []),
        (lambda: model({"g": "Ground"}), ["nothing is connected to 'g.p': nothing flows there"]),
        (lambda: model({"a": "Mass", "b": "Mass"}, "a.flange b.flange",
                       a={"initial_position": 1.0}, b={"initial_position": 1.0}),
         ["'a.s' and 'b.s' are one quantity, and both starts are fixed: they must agree; one of them is enough"]),
        (lambda: model({"a": "Mass", "b": "Mass", "r": "Rod"}, "a.flange r.flange_a", "b.flange r.flange_b",
                       a={"initial_velocity": 1.0}, b={"initial_velocity": 1.0}),
         ["2 starts are fixed for 1 degree of freedom, those of 'a.v' and 'b.v': they must agree; if not, free 1 of "
          "them"]),
        (lambda: law("x y", lambda c: Eq(c.x, -c.y), lambda c: Eq(der(c.x), -c.x), x=1.0, y=-1.0),
         ["'c.x' and 'c.y' are one quantity, and both starts are fixed: they agree, so one of them is enough"]),
        (lambda: law("x y", lambda c: Eq(c.x**2, 4), lambda c: Eq(der(c.y), c.x), x=2.0),
         ["the start of 'c.x' is fixed, but the equations determine it: both must agree; if not, free the start"]),
        (lambda: compiled(PlanarPendulum(EqnEnv(), "p")),
         []),  # the pendulum made its own starts agree
    ],
)  # fmt: skip
def test_legal_models_compile(call, notes):
    assert call().report.notes == notes


# --- names and ports ---------------------------------------------------------------------------------------------


def message_of(call) -> str:
    with pytest.raises(ModelError) as caught:
        call()
    return str(caught.value)


def test_slips_of_the_pen():
    ev = EqnEnv()
    r, m, g = Resistor(ev, "r"), Mass(ev, "m"), Ground(ev, "g")
    diagram = AcausalDiagram().add(r, m, g).add(r)  # adding the same component again changes nothing
    assert list(diagram.components) == ["r", "m", "g"]
    assert message_of(lambda: diagram.connect(r.p, r.p)) == "diagram: 'r.p' is connected to itself: name each port once"
    assert message_of(lambda: diagram.connect(r.p, m.flange)) == (
        "diagram: cannot connect 'm.flange' (Translational) to 'r.p' (Electrical): ports must have the same domain"
    )
    assert message_of(lambda: diagram.connect(r.p)) == "diagram: connect needs at least two ports; got 'r.p' only"
    assert (
        message_of(lambda: diagram.connect(r, "q", g, "p")) == "component 'r' has no port 'q': known names: 'p', 'n'."
    )
    assert message_of(lambda: diagram.add(Ground(ev, "g"))) == (
        "two components are named 'g': rename one of them, or make a new diagram if this is the same model again"
    )


@pytest.mark.parametrize("factor", [1.0, 2.0, 0.3])
def test_a_pin_that_is_a_multiple_has_a_level(factor):
    """A source holds its pin at a multiple of a state. Where the factor was not ±1, the state's part in its own
    equation counted as none, and a circuit with a ground was said to have none."""

    class Source(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            p, u = self.port("p", Electrical), self.variable("u", start=1.0, fixed=True)
            self.add_equations(Eq(p.v, factor * u), Eq(der(u), -u))

    ev = EqnEnv()
    source, meter, ground = Source(ev, "a"), VoltageSensor(ev, "v"), Ground(ev, "g")
    system = compiled(source, meter, ground, connect=[(source.p, meter.p), (meter.n, ground.p)])
    assert system.states == ["a.u"]


class Forgetful(Component):
    """A resistor without p.i + n.i = 0."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v = self.variable("v")
        self.add_equations(Eq(v, p.v - n.v), Eq(v, 3 * p.i))


def test_a_forgotten_equation_of_a_port_is_laid_to_its_component():
    """The message blamed two currents, one of the ground, and advised to declare one of them as an input."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    c, g, s = Forgetful(ev, "c"), Ground(ev, "g"), VoltageSource(ev, "s")
    diagram.connect(s.p, c.p).connect(s.n, c.n, g.p)
    with pytest.raises(
        ModelError,
        match=r"component 'c' \(test_explained_structure\.py:\d+\) has 2 equations, "
        r"but needs 3, for its 1 variable and 2 ports\. Probably missing is one for 'c\.n\.i'\.",
    ):
        AcausalCompiler(ev, diagram)()


def test_slips_of_names_list_what_there_is():
    """A wrong keyword was Python's TypeError; `connect(c.port, …)` printed a bound method."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    with pytest.raises(ModelError, match=r"no argument 'initial_volt': did you mean 'initial_voltage'"):
        Capacitor(ev, "k", initial_volt=1.0)
    with pytest.raises(ModelError, match=r"'g\.port' is a method, not a port: known names: 'p'"):
        diagram.connect(Ground(ev, "g").port, VoltageSource(ev, "s").n)
