"""Heat transfer between lumped temperatures.

Conventions: temperature `T` in kelvin, absolute, heat flow `Q_flow` in watt counted positive into the component at a
port. A component with two ports has dT = port_a.T − port_b.T, and `Q_flow` flows from `port_a` to `port_b`.

Source: F. P. Incropera and D. P. DeWitt, Fundamentals of Heat and Mass Transfer (Wiley).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy

from ..base.errors import ModelError
from ..write import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Thermal, Value, der, smooth
from .arguments import row, start_of

STEFAN_BOLTZMANN = 5.670374419e-8  # W/(m²·K⁴), CODATA 2018


class HeatCapacitor(Component):
    """C·dT/dt = heat.Q_flow, `C` > 0 in joule per kelvin.

    A given `initial_temperature` (kelvin) holds at the start; otherwise 293.15 is a guess.
    """

    def __init__(self, ev: EqnEnv, name: str, C: Value = 1.0, initial_temperature: Value | None = None):
        super().__init__(ev, name)
        capacity = self.parameter("C", C, unit="J/K", bounds=POSITIVE)
        heat = self.port("heat", Thermal)
        start = start_of(self, "initial_temperature", initial_temperature, "K", 293.15)
        # Temperatures are absolute: with a nominal value of one, absolute tolerances would be 300 times as tight.
        temperature = self.variable("T", nominal=300.0, **start)
        self.add_equations(Eq(temperature, heat.T), Eq(capacity * der(temperature), heat.Q_flow))
        self.declare_energy(capacity * temperature)


class _TwoPort(Component):
    """Two ports and one heat flow: dT = port_a.T − port_b.T, Q_flow = port_a.Q_flow = −port_b.Q_flow."""

    def _two_ports(self) -> tuple[sympy.Symbol, sympy.Symbol]:
        a, b = self.port("port_a", Thermal), self.port("port_b", Thermal)
        difference = self.variable("dT", unit="K")
        flow = self.variable("Q_flow", unit="W")
        self.add_equations(Eq(difference, a.T - b.T), Eq(a.Q_flow, flow), Eq(a.Q_flow + b.Q_flow, 0))
        return difference, flow


class ThermalConductor(_TwoPort):
    """Q_flow = G·(port_a.T − port_b.T), `G` ≥ 0 in watt per kelvin; `Q_flow` flows from `port_a` to `port_b`."""

    def __init__(self, ev: EqnEnv, name: str, G: Value = 1.0):
        super().__init__(ev, name)
        conductance = self.parameter("G", G, unit="W/K", bounds=NONNEGATIVE)
        difference, flow = self._two_ports()
        self.add_equations(Eq(flow, conductance * difference))


class Convection(_TwoPort):
    """Newton's law of cooling: Q_flow = h·A·(port_a.T − port_b.T), the coefficient of heat transfer `h` ≥ 0 in
    W/(m²·K), the surface `A` ≥ 0 in square metre."""

    def __init__(self, ev: EqnEnv, name: str, h: Value = 10.0, A: Value = 1.0):
        super().__init__(ev, name)
        coefficient = self.parameter("h", h, unit="W/(m2*K)", bounds=NONNEGATIVE)
        area = self.parameter("A", A, unit="m2", bounds=NONNEGATIVE)
        difference, flow = self._two_ports()
        self.add_equations(Eq(flow, coefficient * area * difference))


class Radiation(_TwoPort):
    """The law of Stefan and Boltzmann: Q_flow = eps·sigma·A·(port_a.T⁴ − port_b.T⁴), the surface `A` ≥ 0 in square
    metre.

    The emissivity 0 ≤ `eps` ≤ 1 is that of a small body in large surroundings; for surfaces that face each other, the
    effective one of both, view factor included. The parameter `sigma` is 5.670374419e-8 W/(m²·K⁴).
    """

    def __init__(self, ev: EqnEnv, name: str, eps: Value = 0.9, A: Value = 1.0):
        super().__init__(ev, name)
        emissivity = self.parameter("eps", eps, unit="1", bounds=(0.0, 1.0))
        area = self.parameter("A", A, unit="m2", bounds=NONNEGATIVE)
        # A parameter for its unit's sake, as `check_units` takes plain numbers to have none.
        sigma = self.parameter("sigma", STEFAN_BOLTZMANN, unit="W/(m2*K4)", bounds=POSITIVE)
        _, flow = self._two_ports()
        # Continued below zero so that it still rises there: the search for a start finds no negative temperatures.
        a, b = (T**3 * smooth(sympy.Abs(T)) for T in (self.port_a.T, self.port_b.T))
        self.add_equations(Eq(flow, emissivity * sigma * area * (a - b)))


class Wall(Component):
    """A wall of n layers, from `port_a` to `port_b`: each has a resistance, and its capacity in the middle of it.

    C_k·d(T_k)/dt = Q_(k−1) − Q_k with Q_k = (T_k − T_(k+1))/(R_k/2 + R_(k+1)/2), and Q_0 = (port_a.T − T_1)/(R_1/2),
    Q_n = (T_n − port_b.T)/(R_n/2). T_1 is `capacitor1.T`, Q_0 is `conductor0.Q_flow`, and so on: capacities and
    conductances are children.

    **Arguments:**

    - `R`: the layers' resistances in kelvin per watt, each > 0: thickness/(conductivity·area). They are the parameters
        `R1`, `R2`, …
    - `C`: their capacities in joule per kelvin, each > 0: density·specific heat·thickness·area. `C1`, `C2`, …
    - `initial_temperature` (kelvin): of all layers, or a sequence with that of each; it holds at the start. If left
        out, 293.15 is a guess.

    **Raises:**

    - `ModelError` if the sequences are empty or of different lengths.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        R: Sequence[Value] | np.ndarray = (1.0,),
        C: Sequence[Value] | np.ndarray = (1.0,),
        initial_temperature: Value | Sequence[Value] | np.ndarray | None = None,
    ):
        super().__init__(ev, name)
        R, C = row(R, name, "R"), row(C, name, "C")
        n = len(R)
        given: Any = initial_temperature
        several = bool(np.ndim(given))
        starts = row(given, name, "initial_temperature") if several else [given] * n
        if n == 0 or not n == len(C) == len(starts):
            temperatures = f" and {len(starts)} in initial_temperature" if several else ""
            raise ModelError(
                f"wall '{name}' needs a resistance, a capacity and, if given, a temperature for each layer; got {n} in "
                f"R, {len(C)} in C{temperatures}"
            )
        r = [self.parameter(f"R{k}", value, unit="K/W", bounds=POSITIVE) for k, value in enumerate(R, start=1)]
        c = [self.parameter(f"C{k}", value, unit="J/K", bounds=POSITIVE) for k, value in enumerate(C, start=1)]
        end, to = self.port("port_a", Thermal), self.port("port_b", Thermal)
        halves = [0, *r, 0]
        conductors = [
            self.add(ThermalConductor(ev, f"conductor{k}", 2 / (halves[k] + halves[k + 1]))) for k in range(n + 1)
        ]
        for k in range(n):
            layer = self.add(HeatCapacitor(ev, f"capacitor{k + 1}", c[k], starts[k]))
            self.connect(end, conductors[k].port_a)
            self.connect(conductors[k].port_b, layer.heat)
            end = layer.heat
        self.connect(end, conductors[n].port_a)
        self.connect(conductors[n].port_b, to)


