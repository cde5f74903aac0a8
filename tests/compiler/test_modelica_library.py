"""Functions that a flat text calls without holding them, read from the sources of their library."""

import math

import pytest
import sympy

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.graph.expressions.smooth import Smooth
from jaxonomy_dae.modelica import load
from jaxonomy_dae.modelica.interpret import Interpreter

FILES = {
    "package.mo": """within;
package Lib "A library" extends Icons.Package;
  constant Real half(min = 0) = 1/2 "one half";
  annotation(version = "1", Documentation(info = "<p>text (with) parentheses; and 'signs'</p>"));
end Lib;
""",
    "Units.mo": """within Lib;
package Units
  type Length = Real(final quantity = "Length", final unit = "m");
  type Point = Length[2];
  type Side = enumeration(left "the left one", right);
end Units;
""",
    "Shapes/package.mo": """within Lib;
package Shapes
  extends Icons.Package;
  import Lib.Units.*;
  import U = Lib.Units;
  partial package Round "what is replaced is replaced for the functions that are inherited, too"
    import Lib.half;
    constant Real ratio = 1.0;
    constant Data data;
    replaceable record State
      Length r;
    end State;
    replaceable partial function area "area"
      extends Icons.Function;
      input State state;
      output Real y;
    end area;
    function twice
      input Real r;
      output Real y = 2*area(State(r = r))*ratio;
    end twice;
    function shifted
      input Real r;
      output Real y;
    algorithm
      y := r + data.offset + half + data.slope - slope(data);
    end shifted;
  end Round;
  function slope
    input Data data;
    output Real y = data.slope;
  end slope;
  record Data
    Real offset = 0.0;
    Real slope = 1.0;
  end Data;
  constant Data standard(offset = 3.0, slope = 2*standard.offset);
  package Disc
    extends Round(final ratio = 10.0, data = standard);
    redeclare function extends area
      import Lib.Shapes.Internal.circle;
    protected
      Real unused;
    algorithm
      y := circle(state.r);
    end area;
    package Inner
      function both "two results, of which the second is left out"
        input Real x, z = Modelica.Constants.unknown;
        output Real s, d;
      algorithm
        s := x + half;
        d := x - .Lib.half;
      end both;
    end Inner;
  end Disc;
  package Internal
    function circle = power(n = 2, c = 3.0) "3 r^2";
    function power
      input Length x;
      input Integer n = 1;
      input Real c = 1.0;
      output Real y;
    algorithm
      y := c;
      for i in 1:n loop
        y := y*x;
      end for;
      annotation(Inline = true);
    end power;
    function side
      input U.Side s;
      input U.Point p;
      output Real y;
    algorithm
      y := if s == U.Side.left then p[1] elseif s == Side.right then p[2] else -1;
    end side;
  end Internal;
  model Machine "models are known by their classes"
    replaceable package Form = Disc constrainedby Round;
    Form.State state(r(start = 1.0)) if true;
  equation
    if state.r > 0 then der(state.r) = 1; else der(state.r) = 0; end if;
  end Machine;
end Shapes;
""",
}
TEXT = """//! base 0.1.0
package 'm'
  function 'm.part.Form.twice' "" input Real 'r'; output Real 'y'; algorithm 'y' := 2.0*'m.part.Form.area'('r'); end 'm.part.Form.twice';
  model 'm'
    Real 'x';
  equation
    'x' = {calls};
  end 'm';
end 'm';"""  # noqa: E501


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("libraries") / "Lib"
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def carried(library, calls: str) -> Interpreter:
    flat = load(TEXT.replace("{calls}", calls), roots=[library.parent])
    return Interpreter(flat.classes, {}.__getitem__, {}, {})


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("Lib.Shapes.Internal.power", [2.0, 3], 8.0),
        ("Lib.Shapes.Internal.circle", [2.0], 12.0),
        ("Lib.Shapes.Internal.side", [1, [5.0, 7.0]], 5.0),
        ("Lib.Shapes.Internal.side", [2, [5.0, 7.0]], 7.0),
        ("Lib.Shapes.Disc.area", [{"r": 2.0}], 12.0),
        ("Lib.Shapes.Disc.twice", [2.0], 240.0),
        ("Lib.Shapes.Disc.shifted", [2.0], 5.5),
        ("Lib.Shapes.Machine.Form.shifted", [2.0], 5.5),
        ("Lib.Shapes.Disc.Inner.both", [2.0, 0.0], [2.5, 1.5]),
    ],
)
def test_a_function_of_a_library(library, name, arguments, expected):
    """Inheritance, redeclaration, short definitions, imports, modified constants, enumerations, types of arrays."""
    of = carried(library, f"'{name}'(1.0)")
    assert of.call(name, arguments, {}) == expected


