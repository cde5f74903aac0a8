"""Reading Base Modelica, and what its expressions become: no model is compiled here."""

import math
import re

import equinox as eqx
import jax
import numpy as np
import pytest
import sympy
from modelica_texts import BALL, BLOCK, PIPE

from jaxonomy_dae import EqnEnv, ModelError
from jaxonomy_dae.graph.expressions.smooth import Smooth
from jaxonomy_dae.modelica import FlatComponent, load, read_base
from jaxonomy_dae.modelica.interpret import Interpreter
from jaxonomy_dae.modelica.left_out import LEFT_OUT, time_table_coefficients
from jaxonomy_dae.modelica.random_numbers import GENERATORS, number, numbers
from jaxonomy_dae.modelica.semi_linear import with_chains_solved
from jaxonomy_dae.modelica.tables import Table, table_1d
from jaxonomy_dae.modelica.tree import Binary, Call, Number, Reference, Unary
from jaxonomy_dae.write.events import EventFlag
from jaxonomy_dae.write.symbols import VariableSymbol


def value_of(text: str, **names):
    """The value of an expression with these names."""
    model = read_base(f"model m Real x; equation x = {text}; end m;")
    return Interpreter({}, names.__getitem__, {}, {}).evaluate(model.equations[0].right)


# --- grammar ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, value",
    [
        ("[v]", [[1], [2]]), ("[v, w]", [[1, 3], [2, 4]]), ("[v; w]", [[1], [2], [3], [4]]),
        ("[A, v]", [[1, 2, 1], [3, 4, 2]]), ("[A; A]", [[1, 2], [3, 4], [1, 2], [3, 4]]),
        ("A ^ 2", [[7, 10], [15, 22]]), ("A ^ 0", [[1, 0], [0, 1]]), ("A .^ 2", [[1, 4], [9, 16]]),
        ("{i + 10 * j for i in 1:2, j in 1:3}", [[11, 12], [21, 22], [31, 32]]),
        ("symmetric(A)", [[1, 2], [2, 4]]),
    ],
)  # fmt: skip
def test_matrices(text, value):
    """Vectors in brackets are columns, `^` multiplies matrices, and the last iterator counts the rows (Modelica
    Language Specification 3.6, sections 10.4.2, 10.6.7, 10.4.1.1)."""
    assert value_of(text, v=[1, 2], w=[3, 4], A=[[1, 2], [3, 4]]) == value


def test_products_of_other_sizes_are_refused():
    with pytest.raises(ModelError, match=r"the product of arrays of sizes \[2\] and \[3\]: 2 is not 3"):
        value_of("{1, 2} * {1, 2, 3}")
    with pytest.raises(ModelError, match=r"a square matrix has powers 0, 1, 2, …; got sizes \[2\] to the power 2"):
        value_of("{1, 2} ^ 2")


def test_a_sign_binds_as_a_sum_does():
    """-a * b is -(a * b), and a - b - c is (a - b) - c (Modelica Language Specification 3.6, section 3.2)."""
    a, b = (Reference((n,), ((),)) for n in "ab")
    (equation,) = read_base("model m equation x = -a * b; end m;").equations
    assert equation.right == Unary("-", Binary("*", a, b))
    assert value_of("2 ^ (-1)") == 0.5
    assert value_of("7 - 4 - 2") == 1
    assert value_of("-3 ^ 2") == -9
    assert value_of("2 * 3 + 4 / 2") == 8
    assert value_of("not 1 < 2 or 3 > 2") is True


def test_declarations_keep_what_they_say():
    flat = load(BALL)
    h = {d.name: d for d in flat.model.declarations}["h"]
    assert h.modifiers["start"] == Number(1.0) and h.line == 5
    assert flat.experiment == {"StopTime": 3.0, "Interval": 0.01}
    assert flat.name == "Ball"


def test_dimensions_of_a_name_stand_before_those_of_its_type():
    """`Real[3] x[2]` is `Real x[2, 3]`: two arrays of three."""
    (x,) = read_base("model m Real[3] x[2]; end m;").declarations
    assert [d.value for d in x.dimensions] == [2, 3]


