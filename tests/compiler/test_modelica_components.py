"""What flat Modelica texts become as components: variables, parameters, equations and events. No model is compiled
here."""

import re

import equinox as eqx
import pytest
import sympy
from modelica_texts import BALL, BLOCK, built

from jaxonomy_dae import EqnEnv, ModelError
from jaxonomy_dae.modelica import FlatComponent, load, read_base
from jaxonomy_dae.modelica.tree import Call
from jaxonomy_dae.write.events import EventFlag
from jaxonomy_dae.write.symbols import VariableSymbol


def test_names_stay_and_parameters_are_declared_where_they_are_read():
    ball = built(BALL)
    assert {"h", "v"} <= set(ball.variables) and {n for n in ball.parameters if n[0] != ":"} == {"e", "bounces"}
    assert ball.parameters["bounces"].is_discrete


def test_modes_are_discrete_variables_and_other_truths_are_expressions():
    block = built(BLOCK)
    discrete = {name for name, p in block.parameters.items() if p.is_discrete}
    assert {"mode", "forward", "backward"} <= discrete and "stuck" not in discrete


def test_starts_of_discrete_variables_are_computed():
    """As those of a periodic source, which begins in the middle of a period: one was left at zero."""
    text = """model m Integer n(start = 7); Real t0; Real x;
      initial algorithm n := integer((time + 0.35) / 0.1); t0 := n * 0.1 - 0.35;
      equation when time >= (pre(n) + 1) * 0.1 then n = pre(n) + 1; t0 = time; end when; x = time - t0; end m;"""
    parameters = built(text).parameters
    assert parameters["n"].value == 3 and parameters["t0"].value == pytest.approx(-0.05)


def test_long_expressions_of_functions_stand_once():
    """Rounds of a function that reads its last result four times: the expression of n rounds had 4^n terms. Under a
    condition nothing gets a name: log(x) need not have a value there."""
    text = """package p
      function f input Real x; output Real y; algorithm
        y := x;
        for i in 1:30 loop y := y * sin(y) + cos(y) / (1.0 + y * y); end for;
      end f;
      function g input Real x; output Real y; algorithm
        if x > 0.0 then y := log(x) * log(x) + log(x) / (1.0 + log(x)) - log(2.0 * x) * log(3.0 * x);
        else y := 0.0; end if;
      end g;
      model m parameter Real a = 0.3; Real x; Real y; Real z; equation
        x = f(a); y = f(time + x); z = g(time - 1.0);
      end m;
    end p;"""
    component = built(text)
    assert all(len(str(e)) < 400 for e in component.equations)
    assert len([n for n in component.parameters if n.startswith(":value")]) >= 15
    logs = [e for e in component.equations if "log" in str(e)]
    assert len(logs) == 1 and "Piecewise" in str(logs[0])


def test_truths_that_each_branch_of_an_if_determines():
    text = """model m Boolean b; Real x; equation
      if time < 1.0 then b = true; x = 1.0; else b = time > 2.0; x = 2.0; end if; end m;"""
    component = FlatComponent(EqnEnv(), "m", load(text), outputs=["b"])
    assert {n for n in component.variables if n[0] != ":"} == {"x", "b"}


def test_the_value_before_the_start_of_what_is_not_kept_is_nothing():
    """`pre(b) = false` was compared with b itself, and said not to hold."""
    text = """model m Boolean b; Real x; initial equation pre(b) = false; equation b = time >= 0.0;
      x = if b then 1.0 else 0.0; end m;"""
    assert "x" in built(text).variables


def test_the_value_before_of_what_may_jump_is_refused():
    """y = 3·d jumps with d, and pre(y) was y itself, 15 instead of 0 here; a state is what it was."""
    text = """model m Real d(start = 0); Real e(start = 0); Real x(start = 0); Real y; equation der(x) = 1; y = 3 * d;
      when x > 1 then d = 5; e = pre({}); end when; end m;"""
    with pytest.raises(ModelError, match=r"pre\(y\): 'y' is neither discrete nor a state"):
        built(text.format("y"))
    assert "e" in built(text.format("x")).parameters and "e" in built(text.format("d")).parameters


