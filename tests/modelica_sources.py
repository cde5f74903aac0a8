"""Small models in Modelica, with what their runs must give by closed forms.

`tests/data/rumoca` holds the equations that rumoca 0.10.2 makes of them. `python tests/modelica_sources.py` writes
these files anew; it needs rumoca.
"""

import json
import pathlib
from typing import Any

FOLDER = pathlib.Path(__file__).parent / "data" / "rumoca"

CIRCUITS = """
package Circuits
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;
  partial model TwoPin
    Pin p, n;
    Real v(unit = "V"), i(unit = "A");
  equation
    v = p.v - n.v;
    i = p.i;
    p.i + n.i = 0;
  end TwoPin;
  model Resistor
    extends TwoPin;
    parameter Real R(unit = "Ohm", min = 0) = 1;
  equation
    v = R*i;
  end Resistor;
  model Capacitor
    extends TwoPin;
    parameter Real C(unit = "F") = 1;
  equation
    C*der(v) = i;
  end Capacitor;
  model Inductor
    extends TwoPin;
    parameter Real L(unit = "H") = 1;
  equation
    L*der(i) = v;
  end Inductor;
  model Step
    extends TwoPin;
    parameter Real V = 1, T = 0;
  equation
    v = if time < T then 0 else V;
  end Step;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
  connector Flange
    Real phi;
    flow Real tau;
  end Flange;
  model Inertia
    Flange a;
    parameter Real J = 1;
    Real w(start = 0, fixed = true);
  equation
    w = der(a.phi);
    J*der(w) = a.tau;
  end Inertia;
  model Emf
    extends TwoPin;
    parameter Real k = 1;
    Flange a;
  equation
    v = k*der(a.phi);
    a.tau = -k*i;
  end Emf;
  model RC
    parameter Real scale = 2;
    Resistor r(R = 0.5*scale);
    Capacitor c(C = 0.3, v(start = 0.1, fixed = true));
    Step s(V = 5, T = 0.5);
    Ground g;
  equation
    connect(s.p, r.p);
    connect(r.n, c.p);
    connect(c.n, s.n);
    connect(s.n, g.p);
    annotation(experiment(StopTime = 2.0, Tolerance = 1e-8));
  end RC;
  model Motor
    Step s(V = 10);
    Resistor r(R = 0.5);
    Inductor l(L = 0.1, i(start = 0, fixed = true));
    Emf e(k = 0.2);
    Inertia j(J = 0.02, a(phi(start = 0, fixed = true)));
    Ground g;
  equation
    connect(s.p, r.p);
    connect(r.n, l.p);
    connect(l.n, e.p);
    connect(e.n, s.n);
    connect(s.n, g.p);
    connect(e.a, j.a);
    annotation(experiment(StopTime = 1.0));
  end Motor;
end Circuits;
"""
PENDULUM = """
model Pendulum "a pendulum in Cartesian coordinates: index three"
  parameter Real L = 1.2, m = 0.5, g = 9.81;
  Real x(start = 0.72, fixed = true), y(start = -0.96);
  Real vx(start = 0, fixed = true), vy, F(start = 1);
equation
  der(x) = vx;
  der(y) = vy;
  m*der(vx) = -F*x;
  m*der(vy) = -F*y - m*g;
  x^2 + y^2 = L^2;
  annotation(experiment(StopTime = 2.0));
end Pendulum;
"""
BALL = """
model Ball
  parameter Real e = 0.8 "coefficient of restitution";
  parameter Real g(unit = "m/s2") = 9.81;
  Real h(start = 1.0, fixed = true, unit = "m");
  Real v(start = 0.0, fixed = true);
  Integer n(start = 0, fixed = true);
equation
  der(h) = v;
  der(v) = -g;
  when h <= 0.0 then
    reinit(v, -e*pre(v));
    n = pre(n) + 1;
  end when;
  annotation(experiment(StopTime = 3.0));
end Ball;
"""
CLUTCH = """
model Clutch "two discs that slide until they turn as one"
  parameter Real J1 = 1, J2 = 2, tau = 3, grip = 4;
  Real w1(start = 10, fixed = true), w2(start = 0, fixed = true), friction;
  Boolean locked(start = false, fixed = true);
equation
  J1*der(w1) = tau - friction;
  J2*der(w2) = friction;
  locked = pre(locked) or w1 - w2 <= 0;
  if locked then
    friction = J2*tau/(J1 + J2);
  else
    friction = grip;
  end if;
  annotation(experiment(StopTime = 8.0));
end Clutch;
"""
THERMOSTAT = """
model Thermostat
  parameter Real low = 19, high = 21, loss = 0.1, power = 2.5, outside = 5;
  Real T(start = 20, fixed = true);
  Boolean on(start = true, fixed = true);
  Integer switches(start = 0, fixed = true);
equation
  der(T) = -loss*(T - outside) + (if on then power else 0);
  on = T < low or (pre(on) and T < high);
  when change(on) then
    switches = pre(switches) + 1;
  end when;
  annotation(experiment(StopTime = 10.0));
end Thermostat;
"""
TANK = """
function outflow "after Torricelli"
  input Real h;
  input Real area;
  output Real q;
protected
  Real speed;
algorithm
  speed := sqrt(2*9.81*max(h, 0));
  q := area*speed;
end outflow;
model Tank
  parameter Real A = 1, hole = 0.05;
  Real h(start = 2, fixed = true);
equation
  A*der(h) = -outflow(h, hole);
  when terminal() or h < 0.5 then
    terminate("nearly empty");
  end when;
  annotation(experiment(StopTime = 30.0));
end Tank;
"""
ROD = """
model Rod "heat along a rod, by arrays and for"
  constant Integer n = 4;
  parameter Real k[n - 1] = {1.0, 2.0, 3.0};
  parameter Real M[2, 2] = [0, 1; -4, -0.5];
  parameter Real left = 3;
  Real T[n](start = {3, 0, 0, 1}, each fixed = true);
  Real q[n - 1], total;
  Real z[2](start = {1, 0}, each fixed = true);
equation
  for i in 1:n - 1 loop
    q[i] = k[i]*(T[i] - T[i + 1]);
  end for;
  der(T[1]) = left - T[1] - q[1];
  for i in 2:n - 1 loop
    der(T[i]) = q[i - 1] - q[i];
  end for;
  der(T[n]) = q[n - 1];
  total = sum(T[i] for i in 1:n);
  der(z) = M*z;
  annotation(experiment(StopTime = 1.0));
end Rod;
"""
POLYNOMIAL = """
function horner "a polynomial and its derivative"
  input Real x;
  input Real c[:];
  output Real y;
  output Real dy;
algorithm
  y := 0;
  dy := 0;
  for i in 1:size(c, 1) loop
    dy := dy*x + y;
    y := y*x + c[i];
  end for;
end horner;
function clipped
  input Real x;
  output Real y;
protected
  Real t, u;
algorithm
  t := mod(x, 2);
  u := 1;
  if x > 3 then
    t := t + 1;
    u := t;
  elseif x > 1 then
    t := 2*t;
  end if;
  y := t + 10*u;
end clipped;
model Polynomial
  parameter Real c[3] = {1, 2, 3};
  Real x(start = 0, fixed = true), y, dy, s;
equation
  der(x) = 1;
  (y, dy) = horner(x, c);
  s = clipped(x);
  annotation(experiment(StopTime = 4.0));
end Polynomial;
"""
SPRING = """
model Spring "a spring with play, written by an if"
  parameter Real c = 9, play = 0.5;
  Real s(start = 1, fixed = true), v(start = 0, fixed = true), f;
equation
  der(s) = v;
  der(v) = -f;
  if s > play then
    f = c*(s - play);
  elseif s < -play then
    f = c*(s + play);
  else
    f = 0;
  end if;
  annotation(experiment(StopTime = 3.0));
end Spring;
"""
SAMPLED = """
model Sampled "a controller with a clock, and whens with further branches"
  parameter Real gain = 0.5;
  Real x(start = 0, fixed = true);
  discrete Real u(start = 0, fixed = true), peak(start = 0, fixed = true);
  Integer phase(start = 0, fixed = true), ticks(start = 0, fixed = true);
  Boolean late;
equation
  der(x) = u;
  when sample(0, 0.25) then
    u = gain*(1 - x) + pre(u);
    peak = if u > pre(peak) then u else pre(peak);
  end when;
  late = time > 1.1;
  when initial() then
    phase = 1;
  elsewhen x > 0.3 then
    phase = 2;
  elsewhen {time > 0.7, late} then
    phase = pre(phase) + 10;
  end when;
algorithm
  when sample(0.1, 0.5) then
    ticks := pre(ticks) + 1;
    if ticks > 2 then
      ticks := 0;
    end if;
  end when;
  annotation(experiment(StopTime = 2.0));
end Sampled;
"""

