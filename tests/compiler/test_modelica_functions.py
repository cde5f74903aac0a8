"""Functions, records and types of flat Modelica texts: which variable a name stands for, and what it starts with."""

import pytest
import sympy
from modelica_texts import built


def number(expression: str, classes: str = "", declarations: str = "") -> float:
    """The value of a parameter that is bound to an expression."""
    c = built(
        f"package 'P' {classes} model 'M' {declarations} parameter Real 'p' = {expression}; "
        "Real 'state'(start = 0.0, fixed = true); equation der('state') = 'p'; end 'M'; end 'P';"
    )
    return c.parameters["p"].value


def function(name: str, body: str) -> str:
    return f"function '{name}' {body} end '{name}';"


def test_entries_and_fields_of_arguments_are_not_those_of_the_model():
    """A function that reads x[1] and r.a of its arguments, in a model whose variables have these names."""
    f = "input Real 'x'[2]; input 'R' 'r'; output Real 'y'; algorithm 'y' := 'x'[1] + 'x'[2] + 'r'.'a';"
    c = built(
        f"package 'P' record 'R' Real 'a'; end 'R'; {function('f', f)} model 'M' "
        "Real 'x'[2](each start = 0.0, each fixed = true); Real 'r.a'; Real 'y'; equation "
        "der('x') = {1, 2}; 'r.a' = 5; 'y' = 'f'({10, 20}, 'R'(4)); end 'M'; end 'P';"
    )
    assert [str(e) for e in c.equations][-1] == "y - 34"


@pytest.mark.parametrize(
    "called, body, value",
    [
        # A local variable is computed after those that it reads, and hides a variable of the model (section 12.4.4).
        ("'f'(1)", "input Real 'u'; output Real 'y' = 'a'; protected Real 'a' = 'b' + 1; Real 'b' = 2 * 'u';", 3),
        # What is applied to arrays although it has scalar arguments is applied to their entries (section 12.4.6).
        ("max('f'({1, 2}))", "input Real 'u'; output Real 'y' = if 'u' > 1.5 then 3 else 4;", 4),
        ("sum('f'([1, 2; 3, 4]))", "input Real 'u'; output Real 'y' = 'u' * 'u';", 30),
        # The condition of a loop has no value behind the jump that ends it.
        ("'f'({1, 2})", "input Real 'u'[2]; output Real 'y'; protected Integer 'i' = 1; algorithm "
         "while 'u'['i'] > 0 loop 'i' := 'i' + 1; if 'i' > 2 then break; end if; end while; 'y' := 'i';", 3),
        ("'f'(1)", "input Real 'u'; output Real 'y'; algorithm 'y' := 'u'; "
         "for b in Boolean loop 'y' := 'y' + (if b then 1 else 10); end for; "
         "for e in 'E' loop 'y' := 'y' + 100 * Integer(e); end for;", 612),
    ],
)  # fmt: skip
def test_functions(called, body, value):
    enumeration = "type 'E' = enumeration('a', 'b', 'c');"
    assert number(called, enumeration + function("f", body), "parameter Real 'b' = 5.0;") == value


def test_a_function_of_the_text_hides_one_that_is_built_in():
    body = "input Real 'u'; input Real 'v'; output Real 'y' = 'u' - 'v';"
    assert number("'cross'(3, 4)", function("cross", body)) == -1


def test_jumps_out_of_nested_loops():
    """Conditions of what has been left were multiplied out, each by all before."""
    body = (
        "input Real 'u'; output Real 'y'; algorithm 'y' := 0; for i in 1:3 loop for j in 1:3 loop "
        "if i * j > 2 * 'u' then return; end if; if j > i then break; end if; 'y' := 'y' + 1; end for; end for;"
    )
    assert len(built(
        f"package 'P' {function('f', body)} model 'M' Real 'x'(start = 0.0, fixed = true); Real 'y'; equation "
        "der('x') = 1; 'y' = 'f'('x'); end 'M'; end 'P';"
    ).equations) < 30  # fmt: skip
    assert [number(f"'f'({u})", function("f", body)) for u in (0, 1, 2, 3.2, 5)] == [0, 2, 3, 5, 6]


