"""Units: what texts mean, what fits, what does not and how that is said, and what the check costs."""

import sys

import numpy as np
import pytest
from library_pages import components_of, domains
from problems import compiled
from sympy import Abs, And, Heaviside, Max, Min, Mod, Piecewise, atan2, exp, log, pi, sign, sin, sqrt
from testset import PROBLEMS

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    ModelError,
    UnitError,
    assign,
    der,
    pre,
    reinit,
)
from jaxonomy_dae.compile.passes import check_units as pass_
from jaxonomy_dae.compile.passes.check_units import check_units
from jaxonomy_dae.graph.units.parse import UnknownUnit, read_unit
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.rotational import SpeedSensor
from jaxonomy_dae.library.signal import Gain
from jaxonomy_dae.library.translational import Mass, SpeedSource
from jaxonomy_dae.write import Eq

EV = EqnEnv()


def of(*units, write, parameters=()):
    """A component with variables a, b, c, … of these units, parameters p, q, … of those, and what `write` returns of
    them as equations."""

    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            v = [self.variable(n, unit=u) for n, u in zip("abcdefgh", units, strict=False)]
            p = [self.parameter(n, 1.0, unit=u) for n, u in zip("pqrs", parameters, strict=False)]
            equations = write(*v, *p)
            self.add_equations(*(equations if isinstance(equations, tuple) else (equations,)))

    return Written(EV, "x")


def wrong(*components, connect=()) -> list[str]:
    """What the check says of a model, a line for each misfit."""
    diagram = AcausalDiagram().add(*components)
    for ends in connect:
        diagram.connect(*ends)
    try:
        check_units(diagram)
    except UnitError as error:
        first, *lines = str(error).split("\n- ")
        assert first == f"units do not fit in {len(lines)} place{'s' if len(lines) > 1 else ''}:"
        return lines
    return []


# --- texts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, like, factor",
    [
        ("N*m", "J", 1), ("kg*m2/s2", "J", 1), ("kg/(m*s)", "Pa*s", 1), ("W/(m2*K)", "kg/(s3*K)", 1),
        ("1/(A*s)", "1/C", 1), ("V*s/rad", "N*m/A", 1), ("Ohm", "V/A", 1), ("m3/rad", "m3", 1), ("rad", "1", 1),
        ("kg m2 s-2", "J", 1), ("m²", "m2", 1), ("m^2", "m**2", 1), ("m/s/s", "m/s2", 1), ("Nm", "N*m", 1),
        ("kNm", "N*m", 1000), ("Nms/rad", "N*m*s", 1), ("kOhm", "ohm", 1000),
        ("mm", "m", 1e-3), ("bar", "Pa", 1e5), ("A*h", "C", 3600), ("kWh", "J", 3.6e6), ("%", "1", 0.01),
        ("rev/min", "rad/s", np.pi / 30), ("deg", "rad", np.pi / 180), ("l/min", "m3/s", 1e-3 / 60), ("Hz", "1/s", 1),
        ("degC", "K", 1), ("W/degC", "W/K", 1),
    ],
)  # fmt: skip
def test_texts_that_are_units(text, like, factor):
    unit, other = read_unit(text), read_unit(like)
    assert unit is not None and other is not None
    assert unit.dimension == other.dimension
    assert unit.scale == pytest.approx(factor * other.scale, rel=1e-12)
    assert str(unit) == text
    assert unit.zero == (273.15 if text == "degC" else 0.0)


def test_no_text_is_an_unknown_unit():
    assert read_unit("") is None


@pytest.mark.parametrize(
    "text", ["metres a second/", "foo", "-", "m/", "3*m", "dB", "V<", "kg*", "m3/2", "1e3*m", "unknown"]
)
def test_texts_that_are_no_units(text):
    with pytest.raises(UnknownUnit):
        read_unit(text)