def settled(text: str, times) -> list[dict[str, float]]:
    """The discrete variables of a model after each of these instants, by carrying out its declared events one by one:
    those that others wait for come first. What they read and write is evaluated by SymPy."""
    component = built(text)
    definitions = {}
    for e in component.equations:
        heads = [s for s in sympy.Add.make_args(e) if str(s).startswith(":when")]
        for head in sorted(heads, key=str)[-1:]:  # `:when[3]` after `:when:pending`, which it reads
            definitions[head] = head - e
    q = {name: p.value for name, p in component.parameters.items() if p.is_discrete}

    def value(e, t):
        known = {s: definitions[s] for s in e.free_symbols if s in definitions}
        if known:
            return value(e.xreplace({s: value(d, t) for s, d in known.items()}), t)
        numbers = {s: t if str(s) == "time" else 2 if "relation" in str(s) else q[s.path] for s in e.free_symbols}
        return sympy.sympify(e.xreplace(numbers))

    out = []
    for t in times:
        for turn in range(60):
            due = [k for k in component.events if k.guard is not None and value(VariableSymbol(k.guard), t) <= 0]
            if not due:
                break
            assert turn < 50, "the iteration has no end"
            now = min(due, key=lambda k: EventFlag.LAST in k.flags)
            written = [v if isinstance(v, float) else value(VariableSymbol(v), t) for v in now.values]
            q.update((a.target.path, v) for a, v in zip(now.actions, written, strict=True))
        out.append({name: float(v) for name, v in q.items()})
    return out


def test_whens_act_once_in_order_and_again_until_nothing_changes():
    """An edge is one iteration long; of a `when` and its `elsewhen` that rise together the first acts; `pre` follows;
    and what reads `pre` of what has changed is looked at again."""
    text = """model m Integer n(start = 0); Integer k(start = 0); Integer j(start = 0); Boolean a(start = false);
      Boolean b(start = false); Boolean c(start = false); Real x; equation x = n + k + j;
      when {time > 1, time > 2} then n = pre(n) + 1; elsewhen time > 1 then k = pre(k) + 1; n = 7; end when;
      a = time > 2; b = pre(a); c = pre(b);
      when c then j = pre(j) + 1; end when; end m;"""
    found = [[values[n] for n in "nkj"] for values in settled(text, [0.5, 1.5, 1.7, 2.5, 3.0])]
    assert found == [[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 1], [2, 0, 1]]


def values_of(text: str) -> dict[str, str]:
    """What the discrete variables of a model become where their `when` acts, by name; `new(n)` is what n becomes."""
    found = {}
    for equation in built(text).equations:
        for target in equation.free_symbols:
            value = target - equation
            if str(target).startswith(":when:new[") and target not in value.free_symbols:
                acts = str(value.args[0][0]) if isinstance(value, sympy.Piecewise) else str(value)
                found[str(target)[10:-1]] = re.sub(r":when:new\[(\w+)\]", r"new(\1)", acts).replace(":pre(", "pre(")
    return found


def test_an_algorithm_in_a_when_goes_on_from_the_values_before_it():
    """A variable that is read before it is assigned has its value before the event; a loop is carried out."""
    text = """model m Integer n(start = 0); Integer k(start = 0); Integer j(start = 1); Real x;
      equation x = n + k + j;
      algorithm when time > 1.0 then n := n + 1; k := 2 * n; for i in 1:3 loop j := j * 2; end for; end when; end m;"""
    assert values_of(text) == {"n": "pre(n) + 1", "k": "2*new(n)", "j": "8*pre(j)"}


def test_whens_of_one_instant_read_each_other():
    """What one of them read was the value before, where the other one assigns it at the same instant."""
    text = """model m Integer k(start = 0); Real j(start = 0.0); Real x; equation x = k + j;
      when sample(0.0, 1.0) then j = 2.0 * k; end when; when sample(0.0, 1.0) then k = pre(k) + 1; end when; end m;"""
    assert values_of(text) == {"j": "2.0*new(k)", "k": "pre(k) + 1"}


