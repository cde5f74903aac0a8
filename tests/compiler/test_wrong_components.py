"""What library components refuse: values out of their bounds, shapes that do not fit, networks that cannot be."""

import numpy as np
import pytest
import scipy.interpolate
import sympy
from bench import Bench
from problems import compiled

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import Component, EqnEnv, ModelError, StructuralError, der
from jaxonomy_dae.library.battery import Cell, HeatedCell, HeatedPack, Pack
from jaxonomy_dae.library.hydraulic import LaminarPipe, Orifice, PressureSource, Tank
from jaxonomy_dae.library.interpolation import interpolated
from jaxonomy_dae.library.thermal import Convection, Radiation, Wall
from jaxonomy_dae.library.transmissions import LeadScrew, Planetary
from jaxonomy_dae.write import Eq

SOC = np.array([0.0, 0.1, 0.25, 0.5, 0.8, 1.0])
OCV = np.array([3.0, 3.45, 3.58, 3.7, 3.97, 4.19])


@pytest.mark.parametrize(
    "make, named",
    [
        (lambda ev: el.Diode(ev, "d", Is=-1e-9), r"d\.Is"),
        (lambda ev: el.MutualInductor(ev, "m", L1=0.0), r"m\.L1"),
        (lambda ev: el.MutualInductor(ev, "m", L1=2.0, L2=0.5, M=-1.0), r"'m': M² must be below L1·L2; got M=-1"),
        (lambda ev: el.HeatedResistor(ev, "r", R=-2.0), r"r\.R"),
        (lambda ev: el.PulseVoltage(ev, "p", period=0.0), r"p\.period"),
    ],
)
def test_electrical(make, named):
    with pytest.raises(ModelError, match=named):
        make(EqnEnv())


@pytest.mark.parametrize(
    "make, named",
    [
        (lambda ev: Planetary(ev, "p", 0.0), r"p\.ratio"),
        (lambda ev: line.Backlash(ev, "b", gap=-1.0), r"b\.gap"),
        (lambda ev: rot.Friction(ev, "f", smooth=0.0), r"f\.smooth"),
        (lambda ev: LeadScrew(ev, "s", lead=-0.1), r"s\.lead"),
    ],
)
def test_mechanical(make, named):
    with pytest.raises(ModelError, match=named):
        make(EqnEnv())


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda ev: Convection(ev, "c", A=-1.0), r"'c\.A' must lie in \[0, inf\); got -1"),
        (lambda ev: Radiation(ev, "r", eps=1.2), r"'r\.eps' must lie in \[0, 1\]; got 1\.2"),
        (lambda ev: Wall(ev, "w", [1.0, -2.0], [1.0, 1.0]), r"'w\.R2' must lie in \(0, inf\); got -2"),
        (lambda ev: Wall(ev, "w", [1.0, 2.0], [1.0]), r"wall 'w' needs .*got 2 in R, 1 in C$"),
        (lambda ev: Wall(ev, "w", [], []), r"wall 'w' needs .*got 0 in R"),
    ],
)
def test_thermal(make, message):
    with pytest.raises(ModelError, match=message):
        make(EqnEnv())


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda ev: sig.Table1D(ev, "t", [0, 2, 1], [0, 1, 2]), r"'t': x must increase, but entry 2 \(1\) follows 2"),
        (lambda ev: sig.Table1D(ev, "t", [0, 1], [0, 1, 2]), r"'t': values has shape \(3,\), x has \(2,\)"),
        (lambda ev: sig.Table1D(ev, "t", [0, 1], [0, np.nan]), r"'t': values is not finite at entry 1"),
        (lambda ev: sig.Table1D(ev, "t", [0, 1], [0, 1], kind="cubic", events=True), "'t': a cubic table has no kinks"),
        (lambda ev: sig.Table2D(ev, "t", [0, 1], [0, 1], [[1, 2]]), r"'t': values has shape \(1, 2\)"),
        (lambda ev: sig.TransferFunction(ev, "f", [1, 0], [2]), r"'f': the numerator's degree, 1, is above"),
        (lambda ev: sig.StateSpace(ev, "s", [[1, 0]], [[1]], [[1]]), r"'s': A has shape \(1, 2\)"),
        (
            lambda ev: sig.StateSpace(ev, "s", np.eye(2), [0, 1], [1, 0]),
            r"B has shape \(1, 2\), expected \(2, 1\): one",
        ),
        (lambda ev: sig.TransferFunction(ev, "f", [[1, 0]], [2, 1]), r"'f': numerator is one row.*shape \(1, 2\)"),
        (lambda ev: sig.DiscreteTransferFunction(ev, "f", [1], [[2, 1]]), r"'f': denominator is one row"),
        (lambda ev: sig.Hysteresis(ev, "h", initially_on="no"), "'h': initially_on is True or False; got 'no'"),
        (lambda ev: sig.FirstOrder(ev, "f", T=0.0), r"f\.T"),
    ],
)
def test_signal(make, message):
    with pytest.raises(ModelError, match=message):
        make(EqnEnv())


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda ev: Orifice(ev, "o", A=-1e-4), r"'o\.A' must lie in \[0, inf\); got -0\.0001"),
        (lambda ev: Tank(ev, "t", A=-1.0), r"'t\.A' must lie in \(0, inf\); got -1"),
        (lambda ev: LaminarPipe(ev, "l", mu=0.0), r"'l\.mu' must lie in \(0, inf\); got 0"),
    ],
)
def test_hydraulic(make, message):
    with pytest.raises(ModelError, match=message):
        make(EqnEnv())