def test_a_folder_of_the_library_itself_is_a_root(library):
    flat = load(TEXT.replace("{calls}", "'Lib.Shapes.Internal.power'(1.0)"), roots=[library])
    assert "Lib.Shapes.Internal.power" in flat.classes


def test_a_part_of_the_model_is_known_by_the_functions_beside_it(library):
    """The text does not say which package `m.part.Form` is: of two with a function `twice`, one has its variables."""
    (library / "Other.mo").write_text(
        """within Lib;
        package Other
          function twice input Real r; output Real y; protected Real more; algorithm y := 0.0; end twice;
          function area input Real r; output Real y; algorithm y := 0.0; end area;
        end Other;""",
        encoding="utf-8",
    )
    of = carried(library, "'m.part.Form.shifted'(1.0)")
    assert of.call("m.part.Form.shifted", [2.0], {}) == 2.5  # of the package that defines both: nothing is changed
    assert "m.part.Form.area" in of.classes


def test_what_no_library_holds_is_refused(library):
    with pytest.raises(ModelError, match=r"the function 'Lib.Shapes.missing' is not known: .*roots=\[…\]"):
        carried(library, "'Lib.Shapes.missing'(1.0)").call("Lib.Shapes.missing", [1.0], {})
    (library / "Broken.mo").write_text("within Lib;\npackage Broken\n  function f input Real = 1;\nend Broken;")
    with pytest.raises(ModelError, match=r"Broken.mo: line 3, column 25: expected a name"):
        carried(library, "'Lib.Broken.f'(1.0)")


def test_values_in_branches_of_functions_get_names():
    """A long value under a condition was written out wherever it was read, so that a function of ten steps in a branch
    grew beyond any bound. It is named, as zero where the condition does not hold."""
    steps = "".join(f"y := (y + {k}.0)*(y - {k}.5)/(1.0 + y*y) + y/(3.0 + y*y);\n" for k in range(1, 12))
    text = f"""package p
      function f input Real x; output Real y; algorithm
        y := x;
        if x > 0 then {steps} else y := -x; end if;
      end f;
      model m end m;
    end p;"""
    names: list[tuple[sympy.Symbol, sympy.Expr]] = []

    def named(e: sympy.Expr) -> sympy.Symbol:
        names.append((sympy.Symbol(f"n{len(names)}", real=True), e))
        return names[-1][0]

    x = sympy.Symbol("x", real=True)
    found = Interpreter(load(text).classes, {}.__getitem__, {}, {}, named=named).call("f", [x], {})
    assert sum(e.count_ops() for _, e in names) < 600
    symbols = [x, *(n for n, _ in names)]
    run = [sympy.lambdify(symbols, e.replace(Smooth, lambda e: e), "math") for e in [*(e for _, e in names), found]]
    for value in (0.7, 1e-3, -2.0):
        expected = value
        for k in range(1, 12):
            square = expected * expected
            expected = (expected + k) * (expected - k - 0.5) / (1.0 + square) + expected / (3.0 + square)
        at = [value, *(0.0 for _ in names)]
        for k, each in enumerate(run[:-1]):
            at[k + 1] = each(*at)
        assert value > 0 or not any(at[1:-1])
        assert math.isclose(run[-1](*at), expected if value > 0 else -value, rel_tol=1e-9)
