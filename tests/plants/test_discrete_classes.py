"""Modelica classes with event semantics that the front end does not read as they are written: inputs whose values
before an event are read, algorithms, connections of enumerations, clocks. References by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, keep_programs, simulate
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.host import kept
from jaxonomy_dae.library.signal import Constant, FirstOrder, Step, Sum
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow

SOURCE = """within ;
package Marks
  type Level = enumeration('U', 'X', '0', '1');
  connector BooleanInput = input Boolean;
  connector BooleanOutput = output Boolean;
  connector RealInput = input Real;
  connector RealOutput = output Real;
  connector IntegerOutput = output Integer;
  connector LevelInput = input Level;
  connector LevelOutput = output Level;
  connector ClockInput = input Clock;

  block Edges "Counts edges of its input, which are none at the start if u was what it is"
    BooleanInput u;
    Integer rises(start = 0, fixed = true), changes(start = 0, fixed = true);
    BooleanOutput before;
    parameter Boolean pre_u_start = false;
  initial equation
    pre(u) = pre_u_start;
  equation
    when edge(u) then
      rises = pre(rises) + 1;
    end when;
    when {initial(), change(u)} then
      changes = if initial() then (if u <> pre(u) then 10 else 0) else pre(changes) + 1;
    end when;
    before = pre(u);
  end Edges;

  block Inertia "A level that lasts for the delay passes"
    LevelInput x;
    LevelOutput y;
    parameter Real delay = 0.1;
  protected
    Level held(start = Level.'0', fixed = true);
    Level old(start = Level.'U', fixed = true);
    discrete Real next(start = 1e9, fixed = true);
    Integer kind;
  algorithm
    when {initial(), change(x)} then
      old := pre(held);
      kind := if old == x then 0 else 1;
      next := time + delay;
      if kind == 0 or delay <= 0 then
        held := x;
      end if;
    elsewhen time >= next then
      held := x;
    end when;
    y := if delay > 0 then held else x;
  end Inertia;

  block Inertias "A register: a loop that is left, behind delays in an array"
    parameter Integer n = 3;
    LevelInput x[n];
    LevelOutput y[n];
    Inertia inertia[n](each delay = 0.2);
    IntegerOutput first;
  protected
    Integer found;
  algorithm
    found := 0;
    for i in 1:n loop
      if y[i] == Level.'1' then
        found := i;
        break;
      end if;
    end for;
    first := found;
  equation
    for i in 1:n loop
      connect(x[i], inertia[i].x);
    end for;
    connect(inertia.y, y);
  end Inertias;

  block PI "Clocked"
    RealInput u;
    RealOutput y;
    parameter Real k = 2, T = 0.5;
  protected
    Real x(start = 0.25, fixed = true);
  equation
    when Clock() then
      x = previous(x) + u * interval(u) / T;
      y = k * (x + u);
    end when;
  end PI;

  block Sample "Its input is continuous"
    RealInput u;
    RealOutput y;
  equation
    y = sample(u);
  end Sample;

  block SampleTruth
    BooleanInput u;
    BooleanOutput y;
  equation
    y = sample(u);
  end SampleTruth;

  block Delay "By one tick"
    RealInput u;
    RealOutput y(start = -1, fixed = true);
  protected
    Boolean ticks = sample(0, 0.25);
  equation
    when ticks then
      y = pre(u);
    end when;
  end Delay;

  block HoldTruth
    BooleanInput u;
    BooleanOutput y;
  equation
    y = hold(u);
  end HoldTruth;

  block SampleByClock
    RealInput u;
    ClockInput clock;
    RealOutput y;
  equation
    y = sample(u, clock);
  end SampleByClock;

  block Ticks "Without inputs"
    RealOutput y;
  protected
    Integer n(start = 0, fixed = true);
  equation
    when Clock() then
      n = previous(n) + 1;
      y = n;
    end when;
  end Ticks;

  model Loop "A hold and a sample in a circle, and a step at a tick: samples are what was before it"
    RealOutput count, late;
  protected
    Clock c = Clock(0.25);
    Real held(start = 5), sampled, step, stepped;
    Boolean on(start = false, fixed = true);
  equation
    count = hold(held);
    held = sampled + 1;
    sampled = sample(count, c);
    when time >= 0.5 then
      on = true;
    end when;
    step = if on then 1 else 0;
    stepped = sample(step, c);
    late = hold(stepped);
  end Loop;