def test_networks_of_fluids():
    ev = EqnEnv()
    a, b = PressureSource(ev, "a"), PressureSource(ev, "b", 2e5)
    with pytest.raises(StructuralError, match=r"the pressure of one node\. Keep one of them, or put a pipe between"):
        compiled(a, connect=[(a.fluid, b.fluid)])
    first, second = LaminarPipe(ev, "first"), Orifice(ev, "second")
    with pytest.raises(
        StructuralError, match=r"nothing determines the pressures of .*Connect a PressureSource, a Tank"
    ):
        compiled(first, connect=[(first.port_a, second.port_a), (first.port_b, second.port_b)])


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda ev: Cell(ev, "c", [0, 0.5, 0.4], OCV[:3]), r"'c': soc must increase, but .* \(0\.4\) follows 0\.5"),
        (lambda ev: Cell(ev, "c", [0.5], [3.7]), r"'c': soc needs a row of at least 2 points; got shape \(1,\)"),
        (lambda ev: Cell(ev, "c", SOC, OCV[:4]), r"'c': ocv has 4 entries, soc has 6: they must agree"),
        (lambda ev: Cell(ev, "c", SOC, [3.0, np.nan, *OCV[2:]]), r"'c\.ocv2'"),
        (lambda ev: Cell(ev, "c", SOC, OCV, kind="spline"), r"'c': kind must be one of linear, cubic; got 'spline'"),
        (lambda ev: Cell(ev, "c", SOC, OCV, Q=-1.0), r"'c\.Q' must lie in \(0, inf\); got -1"),
        (lambda ev: Cell(ev, "c", SOC, OCV, R0=0.0), r"'c\.R0' must lie in \(0, inf\); got 0"),
        (lambda ev: Cell(ev, "c", SOC, OCV, R=[0.1], C=[0.0]), r"'c\.C1' must lie in \(0, inf\); got 0"),
        (lambda ev: Cell(ev, "c", SOC, OCV, R=[0.1, 0.2], C=[1.0]), r"'c' needs .*got 2 in R, 1 in C and no initial_v"),
        (lambda ev: Cell(ev, "c", SOC, OCV, eta=1.1), r"'c\.eta' must lie in \(0, 1\]; got 1\.1"),
        (lambda ev: HeatedCell(ev, "c", SOC, OCV, T_ref=0.0), r"'c\.T_ref' must lie in \(0, inf\); got 0"),
        (lambda ev: Pack(ev, "k", 0, 2, SOC, OCV), r"'k': series must be at least 1, an integer; got 0"),
        (lambda ev: Pack(ev, "k", 3, 2, SOC, OCV, R0=[0.1] * 3), r"'k': R0 has shape \(3,\): .* shape \(3, 2\)"),
        (lambda ev: Pack(ev, "k", 2, 2, SOC, OCV, Q=-1.0), r"'k\.Q' must lie in"),
        (lambda ev: Pack(ev, "k", 2, 2, SOC, OCV, Q=[[1.0, 1.0], [1.0, -1.0]]), r"'cell\[1,1\]\.Q' must lie"),
        (lambda ev: HeatedPack(ev, "k", 2, 2, SOC, OCV, G_neighbour=-1.0), r"'k\.G_neighbour' must lie in"),
    ],
)  # fmt: skip
def test_battery(make, message):
    with pytest.raises(ModelError, match=message):
        make(EqnEnv())