def test_quoted_names_are_no_keywords_and_comments_are_left_out():
    text = "model m Real 'end' \"a\" + \"b\"; /* no */ Real 'if.then'; equation 'end' = 'if.then'; // no\n end m;"
    model = read_base(text)
    assert [d.name for d in model.declarations] == ["end", "if.then"]


@pytest.mark.parametrize(
    "text, where, what",
    [
        ("model m\n  Real x\nequation x = 1; end m;", "line 3, column 1", "expected ';'"),
        ("model m equation x = 2 §; end m;", "line 1, column 24", "unknown character"),
        ("model m equation x + 1; end m;", "line 1, column 23", "expected '='"),
        ("", "line 1, column 1", "expected a class"),
        ("model m equation x = (1; end m;", "line 1, column 24", "expected ','"),
        ("package p model m end m;\n model m end m; end p;", "line 2, column 2", "'p' defines the class 'm' twice"),
    ],
)
def test_syntax_errors_say_where(text, where, what):
    with pytest.raises(ModelError) as error:
        read_base(text)
    assert where in str(error.value) and what in str(error.value)


@pytest.mark.parametrize("text", ["within a", 'function f external "C" g(x)'])
def test_texts_that_end_too_early(text):
    with pytest.raises(ModelError, match="expected ';', at ''"):
        read_base(text)


def test_escapes_in_strings_and_ranges_without_a_step():
    assert value_of(r'"a \"b\"\n" + "c"') == 'a "b"\nc'
    assert value_of("String(true)") == "true"
    with pytest.raises(ModelError, match="the range 1:0:3 has no step"):
        value_of("1:0:3")


def test_a_text_of_a_megabyte_is_read_in_near_linear_time():
    """Counted in tokens that the reader visits, not in seconds: the list of lines is walked once."""
    body = "".join(f"    Real 'x{k}'(start = {k}.0) \"comment\";\n" for k in range(4000))
    rows = "".join(f"    der('x{k}') = -'x{k}' * {k}.5e-3 + sin(time);\n" for k in range(4000))
    model = read_base(f"model 'm'\n{body}  equation\n{rows}  end 'm';")
    assert len(model.equations) == 4000 and model.equations[-1].line == 1 + 4000 + 1 + 4000


# --- expressions ------------------------------------------------------------------------------------------------------


def test_constants_are_computed():
    assert value_of("sum({1, 2, 3} .* {4, 5, 6})") == 32
    assert value_of("{{1, 2}, {3, 4}} * {5, 6}") == [17, 39]
    assert value_of("sum(i * i for i in 1:4)") == 30
    assert value_of("cat(1, {1, 2}, fill(7, 2))") == [1, 2, 7, 7]
    assert value_of("mod(-7, 3)") == 2 and value_of("rem(-7, 3)") == -1 and value_of("div(-7, 3)") == -2
    assert value_of("integer(-1.5)") == -2
    assert value_of("(1:2:7)[3]") == 5
    assert value_of("({2, 4, 6})[end]") == 6
    assert value_of("cross({1, 0, 0}, {0, 1, 0})") == [0, 0, 1]
    assert value_of("size(zeros(2, 3), 2)") == 3
    assert value_of("if 2 > 1 then 10 else 1 / 0") == 10
    assert value_of("smooth(1, 4) + noEvent(5)") == 9


def test_random_expressions_have_the_value_that_python_gives_them():
    """1,000 random expressions of numbers, against Python's own arithmetic."""
    rng = np.random.default_rng(3)

    def drawn(depth: int) -> str:
        if depth == 0:
            return f"{rng.integers(1, 9)}.{rng.integers(0, 9)}"
        sign = rng.choice(["+", "-", "*", "/"])
        return f"({drawn(depth - 1)} {sign} {drawn(depth - 1)})" if rng.random() < 0.7 else f"(-{drawn(depth - 1)})"

    for _ in range(1000):
        text = drawn(int(rng.integers(1, 5)))
        try:
            expected = eval(text)
        except ZeroDivisionError:
            continue
        assert math.isclose(value_of(text), expected, rel_tol=1e-12, abs_tol=1e-12), text


def test_a_subscript_that_is_not_constant_chooses():
    k = sympy.Symbol("k", real=True)
    found = value_of("({10, 20, 30})[k]", k=k)
    assert [float(found.subs(k, n)) for n in (1, 2, 3)] == [10, 20, 30]