def test_a_relation_with_a_choice_in_it():
    """SymPy spread it over the branches and compared them as sets: minutes for a few branches of one variable."""
    bits = " ".join(f"z := div(z, 2); b{k} := if mod(z, 2) > 0 then 1 else 0;" for k in range(1, 8))
    names = " ".join(f"Integer b{k}; Real y{k};" for k in range(1, 8))
    reads = " ".join(f"y{k} = b{k};" for k in range(1, 8))
    text = f"""model m Integer z; Real u; {names} equation u = sin(time); {reads}
      algorithm when time > 0.5 then z := if u > 0.0 then integer(u * 12.7 + 0.5) else 0; {bits} end when; end m;"""
    assert len(values_of(text)) == 8
    text = """model m Real x; Real y; Real u; equation u = sin(time);
      x = if (if u > 0.0 then u ^ 3 else -u) > 0.2 then 1.0 else 2.0;
      y = if time < (if time < 1.0 then 0.5 else 2.0) then 1.0 else 2.0; end m;"""
    component = built(text)
    assert ":value[0]" in component.variables and ":value[1]" not in component.variables
    text = """model m Real u; Integer k; Integer n(start = 0); Real x; equation u = sin(time); x = n + k;
      k = if u > 0.5 then 1 else if u < -0.5 then -1 else 0;
      when k <> 0 then n = pre(n) + 1; elsewhen k > 0 then n = pre(n) + 2; end when; end m;"""
    assert not any(name.startswith(":value") for name in built(text).variables)


def test_at_a_tick_pre_is_the_value_before_it():
    """`pre(k) <> 0` beside a clock was the value that the tick gives to k: a circle."""
    text = """model m Integer k(start = -1); Integer j(start = 2); Real x; equation x = k + j;
      when pre(k) <> 0 and sample(0.0, 1.0) then k = pre(j); j = pre(j) - 1; end when; end m;"""
    assert values_of(text) == {"k": "pre(j)", "j": "pre(j) - 1"}
    assert not any(EventFlag.LISTED in event.flags for event in built(text).events)


@pytest.mark.parametrize(
    ("equations", "told"),
    [
        ("when time > 1.0 then a = b; end when; when time > 2.0 then b = a; end when;", "a → b → a depend"),
        (
            "when time > 1.0 then a = 1; end when; when time > 2.0 then a = b; b = 2; end when;",
            "'a' is assigned by two",
        ),
        ("when time > a then a = 1; end when; b = pre(b) + b;", "b → b depend"),
        ("b = 1; algorithm if time > 1.0 then break; end if; a := 1;", "'break' stands outside of a loop"),
        ("when time > a then a = 1; end when;", "nothing determines 'b'"),
    ],
)
def test_discrete_equations_that_have_no_order_are_refused(equations, told):
    with pytest.raises(ModelError) as error:
        built(f"model m Integer a(start = 0); Integer b(start = 0); Real x; equation\nx = a + b; {equations} end m;")
    assert told in str(error.value)


def test_initial_equations_of_discrete_variables_follow_each_other():
    """The first one read what the second one gives as it was declared."""
    text = """model m discrete Real a; discrete Real b(start = -1.0); Real x; initial equation a = log(b); b = 1.0;
      equation x = a + b; when sample(1.0, 1.0) then a = 2.0; b = 3.0; end when; end m;"""
    parameters = built(text).parameters
    assert parameters["a"].value == 0.0 and parameters["b"].value == 1.0


def test_an_initial_algorithm_counts_at_its_end():
    """Its first value of p was compared with its last one, and said not to hold."""
    text = """model m parameter Real p(fixed = false); constant Real q = 3.0; Real x;
      initial algorithm p := 60.0; if p * q > 100.0 then p := 24.0; end if; equation x = p; end m;"""
    assert built(text).parameters["p"].value == 24.0


@pytest.mark.parametrize(
    "equations, told",
    [
        ("x = y(1.0);", "line 2: the function 'y' is not known"),
        ("x = delay(x, time);", "delay(…) with the delay time, which changes, needs a third argument"),
        ("x = z;", "'z' is not declared"),
        ("x = ({1.0, 2.0})[3];", "the subscript 3 is outside of 1:2"),
        ("{x, x} = {1.0, 2.0, 3.0};", "differ in size"),
        ("if time > 1.0 then x = 1.0; else end if;", "they must have equally many"),
        ("1.0 = 2.0;", "the equation 1.0 = 2.0 is false"),
    ],
)
def test_what_cannot_be_translated_is_said_with_its_line(equations, told):
    with pytest.raises(ModelError) as error:
        built(f"model m Real x; equation\n{equations} end m;")
    assert told in str(error.value)


