"""Models in Base Modelica, run and differentiated: references are closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modelica_texts import BALL, BLOCK, PIPE, TOKEN, WAYS

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate
from jaxonomy_dae.modelica import FlatComponent, load
from jaxonomy_dae.modelica.__main__ import main
from jaxonomy_dae.modelica.random_numbers import number


def compiled(text, **options):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(FlatComponent(ev, "m", load(text), **options))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.slow
def test_a_ball_and_its_gradient():
    """h(3) and its derivative by the restitution, from the closed form (h0 = 1, e = 0.8, g = 9.81)."""
    system = compiled(BALL)

    @jax.jit
    @jax.value_and_grad
    def height(e):
        return simulate(system.with_parameters({"m.e": e}), 3.0, ts=jnp.array([3.0]), rtol=1e-10)["m.h"][0]

    value, slope = height(0.8)
    assert value == pytest.approx(0.0687074609657657, abs=1e-9)
    assert slope == pytest.approx(1.16388772098508, abs=1e-7)


@pytest.mark.slow
def test_friction_by_a_discrete_equation():
    """A block slides from 2 m/s until t = 2 s (mu = 1 N, m = 1 kg), sticks, and slips when the force t - 4 has reached
    1.5 N, at t = 5.5 s; then der(v) = t - 4 - 1."""
    system = compiled(BLOCK, outputs=["stuck"])
    ts = jnp.array([0.0, 1.0, 1.9, 2.1, 5.4, 5.6, 7.0])
    solution = simulate(system, 7.0, ts=ts, rtol=1e-9, atol=1e-11)
    slid = np.maximum(ts - 5.5, 0.0)
    v = np.where(ts < 2.0, 2.0 - ts, 0.5 * slid + slid**2 / 2.0)
    s = np.where(ts < 2.0, 2.0 * ts - ts**2 / 2.0, 2.0 + 0.25 * slid**2 + slid**3 / 6.0)
    np.testing.assert_allclose(solution["m.v"], v, atol=1e-8)
    np.testing.assert_allclose(solution["m.s"], s, atol=1e-8)
    assert solution["m.mode"].tolist() == [1, 1, 1, 0, 0, 1, 1]
    assert solution["m.stuck"].tolist() == [0, 0, 0, 1, 1, 0, 0]


@pytest.mark.long("modes that change at once, again and again")
def test_modes_that_hand_on_a_token_change_at_once():
    """One of the two took back what the other did, and a time of arrival was read before the when that assigns it: the
    token got lost, or was handed on at once."""
    system = compiled(TOKEN)
    ts = jnp.array([0.5, 0.99, 1.01, 1.49, 1.51, 2.49, 2.51, 2.99, 3.01, 3.9])
    solution = simulate(system, 4.0, ts=ts)
    np.testing.assert_array_equal(solution["m.a"], [1, 1, 0, 0, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(solution["m.b"], 1 - np.asarray(solution["m.a"]))
    np.testing.assert_array_equal(solution["m.y"], solution["m.a"])
    np.testing.assert_allclose([solution["m.ta"][-1], solution["m.tb"][-1]], [3.0, 2.5], atol=1e-9)


@pytest.mark.slow
def test_a_when_that_rests_on_what_another_one_assigns_at_the_same_instant():
    """Whether the second way is open was judged by the time since which the first one was open before it opened: the
    second one seemed closed, so that its own time was not set, and it was passed at once."""
    solution = simulate(compiled(WAYS), 3.0, ts=jnp.array([0.5, 1.5, 1.99, 2.01, 2.9]))
    assert solution["m.here"].tolist() == [0, 1, 1, 0, 0]
    assert solution["m.first"].tolist() == [0, 0, 0, 1, 1]
    assert solution["m.second"].tolist() == [0, 0, 0, 0, 0]


WHENS = """model 'Whens'
  Real 'x';
  Integer 'high'(fixed = true, start = 0);
  Integer 'low'(fixed = true, start = 0);
  Integer 'first'(fixed = true, start = 0);
equation
  'x' = sin(1.5707963267948966*time);
  when 'x' > 0.8 then
    'high' = pre('high') + 1;
  elsewhen 'x' > 0.3 then
    'low' = pre('low') + 1;
  end when;
  when time > 2 and 'x' < 0 then
    'first' = pre('first') + 1;
  elsewhen time > 3.5 then
    'first' = pre('first') + 10;
  elsewhen 2*time > 7 then
    'first' = pre('first') + 100;
  end when;
