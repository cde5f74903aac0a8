"""Hydraulics of an incompressible fluid in lumped components.

Conventions: absolute pressure `p` in pascal, mass flow `m_flow` in kilogram per second counted positive into the
component at a port. The port of a component that has one is `fluid`. A component with two has
dp = port_a.p − port_b.p, and `m_flow` flows from `port_a` to `port_b`. The fluid's density `rho` (kg/m³) and dynamic
viscosity `mu` (Pa·s) are parameters of each component that needs them, by default water's at 20 °C. The kinetic energy
of the flow at ports is neglected. In accounts of energy, the power at a port is p·m_flow/rho.

Sources: H. E. Merritt, Hydraulic Control Systems (Wiley, 1967), for orifices, compliances, pumps and cylinders;
F. M. White, Fluid Mechanics (McGraw-Hill), the chapter on viscous flow in ducts, for pipes.
"""

import sympy

from ..write import (
    NONNEGATIVE,
    POSITIVE,
    Component,
    Eq,
    EqnEnv,
    Hydraulic,
    Rotational,
    Translational,
    Value,
    assign,
    der,
)
from .arguments import in_order, start_of, yes_or_no

DENSITY = 998.2  # kg/m³, water at 20 °C
VISCOSITY = 1.002e-3  # Pa·s, water at 20 °C
ATMOSPHERE = 101325.0  # Pa
GRAVITY = 9.80665  # m/s²


class PressureSource(Component):
    """A port held at the parameter `p` (pascal), whatever the flow. `rho` > 0 in kg/m³ is for the account of energy."""

    def __init__(self, ev: EqnEnv, name: str, p: Value = ATMOSPHERE, rho: Value = DENSITY):
        super().__init__(ev, name)
        held = self.parameter("p", p, unit="Pa")
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        fluid = self.port("fluid", Hydraulic)
        self.add_equations(Eq(fluid.p, held))
        self.declare_supply(-held * fluid.m_flow / density)


class MassFlowSource(Component):
    """A mass flow out of the port, from outside: the input `m_flow` (kg/s), which is 0 unless `simulate` is given
    it. `rho` > 0 in kg/m³ is for the account of energy."""

    def __init__(self, ev: EqnEnv, name: str, rho: Value = DENSITY):
        super().__init__(ev, name)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        fluid = self.port("fluid", Hydraulic)
        flow = self.input("m_flow", default=0.0, unit="kg/s")
        self.add_equations(Eq(fluid.m_flow, -flow))
        self.declare_supply(fluid.p * flow / density)