def test_functions_are_carried_out():
    heater = load(PIPE)
    x = sympy.Symbol("x", real=True)
    carried = Interpreter(heater.classes, {"x": x}.__getitem__, {}, {})
    assert sympy.expand(carried.call("polynomial", [[1.0, 0.0, 0.5], x], {})) == 0.5 * x**2 + 1.0
    (limited,) = carried.call("limited", [x], {}).args  # marked as smooth: functions have no events
    assert [float(limited.subs(x, v)) for v in (1.0, 5.0)] == [1.0, 2.0]
    assert carried.call("limited", [7.0], {"top": 3.0}) == 3.0


def test_branches_are_joined_in_the_order_of_assignment():
    """The order was that of a set, which differs from process to process, and with it that of equations."""
    names = [f"v{k}" for k in range(12)]
    outputs, assigned = (" ".join(text.format(n) for n in names) for text in ("output Real {};", "{} := x;"))
    function = f"function f input Real x; {outputs} algorithm if x > 1 then {assigned} end if; end f;"
    x = sympy.Symbol("x", real=True)
    carried = Interpreter(load(f"package p {function} model m end m; end p;").classes, {"x": x}.__getitem__, {}, {})
    (algorithm,) = carried.classes["f"].algorithms
    assert list(carried.assigned_by(algorithm)) == names


def test_return_and_break_under_a_condition():
    """What follows a conditional return is carried out where it did not happen."""
    text = """package p
      function first "the place of the first entry above x; minus one if there is none"
        input Real c[:]; input Real x; output Real y;
      algorithm
        y := -1.0;
        for i in 1:size(c, 1) loop
          if c[i] > x then y := i; return; end if;
        end for;
      end first;
      function passed "entries before the first that is above x, and ten more if there is none"
        input Real c[:]; input Real x; output Real y;
      protected
        Boolean all;
      algorithm
        y := 0.0;
        all := true;
        for i in 1:size(c, 1) loop
          if c[i] > x then all := false; break; end if;
          y := y + 1.0;
        end for;
        if all then y := y + 10.0; end if;
      end passed;
      model m end m;
    end p;"""
    x = sympy.Symbol("x", real=True)
    carried = Interpreter(load(text).classes, {"x": x}.__getitem__, {}, {})
    entries = [1.0, 5.0, 3.0]
    for name, of_none in (("first", -1.0), ("passed", 13.0)):
        found = sympy.lambdify(x, carried.call(name, [entries, x], {}).replace(Smooth, lambda e: e), "math")
        for value in (0.0, 2.0, 4.0, 6.0):
            place = next((k for k, c in enumerate(entries) if c > value), None)
            expected = of_none if place is None else place + (1.0 if name == "first" else 0.0)
            assert found(value) == carried.call(name, [entries, value], {}) == expected


def test_functions_that_texts_leave_out():
    """Against NumPy: norms, a rotation and its angle, the phases of windings, a filter's cut-off."""
    frames = "Modelica.Mechanics.MultiBody.Frames"
    v = [3.0, -4.0, 12.0]
    fitted = LEFT_OUT["Modelica.Math.Matrices.leastSquares"]([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]], [1.0, 3.0, 4.0])
    assert fitted == pytest.approx([1.5, 7 / 6], rel=1e-14)
    with pytest.raises(ModelError, match="least squares need numbers"):
        LEFT_OUT["Modelica.Math.Matrices.leastSquares"]([[sympy.Symbol("x")]], [1.0])
    assert LEFT_OUT["Modelica.Math.Vectors.length"](v) == 13.0
    assert LEFT_OUT["Modelica.Math.Vectors.normalize"](v) == pytest.approx([x / 13 for x in v])
    axis = [x / 13 for x in v]
    turned = LEFT_OUT[f"{frames}.TransformationMatrices.planarRotation"](axis, 0.7)
    np.testing.assert_allclose(np.array(turned) @ np.array(turned).T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.array(turned) @ axis, axis, atol=1e-14)
    x = [1.0, 2.0, -0.5]
    after = LEFT_OUT[f"{frames}.TransformationMatrices.resolve2"](turned, x)
    assert LEFT_OUT[f"{frames}.planarRotationAngle"](axis, x, after) == pytest.approx(0.7)
    assert LEFT_OUT[f"{frames}.TransformationMatrices.resolve1"](turned, after) == pytest.approx(x)
    orientation = LEFT_OUT["Modelica.Electrical.Polyphase.Functions.symmetricOrientation"]
    assert orientation(3) == pytest.approx([0, 2 * math.pi / 3, 4 * math.pi / 3])
    assert orientation(6) == pytest.approx([*orientation(3), *(a - math.pi / 6 for a in orientation(3))])


