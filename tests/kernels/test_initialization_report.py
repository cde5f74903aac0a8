"""What initialization says: reports, errors by name, parameters solved for, singular blocks."""

import html.parser

import jax
import numpy as np
import pytest
from problems import FreeMass, compiled, environment, oscillator, pendulum, rc_circuit, without_lines
from sympy import Eq, cos, sin

from jaxonomy_dae import Component, EqnEnv, InitializationError, ModelError, der, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Spring


def parallel(b=2.0):
    """Two capacitors in parallel with starts of their own."""
    ev = EqnEnv()
    first, second = Capacitor(ev, "a", 1.0, initial_voltage=1.0), Capacitor(ev, "b", 1.0, initial_voltage=b)
    r, g = Resistor(ev, "r"), Ground(ev, "g")
    return compiled(first, second, r, g, connect=[(first.p, second.p, r.p), (first.n, second.n, r.n, g.p)])


def divider(r1, r2):
    """Two resistors in series at 3 V."""
    ev = EqnEnv()
    source, a, b = VoltageSource(ev, "source", 3.0), Resistor(ev, "r1", 1.0), Resistor(ev, "r2", 1.0)
    ground = Ground(ev, "ground")
    system = compiled(source, a, b, ground, connect=[(source.p, a.p), (a.n, b.p), (b.n, source.n, ground.p)])
    return system.with_parameters({"r1.R": r1, "r2.R": r2})


def error(function):
    with pytest.raises(InitializationError) as caught:
        function()
    return without_lines(caught.value)


# --- texts -------------------------------------------------------------------------------------------------------

MOVED = """\
a consistent initial point at t = 0
found by Newton, 5 evaluations
fixed:
    pend.vx = 1.6
    pend.x = 0.6
fixed in the model, but outranked by values given:
    pend.y
    pend.vy
guesses:
    pend.y = -0.8, moved by 0.132 from -0.932039
    pend.vy = 1.2, moved by 1.2 from 0"""

AGREEING = """\
a consistent initial point at t = 0
the starts are the states; nothing had to be solved
fixed:
    a.v = 1
redundant, as they follow from others:
    b.v = 1, from a.v = 1"""

CONTRADICTION = """\
no consistent initial point was found; conditions that could not be met, largest error first:
  start of a.v, 1: off by 1
b.v and a.v are fixed at 2 and 1, which contradict each other: leave out `initial_voltage` of b or `initial_voltage` \
of a (in components of your own: fixed=False), or give values that agree."""

OFF_THE_CIRCLE = """\
no consistent initial point was found; conditions that could not be met, largest error first:
  pend: 0 = -L**2 + x**2 + y**2, in pend.x, pend.y: off by 0.235
  start of pend.x, 0.9: off by 0.114
  start of pend.y, -0.9: off by 0.114
pend.y and pend.x are fixed at -0.9 and 0.9, which contradict each other: release one start (fixed=False, or without \
the component's argument `initial_…`), or give values that agree."""

SHORT = """\
the equations are singular at the initial point with r1.R = 0, r2.R = 0: they do not determine source.i
  r1: 0 = n.v - p.v + v
  r1: 0 = -R*i + v
  r2: 0 = -R*i + v
Give one of r1.R, r2.R another value, or remove from the model what has become superfluous."""

MASSLESS = """\
the equations are singular at the initial point with mass.M = 0: they do not determine der(mass.v)
  mass: 0 = M*der(v) - flange.f
Give mass.M another value, or remove from the model what has become superfluous."""

TOO_FEW = (
    "solve_for: 1 value too few: nothing determines 'spring.length'. Give one of: 'wall.flange.f', 'spring.f', "
    "'mass.flange.f', 'der(mass.v)', in initial={...} or as a fixed start."
)

TOO_MANY = (
    "solve_for: a value too many for 1 unknown parameter ('spring.length'): 'spring.f' follows from the others. "
    "Leave it out, or solve for one more parameter ('wall.position', 'damper.d', 'mass.m')."
)


def texts():
    """All texts, as one text: computed in other processes too."""
    rest = {"mass.s": 0.3, "mass.v": 0.0, "der(mass.v)": 0.0}
    model = oscillator()
    return [
        str(pendulum().initialization_report(initial={"pend.x": 0.6, "pend.vx": 1.6})),
        str(parallel(b=1.0).initialization_report()),
        error(parallel().initialize),
        error(lambda: pendulum().initialize(initial={"pend.x": 0.9, "pend.y": -0.9})),
        error(divider(0.0, 0.0).initialize),
        error(oscillator(kind=FreeMass).with_parameters({"mass.M": 0.0}).initialize),
        error(lambda: model.initialize(solve_for=["spring.length"])),
        error(lambda: model.initialize(initial=rest | {"spring.f": 1.0}, solve_for=["spring.length"])),
    ]