class Tank(Component):
    """An open tank with its port at the bottom: rho·A·d(level)/dt = fluid.m_flow, fluid.p = p_ambient + rho·g·level.

    The cross-section `A` > 0 in square metre, `level` in metre, `rho` > 0 in kg/m³, `p_ambient` in pascal, `g` in
    metre per second squared. A given `initial_level` (metre) holds at the start; otherwise 1 is a guess. An empty tank
    is not recognised: the level becomes negative.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        A: Value = 1.0,
        initial_level: Value | None = None,
        rho: Value = DENSITY,
        p_ambient: Value = ATMOSPHERE,
        g: Value = GRAVITY,
    ):
        super().__init__(ev, name)
        area = self.parameter("A", A, unit="m2", bounds=POSITIVE)
        start = start_of(self, "initial_level", initial_level, "m", 1.0)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        ambient = self.parameter("p_ambient", p_ambient, unit="Pa")
        gravity = self.parameter("g", g, unit="m/s2")
        fluid = self.port("fluid", Hydraulic)
        level = self.variable("level", **start)
        self.add_equations(
            Eq(density * area * der(level), fluid.m_flow), Eq(fluid.p, ambient + density * gravity * level)
        )
        self.declare_energy(area * level * ambient, density * gravity * area * level**2 / 2)


class HydraulicCapacity(Component):
    """A linear compliance: rho·C·dp/dt = fluid.m_flow, `C` > 0 in m³/Pa, `rho` > 0 in kg/m³.

    A volume V of a fluid with bulk modulus K has C = V/K (Merritt, 1967). A given `initial_pressure` (pascal) holds at
    the start; otherwise that of the atmosphere is a guess.
    """

    def __init__(
        self, ev: EqnEnv, name: str, C: Value = 1e-9, initial_pressure: Value | None = None, rho: Value = DENSITY
    ):
        super().__init__(ev, name)
        compliance = self.parameter("C", C, unit="m3/Pa", bounds=POSITIVE)
        start = start_of(self, "initial_pressure", initial_pressure, "Pa", ATMOSPHERE)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        fluid = self.port("fluid", Hydraulic)
        # In bar. By default tolerances would be in pascals, five decades tighter than anyone asks for.
        p = self.variable("p", nominal=1e5, **start)
        self.add_equations(Eq(p, fluid.p), Eq(density * compliance * der(p), fluid.m_flow))
        self.declare_energy(compliance * p**2 / 2)


class Accumulator(Component):
    """Fluid that compresses a charge of gas: rho·d(V_fluid)/dt = fluid.m_flow, V_gas = V0 − V_fluid,
    fluid.p·V_gas^n = p0·V0^n.

    The volume `V0` > 0 (m³) is that of the empty accumulator, filled with gas at the pressure `p0` > 0 (pascal,
    absolute); `n` > 0 is 1 for an isothermal gas, and the ratio of its specific heats for one without heat exchange.
    A given `initial_volume` (m³) of fluid holds at the start; otherwise 0 is a guess. An empty accumulator is not
    recognised: the pressure falls below `p0`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        V0: Value = 1e-3,
        p0: Value = 1e6,
        n: Value = 1.0,
        initial_volume: Value | None = None,
        rho: Value = DENSITY,
    ):
        super().__init__(ev, name)
        total = self.parameter("V0", V0, unit="m3", bounds=POSITIVE)
        precharge = self.parameter("p0", p0, unit="Pa", bounds=POSITIVE)
        exponent = self.parameter("n", n, unit="1", bounds=POSITIVE)
        start = start_of(self, "initial_volume", initial_volume, "m3")
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        fluid = self.port("fluid", Hydraulic)
        volume = self.variable("V_fluid", nominal=1e-3, **start)
        # Bounded, so that the search for a start takes no negative volume to a power.
        gas = self.variable("V_gas", nominal=1e-3, unit="m3", bounds=POSITIVE)
        self.add_equations(
            Eq(density * der(volume), fluid.m_flow),
            Eq(gas, total - volume),
            Eq(fluid.p, precharge * (total / gas) ** exponent),
        )
        self.declare_energy(precharge * total * _work_of_compression(total / gas, exponent))


def _work_of_compression(ratio: sympy.Expr, n: sympy.Expr) -> sympy.Expr:
    """(ratio^(n − 1) − 1)/(n − 1), the work on a gas in units of p0·V0; near n = 1 by its series in n − 1."""
    above, log = n - 1, sympy.log(ratio)
    near = sympy.Abs(above) < 1e-5  # beyond, cancellation costs less than the series would
    series = log * (1 + above * log / 2)
    return sympy.Piecewise((series, near), ((ratio**above - 1) / above, True))


class _TwoPort(Component):
    """Two ports and one mass flow: dp = port_a.p − port_b.p, m_flow = port_a.m_flow = −port_b.m_flow."""

    def _two_ports(self, m_flow: dict | None = None) -> tuple[sympy.Symbol, sympy.Symbol]:
        a, b = self.port("port_a", Hydraulic), self.port("port_b", Hydraulic)
        dp = self.variable("dp", nominal=1e5, unit="Pa")
        flow = self.variable("m_flow", **(m_flow or {"unit": "kg/s"}))
        self.add_equations(Eq(dp, a.p - b.p), Eq(a.m_flow, flow), Eq(a.m_flow + b.m_flow, 0))
        return dp, flow