end Marks;
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    before = list(kept._CHOSEN)
    keep_programs(None)
    folder = tmp_path_factory.mktemp("marks") / "Marks"
    folder.mkdir()
    (folder / "package.mo").write_text(SOURCE)
    yield Library(folder.parent)
    kept._CHOSEN[:] = before


def test_inputs_before_events(library):
    """A step at 0.3; the input is true from the start for the second and third block, for which pre(u) is true and
    false at the start: an edge at the initial time counts for `change` beside initial(), not for a `when` alone."""
    ev, d = EqnEnv(), AcausalDiagram()
    step, always = Step(ev, "step", start_time=0.3), Constant(ev, "always", 1.0)
    rises = library["Marks.Edges"](ev, "rises")
    was = library.component("Marks.Edges", pre_u_start=True)(ev, "was")
    was_not = library["Marks.Edges"](ev, "was_not")
    d.add(step, always, rises, was, was_not)
    d.connect(step.y, rises.u)
    d.connect(always.y, was.u, was_not.u)
    s = simulate(AcausalCompiler(ev, d)(), 1.0, ts=jnp.array([0.0, 0.2, 0.4, 1.0]))
    assert s["rises.rises"].tolist() == [0, 0, 1, 1]
    assert s["rises.changes"].tolist() == [0, 0, 1, 1]
    assert s["rises.before"].tolist() == [0, 0, 1, 1]
    assert s["was.changes"].tolist() == [0, 0, 0, 0]
    assert s["was_not.changes"].tolist() == [10, 10, 10, 10]
    assert s["was_not.rises"].tolist() == [0, 0, 0, 0]
    assert s["was_not.before"].tolist() == [1, 1, 1, 1]


def test_algorithms_and_enumerations(library):
    """Levels from 0 to 1 at 0.1 and back at 0.2, and to 1 for good at 0.5: with a delay of 0.2, y follows at 0.7. The
    second entry follows from the start, the third never."""
    ev, d = EqnEnv(), AcausalDiagram()
    steps = [Step(ev, f"at{k}", start_time=t, height=h) for k, (t, h) in enumerate(((0.1, 1), (0.2, -1), (0.5, 1)))]
    pulse = Sum(ev, "pulse", [1.0] * 4)
    three, four = Constant(ev, "three", 3.0), Constant(ev, "four", 4.0)
    x = library["Marks.Inertias"](ev, "x")
    d.add(*steps, pulse, three, four, x)
    for k, part in enumerate((*steps, three), 1):
        d.connect(part.y, pulse[f"u{k}"])
    d.connect(pulse.y, x["x[1]"])
    d.connect(four.y, x["x[2]"])
    d.connect(three.y, x["x[3]"])
    s = simulate(AcausalCompiler(ev, d)(), 1.0, ts=jnp.array([0.1, 0.15, 0.25, 0.45, 0.6, 0.69, 0.71, 1.0]))
    assert s["x.y[1]"].tolist() == [3, 3, 3, 3, 3, 3, 4, 4]
    assert s["x.y[2]"].tolist() == [3, 3, 4, 4, 4, 4, 4, 4]
    assert s["x.y[3]"].tolist() == [3] * 8
    assert s["x.first"].tolist() == [0, 0, 2, 2, 2, 2, 1, 1]