EXPECTED = [MOVED, AGREEING, CONTRADICTION, OFF_THE_CIRCLE, SHORT, MASSLESS, TOO_FEW, TOO_MANY]


@pytest.mark.long("eight models, each with a start and a diagnosis of its own")
def test_texts():
    for found, expected in zip(texts(), EXPECTED, strict=True):
        assert found == expected


@pytest.mark.slow
def test_texts_do_not_depend_on_the_hash_seed():
    import subprocess
    import sys

    program = "import conftest, test_initialization_report as t; assert t.texts() == t.EXPECTED"
    done = subprocess.run([sys.executable, "-c", program], env=environment(PYTHONHASHSEED="1"), capture_output=True)
    assert done.returncode == 0, done.stderr


class Balanced(html.parser.HTMLParser):
    """Checks that tags close in order."""

    def __init__(self):
        super().__init__()
        self.open, self.text = [], ""

    def handle_starttag(self, tag, attrs):
        if tag != "br":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_html_is_well_formed_and_says_the_same():
    report = pendulum().initialization_report(initial={"pend.x": 0.6, "pend.vx": 1.6})
    parser = Balanced()
    parser.feed(report._repr_html_())
    parser.close()
    assert not parser.open
    for line in str(report).splitlines():
        assert line.strip().removesuffix(":") in parser.text


# --- attributes --------------------------------------------------------------------------------------------------


def test_attributes():
    report = pendulum().initialization_report(initial={"pend.x": 0.6, "pend.vx": 1.6})
    assert report.consistent and report.method == "Newton" and not report.residuals and not report.blocks
    assert dict(report.fixed) == {"pend.x": 0.6, "pend.vx": 1.6}
    assert report.outranked == ["pend.y", "pend.vy"]
    y = next(g for g in report.guesses if g.name == "pend.y")
    assert y.value == pytest.approx(-0.8, rel=1e-12) and y.moved == pytest.approx(-0.8 + np.sin(1.2), rel=1e-10)


def test_redundant_starts_of_the_pendulum():
    """It fixes four numbers of two degrees of freedom."""
    report = pendulum().initialization_report()
    assert report.consistent and report.method == "the start was consistent"
    found = {r.name: ([n for n, _ in r.follows_from], r.agrees) for r in report.redundant}
    assert found == {"pend.y": (["pend.x"], True), "pend.vy": (["pend.x", "pend.vx"], True)}  # x·vx + y·vy = 0


def test_residuals_are_sorted_and_named():
    report = pendulum().initialization_report(initial={"pend.x": 0.9, "pend.y": -0.9})
    assert not report.consistent
    assert [abs(r.value) for r in report.residuals] == sorted([abs(r.value) for r in report.residuals], reverse=True)
    assert report.residuals[0].variables == ("pend.x", "pend.y")
    assert [r.agrees for r in report.redundant] == [False]


def test_no_report_inside_jit():
    system = oscillator()
    with pytest.raises(ModelError, match="outside jit"):
        jax.jit(lambda x: system.initialization_report(initial={"mass.s": x}).time)(1.0)