DAMPED = """model m
  parameter Real d = 2.0; Real x(start = 1.0, fixed = true); Real v(start = 0.0, fixed = true); Real f; Real g;
  equation der(x) = v; der(v) = -x - f; f = d * v; g = f; end m;"""


def test_a_law_takes_the_place_of_an_equation():
    """A term beside the written law; a function in its place; a law of a derivative."""
    damped = load(DAMPED)
    for flat, left in (
        (damped.add_term("f", lambda m, f: m.symbol("v") ** 3), ["der(v) + f + x", "-d*v + f - v**3"]),
        (damped.replace("f", _doubled), ["der(v) + f + x", "f - law"]),
        (damped.replace("der(v)", lambda m, a: 2 * a), ["-d*v + f", "der(v) + 2*f + 2*x"]),
    ):
        equations = [str(e) for e in FlatComponent(EqnEnv(), "m", flat).equations]
        assert sorted(equations) == sorted(["der(x) - v", "-f + g", *left])


def _doubled(m, f):
    return m.function("law", lambda v: 2.0 * v, [m.symbol("v")])[0]


PARTS = """model 'Parts'
  parameter Real 'R' = 2; Real 'a.v'; Real 'a.i'; Real 'a.p'; Real 'a.n'; Real 'b.v'; Real 'b.i'; Real 'b.heat';
  Real 'one';
equation 'a.v' = 'a.p' - 'a.n'; 'R' * 'a.i' = 'a.v'; 'a.p' = 'one'; 'one' = 1; 'a.n' = 'a.p' - 'one';
  'b.v' = 'a.v'; 'b.i' = 'b.v'^3;
  'b.heat' = 'b.v' * 'b.i';
end 'Parts';"""


class Cubic(eqx.Module):
    def __call__(self, u):
        return u**3


def test_a_network_is_the_law_of_a_part():
    """The law of a part is its one equation that does more than add its variables up. A network reads what that read,
    unless inputs are named."""
    flat, network = load(PARTS), Cubic()
    for changed, inputs in (
        (flat.replace("a", network), ["a.i"]),
        (flat.replace("a.v", network, inputs=["a.p"]), ["a.p"]),
        (flat.add_term("a", network), ["a.i"]),
    ):
        (term,) = FlatComponent(EqnEnv(), "m", changed).learned_terms
        assert [s.path for s in term.inputs] == inputs
    with pytest.raises(ModelError, match="found those of 'b.i' on line 5 and 'b.heat' on line 6: name one of them"):
        FlatComponent(EqnEnv(), "m", flat.replace("b", network))
    with pytest.raises(ModelError, match="a network, or a function law"):
        flat.replace("a", 3.0)
    with pytest.raises(ModelError, match="the law of 'a' has been changed already"):
        flat.replace("a", network).add_term("a", network)


def test_a_law_for_what_no_equation_gives_is_refused():
    for name, told in (("g", "one equation 'g = …'; found none"), ("w", "no variable or part 'w'")):
        with pytest.raises(ModelError, match=told):
            FlatComponent(EqnEnv(), "m", load(DAMPED).replace(name, lambda m, f: f))


def test_truths_that_define_each_other_are_refused():
    text = "model m Boolean a; Boolean b; Real x; equation a = not b; b = not a; x = if a then 1.0 else 2.0; end m;"
    with pytest.raises(ModelError, match="a → b → a depend on each other"):
        built(text)


def test_a_file_of_several_models_is_refused():
    with pytest.raises(ModelError, match="'p' holds 2"):
        load("package p model a end a; model b end b; end p;")


def test_an_output_that_is_not_declared_is_refused():
    with pytest.raises(ModelError, match="outputs: 'm' has no variable 'gg'"):
        FlatComponent(EqnEnv(), "m", load(DAMPED), outputs=["gg"])


def test_calls_of_unknown_functions_name_the_nearest():
    with pytest.raises(ModelError, match="did you mean 'sum' or 'sin'"):
        built("model m Real x; equation x = sim(time); end m;")
    assert isinstance(read_base("model m equation x = f(1); end m;").equations[0].right, Call)
