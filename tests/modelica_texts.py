"""Flat Modelica models that tests share, written by hand in Base Modelica."""

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.modelica import FlatComponent, load


def built(text: str) -> FlatComponent:
    """The component of a text."""
    return FlatComponent(EqnEnv(), "m", load(text))


BALL = """//! base 0.1.0
package 'Ball'
  model 'Ball' "a ball that bounces"
    parameter Real 'e'(min = 0.0) = 0.8 "coefficient of restitution";
    Real 'h'(fixed = true, start = 1.0, unit = "m");
    Real 'v'(fixed = true, start = 0.0, unit = "m/s");
    Integer 'bounces'(fixed = true, start = 0);
  equation
    der('h') = 'v';
    der('v') = -9.81;
    when 'h' <= 0.0 then
      reinit('v', -'e' * pre('v'));
      'bounces' = pre('bounces') + 1;
    end when;
    annotation(experiment(StopTime = 3.0, Interval = 0.01));
  end 'Ball';
end 'Ball';
"""

# Coulomb friction as the Modelica library writes it: a mode by a discrete equation, in a loop with the acceleration.
# One mass, pushed by a force that rises until it slips; the force and the mass are 1 N/s and 1 kg.
BLOCK = """package 'Block'
  model 'Block'
    parameter Real 'mu'(unit = "N") = 1.0 "sliding friction";
    parameter Real 'peak' = 1.5 "static over sliding friction";
    parameter Real 'v0' = 2.0;
    Real 's'(fixed = true, start = 0.0);
    Real 'v'(fixed = true, start = 'v0');
    Real 'a';
    Real 'f' "friction";
    Real 'sa' "path parameter of the characteristic";
    Boolean 'forward'(fixed = true, start = false) "starts to slide forward";
    Boolean 'backward'(fixed = true, start = false);
    Boolean 'stuck';
    Integer 'mode'(fixed = true, start = 3, min = -1, max = 3);
  equation
    der('s') = 'v';
    der('v') = 'a';
    'a' = (if time < 4.0 then 0.0 else time - 4.0) - 'f';
    'forward' = pre('mode') == 0 and ('sa' > 'peak' * 'mu' or pre('forward') and 'sa' > 'mu')
      or initial() and 'v' > 0.0;
    'backward' = pre('mode') == 0 and ('sa' < -'peak' * 'mu' or pre('backward') and 'sa' < -'mu')
      or initial() and 'v' < 0.0;
    'stuck' = not (pre('mode') == 1 or 'forward' or pre('mode') == -1 or 'backward');
    'a' = if 'stuck' then 0.0 else if 'forward' or pre('mode') == 1 then 'sa' - 'peak' * 'mu' else 'sa' + 'peak' * 'mu';
    'f' = if 'stuck' then 'sa' else if 'forward' or pre('mode') == 1 then 'mu' else -'mu';
    'mode' = if (pre('mode') == 1 or 'forward') and 'v' > 0.0 then 1
      else if (pre('mode') == -1 or 'backward') and 'v' < 0.0 then -1 else 0;
    annotation(experiment(StopTime = 7.0));
  end 'Block';
end 'Block';
"""

# A token that two steps hand to each other after 1 s and after 0.5 s, as the steps of a state graph do: a step gives it
# away and the other one takes it at once, and the time at which a step got it is that of the same instant.
TOKEN = """model 'Token'
  Boolean 'a'(start = true, fixed = true);
  Boolean 'b'(start = false, fixed = true);
  Boolean 'ready';
  Boolean 'leaves a';
  Boolean 'leaves b';
  discrete Real 'ta'(start = 0.0, fixed = true);
  discrete Real 'tb'(start = 0.0, fixed = true);
  Real 'waited';
  Real 'y';
equation
  when pre('a') then
    'ta' = time;
  end when;
  when pre('b') then
    'tb' = time;
  end when;
  'waited' = if pre('b') then time - 'tb' else 0.0;
  'leaves a' = pre('a') and time >= 'ta' + 1.0;
  'leaves b' = pre('b') and 'waited' > 0.5;
  'a' = 'leaves b' or pre('a') and not 'leaves a';
  'b' = 'leaves a' or pre('b') and not 'leaves b';
  'ready' = pre('a');
  'y' = if 'ready' then 1.0 else 0.0;
end 'Token';
"""