end 'Whens';
"""


@pytest.mark.slow
def test_an_elsewhen_acts_when_its_condition_becomes_true():
    """A branch happened when the condition of an earlier branch ended, and did not while that held. Which of them
    *become* true at an instant is asked: the first of these acts."""
    ts = jnp.array([0.1, 0.4, 0.9, 1.7, 3.4, 3.6, 4.4, 4.9])
    solution = simulate(compiled(WHENS), 5.0, ts=ts)
    assert solution["m.high"].tolist() == [0, 0, 1, 1, 1, 1, 1, 2]
    assert solution["m.low"].tolist() == [0, 1, 1, 1, 1, 1, 2, 2]
    assert solution["m.first"].tolist() == [0, 0, 0, 0, 1, 11, 11, 11]


@pytest.mark.long("a clock of two generations of variables")
def test_random_numbers_of_a_run_are_those_of_integers():
    """A state of 128 bits, kept in four discrete variables, of which a clock makes the next one."""
    text = """package 'N' function 'random' input Integer 's'[4]; output Real 'r'; output Integer 'after'[4];
      external "C" ModelicaRandom_xorshift128plus('s', 'after', 'r'); end 'random';
      model 'N' discrete Real 'y'; discrete Real 'r'; Integer 's[1]'; Integer 's[2]'; Integer 's[3]'; Integer 's[4]';
      parameter Integer 'seed'(fixed = false);
      initial equation 'seed' = -1234567890; pre('s[1]') = 'seed'; pre('s[2]') = 1; pre('s[3]') = 2147483647;
        pre('s[4]') = -2147483648; 'r' = 'random'(pre('s'));
      equation when sample(0.0, 1.0) then 'y' = 2.0 * 'r'; end when;
        when sample(0.0, 1.0) then
          ('r', 's') = 'random'({pre('s[1]'), pre('s[2]'), pre('s[3]'), pre('s[4]')});
        end when; end 'N'; end 'N';"""
    state, expected = [-1234567890, 1, 2147483647, -2147483648], []
    for _ in range(6):
        r, state = number("xorshift128plus", state)
        expected.append(2 * r)
    solution = simulate(compiled(text), 5.5, ts=np.arange(6) + 0.5)
    np.testing.assert_array_equal(solution["m.y"], expected)
    assert [int(solution[f"m.s[{k}]"][-1]) for k in range(1, 5)] == state


@pytest.mark.long("two compilations")
def test_functions_tables_and_initial_equations():
    """2 T' = p - T with T'(0) = 0.5 and p(0) = 3 begins at T = 2; T0 = T(0) + 1 stays 3."""
    system = compiled(PIPE)
    ts = jnp.linspace(0.0, 2.0, 9)
    solution = simulate(system, 2.0, ts=ts, rtol=1e-9, atol=1e-11)
    T = np.asarray(solution["m.T"])
    # p = 3 + sin(t)^2 / 2 = 3.25 - cos(2 t) / 4; the answer of 2 T' + T to it, from T(0) = 2.
    forced = 3.25 - (np.cos(2 * ts) + 4 * np.sin(2 * ts)) / (4 * 17)
    start = 2.0 - (3.25 - 1 / 68)
    np.testing.assert_allclose(T, forced + start * np.exp(-ts / 2.0), atol=1e-8)
    np.testing.assert_allclose(solution["m.T0"], 3.0, atol=1e-9)
    np.testing.assert_allclose(solution["m.q"], np.minimum(T, 2.0), atol=1e-12)
    np.testing.assert_allclose(solution["m.r"], np.interp(T, [0.0, 1.0, 3.0], [0.0, 2.0, 3.0]), atol=1e-9)
    np.testing.assert_allclose(solution["m.loss"], T + 2 * 3.0 + 3.0, atol=1e-8)


@pytest.mark.long("a run with events")
def test_the_command_runs_a_file(tmp_path, capsys):
    file, table = tmp_path / "ball.bmo", tmp_path / "out.csv"
    file.write_text(BALL)
    assert main([str(file), "h", "bounces", "--csv", str(table), "--tolerance", "1e-10"]) == 0
    assert "h = 0.06870746" in capsys.readouterr().out
    rows = np.genfromtxt(table, delimiter=",", names=True)
    assert rows.dtype.names == ("time", "h", "bounces") and len(rows) == 301 and rows["bounces"][-1] == 6


def test_the_command_says_why_a_file_cannot_be_run(tmp_path, capsys):
    file = tmp_path / "wrong.bmo"
    file.write_text("model m\n Real x; equation x = y; end m;")
    assert main([str(file)]) == 1
    assert "m, line 2: 'y' is not declared" in capsys.readouterr().err


def test_the_command_says_which_variable_it_does_not_know(tmp_path, capsys):
    file = tmp_path / "decay.bmo"
    file.write_text("model m\n Real x(start = 1, fixed = true); equation der(x) = -x; end m;")
    assert main([str(file), "y"]) == 1
    assert "'m.y'" in capsys.readouterr().err


NEWTON = """package 'M'
  function 'root' "by Newton's method, as media functions invert their formulas"
    input Real 'a';
    output Real 'y';
  protected
    Boolean 'found';
    Integer 'i';
    Real 'd';
  algorithm
    'y' := 'a';
    'i' := 0;
    'found' := false;
    while 'i' < 50 and not 'found' loop
      'd' := ('y' * 'y' - 'a') / (2 * 'y');
      'y' := 'y' - 'd';
      'i' := 'i' + 1;
      if abs('d') < 1e-13 then
        'found' := true;
      end if;
    end while;
  end 'root';
  model 'M'
    parameter Real 'k' = 1.0;
    Real 'x'(start = 1.0, fixed = true);
  equation
    der('x') = 'k' * 'root'('x');
  end 'M';