# The root itself has an infinite slope at zero, where a flow that turns would stop Newton's method and the step
# control.
def _regularised_root(x: sympy.Expr, small: sympy.Expr) -> sympy.Expr:
    """x/(x² + small²)^(1/4): sign(x)·√|x| where |x| ≫ small, and x/√small, with a finite slope, where |x| ≪ small.

    The relative deviation from the root is (small/x)²/4 to first order.
    """
    return x / (x**2 + small**2) ** sympy.Rational(1, 4)


class _Restriction(_TwoPort):
    """A sharp-edged orifice."""

    def _through(self, A: Value, Cd: Value, rho: Value, dp_small: Value) -> tuple[sympy.Expr, sympy.Symbol]:
        """(the flow through it where it is open, the flow)."""
        area = self.parameter("A", A, unit="m2", bounds=NONNEGATIVE)
        discharge = self.parameter("Cd", Cd, unit="1", bounds=POSITIVE)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        small = self.parameter("dp_small", dp_small, unit="Pa", bounds=POSITIVE)
        dp, flow = self._two_ports()
        self.declare_dissipation(dp * flow / density)
        return area * discharge * sympy.sqrt(2 * density) * _regularised_root(dp, small), flow


class Orifice(_Restriction):
    """m_flow = A·Cd·√(2·rho)·dp/(dp² + dp_small²)^(1/4), which is A·Cd·√(2·rho·dp) where dp ≫ dp_small.

    The area `A` ≥ 0 in square metre, the discharge coefficient `Cd` > 0, `rho` > 0 in kg/m³ and `dp_small` > 0 in
    pascal, below which the flow is proportional to dp. Source: Merritt (1967), the chapter on fluid flow fundamentals.
    """

    def __init__(
        self, ev: EqnEnv, name: str, A: Value = 1e-4, Cd: Value = 0.6, rho: Value = DENSITY, dp_small: Value = 100.0
    ):
        super().__init__(ev, name)
        opening = self._opening()
        through, flow = self._through(A, Cd, rho, dp_small)
        self.add_equations(Eq(flow, opening * through))

    def _opening(self) -> Value:
        """The open part of the area."""
        return 1


class Valve(Orifice):
    """An `Orifice` whose area is `opening`·`A`: m_flow = opening·A·Cd·√(2·rho)·dp/(dp² + dp_small²)^(1/4).

    The input `opening` is 1 (open) unless `simulate` or a connected signal gives it; 0 is closed, and values outside
    [0, 1] are not cut off.
    """

    def _opening(self) -> Value:
        return self.input("opening", default=1.0, unit="1")


class CheckValve(_TwoPort):
    """A valve that lets fluid pass from `port_a` to `port_b` only: two straight branches, as an ideal diode has.

    While it is open, dp = p_crack + R·m_flow with m_flow ≥ 0; while it is shut, m_flow = 0 with dp ≤ p_crack. The
    cracking pressure `p_crack` in pascal and the resistance `R` in pascal second per kilogram are ≥ 0; both zero is the
    ideal valve. The discrete variable `active` is 1 while it is open. In series with an `Orifice`, flow is turbulent.

    In series with an `Inertance` the flow is a state, which a shut valve holds at zero: write `inertial=True`. The
    discrete variable is then `shut`, 0 at the start.
    """

    def __init__(
        self, ev: EqnEnv, name: str, p_crack: Value = 0.0, R: Value = 0.0, rho: Value = DENSITY, inertial: bool = False
    ):
        super().__init__(ev, name)
        crack = self.parameter("p_crack", p_crack, unit="Pa", bounds=NONNEGATIVE)
        resistance = self.parameter("R", R, unit="Pa*s/kg", bounds=NONNEGATIVE)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        dp, flow = self._two_ports()
        if yes_or_no(inertial, name, "inertial"):
            self.complementary(flow, crack + resistance * flow - dp, "shut", order=1)
        else:
            self.complementary(crack + resistance * flow - dp, flow)
        self.declare_dissipation(dp * flow / density)