# --- parameters solved for ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_rest_length_that_balances_a_load():
    """K·(x − L) = −F at rest: L = x + F/K, and dL/dK = −F/K²."""
    ev = EqnEnv()

    class Load(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            f = self.parameter("f", 2.0)
            x, v = self.variable("x", start=0.1), self.variable("v", start=0.0, fixed=True)
            k, length, m = self.parameter("K", 5.0), self.parameter("length", 0.0), self.parameter("M", 3.0)
            self.add_equations(Eq(der(x), v), Eq(m * der(v), -k * (x - length) - f))

    system = compiled(Load(ev, "m"))

    def length(k, x):
        initial = {"m.x": x, "der(m.v)": 0.0}
        changed = system.with_parameters({"m.K": k})
        return changed.initialize(initial=initial, solve_for=["m.length"])[1].parameters["m.length"]

    @jax.jit
    @jax.vmap
    def solved(k):
        value, slopes = jax.value_and_grad(length, (0, 1))(k, 0.3)
        initial = {"m.x": 0.3, "der(m.v)": 0.0}
        x, found = system.with_parameters({"m.K": k}).initialize(initial=initial, solve_for=["m.length"])
        again = found.initialize(initial=initial)
        return value, slopes, found.parameters["m.length"], x, again, found.vector_field(0.0, x)

    k = np.array([4.0, 5.0, 8.0])
    value, slopes, found, x, again, field = solved(k)
    np.testing.assert_allclose(value, 0.3 + 2 / k, rtol=1e-12)
    np.testing.assert_allclose(found, 0.3 + 2 / k, rtol=1e-12)
    np.testing.assert_allclose(slopes[0], -2 / k**2, rtol=1e-12)
    np.testing.assert_allclose(slopes[1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(again, x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(field, 0.0, atol=1e-14)  # it rests


class Tank(Component):
    """A dh/dt = q − u·c·√h with a valve opening u between 0 and 1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        area, q, c = self.parameter("A", 2.0), self.parameter("q", 0.6), self.parameter("c", 1.0)
        u = self.parameter("u", 0.5, bounds=(0.0, 1.0))
        h = self.variable("h", start=1.0, fixed=True)
        self.add_equations(Eq(area * der(h), q - u * c * h**0.5))


@pytest.mark.slow
def test_a_valve_opening_and_its_bounds():
    system = compiled(Tank(EqnEnv(), "tank"))
    _, found = system.initialize(initial={"tank.h": 4.0, "der(tank.h)": 0.0}, solve_for=["tank.u"])
    assert float(found.parameters["tank.u"]) == pytest.approx(0.3, rel=1e-12)  # q/(c·√h)
    # On the bound itself, with rounding.
    _, found = system.initialize(initial={"tank.h": 0.36, "der(tank.h)": 0.0}, solve_for=["tank.u"])
    assert float(found.parameters["tank.u"]) == pytest.approx(1.0, rel=1e-12)
    assert float(found.parameters["tank.u"]) <= 1.0
    message = error(lambda: system.initialize(initial={"tank.h": 0.09, "der(tank.h)": 0.0}, solve_for=["tank.u"]))
    assert message == (
        "solve_for: the values given need tank.u = 2, which is out of its bounds [0, 1]. Give other values in "
        "initial={...}, or start the search elsewhere with system.with_parameters({'tank.u': guess})"
    )

    @jax.jit
    def opening(h):
        initial = {"tank.h": h, "der(tank.h)": 0.0}
        return system.initialize(initial=initial, solve_for=["tank.u"])[1].parameters["tank.u"]

    assert float(opening(4.0)) == pytest.approx(0.3, rel=1e-12)
    assert np.isnan(opening(0.09))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:initial=")
def test_two_parameters_from_two_values_on_a_constrained_model():
    """The mass and the length of a pendulum from its tension and its speed, at x = 0: 2·λ·L = m·(v²/L + g)."""
    system = pendulum(initial_theta=-np.pi / 2)
    given = {"pend.x": 0.0, "pend.y": -2.0, "pend.vx": 1.0, "pend.lam": 7.0}
    _, found = system.initialize(initial=given, solve_for=["pend.L", "pend.m"])
    assert float(found.parameters["pend.L"]) == pytest.approx(2.0, rel=1e-12)
    assert float(found.parameters["pend.m"]) == pytest.approx(28.0 / (0.5 + 9.81), rel=1e-12)


@pytest.mark.slow
def test_a_start_expression_of_an_unknown_parameter():
    """The release angle from a height: y = L·sin(θ), θ unknown."""
    system = pendulum()
    _, found = system.initialize(initial={"pend.y": -0.8}, solve_for=["pend.initial_theta"])
    assert np.sin(float(found.parameters["pend.initial_theta"])) == pytest.approx(-0.8, rel=1e-10)


def test_names_to_solve_for_are_checked():
    system = oscillator()
    with pytest.raises(ModelError, match=r"did you mean 'spring\.length'"):
        system.initialize(solve_for=["spring.lenght"])
    with pytest.raises(ModelError, match=r"write solve_for=\['spring\.c'\]"):
        system.initialize(solve_for="spring.c")
    with pytest.raises(ModelError, match="is a variable"):
        system.initialize(solve_for=["mass.s"])


# --- singular blocks ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_singular_blocks_are_never_integrated():
    with pytest.raises(InitializationError, match=r"r1\.R = 0, r2\.R = 0"):
        simulate(divider(0.0, 0.0), 1.0)
    # Opposite resistances add up to nothing as well; one of them alone does no harm.
    with pytest.raises(InitializationError, match=r"r1\.R = 2, r2\.R = -2.*do not determine"):
        divider(2.0, -2.0).initialize()
    one = divider(0.0, 2.0)
    assert float(one.observe("source.i", 0.0, one.initialize())) == pytest.approx(-1.5, rel=1e-12)
    with pytest.raises(InitializationError, match=r"r\.R = 0.*do not determine"):
        rc_circuit().with_parameters({"r.R": 0.0}).initialize()
    with pytest.raises(ModelError, match=r"c\.C"):
        rc_circuit().with_parameters({"c.C": 0.0}).initialize()


@pytest.mark.parametrize("scale", [1e-15, 1e15])
def test_units_are_no_reason(scale):
    """What is regular in one unit is regular in all: farads and picofarads, ohms and teraohms."""
    system = rc_circuit().with_parameters({"c.C": scale, "r.R": 1 / scale})
    assert not system.initialization_report().notes
    assert not divider(scale, 2 * scale).initialization_report().notes


class Bob(Component):
    """A pendulum whose mass and length may be zero."""

    def __init__(self, ev, name, m=1.0, length=1.0):
        super().__init__(ev, name)
        m, r = self.parameter("m", m), self.parameter("L", length)
        x, y = self.variable("x", start=0.6 * r, fixed=True), self.variable("y", start=-0.8 * r, fixed=True)
        vx, vy = self.variable("vx", start=0.0, fixed=True), self.variable("vy", start=0.0, fixed=True)
        lam = self.variable("lam")
        self.add_equations(
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(m * der(vx), -lam * x),
            Eq(m * der(vy), -lam * y - m * 9.81),
            Eq(x**2 + y**2, r**2),
        )


@pytest.mark.slow
def test_a_massless_pendulum_and_one_without_length():
    system = compiled(Bob(EqnEnv(), "pend"))
    message = error(system.with_parameters({"pend.m": 0.0}).initialize)
    assert "with pend.m = 0: they do not determine der(pend.vx), der(pend.vy)" in message
    message = error(system.with_parameters({"pend.L": 0.0}).initialize)
    assert "with pend.x = 0, pend.y = 0: they do not determine" in message
    assert "Start elsewhere" in message


class Folded(Component):
    """dx/dt = −z where z² + b·z = c·x: at c = 0 the root z = 0 is simple with slope b, double if b = 0."""

    def __init__(self, ev, name, b=0.0):
        super().__init__(ev, name)
        b, c = self.parameter("b", b), self.parameter("c", 0.0)
        x, z = self.variable("x", start=1.0, fixed=True), self.variable("z", start=0.0)
        self.add_equations(Eq(der(x), -z), Eq(z**2 + b * z, c * x))


def test_a_nonlinear_block_at_a_fold():
    message = error(compiled(Folded(EqnEnv(), "c")).initialize)
    assert "with c.b = 0: they do not determine der(c.x)" in message  # which is −z
    regular = compiled(Folded(EqnEnv(), "c", b=3.0))
    assert regular.initialization_report().consistent


class Pair(Component):
    """Two linear equations whose rows differ by e."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        e, a = self.parameter("e", 1.0), self.parameter("a", 1.0)
        x = self.variable("x", start=1.0, fixed=True)
        u, v = self.variable("u"), self.variable("v")
        self.add_equations(Eq(der(x), -u), Eq(a * u + v, x), Eq(u + (1 + e) * v, x))


def test_an_ill_conditioned_block_is_a_note():
    """The condition number of [[1, 1], [1, 1 + e]] is close to 4/e."""
    system = compiled(Pair(EqnEnv(), "c"))
    report = system.with_parameters({"c.e": 1e-13}).initialization_report()
    assert report.consistent and len(report.notes) == 1
    assert "block of der(c.x), c.v is ill-conditioned, 4.0e+13" in report.notes[0]
    assert not system.with_parameters({"c.e": 1e-9}).initialization_report().notes
    with pytest.raises(InitializationError, match=r"c\.e = 0.*do not determine der\(c\.x\), c\.v"):
        system.with_parameters({"c.e": 0.0}).initialize()


class Lever(Component):
    """A force that carries the torque of a weight on a lever at the angle phi."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        arm = self.parameter("arm", 0.3)
        phi, force = self.variable("phi", start=1.0, fixed=True), self.variable("force")
        self.add_equations(Eq(der(phi), 1.0), Eq(arm * sin(phi) * force, 2 + cos(phi)))


@pytest.mark.parametrize(("phi", "undecided"), [(0.0, False), (np.pi, True), (1e-16, True)])
def test_a_coefficient_below_its_rounding_error(phi, undecided):
    """sin(π) is 1.2e-16 in floating point: not zero, and of no known sign. Both readings are said, and what makes it
    so: the angle, not the arm, which scales what is nothing but a rounding error."""
    system = compiled(Lever(EqnEnv(), "lever"))
    with pytest.raises(InitializationError, match="singular.*do not determine lever.force") as error:
        system.initialize(initial={"lever.phi": phi})
    text = str(error.value)
    assert f"with lever.phi = {phi:.6g}" in text and "arm =" not in text and "Start elsewhere" in text
    assert ("Either the point is singular, or it is nearer to a singular one" in text) == undecided


@pytest.mark.slow
def test_a_large_singular_block():
    """A ring of 250 equal equations uₖ = a·uₖ₊₁ + x is singular at a = 1: by a sparse factorization."""

    class Ring(Component):
        def __init__(self, ev, name, n=250):
            super().__init__(ev, name)
            a = self.parameter("a", 0.5)
            x = self.variable("x", start=1.0, fixed=True)
            u = [self.variable(f"u{k}") for k in range(n)]
            self.add_equations(Eq(der(x), -u[0]), *(Eq(u[k], a * u[(k + 1) % n] + x) for k in range(n)))

    system = compiled(Ring(EqnEnv(), "ring"))
    x = system.initialize()
    assert float(system.observe("ring.u0", 0.0, x)) == pytest.approx(2.0, rel=1e-12)  # x/(1 − a)
    with pytest.raises(InitializationError, match=r"ring\.a"):
        system.with_parameters({"ring.a": 1.0}).initialize()


def test_batches_are_as_before():
    """Under vmap a singular block gives no name, and the others' values stay right."""
    system = divider(1.0, 1.0)

    def current(r):
        changed = system.with_parameters({"r1.R": r, "r2.R": r})
        return changed.observe("source.i", 0.0, changed.initialize())

    found = jax.jit(jax.vmap(current))(np.array([1.0, 0.0, 3.0]))
    np.testing.assert_allclose(np.asarray(found)[[0, 2]], [-1.5, -0.5], rtol=1e-12)
    assert not np.isfinite(found[1])


@pytest.mark.slow
def test_a_hanging_load_in_equilibrium():
    """Two springs in series from a wall, both masses at rest at given places: two rest lengths follow."""
    ev = EqnEnv()
    wall = FixedPosition(ev, "wall")
    s1, s2 = Spring(ev, "s1", 4.0), Spring(ev, "s2", 9.0)
    m1, m2 = Mass(ev, "m1", 1.0, initial_velocity=0.0), Mass(ev, "m2", 2.0, initial_velocity=0.0)
    d = Damper(ev, "d", 1.0)
    system = compiled(
        wall, s1, s2, m1, m2, d,
        connect=[(wall.flange, s1.flange_a, d.flange_a), (s1.flange_b, m1.flange, s2.flange_a, d.flange_b),
                 (s2.flange_b, m2.flange)],
    )  # fmt: skip
    initial = {"m1.s": 1.0, "m2.s": 3.0, "der(m1.v)": 0.0, "der(m2.v)": 0.0}
    _, found = system.initialize(initial=initial, solve_for=["s1.length", "s2.length"])
    assert float(found.parameters["s1.length"]) == pytest.approx(1.0, rel=1e-12)
    assert float(found.parameters["s2.length"]) == pytest.approx(2.0, rel=1e-12)


class _NearlyTheSame(Component):
    """u = x + y and v = x + (1 + e)·y, given at the start: ∂y/∂v = 1/e."""

    def __init__(self, ev, name, e):
        super().__init__(ev, name)
        x, y = self.variable("x"), self.variable("y")
        u = self.variable("u", start=1.0, fixed=True)
        v = self.variable("v", start=self.parameter("v0", 1 + e), fixed=True)
        e = self.parameter("e", e)
        self.add_equations(Eq(der(x), -x), Eq(der(y), -y), Eq(u, x + y), Eq(v, x + (1 + e) * y))


@pytest.mark.slow
@pytest.mark.parametrize("e", [1e-8, 1e-10, 1e-11])
def test_gradients_of_nearly_redundant_starts_say_so_before_they_lose_digits(e):
    """At e = 1e-11 they were off by 1.4 % without a word."""
    system = compiled(_NearlyTheSame(EqnEnv(), "c", e))

    def start(v0):
        return system.with_parameters({"c.v0": v0}).initialize(throw=False)

    at = system.states.index("c.y")
    off = abs(float(jax.jit(jax.jacfwd(start))(1 + e)[at]) * e - 1)
    said = [note for note in system.initialization_report().notes if "ill-conditioned" in note]
    assert said or off < 1e-4
    assert e < 1e-9 or not said