end 'M';
"""


@pytest.mark.slow
def test_a_while_on_variables_and_its_derivative():
    """x' = k √x: x = (1 + k t/2)²."""
    system = compiled(NEWTON)

    def end(k):
        return simulate(system.with_parameters({"m.k": k}), 1.0, ts=jnp.array([1.0]), rtol=1e-10, atol=1e-12)["m.x"][0]

    value, slope = jax.value_and_grad(end)(1.0)
    assert value == pytest.approx(2.25, abs=1e-9)
    assert slope == pytest.approx(1.5, abs=1e-8)
    assert jax.jvp(end, (1.0,), (1.0,))[1] == pytest.approx(1.5, abs=1e-8)


@pytest.mark.slow
def test_a_violated_assertion_ends_the_run():
    system = compiled(
        """model 'M'
  parameter Real 'least' = 0.5;
  Real 'x'(start = 1.0, fixed = true);
equation
  der('x') = -1.0;
  assert('x' > 'least', "the level is too low", AssertionLevel.error);
  assert('x' > 0.9, "this one is a warning", AssertionLevel.warning);
end 'M';
"""
    )

    def when(least):
        return simulate(system.with_parameters({"m.least": least}), 2.0, ts=jnp.array([0.0, 0.25]))

    run = when(0.5)
    assert run.events.terminated == "an assertion is violated: the level is too low"
    assert float(run.events.ts[0]) == pytest.approx(0.5, abs=1e-9)
    assert jax.grad(lambda least: when(least).events.ts[0])(0.5) == pytest.approx(-1.0, abs=1e-9)


QUIET = """//! base 0.1.0
package 'm'
model 'm'
  Real 'x'(start = -1, fixed = true);
  Real 'y';
  Real 'z';
equation
  der('x') = 1;
  'y' = if noEvent('x' > 0) then 1 else 2;
  'z' = if EVENT then 1 else 2;
end 'm';
end 'm';"""


@pytest.mark.parametrize("condition, events", [("'x' > 0", True), ("noEvent('x' > 0)", False)])
def test_a_relation_in_noevent_is_an_event_elsewhere(condition, events):
    assert (compiled(QUIET.replace("EVENT", condition)).plan.events is not None) == events


def test_the_entries_of_a_matrix_of_truths():
    text = QUIET.replace("  Real 'z';", "  Real 'z';\n  Boolean[2, 2] 'b';")
    text = text.replace("equation", "equation\n  'b' = {{time > 1, 'x' > 5}, {false, true}};")
    system = compiled(text.replace("EVENT", "'b'[1, 1] and 'b'[2, 2]"))
    assert system.observe(["m.z"], 2.0, jnp.zeros(1)).tolist() == [1]
    assert system.observe(["m.z"], 0.5, jnp.zeros(1)).tolist() == [2]