class ReliefValve(_Restriction):
    """A valve that opens where dp reaches `p_open`, and shuts where it has fallen to `p_close` < p_open (pascal).

    While it is open, it is an `Orifice` with `A` ≥ 0, `Cd` > 0, `rho` > 0 and `dp_small` > 0; while it is shut,
    m_flow = 0. The discrete variable `opened` is 1 or 0, at the start by dp ≥ p_open.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        p_open: Value = 1e7,
        p_close: Value = 9e6,
        A: Value = 1e-4,
        Cd: Value = 0.6,
        rho: Value = DENSITY,
        dp_small: Value = 100.0,
    ):
        super().__init__(ev, name)
        # Two pressures: with one, the fall of dp as it opens would shut the valve at once.
        upper, lower = self.parameter("p_open", p_open, unit="Pa"), self.parameter("p_close", p_close, unit="Pa")
        in_order(self, "p_close", "p_open")
        through, flow = self._through(A, Cd, rho, dp_small)
        opened = self.discrete("opened", start=0, unit="1")
        self.either(Eq(opened, 1), flow - through, flow)
        dp = self.dp
        self.when(dp >= upper, assign(opened, 1), on=Eq(opened, 0), at_start=True)
        self.when(dp <= lower, assign(opened, 0), on=Eq(opened, 1))


class LaminarPipe(_TwoPort):
    """The law of Hagen and Poiseuille: m_flow = π·D⁴·rho/(128·mu·L)·dp.

    The inner diameter `D` > 0 and the length `L` > 0 in metre, `rho` > 0 in kg/m³, `mu` > 0 in Pa·s. Source: White.
    """

    def __init__(
        self, ev: EqnEnv, name: str, D: Value = 0.01, L: Value = 1.0, rho: Value = DENSITY, mu: Value = VISCOSITY
    ):
        super().__init__(ev, name)
        diameter = self.parameter("D", D, unit="m", bounds=POSITIVE)
        length = self.parameter("L", L, unit="m", bounds=POSITIVE)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        viscosity = self.parameter("mu", mu, unit="Pa*s", bounds=POSITIVE)
        dp, flow = self._two_ports()
        self.add_equations(Eq(flow, sympy.pi * diameter**4 * density / (128 * viscosity * length) * dp))
        self.declare_dissipation(dp * flow / density)


class TurbulentPipe(_TwoPort):
    """The law of Darcy and Weisbach, dp = f·(L/D)·rho·u²/2 with the mean velocity u = m_flow/(rho·A) and A = π·D²/4,
    solved for the flow and regularised: m_flow = A·√(2·rho·D/(f·L))·dp/(dp² + dp_small²)^(1/4).

    The inner diameter `D` > 0 and the length `L` > 0 in metre, the constant friction factor `f` > 0 (Darcy's, four
    times Fanning's), `rho` > 0 in kg/m³ and `dp_small` > 0 in pascal, below which the flow is proportional to dp.
    Source: White.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        D: Value = 0.01,
        L: Value = 1.0,
        f: Value = 0.02,
        rho: Value = DENSITY,
        dp_small: Value = 100.0,
    ):
        super().__init__(ev, name)
        diameter = self.parameter("D", D, unit="m", bounds=POSITIVE)
        length = self.parameter("L", L, unit="m", bounds=POSITIVE)
        friction = self.parameter("f", f, unit="1", bounds=POSITIVE)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        small = self.parameter("dp_small", dp_small, unit="Pa", bounds=POSITIVE)
        dp, flow = self._two_ports()
        area = sympy.pi * diameter**2 / 4
        root = _regularised_root(dp, small)
        self.add_equations(Eq(flow, area * sympy.sqrt(2 * density * diameter / (friction * length)) * root))
        self.declare_dissipation(dp * flow / density)