SOURCES = {
    "Circuits.RC": CIRCUITS, "Circuits.Motor": CIRCUITS, "Pendulum": PENDULUM, "Ball": BALL, "Clutch": CLUTCH,
    "Thermostat": THERMOSTAT, "Tank": TANK, "Rod": ROD, "Polynomial": POLYNOMIAL, "Spring": SPRING,
    "Sampled": SAMPLED,
}  # fmt: skip
LEFT_OUT = {
    "span", "component_ref", "value_type_provenance", "flat_type_ids", "declaration", "provenance",
    "begin_provenance", "finish_provenance", "source_map",
}  # fmt: skip


def stored(model: str) -> dict[str, Any]:
    """The equations that rumoca makes of a model, without places in the source."""
    return json.loads((FOLDER / f"{model}.json").read_text())


def without_places(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: without_places(v) for k, v in value.items() if k not in LEFT_OUT and v is not None}
    return [without_places(v) for v in value] if isinstance(value, list) else value


def main() -> None:
    import rumoca

    FOLDER.mkdir(parents=True, exist_ok=True)
    for model, source in SOURCES.items():
        dae = rumoca.Session().loads(source, model=model).to_dict("dae")
        (FOLDER / f"{model}.json").write_text(json.dumps(without_places(dae), separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()
