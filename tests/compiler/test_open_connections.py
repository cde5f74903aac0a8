"""What connections become where a Modelica class is opened: those of discrete connectors, and those that stay open."""

import functools

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.library.signal import Constant, Gain
from jaxonomy_dae.modelica import Library, component
from jaxonomy_dae.modelica.boolean_connections import with_single_connections
from jaxonomy_dae.modelica.sources import Sources


def test_connections_of_discrete_connectors_are_equations(tmp_path):
    source = """package Bank
  type Level = enumeration(low, high);
  connector Signal = input Boolean;
  connector LevelIn = input Level;
  connector LevelOut = output Level;
  model Switch
    Signal on;
  end Switch;
  model Gate
    LevelIn x;
    LevelOut y;
  end Gate;
  model Group
    Signal on[2];
  end Group;
  model Switches
    parameter Integer m = 3;
    Signal on[m];
    Switch switch[m];
    Group group, other;
    LevelOut level;
    Gate first, second, third if m > 2;
  equation
    connect(first.y, second.x);
    connect(level, second.y);
    connect(first.y, third.x);
    connect(on, switch.on);
    connect(on[1], switch[1].on);
    connect(group.on, other.on);
  end Switches;
end Bank;
"""
    (tmp_path / "Bank.mo").write_text(source)
    new = with_single_connections(Sources([tmp_path]), source)
    changes = {
        "connect(on, switch.on)": "for k__ in 1:m loop switch[k__].on = on[k__]; end for",
        "connect(on[1], switch[1].on)": "switch[1].on = on[1]",
        # Nothing says here which of two inputs of parts is given.
        "connect(group.on, other.on)": "for k__ in 1:size(group.on, 1) loop connect(group.on[k__], other.on[k__]); "
        "end for",
        "connect(first.y, second.x)": "second.x = first.y",
        "connect(level, second.y)": "level = second.y",
    }
    expected = functools.reduce(lambda text, change: text.replace(*change), changes.items(), source)
    assert new == expected


def test_inputs_of_components_are_equal_to_those_of_their_class(tmp_path):
    """A flip-flop, which opens; what may be absent stays a connection."""
    source = """package Logic
  connector In = input Boolean;
  connector Out = output Boolean;
  block Nor
    In a, b;
    Out y;
  equation
    y = not (a or b);
  end Nor;
  block Pre
    In u;
    Out y;
  equation
    y = pre(u);
  end Pre;
  block Keeps
    parameter Boolean more = false;
    In s, r;
    In t if more;
    Out q;
    Nor first, second;
    Nor third if more;
    Pre late;
  equation
    connect(s, first.a);
    connect(second.b, r);
    connect(t, third.a);
    connect(r, third.b);
    connect(second.y, first.b);
    connect(first.y, late.u);
    connect(late.y, second.a);
    connect(second.y, q);
  end Keeps;
end Logic;
"""
    (tmp_path / "Logic.mo").write_text(source)
    new = with_single_connections(Sources([tmp_path]), source)
    made = {
        "connect(s, first.a)": "first.a = s", "connect(second.b, r)": "second.b = r",
        "connect(second.y, first.b)": "first.b = second.y", "connect(first.y, late.u)": "late.u = first.y",
        "connect(late.y, second.a)": "second.a = late.y", "connect(second.y, q)": "q = second.y",
    }  # fmt: skip
    assert new == functools.reduce(lambda text, change: text.replace(*change), made.items(), source)
    assert Library(tmp_path)["Logic.Keeps"].opened.inputs == ("s", "r")


def test_open_connectors_count_as_connected(tmp_path):
    """Alone, a line force found its flanges loose: no force acted."""
    text = """package Lines
  connector Flange
    Real s;
    flow Real f;
  end Flange;
  partial model Two
    Flange a, b;
  equation
    assert(cardinality(b) > 0, "loose");
  end Two;
  model Line
    extends Two;
    Real force;
  equation
    a.s = 0;
    b.s = 2;
    if cardinality(a) > 0 then
      force = a.f;
    else
      force = 0;
    end if;
  end Line;
end Lines;
"""
    (tmp_path / "Lines.mo").write_text(text)
    line = Library(tmp_path)["Lines.Line"](EqnEnv(), "line")
    assert "-a.f + force" in map(str, line.equations)


def test_outputs_that_are_held_between_events_drive_inputs():
    """They were no variables, and nothing could be connected to them."""
    text = """connector RealInput = input Real;
connector BooleanOutput = output Boolean;
block Relay
  RealInput u;
  BooleanOutput y;
equation
  y = not pre(y) and u > 1 or pre(y) and u >= 0;
end Relay;
"""
    ev, d = EqnEnv(), AcausalDiagram()
    relay, level, gain = component("Relay", source=text)(ev, "relay"), Constant(ev, "level", 2.0), Gain(ev, "gain", 3.0)
    d.add(relay, level, gain)
    d.connect(level.y, relay.u)
    d.connect(relay, "y", gain, "u")
    system = AcausalCompiler(ev, d)()
    assert system.plan.resolve(["gain.u"])[0] == system.plan.resolve(["relay.y"])[0]
