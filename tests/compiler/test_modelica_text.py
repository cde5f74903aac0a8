"""Reading Base Modelica, and what its expressions become: no model is compiled here."""

import math

import jax
import numpy as np
import pytest
import sympy
from modelica_texts import BALL, PIPE, built

from jaxonomy_dae import ModelError
from jaxonomy_dae.graph.expressions.smooth import Smooth
from jaxonomy_dae.modelica import load, read_base
from jaxonomy_dae.modelica.interpret import Interpreter
from jaxonomy_dae.modelica.left_out import LEFT_OUT, time_table_coefficients
from jaxonomy_dae.modelica.random_numbers import GENERATORS, number, numbers
from jaxonomy_dae.modelica.semi_linear import with_chains_solved
from jaxonomy_dae.modelica.tables import Table, table_1d
from jaxonomy_dae.modelica.tree import Binary, Number, Reference, Unary
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


# --- delays -----------------------------------------------------------------------------------------------------------

LATE = "model m parameter Real T = 0.5; Real x(start = 1, fixed = true); Real y; equation der(x) = -x; y = {}; end m;"


def test_delays():
    once = built(LATE.format("delay(x, T) + 2 * delay(x, T) + delay(3.0, T) + delay(x, 0)"))
    assert [(str(d.longest), d.is_constant) for d in once.delays] == [("T", True)]
    changing = built(LATE.format("delay(x, 0.2 + x, 2 * T)")).delays
    assert [d.is_constant for d in changing] == [False]
    with pytest.raises(ModelError, match="needs a third argument, the longest delay"):
        built(LATE.format("delay(x, x)"))