def python_xorshift(name, state):
    """The generators written with fixed-width integers of NumPy, one word after the other (Vigna 2016)."""
    s = np.array(state[: len(state) // 2 * 2], np.int32).view(np.uint64).copy()
    place = state[-1]
    with np.errstate(over="ignore"):
        if name == "xorshift64star":
            x = s[0]
            x ^= x >> np.uint64(12)
            x ^= x << np.uint64(25)
            x ^= x >> np.uint64(27)
            out = s[0] = x * np.uint64(2685821657736338717)
        elif name == "xorshift128plus":
            a, b = s
            a ^= a << np.uint64(23)
            s[0] = b
            out = s[1] = (a ^ b ^ (a >> np.uint64(17)) ^ (b >> np.uint64(26))) + b
        else:
            a = s[place]
            place = (place + 1) % 16
            b = s[place]
            b ^= b << np.uint64(31)
            s[place] = a ^ (a >> np.uint64(30)) ^ b ^ (b >> np.uint64(11))
            out = s[place] * np.uint64(1181783497276652981)
    after = s.view(np.int32).tolist() + ([place] if len(state) % 2 else [])
    return float(np.int64(np.uint64(out).view(np.int64))) / 2.0**64 + 0.5, after


@pytest.mark.parametrize(("name", "count"), [(n, c) for n, (_, c) in GENERATORS.items()])
def test_generators_of_random_numbers(name, count):
    """Many steps; the mean and variance of a uniform distribution."""
    state = [*np.random.default_rng(5).integers(-(2**31), 2**31, count - count % 2).tolist(), *([14] * (count % 2))]
    found = []
    for _ in range(400):
        expected = python_xorshift(name, state)
        r, state = number(name, state)
        assert (r, state) == expected
        found.append(r)
    assert np.mean(found) == pytest.approx(0.5, abs=0.05) and np.var(found) == pytest.approx(1 / 12, abs=0.01)


def test_random_numbers_need_integers_of_64_bits():
    with jax.enable_x64(False), pytest.raises(ModelError, match="xorshift64star computes with integers of 64 bits"):
        numbers("xorshift64star")(123456789.0, -987654321.0)


def test_chains_of_semi_linear_have_a_solution_at_rest():
    """Two connections with a passage between them, of opposite flows; what is between their ends hung on 0·h = 0."""
    names = "ma Ha mb Hb mc Hc md Hd q ha hb hc"
    text = f"""model m {" ".join(f"Real {n};" for n in names.split())} Real left; Real right; equation q = 0.0;
      ma + mb = 0.0; Ha + Hb = 0.0; mb + mc = 0.0; Hb + Hc + q = 0.0; mc = -md; Hc + Hd = 0.0; ma = time - 1.0;
      left = 3.0; right = 5.0; Ha = semiLinear(ma, ha, left); Hb = semiLinear(mb, ha, hb);
      semiLinear(mc, hc, hb) = Hc; Hd = semiLinear(md, hc, right); end m;"""
    statements = with_chains_solved(load(text).model.equations, lambda r: r.path)

    def holds(values):
        evaluate = Interpreter({}, values.__getitem__, {}, {}).evaluate
        return all(evaluate(s.left) == evaluate(s.right) for s in statements)

    for time in (0.0, 1.0, 2.5):
        m, h = time - 1.0, 5.0 if time >= 1.0 else 3.0
        values = dict(time=time, ma=m, mb=-m, mc=m, md=-m, Ha=m * h, Hb=-m * h, Hc=m * h, Hd=-m * h, q=0.0)
        values |= dict(left=3.0, right=5.0, ha=h, hb=h, hc=h)
        assert holds(values)
        assert not any(holds(values | {name: 4.0}) for name in ("ha", "hb", "hc"))


def test_a_state_that_no_event_keeps_is_refused():
    text = """package 'm' function 'f' input Integer 's'[2]; output Real 'r'; output Integer 'after'[2];
      external "C" ModelicaRandom_xorshift64star('s', 'after', 'r'); end 'f';
      model 'm' Real 'x'; Real 'y'; equation 'y' = time; 'x' = 'f'({'y', 'y'}); end 'm'; end 'm';"""
    with pytest.raises(ModelError, match="a when assigns; got y"):
        built(text)


def test_a_time_table_is_a_line_until_its_next_event():
    """Its rows jump at t = 2; a line until the next row, and the last one goes on."""
    rows = [[0.0, 0.0], [1.0, 2.0], [2.0, 3.0], [2.0, 5.0], [4.0, 1.0]]
    t = sympy.Symbol("t", real=True)
    found = time_table_coefficients(rows, 0.5, 0.0, t, 1, 1e-14, 1.0)
    functions = [sympy.lambdify(t, sympy.sympify(e).replace(Smooth, lambda e: e), "math") for e in found]
    for at, value, event in ((1.5, 1.5, 2.0), (2.5, 3.0, 3.0), (3.0, 5.5, 3.0), (6.0, -0.5, 6.0)):  # none from t = 3
        a, b, next_event, _ = (f(at) for f in functions)
        assert a * at + b == pytest.approx(value) and next_event == pytest.approx(event)


def test_quoted_names_with_subscripts_inside():
    """OpenModelica writes x[i].y in a loop as one quoted name, and literals in the names of entries."""
    text = r"""package p
      type 'L' = enumeration('\'U\'', 'one');
      model m
        constant Integer 't[\'L\'.\'\\\'U\\\'\']' = 5;
        constant Integer 't[\'L\'.\'one\']' = 7;
        Real 'x[1].y'; Real 'x[2].y'; Real 'z'; Real 'w';
      equation
        'w' = sum('x[(1:2)[\'$k\']].y' for '$k' in 1:2);
        'z' = 't[1]' + 't[2]' + time;
      algorithm
        for 'i' in 1:2 loop 'x[\'i\'].y' := 'i' * time; end for;
      end m;
    end p;"""
    component = built(text)
    time = component.ev.t
    x1, x2, z, w = map(VariableSymbol, ("x[1].y", "x[2].y", "z", "w"))
    assert {e.subs({x1: time, x2: 2 * time, z: 12 + time, w: 3 * time}) for e in component.equations} == {0}


# --- tables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("smoothness", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("extrapolation", [1, 2])
def test_a_table_of_a_symbol_is_that_of_numbers(smoothness, extrapolation):
    """The Piecewise that equations get has the values of direct evaluation, and those of its nodes."""
    rows = np.array([[0.0, 1.0], [1.0, 3.0], [2.0, 2.0], [4.0, 5.0], [5.0, 4.0]])
    table = Table(rows, [2], smoothness, extrapolation)
    u = sympy.Symbol("u", real=True)
    found = sympy.lambdify(u, table.value(1, u, True), "math")
    for v in np.linspace(-1.0, 6.0, 29):
        assert math.isclose(found(float(v)), table.value(1, float(v), True), rel_tol=1e-9, abs_tol=1e-9)
    assert [table.value(1, x, True) for x in rows[:-1, 0]] == pytest.approx(rows[:-1, 1].tolist())


@pytest.mark.parametrize(
    "smoothness, slopes",
    [
        # x = 0, 1, 3, 4, 6; y = 0, 1, 2, 5, 5.5; chords 1, 1/2, 3, 1/4. Inside, Fritsch and Butland (1984, equation 5
        # with alpha = (1 + h2/(h1 + h2))/3) and Steffen (1990, equations 10 and 11); at the ends the chords.
        (4, [1.0, 3 * 3 / (5 / 1.0 + 4 / 0.5), 3 * 3 / (4 / 0.5 + 5 / 3.0), 3 * 3 / (5 / 3.0 + 4 / 0.25), 0.25]),
        (5, [1.0, 2.5 / 3, 1.0, 0.5, 0.25]),
    ],
)
def test_monotone_tables_have_the_slopes_of_the_library(smoothness, slopes):
    """Both were read as SciPy's PCHIP, whose ends are others and which is not Steffen's inside."""
    x, y = np.array([0.0, 1.0, 3.0, 4.0, 6.0]), np.array([0.0, 1.0, 2.0, 5.0, 5.5])
    table = Table(np.stack([x, y], 1), [2], smoothness, 2)
    h = 1e-6
    found = [
        (table.value(1, at + d, True) - table.value(1, at, True)) / d for at, d in zip(x, [h] * 4 + [-h], strict=True)
    ]
    assert found == pytest.approx(slopes, abs=1e-4)
    fine = np.array([table.value(1, float(u), True) for u in np.linspace(0.0, 6.0, 200)])
    assert (np.diff(fine) > 0).all()


def test_a_table_without_extrapolation_has_no_value_outside():
    table = Table(np.array([[0.0, 1.0], [2.0, 3.0]]), [2], 1, 4)
    assert [table.value(1, u, False) for u in (0.0, 0.5, 2.0)] == [1.0, 1.5, 3.0]
    with pytest.raises(ModelError, match=r"the table is read at 2.5, outside of \[0, 2\], without extrapolation"):
        table.value(1, 2.5, False)


@pytest.mark.parametrize("extrapolation", [1, 2])
def test_a_table_of_parameters_is_that_of_their_values(extrapolation):
    """Its entries had to be numbers."""
    rows = [[0.0, 1.0], [1.0, 3.0], [2.5, 2.0]]
    a, b, u = sympy.symbols("a b u", real=True)
    known = table_1d("t", "NoName", rows, [2], 1, extrapolation)
    found = table_1d("t", "NoName", [[0.0, 1.0], [a, b], [2.5, 2.0]], [2], 1, extrapolation).value(1, u, True)
    for at in (-1.0, 0.0, 0.3, 1.0, 2.0, 2.5, 4.0):
        assert float(found.subs({a: 1.0, b: 3.0, u: at})) == pytest.approx(known.value(1, at, True))
    with pytest.raises(ModelError, match="entries of a smooth table are numbers"):
        table_1d("t", "NoName", [[0.0, a], [1.0, 2.0], [3.0, b]], [2], 4, extrapolation).value(1, u, True)


@pytest.mark.parametrize(("smoothness", "changeable"), [(1, True), (2, False)])
def test_entries_of_smooth_tables_are_final(smoothness, changeable):
    """A table of parameters was refused where its polynomials depend on all entries."""
    entries = "0.0, p; 1.0, 2.0; 2.0, q; 3.0, 1.0"
    text = f"""model m parameter Real p = 0.5; parameter Real q = 2.0 * p; Real x; Real y;
      parameter ExternalObject t = Modelica.Blocks.Types.ExternalCombiTable1D("NoName", "NoName",
        [{entries}], {{2}}, {smoothness}, 1);
      equation x = time; y = ModelicaStandardTables_CombiTable1D_getValue(t, 1, x); end m;"""
    assert ("p" in built(text).parameters) == changeable


def test_a_table_that_jumps_has_the_later_value_at_the_jump():
    table = Table(np.array([[2.0, 0.0], [2.0, 1.0], [4.0, 0.0]]), [2], 3, 1)
    assert [table.value(1, t, True) for t in (1.0, 2.0, 3.0)] == [0.0, 1.0, 1.0]


def test_a_table_over_time_is_zero_before_its_start():
    """Its start was read and left unused."""
    table = Table(np.array([[0.0, 5.0], [2.0, 7.0]]), [2], 1, 2, start=1.0)
    t = sympy.Symbol("t", real=True)
    found = sympy.lambdify(t, table.value(1, t, True), "math")
    for at, expected in ((0.5, 0.0), (1.0, 6.0), (1.5, 6.5)):
        assert table.value(1, at, True) == found(at) == expected


# --- components -------------------------------------------------------------------------------------------------------


def built(text: str) -> FlatComponent:
    return FlatComponent(EqnEnv(), "m", load(text))


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
        ("x = delay(x, 1.0);", "delay(…) needs the past"),
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