def test_fields_of_records():
    """Defaults read other fields; constants are not arguments of the constructor (section 12.6)."""
    f = function("f", "input 'R' 'r'; output Real 'y' = 100 * 'r'.'k' + 10 * 'r'.'a' + 'r'.'b';")
    record = "record 'R' constant Real 'k' = 3; Real 'a' = 1; Real 'b' = 2 * 'a'; end 'R';"
    assert number("'f'('R'())", record + f, "parameter Real 'a' = 7.0;") == 312
    assert number("'f'('R'(2))", record + f) == 324
    assert number("'f'('R'(4, 1, 2))", record + f) == 412  # as front ends write records that they have computed


def test_types_give_modifiers_and_dimensions():
    c = built(
        "package 'P' constant Real 'c' = 4.0; type 'T' = Real(start = 'c', unit = \"m\"); type 'V' = 'T'[2]; "
        "model 'M' parameter Boolean 'given' = true; 'T' 'x'(fixed = 'given'); 'V' 'v'[1](each fixed = true); "
        "Real 'w'(fixed = not 'given'); equation der('x') = 1; der('v') = {{1, 2}}; der('w') = 0; end 'M'; end 'P';"
    )
    found = {name: (None if v.start is None else float(v.start), v.fixed, v.unit) for name, v in c.variables.items()}
    assert found == {
        "x": (4.0, True, "m"), "v[1,1]": (4.0, True, "m"), "v[1,2]": (4.0, True, "m"), "w": (None, False, ""),
    }  # fmt: skip


def test_an_algorithm_begins_with_starts():
    """What it does not assign in every case is what it starts as (section 11.1.2)."""
    c = built(
        "model 'M' Real 'x'(start = 1.0, fixed = true); Real 'y'(start = 5.0); Real 'z'; equation der('x') = -1; "
        "algorithm 'y' := 'y' + 'x'; algorithm if 'x' > 0.0 then 'z' := 1; end if; end 'M';"
    )
    y, z = (str(e) for e in c.equations[1:3])
    assert y == "-x + y - 5.0"
    assert z.startswith("z - Piecewise((1, ") and z.endswith(", (0.0, True))")


def test_variables_that_are_records():
    c = built(
        "package 'P' record 'R' Real 'a'; Real 'b' = 2 * 'a'; end 'R'; "
        "record 'S' 'R' 'r'; Real 'k' = 'r'.'b'; end 'S'; "
        "model 'M' parameter 'R' 'q'('a' = 5.0); 'R' 'w'('a'(start = 3.0, fixed = true)); 'R' 's'[2]('a' = {1, 2}); "
        "'S' 'n'('r'('a' = 'q'.'b')); equation der('w'.'a') = 'w'.'b'; end 'M'; end 'P';"
    )
    known = ("w.a", "q.b")
    unknown = {s for e in c.equations for s in e.free_symbols if str(s) not in known}
    (found,) = sympy.solve(list(c.equations), list(unknown), dict=True)
    assert {str(k): str(v) for k, v in found.items()} == {
        "der(w.a)": "2*w.a", "w.b": "2*w.a", "s[1].a": "1", "s[1].b": "2", "s[2].a": "2", "s[2].b": "4",
        "n.r.a": "q.b", "n.r.b": "2*q.b", "n.k": "2*q.b",
    }  # fmt: skip
    assert float(c.variables["w.a"].start) == 3 and c.variables["w.a"].fixed
    assert c.parameters["q.a"].value == 5


def test_a_function_with_results_of_several_types():
    """An Integer among the results is an expression, as every Integer that an equation determines."""
    body = "input Real 'u'; output Real 'y' = 2 * 'u'; output Integer 'n' = integer('u') + 3;"
    c = built(
        f"package 'P' {function('f', body)} model 'M' Real 'y'; Integer 'n'; Real 'z'; equation ('y', 'n') = 'f'(1.5); "
        "'z' = 'n'; end 'M'; end 'P';"
    )
    assert [str(e) for e in c.equations] == ["y - 3.0", "z - 4"]


def test_without_a_start_it_is_what_is_next_to_zero_within_the_bounds():
    c = built(
        "model 'M' Integer 'n'(min = 2); Real 'x'(max = -1.0, fixed = true); Real 'y'(min = 3.0); equation "
        "der('x') = 1; when time > 1 then 'n' = pre('n') + 1; end when; "
        "algorithm if noEvent('x' > 0.0) then 'y' := 5; end if; end 'M';"
    )
    assert c.parameters["n"].value == 2 and float(c.variables["x"].start) == -1
    assert "y - smooth(Piecewise((5, x > 0.0), (3.0, True)))" in map(str, c.equations)