@pytest.mark.parametrize(
    "make, named",
    [
        (lambda ev: pl.Body(ev, "b", m=0.0), r"b\.m"),
        (lambda ev: pl.Body(ev, "b", J=-1.0), r"b\.J"),
        (lambda ev: pl.MassiveLink(ev, "k", m=-1.0), r"k\.m"),
        (lambda ev: pl.SpringDamper(ev, "s", c=-1.0), r"s\.c"),
    ],
)
def test_planar(make, named):
    with pytest.raises(ModelError, match=named):
        make(EqnEnv())


def test_what_nothing_holds_is_said_once():
    """Regression: the fault was reported twice, for x and for y, in terms of levels."""
    b = Bench()
    link, pin = b(pl.Link, "link"), b(pl.Revolute, "pin")
    b.join(link.frame_b, pin.frame_a)
    with pytest.raises(
        StructuralError, match="^nothing holds 'link' and 'pin': no body and no world .*Body or a World"
    ):
        b.compile()


def test_two_worlds_at_one_link():
    b = Bench()
    west, east, link = b(pl.World, "west"), b(pl.World, "east", 1.0), b(pl.Link, "link")
    b.chain(west.frame, link.frame_a, link.frame_b, east.frame)
    with pytest.raises(
        StructuralError, match="'west', 'east' and 'link' form a loop.* difference of 'x', 'y' and 'phi'"
    ):
        b.compile()


def test_complementarity():
    class Wrong(Component):
        def __init__(self, ev, name, order, **options):
            super().__init__(ev, name)
            x, f = self.variable("x", start=1.0, fixed=True), self.variable("f")
            self.add_equations(Eq(der(x), f))
            self.complementary(x, f, order=order, **options)

    with pytest.raises(ModelError, match="order says how many times a branch is differentiated, 0, 1 or 2; got 3"):
        Wrong(EqnEnv(), "w", 3)
    with pytest.raises(ModelError, match="a restitution is for gaps between positions, order=2; got order=1"):
        Wrong(EqnEnv(), "w", 1, restitution=0.5)


def curve(values=OCV):
    """The cubic table: Hermite's splines with the slopes of the chords behind."""
    slopes = np.diff(values) / np.diff(SOC)
    return scipy.interpolate.CubicHermiteSpline(SOC, values, np.append(slopes[:1], slopes))


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_tables_and_their_integrals(kind):
    u, names = sympy.Symbol("u"), sympy.symbols("a:6")
    value, integral = sympy.lambdify([u, names], interpolated(u, SOC, names, kind), "numpy")(
        at := np.linspace(-0.2, 1.2, 29), OCV
    )
    spline = scipy.interpolate.make_interp_spline(SOC, OCV, k=1) if kind == "linear" else curve()
    # Rounding of a few volts, magnified in the cubic's coefficients by 1/width² and more: widths are 0.1 to 0.3.
    np.testing.assert_allclose(value, spline(at, extrapolate=True), rtol=0, atol=1e-12)
    whole = spline.antiderivative()
    np.testing.assert_allclose(integral, whole(at, extrapolate=True) - whole(0.0), rtol=0, atol=1e-12)