class Inertance(_TwoPort):
    """The inertia of the fluid in a duct: (L/A)·d(m_flow)/dt = dp, the length `L` > 0 in metre, the cross-section
    `A` > 0 in square metre.

    A given `initial_m_flow` (kg/s) holds at the start; otherwise 0 is a guess. `rho` > 0 in kg/m³ is for the account of
    energy.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        L: Value = 1.0,
        A: Value = 1e-4,
        initial_m_flow: Value | None = None,
        rho: Value = DENSITY,
    ):
        super().__init__(ev, name)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        length = self.parameter("L", L, unit="m", bounds=POSITIVE)
        area = self.parameter("A", A, unit="m2", bounds=POSITIVE)
        dp, flow = self._two_ports(m_flow=start_of(self, "initial_m_flow", initial_m_flow, "kg/s"))
        self.add_equations(Eq(length / area * der(flow), dp))
        self.declare_energy(length / area * flow**2 / (2 * density))


class Pump(_TwoPort):
    """A pump of constant displacement, without leakage and friction: m_flow = rho·D·w with w = d(flange.phi)/dt, and
    flange.tau = −D·dp = D·(port_b.p − port_a.p).

    The displacement `D` in cubic metre per radian, `rho` > 0 in kg/m³. Driven by the fluid, it is a motor: what the
    shaft takes in, flange.tau·w, is what the fluid gains, (port_b.p − port_a.p)·m_flow/rho. Source: Merritt (1967),
    the chapter on pumps and motors.
    """

    def __init__(self, ev: EqnEnv, name: str, D: Value = 1e-6, rho: Value = DENSITY):
        super().__init__(ev, name)
        displacement = self.parameter("D", D, unit="m3/rad")
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        flange = self.port("flange", Rotational)
        phi = self.variable("phi", unit="rad")
        w = self.variable("w", unit="rad/s")
        dp, flow = self._two_ports()
        self.add_equations(
            Eq(phi, flange.phi),
            Eq(w, der(phi)),
            Eq(flow, density * displacement * w),
            Eq(flange.tau, -displacement * dp),
        )


class Cylinder(Component):
    """A piston that the fluid pushes towards larger positions: f = A·(fluid.p − p_ambient) acts on what is connected to
    the flange (flange.f = −f), and fluid.m_flow = rho·A·v with v = d(flange.s)/dt.

    The piston's area `A` > 0 in square metre, `rho` > 0 in kg/m³, `p_ambient` (pascal) acts on the other side. Its ends
    are not stops. Source: Merritt (1967), the chapter on hydraulic power elements.
    """

    def __init__(self, ev: EqnEnv, name: str, A: Value = 1e-3, rho: Value = DENSITY, p_ambient: Value = ATMOSPHERE):
        super().__init__(ev, name)
        area = self.parameter("A", A, unit="m2", bounds=POSITIVE)
        density = self.parameter("rho", rho, unit="kg/m3", bounds=POSITIVE)
        ambient = self.parameter("p_ambient", p_ambient, unit="Pa")
        fluid, flange = self.port("fluid", Hydraulic), self.port("flange", Translational)
        s = self.variable("s", unit="m")
        v = self.variable("v", unit="m/s")
        f = self.variable("f", unit="N")
        self.add_equations(
            Eq(s, flange.s),
            Eq(v, der(s)),
            Eq(fluid.m_flow, density * area * v),
            Eq(f, area * (fluid.p - ambient)),
            Eq(flange.f, -f),
        )
        self.declare_energy(ambient * area * s)  # the work against what acts on the other side


class PressureSensor(Component):
    """The pressure at a port as the output `p` (pascal); nothing flows into it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        fluid = self.port("fluid", Hydraulic)
        self.output("p", fluid.p, unit="Pa")
        self.add_equations(Eq(fluid.m_flow, 0))


class FlowSensor(Component):
    """The mass flow from `port_a` to `port_b` as the output `m_flow` (kg/s); no pressure is lost in it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        a, b = self.port("port_a", Hydraulic), self.port("port_b", Hydraulic)
        self.output("m_flow", a.m_flow, unit="kg/s")
        self.add_equations(Eq(a.p, b.p), Eq(a.m_flow + b.m_flow, 0))
