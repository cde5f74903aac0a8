"""A small library in Modelica, written in the style of the standard one, whose classes tests open as components."""

import os
from pathlib import Path

import pytest

DEVICES = """
package Devices "devices with connectors"
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;
  connector Plug
    parameter Integer m = 3;
    Pin pin[m];
  end Plug;
  connector Flange
    Real phi(unit = "rad");
    flow Real tau(unit = "N.m");
  end Flange;
  connector HeatPort
    Real T(unit = "K");
    flow Real Q_flow(unit = "W");
  end HeatPort;
  connector MagneticPort
    Real V_m(unit = "A");
    flow Real Phi(unit = "Wb");
  end MagneticPort;
  connector FluidPort
    Real p;
    flow Real m_flow;
    stream Real h_outflow;
  end FluidPort;
  connector RealInput = input Real;
  connector RealOutput = output Real;
  connector BooleanInput = input Boolean;
  connector BooleanOutput = output Boolean;
  type Law = enumeration(linear, cubic);
  function power
    input Real x;
    input Integer n;
    output Real y;
  algorithm
    y := 1;
    for k in 1:n loop
      y := y*x;
    end for;
  end power;
  partial model OnePort
    Pin p, n;
    Real v, i;
  equation
    v = p.v - n.v;
    i = p.i;
    p.i + n.i = 0;
  end OnePort;
  model Resistor "resistor with a port for its heat"
    extends OnePort;
    parameter Real R(unit = "Ohm", start = 1);
    parameter Real alpha(unit = "1/K") = 0;
    parameter Boolean useHeatPort = false;
    HeatPort heatPort(T = T_heatPort, Q_flow = -loss) if useHeatPort;
    Real T_heatPort, loss;
  equation
    v = R*(1 + alpha*(T_heatPort - 300))*i;
    loss = v*i;
    if not useHeatPort then
      T_heatPort = 300;
    end if;
  end Resistor;
  model Conductor "a law with a choice"
    extends OnePort;
    parameter Real G = 0.5;
    parameter Law law = Law.linear;
  equation
    i = G*(if law == Law.linear then v else power(v, 3));
  end Conductor;
  model Capacitor
    extends OnePort;
    parameter Real C = 1;
  equation
    C*der(v) = i;
  end Capacitor;
  model Sensor "a potential as a signal; no current"
    Pin p;
    RealOutput y;
  equation
    p.i = 0;
    y = p.v;
  end Sensor;
  model Switch
    extends OnePort;
    parameter Real Ron = 0.01, Goff = 0.001;
    BooleanInput closed;
    BooleanOutput conducts;
  equation
    v = i*(if closed then Ron else 1/Goff);
    conducts = closed;
  end Switch;
  model Source "a voltage by a signal"
    extends OnePort;
    RealInput u;
  equation
    v = u;
  end Source;
  model Inertia
    Flange a;
    parameter Real J = 1;
    Real w;
  equation
    w = der(a.phi);
    J*der(w) = a.tau;
  end Inertia;
  model Brake "friction between bodies, by modes"
    Flange a, b;
    parameter Real tau0 = 1, k = 100;
    parameter Real table[:, 2] = [0, 1; 1, 2];
    Real w, tau;
  equation
    w = der(a.phi) - der(b.phi);
    tau = tau0*tanh(k*w)*table[1, 2];
    a.tau = tau;
    b.tau = -tau;
  end Brake;
  model Load "three phases, of equal resistors"
    parameter Integer m = 3;
    parameter Real R[m] = fill(2, m);
    Plug plug(m = m);
    Pin star;
    Resistor phase[m](R = R);
  equation
    for k in 1:m loop
      connect(plug.pin[k], phase[k].p);
      connect(phase[k].n, star);
    end for;
  end Load;
  model Gap "a reluctance"
    MagneticPort a, b;
    parameter Real Rm = 1e6;
  equation
    a.V_m - b.V_m = Rm*a.Phi;
    a.Phi + b.Phi = 0;
  end Gap;
  model Pipe
    FluidPort a;
  equation
    a.m_flow = a.p;
    a.h_outflow = inStream(a.h_outflow);
  end Pipe;
  model Open "with one equation too few"
    Pin p;
    Real x;
  equation
    p.v = 0;
  end Open;
end Devices;
"""

LIBRARY = "MODELICA_LIBRARY"  # names the folder that holds the folders Modelica and ModelicaServices, version 4.1.0


def written_to(folder: Path) -> Path:
    """The library as a file of the folder."""
    file = folder / "Devices.mo"
    file.write_text(DEVICES)
    return file


def standard_library() -> str:
    """The folder of the Modelica Standard Library; the test is skipped without one."""
    folder = os.environ.get(LIBRARY, "")
    if not (Path(folder) / "Modelica" / "package.mo").exists():
        pytest.skip(f"{LIBRARY} does not name the folder of the Modelica Standard Library")
    return folder
