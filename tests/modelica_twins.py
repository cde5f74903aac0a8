"""The models of `modelica_sources` in Base Modelica, flattened by hand."""


def _model(name: str, body: str, functions: str = "") -> str:
    return f"//! base 0.1.0\npackage '{name}'\n{functions}  model '{name}'\n{body}  end '{name}';\nend '{name}';\n"


_RC = """    parameter Real 'scale' = 2.0;
    parameter Real 'r.R'(unit = "Ohm", min = 0.0) = 0.5 * 'scale';
    parameter Real 'c.C'(unit = "F") = 0.3;
    parameter Real 's.V' = 5.0;
    parameter Real 's.T' = 0.5;
    Real 'r.v'; Real 'r.i'; Real 'c.v'(start = 0.1, fixed = true); Real 'c.i'; Real 's.v'; Real 's.i';
  equation
    'r.v' = 'r.R' * 'r.i';
    'c.C' * der('c.v') = 'c.i';
    's.v' = if time < 's.T' then 0.0 else 's.V';
    's.v' = 'r.v' + 'c.v';
    'r.i' = 'c.i';
    's.i' + 'r.i' = 0.0;
"""
_MOTOR = """    parameter Real 's.V' = 10.0; parameter Real 's.T' = 0.0; parameter Real 'r.R' = 0.5;
    parameter Real 'l.L' = 0.1; parameter Real 'e.k' = 0.2; parameter Real 'j.J' = 0.02;
    Real 's.v'; Real 'r.v'; Real 'l.v'; Real 'l.i'(start = 0.0, fixed = true); Real 'e.v'; Real 'e.a.tau';
    Real 'j.a.phi'(start = 0.0, fixed = true); Real 'j.w'(start = 0.0, fixed = true); Real 'j.a.tau';
  equation
    's.v' = if time < 's.T' then 0.0 else 's.V';
    's.v' = 'r.v' + 'l.v' + 'e.v';
    'r.v' = 'r.R' * 'l.i';
    'l.L' * der('l.i') = 'l.v';
    'e.v' = 'e.k' * der('j.a.phi');
    'e.a.tau' = -'e.k' * 'l.i';
    'e.a.tau' + 'j.a.tau' = 0.0;
    'j.w' = der('j.a.phi');
    'j.J' * der('j.w') = 'j.a.tau';
"""
_PENDULUM = """    parameter Real 'L' = 1.2; parameter Real 'm' = 0.5; parameter Real 'g' = 9.81;
    Real 'x'(start = 0.72, fixed = true); Real 'y'(start = -0.96);
    Real 'vx'(start = 0.0, fixed = true); Real 'vy'; Real 'F'(start = 1.0);
  equation
    der('x') = 'vx';
    der('y') = 'vy';
    'm' * der('vx') = -'F' * 'x';
    'm' * der('vy') = -'F' * 'y' - 'm' * 'g';
    'x' ^ 2 + 'y' ^ 2 = 'L' ^ 2;
"""
_BALL = """    parameter Real 'e' = 0.8; parameter Real 'g' = 9.81;
    Real 'h'(start = 1.0, fixed = true); Real 'v'(start = 0.0, fixed = true); Integer 'n'(start = 0, fixed = true);
  equation
    der('h') = 'v';
    der('v') = -'g';
    when 'h' <= 0.0 then
      reinit('v', -'e' * pre('v'));
      'n' = pre('n') + 1;
    end when;
"""
_CLUTCH = """    parameter Real 'J1' = 1.0; parameter Real 'J2' = 2.0;
    parameter Real 'tau' = 3.0; parameter Real 'grip' = 4.0;
    Real 'w1'(start = 10.0, fixed = true); Real 'w2'(start = 0.0, fixed = true); Real 'friction';
    Boolean 'locked'(start = false, fixed = true);
  equation
    'J1' * der('w1') = 'tau' - 'friction';
    'J2' * der('w2') = 'friction';
    'locked' = pre('locked') or 'w1' - 'w2' <= 0.0;
    'friction' = if 'locked' then 'J2' * 'tau' / ('J1' + 'J2') else 'grip';
"""
_THERMOSTAT = """    parameter Real 'low' = 19.0; parameter Real 'high' = 21.0; parameter Real 'loss' = 0.1;
    parameter Real 'power' = 2.5; parameter Real 'outside' = 5.0;
    Real 'T'(start = 20.0, fixed = true); Boolean 'on'(start = true, fixed = true);
    Integer 'switches'(start = 0, fixed = true);
  equation
    der('T') = -'loss' * ('T' - 'outside') + (if 'on' then 'power' else 0.0);
    'on' = 'T' < 'low' or pre('on') and 'T' < 'high';
    when change('on') then
      'switches' = pre('switches') + 1;
    end when;
"""
_OUTFLOW = """  function 'outflow'
    input Real 'h'; input Real 'area'; output Real 'q';
    Real 'speed';
  algorithm
    'speed' := sqrt(2.0 * 9.81 * max('h', 0.0));
    'q' := 'area' * 'speed';
  end 'outflow';
"""
_TANK = """    parameter Real 'A' = 1.0; parameter Real 'hole' = 0.05;
    Real 'h'(start = 2.0, fixed = true);
  equation
    'A' * der('h') = -'outflow'('h', 'hole');
    when 'h' < 0.5 then
      terminate("nearly empty");
    end when;
"""
_ROD = """    parameter Real 'k[1]' = 1.0; parameter Real 'k[2]' = 2.0; parameter Real 'k[3]' = 3.0;
    parameter Real 'M[1,1]' = 0.0; parameter Real 'M[1,2]' = 1.0;
    parameter Real 'M[2,1]' = -4.0; parameter Real 'M[2,2]' = -0.5;
    parameter Real 'left' = 3.0;
    Real 'T[1]'(start = 3.0, fixed = true); Real 'T[2]'(start = 0.0, fixed = true);
    Real 'T[3]'(start = 0.0, fixed = true); Real 'T[4]'(start = 1.0, fixed = true);
    Real 'q[1]'; Real 'q[2]'; Real 'q[3]'; Real 'total';
    Real 'z[1]'(start = 1.0, fixed = true); Real 'z[2]'(start = 0.0, fixed = true);
  equation
    'q[1]' = 'k[1]' * ('T[1]' - 'T[2]');
    'q[2]' = 'k[2]' * ('T[2]' - 'T[3]');
    'q[3]' = 'k[3]' * ('T[3]' - 'T[4]');
    der('T[1]') = 'left' - 'T[1]' - 'q[1]';
    der('T[2]') = 'q[1]' - 'q[2]';
    der('T[3]') = 'q[2]' - 'q[3]';
    der('T[4]') = 'q[3]';
    'total' = 'T[1]' + 'T[2]' + 'T[3]' + 'T[4]';
    der('z[1]') = 'M[1,1]' * 'z[1]' + 'M[1,2]' * 'z[2]';
    der('z[2]') = 'M[2,1]' * 'z[1]' + 'M[2,2]' * 'z[2]';
"""
_HORNER = """  function 'horner'
    input Real 'x'; input Real 'c'[:]; output Real 'y'; output Real 'dy';
  algorithm
    'y' := 0.0;
    'dy' := 0.0;
    for 'i' in 1:size('c', 1) loop
      'dy' := 'dy' * 'x' + 'y';
      'y' := 'y' * 'x' + 'c'['i'];
    end for;
  end 'horner';
  function 'clipped'
    input Real 'x'; output Real 'y';
    Real 't'; Real 'u';
  algorithm
    't' := mod('x', 2.0);
    'u' := 1.0;
    if 'x' > 3.0 then
      't' := 't' + 1.0;
      'u' := 't';
    elseif 'x' > 1.0 then
      't' := 2.0 * 't';
    end if;
    'y' := 't' + 10.0 * 'u';
  end 'clipped';
"""
_POLYNOMIAL = """    parameter Real 'c[1]' = 1.0; parameter Real 'c[2]' = 2.0; parameter Real 'c[3]' = 3.0;
    Real 'x'(start = 0.0, fixed = true); Real 'y'; Real 'dy'; Real 's';
  equation
    der('x') = 1.0;
    ('y', 'dy') = 'horner'('x', {'c[1]', 'c[2]', 'c[3]'});
    's' = 'clipped'('x');
"""
_SPRING = """    parameter Real 'c' = 9.0; parameter Real 'play' = 0.5;
    Real 's'(start = 1.0, fixed = true); Real 'v'(start = 0.0, fixed = true); Real 'f';
  equation
    der('s') = 'v';
    der('v') = -'f';
    'f' = if 's' > 'play' then 'c' * ('s' - 'play') else if 's' < -'play' then 'c' * ('s' + 'play') else 0.0;
"""
_SAMPLED = """    parameter Real 'gain' = 0.5;
    Real 'x'(start = 0.0, fixed = true);
    discrete Real 'u'(start = 0.0, fixed = true); discrete Real 'peak'(start = 0.0, fixed = true);
    Integer 'phase'(start = 0, fixed = true); Integer 'ticks'(start = 0, fixed = true);
    Boolean 'late';
  equation
    der('x') = 'u';
    when sample(0.0, 0.25) then
      'u' = 'gain' * (1.0 - 'x') + pre('u');
      'peak' = if 'u' > pre('peak') then 'u' else pre('peak');
    end when;
    'late' = time > 1.1;
    when initial() then
      'phase' = 1;
    elsewhen 'x' > 0.3 then
      'phase' = 2;
    elsewhen {time > 0.7, 'late'} then
      'phase' = pre('phase') + 10;
    end when;
    when sample(0.1, 0.5) then
      'ticks' = if pre('ticks') + 1 > 2 then 0 else pre('ticks') + 1;
    end when;
"""

TWINS = {
    "Circuits.RC": _model("RC", _RC),
    "Circuits.Motor": _model("Motor", _MOTOR),
    "Pendulum": _model("Pendulum", _PENDULUM),
    "Ball": _model("Ball", _BALL),
    "Clutch": _model("Clutch", _CLUTCH),
    "Thermostat": _model("Thermostat", _THERMOSTAT),
    "Tank": _model("Tank", _TANK, _OUTFLOW),
    "Rod": _model("Rod", _ROD),
    "Polynomial": _model("Polynomial", _POLYNOMIAL, _HORNER),
    "Spring": _model("Spring", _SPRING),
    "Sampled": _model("Sampled", _SAMPLED),
}