class FixedTemperature(Component):
    """A port held at the parameter `T` (kelvin)."""

    def __init__(self, ev: EqnEnv, name: str, T: Value = 293.15):
        super().__init__(ev, name)
        held = self.parameter("T", T, unit="K")
        heat = self.port("heat", Thermal)
        self.add_equations(Eq(heat.T, held))
        self.declare_supply(-heat.Q_flow)


class TemperatureSource(Component):
    """A port held at a temperature from outside: the input `T` (kelvin), which is 293.15 unless `simulate` is given
    it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        heat = self.port("heat", Thermal)
        held = self.input("T", default=293.15, unit="K")
        self.add_equations(Eq(heat.T, held))
        self.declare_supply(-heat.Q_flow)


class HeatFlowSource(Component):
    """A heat flow out of the port, from outside: the input `Q_flow` (watt), which is 0 unless `simulate` is given
    it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        heat = self.port("heat", Thermal)
        flow = self.input("Q_flow", default=0.0, unit="W")
        self.add_equations(Eq(heat.Q_flow, -flow))
        self.declare_supply(flow)


class TemperatureSensor(Component):
    """The temperature at a port as the output `T` (kelvin); no heat flows into it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        heat = self.port("heat", Thermal)
        self.output("T", heat.T, unit="K")
        self.add_equations(Eq(heat.Q_flow, 0))


class HeatFlowSensor(Component):
    """The heat flow from `port_a` to `port_b` as the output `Q_flow` (watt); both have the same temperature."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        a, b = self.port("port_a", Thermal), self.port("port_b", Thermal)
        self.output("Q_flow", a.Q_flow, unit="W")
        self.add_equations(Eq(a.T, b.T), Eq(a.Q_flow + b.Q_flow, 0))