# A step with two ways on, of which the first one counts if both are open, as in a state graph. Both open when the step
# is reached, at t = 1, and are passed 1 s later: the first one at t = 2, so that the second one never is.
WAYS = """model 'Ways'
  Boolean 'begin'(start = true, fixed = true);
  Boolean 'here'(start = false, fixed = true);
  Boolean 'first'(start = false, fixed = true);
  Boolean 'second'(start = false, fixed = true);
  Boolean 'open 1';
  Boolean 'open 2';
  Boolean 'pass 1';
  Boolean 'pass 2';
  Boolean 'leaves';
  discrete Real 'since 1'(start = 0.0, fixed = true);
  discrete Real 'since 2'(start = 0.0, fixed = true);
  Real 'y';
equation
  when 'open 1' then
    'since 1' = time;
  end when;
  when 'open 2' then
    'since 2' = time;
  end when;
  'leaves' = pre('begin') and time >= 1.0;
  'open 1' = pre('here');
  'pass 1' = 'open 1' and time >= 'since 1' + 1.0;
  'open 2' = pre('here') and not 'pass 1';
  'pass 2' = 'open 2' and time >= 'since 2' + 1.0;
  'begin' = pre('begin') and not 'leaves';
  'here' = 'leaves' or pre('here') and not ('pass 1' or 'pass 2');
  'first' = 'pass 1' or pre('first');
  'second' = 'pass 2' or pre('second');
  'y' = if 'first' then 1.0 else 0.0;
end 'Ways';
"""

# Functions with loops and branches, arrays, records, enumerations, tables, initial equations, an algorithm.
PIPE = """package 'Heater'
  type 'Shape' = enumeration('Flat', 'Round' "with a comment");
  record 'Pair'
    Real 'a';
    Real 'b';
  end 'Pair';
  function 'polynomial' "by Horner's rule"
    input Real 'c'[:];
    input Real 'x';
    output Real 'y';
  algorithm
    'y' := 'c'[size('c', 1)];
    for 'i' in 1:size('c', 1) - 1 loop
      'y' := 'y' * 'x' + 'c'[size('c', 1) - 'i'];
    end for;
  end 'polynomial';
  function 'limited'
    input Real 'u';
    input Real 'top' = 2.0;
    output Real 'y';
  algorithm
    if 'u' > 'top' then
      'y' := 'top';
    else
      'y' := 'u';
    end if;
  end 'limited';
  class 'Modelica.Blocks.Types.ExternalCombiTable1D'
    extends ExternalObject;
  end 'Modelica.Blocks.Types.ExternalCombiTable1D';
  function 'value'
    input 'Modelica.Blocks.Types.ExternalCombiTable1D' 'table';
    input Integer 'column';
    input Real 'u';
    output Real 'y';
  external "C" 'y' = ModelicaStandardTables_CombiTable1D_getValue('table', 'column', 'u');
  end 'value';
  model 'Heater'
    parameter 'Shape' 'shape' = 'Shape'.'Round';
    constant Integer 'n' = 3;
    parameter Real 'C'(unit = "J/K") = if 'shape' == 'Shape'.'Round' then 2.0 else 1.0;
    parameter Real 'T0'(fixed = false, start = 1.0);
    parameter 'Modelica.Blocks.Types.ExternalCombiTable1D' 'table'
      = 'Modelica.Blocks.Types.ExternalCombiTable1D'(
        "NoName", "NoName", {{0.0, 0.0}, {1.0, 2.0}, {3.0, 3.0}}, {2}, 1, 2);
    Real 'T'(start = 1.0);
    Real 'p';
    Real 'q';
    Real 'r';
    Real 'w[1]';
    Real 'w[2]';
    Real 'loss';
  initial equation
    der('T') = 0.5;
    'T0' = 'T' + 1.0;
  equation
    'C' * der('T') = 'p' - 'T';
    'p' = 'polynomial'({1.0, 0.0, 0.5}, sin(time)) + 2.0;
    'q' = 'limited'('T');
    'r' = 'value'('table', 1, 'T');
    {'w[1]', 'w[2]'} = {{1.0, 2.0}, {0.0, 1.0}} * {'T', 'T0'};
    if 'n' > 2 then
      'loss' = sum('w'[i] for i in 1:2);
    else
      'loss' = 0.0;
    end if;
  end 'Heater';
end 'Heater';
"""