def test_a_clocked_controller(library):
    """A PI controller with a clock of 0.1 s around our first-order lag, whose steps have a closed form."""
    ev, d = EqnEnv(), AcausalDiagram()
    pi = library.component("Marks.PI", clock=0.1)(ev, "pi")
    lag, goal, gap = FirstOrder(ev, "lag", T=0.4), Constant(ev, "goal", 1.0), Sum(ev, "gap", (1, -1))
    d.add(pi, lag, goal, gap)
    d.connect(goal.y, gap["u1"])
    d.connect(lag.y, gap["u2"])
    d.connect(gap.y, pi.u)
    d.connect(pi.y, lag.u)
    system = AcausalCompiler(ev, d)()
    ts = jnp.arange(1.0, 9.0) * 0.1 - 0.01

    def run(values):
        return simulate(system.with_parameters(values), 0.8, ts=ts, rtol=1e-10, atol=1e-12)["lag.y"]

    def by_hand(values):
        k, T, tau = (values[n] for n in ("pi.k", "pi.T", "lag.T"))
        x, v, out = 0.25, 0.0, []
        for _ in range(8):
            u = 1.0 - v
            x = x + u * 0.1 / T
            y = k * (x + u)
            out.append(y + (v - y) * jnp.exp(-0.09 / tau))
            v = y + (v - y) * jnp.exp(-0.1 / tau)
        return jnp.stack(out)

    values = {"pi.k": 1.5, "pi.T": 0.5, "lag.T": 0.4}
    np.testing.assert_allclose(run(values), by_hand(values), rtol=1e-8)
    weights = jnp.linspace(1.0, 2.0, 8)
    slopes, expected = (jax.grad(lambda v, f=f: weights @ f(v))(values) for f in (run, by_hand))
    for name, slope in expected.items():
        np.testing.assert_allclose(slopes[name], slope, rtol=1e-6, err_msg=name)


def test_clocks(library):
    """What has a clock samples before what happens at a tick, and counts its ticks from the initial time."""
    with pytest.raises(ModelError, match=r"'Marks.PI': its surroundings decide when its clock ticks. .*clock=0.1"):
        library["Marks.PI"]
    ev, d = EqnEnv(), AcausalDiagram()
    ticks = library.component("Marks.Ticks", clock=0.25)(ev, "ticks")
    one = library.component("Marks.Sample", clock=0.25)(ev, "one")
    two = library.component("Marks.SampleByClock", clock=0.25)(ev, "two")
    truths = [library.component(f"Marks.{n}Truth", clock=0.25)(ev, n) for n in ("Sample", "Hold")]
    first, second = (library["Marks.Delay"](ev, n) for n in ("first", "second"))
    turn = Step(ev, "turn", start_time=0.4)
    loop, lag, step = library["Marks.Loop"](ev, "loop"), FirstOrder(ev, "lag", T=1.0), Constant(ev, "step", 1.0)
    d.add(ticks, one, two, loop, lag, step, turn, first, second, *truths)
    d.connect(lag.y, first.u)
    d.connect(first.y, second.u)
    d.connect(turn.y, *(t.u for t in truths))
    d.connect(step.y, lag.u)
    d.connect(lag.y, one.u, two.u)
    ts = jnp.array([0.1, 0.3, 0.6, 0.8])
    s = simulate(AcausalCompiler(ev, d)(), 1.0, ts=ts, rtol=1e-9, atol=1e-11)
    assert s["ticks.y"].tolist() == [1, 2, 3, 4]
    for name in ("one.y", "two.y"):
        np.testing.assert_allclose(s[name], 1.0 - np.exp(-np.floor(np.asarray(ts) / 0.25) * 0.25), atol=1e-8)
    before = 1.0 - np.exp(-np.floor(np.asarray(ts) / 0.25) * 0.25)
    np.testing.assert_allclose(s["first.y"], before, atol=1e-8)
    np.testing.assert_allclose(s["second.y"], [-1.0, *before[:-1]], atol=1e-8)
    assert s["Sample.y"].tolist() == s["Hold.y"].tolist() == [0, 0, 1, 1]
    assert s["loop.count"].tolist() == [6, 7, 8, 9]
    assert s["loop.late"].tolist() == [0, 0, 0, 1]
