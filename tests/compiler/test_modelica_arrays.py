"""Arrays of flat Modelica texts that are declared as a whole: in whens, under conditions, in algorithms, without
entries."""

import sympy
from modelica_texts import built

from jaxonomy_dae.graph.expressions.from_sympy import read
from jaxonomy_dae.graph.expressions.kernel import Kernel

STATE = "Real 'x'(start = 0.0, fixed = true);"


def equations(declarations: str, body: str) -> list[str]:
    return [str(e) for e in built(f"model 'M' {STATE} {declarations} equation der('x') = 1; {body} end 'M';").equations]


def new_value(name: str, of: list[str]) -> str:
    """What a variable becomes where a when acts."""
    (found,) = (e for e in of if e.startswith(f":when:new[{name}] - "))
    return found.partition("Piecewise((")[2].rpartition(", Eq(:when:acts")[0]


DISCRETE = "Integer 'n'[2](start = {0, 5}, each fixed = true);"


def test_a_when_assigns_a_whole_array():
    """Where no array of a text was declared by its entries, the assignment was lost."""
    found = equations(DISCRETE, "when time > 1 then 'n' = {1, 2} + pre('n'); end when;")
    assert [new_value(f"n[{k}]", found) for k in (1, 2)] == [":pre(n[1]) + 1", ":pre(n[2]) + 2"]
    found = equations(DISCRETE, "algorithm when time > 1 then 'n' := {1, 2} + pre('n'); end when;")
    assert [new_value(f"n[{k}]", found) for k in (1, 2)] == [":pre(n[1]) + 1", ":pre(n[2]) + 2"]


def test_a_subscript_within_pre_is_the_present_one():
    more = " Integer 'k'(start = 1, fixed = true); Integer 'j'(start = 0, fixed = true);"
    found = equations(DISCRETE + more, "when time > 1 then 'k' = 2; 'n' = {1, 2}; 'j' = pre('n'['k']); end when;")
    assert new_value("j", found) == "Piecewise((:pre(n[1]), Eq(:when:new[k], 1)), (:pre(n[2]), True))"


def test_an_iterator_within_pre_hides_a_variable():
    body = "algorithm when time > 1 then for i in 1:1 loop 'n'[i] := pre('n'[i]) + 3; end for; end when;"
    assert new_value("n[1]", equations(DISCRETE + "parameter Integer 'i' = 2;", body)) == ":pre(n[1]) + 3"


def test_branches_determine_a_discrete_array():
    body = "if time > 1 then 'n' = {1, 2}; 'y' = 7; else 'y' = 8; 'n' = {3, 4}; end if; 'z' = 'n'[2];"
    found = equations("Integer 'n'[2]; Real 'y'; Real 'z';", body)
    assert any(e.startswith("z - Piecewise((2, ") and e.endswith("(4, True))") for e in found)


def test_an_array_within_an_algorithm_is_as_it_is_there():
    body = "algorithm 'y'[1] := 'x'; 'y'[2] := 1; 's' := sum('y'); 'y'[1] := 5;"
    assert equations("Real 'y'[2]; Real 's';", body)[1:] == ["y[1] - 5", "y[2] - 1", "s - x - 1"]


def test_arrays_without_entries():
    declared = "Real 'z'[0]; parameter Real 'A'[0, 1] = zeros(0, 1); Real 'y';"
    assert equations(declared, "'y' = 'x' + sum('z') + 'z' * 'z'; der('z') = 'A' * {'x'};")[1:] == ["-x + y"]


def test_initial_algorithms_leave_variables_variables():
    c = built(
        f"model 'M' {STATE} parameter Real 'p'(fixed = false); Real 'y'; initial algorithm 'p' := 1; 'p' := 'p' + 2; "
        "'y' := 2 * 'p'; equation der('x') = 1; der('y') = 'p'; end 'M';"
    )
    assert [str(e) for e in c.equations] == ["der(x) - 1", "-p + der(y)"]
    assert c.parameters["p"].value == 3 and float(c.variables["y"].start) == 6 and c.variables["y"].fixed


def test_an_array_of_states_starts_anew():
    body = "der('q') = {1, 2}; when time > 1 then reinit('q', {10, 20}); end when;"
    found = equations("Real 'q'[2](each start = 0.0, each fixed = true);", body)
    assert [e for e in found if e.startswith(":when:reinit")] == [
        f":when:reinit[q[{k}]] - Piecewise(({10 * k}, Eq(:when:acts[1], 1)), (q[{k}], True))" for k in (1, 2)
    ]


def test_quotients_of_integers_are_whole():
    """49 times the number next to 1/49 is less than one."""
    body = (
        "when sample(1, 1) then 'n' = pre('n') + 7; end when; 'y' = div('n', 49) + 10 * mod('n', 49) + rem('n', -49);"
    )
    c = built(f"model 'M' Integer 'n'(start = 0, fixed = true); Real 'y'; equation {body} end 'M';")
    equation = next(e for e in c.equations if "y" in map(str, e.free_symbols))
    n, y = (next(s for s in equation.free_symbols if str(s) == name) for name in "ny")
    values = Kernel([read(sympy.solve(equation, y)[0], str)], ["n"])
    assert [float(values([k], "numpy")[0]) for k in (42, 49, -49, -56)] == [462, 1, -1, 412]