def test_a_text_that_is_no_unit_names_the_variable():
    class Cart(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            self.parameter("drag", 1.0, unit="N*sec/foo")
            x, y = self.variable("x", unit="m/"), self.variable("y", unit="m/")
            self.add_equations(Eq(x, y))

    assert wrong(Cart(EV, "cart")) == [
        "'cart.x' has the unit 'm/', but it cannot be read: units are texts such as 'm/s', 'N*m' or "
        "'kg/(m*s)', '1' for a number, '' if there is none (1 more have it)",
        "'cart.drag' has the unit 'N*sec/foo', but 'foo' is not known: units are texts such as 'm/s', 'N*m' or "
        "'kg/(m*s)', '1' for a number, '' if there is none",
    ]


# --- what fits ---------------------------------------------------------------------------------------------------

RIGHT = {
    "sums and products": of("N", "kg", "m/s", "N", write=lambda f, m, v, g: Eq(m * der(v), f + 2 * g)),
    "second derivatives": of("m", "m/s2", write=lambda x, a: Eq(der(der(x)), a)),
    "time": of("m", "m/s", write=lambda x, v: Eq(x, v * EV.t)),
    "rad is a number": of("m", "m", "rad", write=lambda s, r, phi: Eq(s, r * phi)),
    "torque is energy": of("J", "N*m", write=lambda e, tau: Eq(e, tau)),
    "functions of numbers": of("1", "s", "K", "K", write=lambda y, t, a, b: Eq(y, exp(-t / (2 * t)) + sin(a / b))),
    "roots": of("m/s", "m", "m/s2", write=lambda v, h, g: Eq(v, sqrt(2 * g * h))),
    "fractional powers": of("Pa", "Pa", write=lambda a, b: Eq(a, b / (a**2 + b**2) ** 0.25 * sqrt(b))),
    "exponents": of("1", "K", "K", "1", write=lambda y, a, b, n: Eq(y, (a / b) ** (n - 1))),
    "laws of time": of("V", write=lambda u: Eq(u, 325 * sin(100 * pi * EV.t) * Piecewise((1, EV.t > 0.5), (0, True)))),
    "numbers of seconds": of("V", "V", write=lambda u, v: (Eq(u, 2 * EV.t - 1), Eq(v, exp(-EV.t)))),
    "numbers beside a quantity": of(
        "m", "K", "m", write=lambda a, b, c: (Eq(a, 5), Eq(c, Piecewise((2, b > 350), (Max(a, 3), True))), Eq(a, c + 1))
    ),
    "numbers in a difference": of("W", "K", "W/K", write=lambda q, T, g: Eq(q, g * (T - 293.15))),
    "a number of degC": of("degC", "W", "W/K", write=lambda c, q, g: (Eq(c, 20), Eq(q, g * (c - 20)))),
    "zero": of("m", "m", write=lambda a, b: Eq(Max(a, 0), Piecewise((b, b > 0), (0, True)))),
    "numbers": of("1", "K", "1/K", write=lambda y, dT, alpha: Eq(y, 1 + alpha * dT)),
    "a number of percent": of("%", "%", write=lambda y, u: Eq(y, 100 - u)),
    "branches": of("V", "A", "1", "Ohm", write=lambda v, i, s, r: Eq(v, Piecewise((r * i, s > 0), (2 * v, True)))),
    "extremes": of("m", "m", "1", write=lambda a, b, y: (Eq(a, Min(Abs(a), b)), Eq(y, sign(a) * Heaviside(b)))),
    "angles": of("rad", "m", "m", write=lambda phi, x, y: Eq(phi, atan2(y, x))),
    "cycles": of("1", "s", write=lambda y, T: Eq(y, Mod(EV.t, T) / T)),
    "equal scales": of("mm", "mm", "kW", "kJ", write=lambda a, b, p, e: (Eq(a, 3 * b), Eq(der(e), p))),
    "converted by a number": of("mm", "m", write=lambda a, b: Eq(a, 1000 * b)),
    "converted in a rate": of("kWh", "W", write=lambda e, p: Eq(der(e), p / 3.6e6)),
    "converted with a half": of("kJ", "kg", "m/s", write=lambda e, m, v: Eq(e, m * v**2 / 2000)),
    "converted angles": of("deg", "rad", "1", write=lambda d, r, y: (Eq(d, r * 180 / pi), Eq(y, sin(d * pi / 180)))),
    "converted in a sum": of("mm", "m", "m", write=lambda a, b, c: Eq(a, 1000 * (b + c))),
    "differences of degC": of("W", "degC", "degC", "W/K", write=lambda q, a, b, g: Eq(q, g * (a - b))),
    "degC plus kelvin": of("degC", "degC", "K", write=lambda a, b, dT: Eq(a, b + dT)),
    "degC is a mean": of("degC", "degC", "degC", write=lambda a, b, c: Eq(a, (b + c) / 2)),
    "degC weighted": of("degC", "degC", "degC", "1", write=lambda a, b, c, w: Eq(a, w * b + (1 - w) * c)),
    "degC made kelvin": of("K", "degC", write=lambda k, c: Eq(k, c + 273.15)),
    "degC compared": of("degC", "degC", "1", write=lambda a, b, y: Eq(y, Piecewise((1, a > b), (0, True)))),
    "rates of degC": of("degC", "K/s", write=lambda a, r: Eq(der(a), r)),
}


@pytest.mark.parametrize("model", RIGHT.values(), ids=RIGHT.keys())
def test_equations_that_fit(model):
    assert wrong(model) == []


UNKNOWN = {
    "a sum": of("", "m", write=lambda a, b: Eq(a, b)),
    "a factor": of("N", "", "s", write=lambda a, k, t: Eq(a, k * t)),
    "a function": of("1", "", write=lambda a, b: Eq(a, sin(b) + exp(b))),
    "an exponent": of("1", "", "m", write=lambda a, n, x: Eq(a, (x / x) ** n)),
    "a base and an exponent": of("m2", "", "", write=lambda a, b, n: Eq(a, b**n)),
    "a base": of("1", "", "1", write=lambda a, b, n: Eq(a, b**n)),
    "with a number": of("m", "", "m", write=lambda a, b, c: Eq(a, (b + 1) * c)),
    "of both kinds": of("m", "", "s", write=lambda a, b, c: (Eq(a, b), Eq(c, b))),
    "a branch": of("m", "", "s", write=lambda a, b, c: Eq(a, Piecewise((b, c > 0), (a, True)) * c / c)),
    "a degree": of("degC", "", "", write=lambda a, k, b: (Eq(a, k * a + b), Eq(b, 2 * a + b))),
}


@pytest.mark.parametrize("model", UNKNOWN.values(), ids=UNKNOWN.keys())
def test_what_has_no_unit_fits_everything(model):
    assert wrong(model) == []


# --- what does not -----------------------------------------------------------------------------------------------

ADDED = "terms of a sum must have one unit"
MISFITS = [
    (of("V", "Ohm", "A", write=lambda v, r, i: Eq(v, r * i**2)), f"{ADDED}, but 'a' is in V and 'b*c**2' in W"),
    (of("m", "s", "m", write=lambda a, t, b: Eq(a, b + t)), f"{ADDED}, but 'a' is in m and 'b' in s"),
    (of("m", "", "s", write=lambda a, b, t: Eq(a, b + t)), f"{ADDED}, but 'a' is in m and 'c' in s"),
    (of("m", "m", write=lambda x, y: Eq(der(x), y)), f"{ADDED}, but 'b' is in m and 'der(a)' in m/s"),
    (of("m", "m", write=lambda x, y: Eq(x, y + EV.t)), f"{ADDED}, but 'a' is in m and 'time' in s"),
    (of("1", "K", write=lambda y, dT: Eq(y, 1 + dT)), f"{ADDED}, but 'a' is in 1 and 'b' in K"),
    (of("m", "1", write=lambda x, y: Eq(y * x, x * (x + 5))), f"{ADDED}, but 'a*b' is in m and 'a*(a + 5)' in m2"),
    (of("mm", "m", write=lambda a, b: Eq(a, b)), f"{ADDED}, but 'a' is in mm and 'b' in m (1 m is 1000 mm)"),
    (of("mm", "m", write=lambda a, b: Eq(a, 2 * b)), f"{ADDED}, but 'a' is in mm and '2*b' in m (1 m is 1000 mm)"),
    (
        of("mm", "m", write=lambda a, b: Eq(a, b / 1000)),
        f"{ADDED}, but 'a' is in mm and 'b/1000' in m (1 m is 1000 mm)",
    ),
    (of("Pa", "bar", write=lambda a, b: Eq(a, b)), f"{ADDED}, but 'a' is in Pa and 'b' in bar (1 bar is 100000 Pa)"),
    (
        of("A*h", "A", write=lambda q, i: Eq(der(q), i)),
        f"{ADDED}, but 'b' is in A and 'der(a)' in A*h/s (1 A*h/s is 3600 A)",
    ),
    (of("1", "m", write=lambda y, x: Eq(y, exp(x))), "exp takes a number (or an angle in rad), but 'b' is in m"),
    (
        of("1", "deg", write=lambda y, phi: Eq(y, sin(phi))),
        "sin takes a number (or an angle in rad), but 'b' is in deg (1 deg is 0.0174533)",
    ),
    (of("1", "Pa", write=lambda y, p: Eq(y, log(p))), "log takes a number (or an angle in rad), but 'b' is in Pa"),
    (of("1", "m", write=lambda y, n: Eq(y, 2**n)), "an exponent is a number, but 'b' is in m"),
    (
        of("1", "m", "1", write=lambda y, x, n: Eq(y, x**n)),
        "what is raised to an exponent that is not constant is a number, but 'b' is in m",
    ),
    (
        of("m", "s", write=lambda a, t: Eq(a, a * Max(a, t) / a)),
        "arguments of max need one unit, but 'a' is in m and 'b' in s",
    ),
    (
        of("m", "s", "1", write=lambda a, t, y: Eq(y, Piecewise((y, a > t), (0, True)) * 2)),
        "sides of a comparison need one unit, but 'a' is in m and 'b' in s",
    ),
    (
        of("m", "s", "1", write=lambda a, t, y: Eq(a, y * Piecewise((a, y > 0), (t, True)))),
        "branches need one unit, but 'a' is in m and 'b' in s",
    ),
    (
        of("K", "degC", write=lambda k, c: Eq(k, c)),
        f"{ADDED}, but the zero of 'b', in degC, does not cancel: convert it to K, or take a difference, in 'a'",
    ),
    (
        of("K", "degC", write=lambda k, c: Eq(k, c + 20)),
        f"{ADDED}, but the zero of 'b', in degC, does not cancel: convert it to K, or take a difference, in 'a'",
    ),
    (
        of("degC", "K", "1", write=lambda c, k, y: Eq(y, Piecewise((1, c > k), (0, True)))),
        "sides of a comparison need one unit, but the zero of 'a', in degC, does not cancel: convert it to K, or take "
        "a difference, in 'b'",
    ),
    (
        of("W", "degC", "W/K4", write=lambda q, c, s: Eq(q, s * c**4)),
        "degC has a zero of its own, so 'b' cannot stand in a power or quotient: use K",
    ),
]  # fmt: skip


@pytest.mark.parametrize("model, sentence", MISFITS, ids=[s[-40:] for _, s in MISFITS])
def test_equations_that_do_not_fit(model, sentence):
    (line,) = wrong(model)
    where, _, rest = line.partition(": ")
    assert where == "x (Written)"
    equation, _, said = rest.partition(": ")
    assert equation.startswith("0 = ")
    assert said == sentence


def test_the_whole_message():
    class Spring(Component):
        """F = k·x², in which k is meant for x."""

        def __init__(self, ev, name):
            super().__init__(ev, name)
            k = self.parameter("k", 1.0, unit="N/m")
            x, f = self.variable("x", unit="m"), self.variable("f", unit="N")
            self.add_equations(Eq(f, k * x**2), Eq(x, EV.t))

    diagram = AcausalDiagram().add(Spring(EV, "one"), Spring(EV, "two"), Spring(EV, "three"))
    with pytest.raises(UnitError) as error:
        AcausalCompiler(EV, diagram, check_units=True)()
    assert isinstance(error.value, ModelError)
    assert str(error.value) == (
        "units do not fit in 2 places:\n"
        "- one (Spring): 0 = -k*x**2 + f: terms of a sum must have one unit, but 'f' is in N and 'k*x**2' in J "
        "(2 more components like it)\n"
        "- one (Spring): 0 = -time + x: terms of a sum must have one unit, but 'x' is in m and 'time' in s "
        "(2 more components like it)"
    )
    AcausalCompiler(EV, diagram)  # is asked for nothing


def test_long_lists_are_cut():
    class Many(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            t = self.variable("t", unit="s")
            for k in range(20):
                self.add_equations(Eq(self.variable(f"x{k}", unit="m"), t))

    with pytest.raises(UnitError) as error:
        check_units(AcausalDiagram().add(Many(EV, "x")))
    lines = str(error.value).split("\n- ")
    assert lines[0] == "units do not fit in 20 places:" and len(lines) == 14 and lines[-1] == "… and 8 more"


# --- starts, parameters, events, accounts, connections -----------------------------------------------------------


def test_starts_and_dependent_parameters():
    class Cart(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x0, v0 = self.parameter("x0", 1.0, unit="m"), self.parameter("v0", 1.0, unit="m/s")
            self.parameter("half", x0 / 2, unit="m")
            self.parameter("area", x0**2, unit="m")
            x = self.variable("x", start=v0, unit="m")
            y = self.variable("y", start=2 * x0, unit="m")
            self.start(der(x), v0)
            self.start(der(y), x0)
            self.add_equations(Eq(der(der(x)), 0), Eq(der(der(y)), 0))

    assert wrong(Cart(EV, "c")) == [
        f"c (Cart): the start of 'x' = v0: {ADDED}, but 'x' is in m and 'v0' in m/s",
        f"c (Cart): the start of 'der(y)' = x0: {ADDED}, but 'x0' is in m and 'der(y)' in m/s",
        f"c (Cart): 'area' = x0**2: {ADDED}, but 'area' is in m and 'x0**2' in m2",
    ]


def test_values_from_a_parent_are_checked_where_they_are_used():
    class Pair(Component):
        def __init__(self, ev, name, unit):
            super().__init__(ev, name)
            r = self.parameter("r", 1.0, unit=unit)
            self.add(Resistor(ev, "a", R=r / 2))

    assert wrong(Pair(EV, "right", "Ohm")) == []
    assert wrong(Pair(EV, "right", "Ohm"), Pair(EV, "wrong", "S")) == [
        f"wrong.a (Resistor): 'R' = ../r/2: {ADDED}, but 'R' is in Ohm and '../r/2' in S"
    ]


def test_variables_of_children_have_the_units_of_the_child():
    class Holder(Component):
        def __init__(self, ev, name, unit):
            super().__init__(ev, name)
            child = self.add(of(unit, write=lambda a: Eq(a, 0)))
            self.add_equations(Eq(self.variable("y", unit="m"), child.a))

    assert wrong(Holder(EV, "one", "m"), Holder(EV, "two", "")) == []
    (line,) = wrong(Holder(EV, "one", "m"), Holder(EV, "two", "kg"))
    assert line == f"two (Holder): 0 = -x.a + y: {ADDED}, but 'y' is in m and 'x.a' in kg"


class Ball(Component):
    """A ball with an event for everything that events can say."""

    def __init__(self, ev, name, height="m", speed="m/s", count="1", period="s", back="1"):
        super().__init__(ev, name)
        h, v = self.variable("h", unit="m"), self.variable("v", unit="m/s")
        low, limit = self.parameter("low", 0.0, unit=height), self.parameter("limit", 0.0, unit=speed)
        e, T = self.parameter("e", 0.9, unit=back), self.parameter("T", 0.9, unit=period)
        n, one = self.discrete("n", unit="1"), self.parameter("one", 1.0, unit=count)
        self.add_equations(Eq(der(h), v), Eq(der(v), 0))
        self.when(And(h <= low, v < limit), reinit(v, -e * pre(v)), reinit(h, 0), assign(n, pre(n) + one))
        self.when(self.sampled(T), assign(n, 0))


def test_relations_that_are_events_are_reported_once():
    class Step(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            start = self.parameter("start", 1.0, unit="m")
            self.output("y", Piecewise((1, self.relation(ev.t >= start)), (0, True)))

    (line,) = wrong(Step(EV, "step"))
    assert line.endswith("sides of a comparison need one unit, but 'time' is in s and 'start' in m")


@pytest.mark.parametrize(
    "units, said",
    [
        ({"height": "s"}, f"when((h <= low) & (v < limit)): {ADDED}, but 'h' is in m and 'low' in s"),
        ({"speed": "mm/s"}, f"when((h <= low) & (v < limit)): {ADDED}, but 'v' is in m/s and 'limit' in mm/s"),
        ({"back": "kg"}, "reinit(v, -e*v): terms of a sum must have one unit, but 'v' is in m/s and 'e*v'"),
        ({"count": "m"}, f"assign(n, one + pre(n)): {ADDED}, but 'n' is in 1 and 'one' in m"),
        ({"period": "m"}, "the period of sampled(T) = T: terms of a sum must have one unit, but"),
    ],
)
def test_events(units, said):
    assert wrong(Ball(EV, "ball")) == []
    (line,) = wrong(Ball(EV, "ball", **units))
    assert line.startswith("ball (Ball): ") and said.partition(":")[0] in line
    assert {*said.split()} <= {*line.replace("pre(n)", "pre(n)").split()}, line


def test_branches_of_an_equation_need_not_agree():
    class Valve(Component):
        def __init__(self, ev, name, unit):
            super().__init__(ev, name)
            p, q = self.variable("p", unit="Pa"), self.variable("q", unit="m3/s")
            leak = self.parameter("leak", 0.0, unit=unit)
            self.either(Eq(self.discrete("open", unit="1"), 1), p, q - leak)

    assert wrong(Valve(EV, "v", "m3/s")) == []
    (line,) = wrong(Valve(EV, "v", "kg/s"))
    assert line.endswith(f"{ADDED}, but 'q' is in m3/s and 'leak' in kg/s")


def test_accounts_of_energy():
    class Flywheel(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            J, w = self.parameter("J", 1.0, unit="kg*m2"), self.variable("w", unit="rad/s")
            self.add_equations(Eq(der(w), 0))
            self.declare_energy(J * w**2 / 2)
            self.declare_supply(J * w**2)
            self.declare_dissipation(J * w * der(w))

    assert wrong(Flywheel(EV, "f")) == [
        "f (Flywheel): the supply J*w**2: terms of a sum must have one unit, but 'J*w**2' is in J and 'supply' in W"
    ]


def test_signals():
    sensor, source, gain = SpeedSensor(EV, "sensor"), SpeedSource(EV, "source"), Gain(EV, "gain")
    assert wrong(sensor, source, gain, connect=[(sensor.y, gain.u), (gain.y, source.u)]) == []
    assert wrong(sensor, source, connect=[(sensor.y, source.u)]) == [
        "diagram: connect(sensor.y, source.u): 'sensor.y' is in rad/s and 'source.u' in m/s"
    ]
    celsius, kelvin = of("degC", write=lambda a: Eq(a, 0)), Thermometer(EV, "t")
    assert wrong(celsius, kelvin, connect=[(celsius.a, kelvin.u)]) == [
        "diagram: connect(x.a, t.u): 'x.a' is in degC and 't.u' in K (0 degC is 273.15 K)"
    ]

    class Both(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            self.add(sensor), self.add(source)
            self.connect(self.sensor.y, self.source.u)

    assert wrong(Both(EV, "both")) == [
        "both (Both): connect(sensor.y, source.u): 'sensor.y' is in rad/s and 'source.u' in m/s"
    ]


class Thermometer(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        self.output("y", self.input("u", unit="K"), unit="K")


# --- the library -------------------------------------------------------------------------------------------------

# Compared with each other alone; as all signals, they may have any unit.
ANY_UNIT = ("Switch.u", "Switch.threshold", "JoiningSwitch.u", "JoiningSwitch.threshold")


QUICK = ("rotational", "thermal")  # the others have more components


@pytest.mark.parametrize("domain", [d if d in QUICK else pytest.param(d, marks=pytest.mark.slow) for d in domains()])
def test_components_of_the_library_fit(domain):
    assert components_of(domain)
    for component in components_of(domain):
        assert wrong(component) == []


@pytest.mark.parametrize("domain", [d for d in domains() if d != "signal"])
def test_components_of_the_library_declare_units(domain):
    without = [
        f"{type(c).__name__}.{name}"
        for c in components_of(domain)
        for name, declared in (*c.parameters.items(), *c.variables.items())
        if not declared.unit and getattr(declared, "kind", "") not in ("event", "start")
    ]
    assert set(without) <= set(ANY_UNIT)


LARGE = ("andrews", "caraxis", "sundials_heat2d", "sundials_slcrank")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n for n in PROBLEMS])
def test_published_models_fit(name):
    _, diagram = PROBLEMS[name].build()
    check_units(diagram)


# --- cost --------------------------------------------------------------------------------------------------------


def ladder(cells: int) -> AcausalDiagram:
    diagram = AcausalDiagram()
    source, ground = VoltageSource(EV, "source"), Ground(EV, "ground")
    diagram.connect(source.n, ground.p)
    before = source.p
    for k in range(cells):
        r, c = Resistor(EV, f"r{k}", R=1.0 + k), Capacitor(EV, f"c{k}", C=1e-3, initial_voltage=0.1 * k)
        diagram.connect(before, r.p)
        diagram.connect(r.n, c.p)
        diagram.connect(c.n, ground.p)
        before = r.n
    return diagram


def test_symbolic_work_is_done_once_for_each_shape(monkeypatch):
    counts = {}

    def counted(name, function):
        def call(*arguments):
            counts[name] = counts.get(name, 0) + 1
            return function(*arguments)

        return call

    for name in ("read_expression", "misfits_of_equation", "misfits_of_value", "shortened"):
        monkeypatch.setattr(pass_, name, counted(name, getattr(pass_, name)))
    check_units(ladder(2))
    small = dict(counts)
    counts.clear()
    check_units(ladder(200))
    assert counts == small and small["misfits_of_equation"] > 10


def test_components_whose_units_differ_are_checked_each():
    right, left = of("m", "m", write=lambda a, b: Eq(a, b)), of("m", "s", write=lambda a, b: Eq(a, b))
    left.name = "y"
    assert wrong(right, left) == [f"y (Written): 0 = a - b: {ADDED}, but 'a' is in m and 'b' in s"]


# --- the package behind it ---------------------------------------------------------------------------------------


def test_a_model_that_fits_compiles_to_the_same_system():
    diagram = AcausalDiagram().add(Mass(EV, "mass", initial_position=0.0, initial_velocity=1.0))
    assert AcausalCompiler(EV, diagram, check_units=True)().states == AcausalCompiler(EV, diagram)().states


def test_the_missing_package_names_the_extra(monkeypatch):
    from jaxonomy_dae.graph.units import parse

    parse._registry.cache_clear()
    parse.read_unit.cache_clear()
    monkeypatch.setitem(sys.modules, "pint", None)  # so that importing it raises
    mass = Mass(EV, "mass", initial_position=0.0, initial_velocity=1.0)
    compiled(mass)  # needs it not
    with pytest.raises(ImportError, match=r"check_units=True needs Pint: pip install 'jaxonomy_dae\[units\]'"):
        compiled(mass, check_units=True)
    parse._registry.cache_clear()
