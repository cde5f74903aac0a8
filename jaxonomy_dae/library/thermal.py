"""Heat conduction between lumped temperatures.

Conventions: temperature `T` in kelvin, heat flow `Q_flow` in watt counted positive into the component at a port.
"""

from ..modeling import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Thermal, Value, der


class HeatCapacitor(Component):
    """C·dT/dt = heat.Q_flow, `C` > 0 in joule per kelvin.

    A given `initial_temperature` (kelvin) holds at the start; otherwise 293.15 is a guess.
    """

    def __init__(self, ev: EqnEnv, name: str, C: Value = 1.0, initial_temperature: Value | None = None):
        super().__init__(ev, name)
        capacity = self.parameter("C", C, unit="J/K", bounds=POSITIVE)
        start = 293.15 if initial_temperature is None else initial_temperature
        t0 = self.parameter("initial_temperature", start, unit="K")
        heat = self.port("heat", Thermal)
        temperature = self.variable("T", start=t0, fixed=initial_temperature is not None, nominal=300.0, unit="K")
        self.add_equations(Eq(temperature, heat.T), Eq(capacity * der(temperature), heat.Q_flow))


class ThermalConductor(Component):
    """Q_flow = G·(port_a.T − port_b.T), `G` ≥ 0 in watt per kelvin; `Q_flow` flows from `port_a` to `port_b`."""

    def __init__(self, ev: EqnEnv, name: str, G: Value = 1.0):
        super().__init__(ev, name)
        conductance = self.parameter("G", G, unit="W/K", bounds=NONNEGATIVE)
        a, b = self.port("port_a", Thermal), self.port("port_b", Thermal)
        difference = self.variable("dT", unit="K")
        flow = self.variable("Q_flow", unit="W")
        self.add_equations(
            Eq(difference, a.T - b.T),
            Eq(flow, conductance * difference),
            Eq(a.Q_flow, flow),
            Eq(a.Q_flow + b.Q_flow, 0),
        )


class FixedTemperature(Component):
    """A port held at the parameter `T` (kelvin)."""

    def __init__(self, ev: EqnEnv, name: str, T: Value = 293.15):
        super().__init__(ev, name)
        held = self.parameter("T", T, unit="K")
        heat = self.port("heat", Thermal)
        self.add_equations(Eq(heat.T, held))
