"""The dictionary of rumoca becomes the record of a flat model. NumPy only."""

import copy

import pytest
import sympy
from modelica_sources import BALL, SOURCES, stored, without_places

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.modelica import FlatComponent, load, read_rumoca

# der(x) = -k x, y = 2 x; written by hand, with places in the source.
TEXT = "model Decay\n  parameter Real k = 3;\n  Real x(start = 1, fixed = true), y;\n\n  y = 2*x;\nend Decay;\n"


def at(text):
    start = TEXT.index(text)
    return {"origin": "source", "span": {"source": 7, "start": start, "end": start + len(text)}}


def by_hand():
    nothing = {"fixed": None, "binding": None, "min": None, "max": None, "nominal": None, "unit": None}
    nothing |= {"state_select": "Default", "description": None}
    lists = (
        "functions", "domains", "initialization_equation_operations", "initial_discrete_values",
        "initial_parameter_values", "discrete_real_equations", "discrete_value_owners", "model_event_transactions",
        "relations", "conditions", "event_actions", "clocks", "clock_ownerships", "previous_values", "terminals",
        "delays",
    )  # fmt: skip
    return {
        "schema_version": 43,
        "source_map": {"files": [[7, "Decay.mo", TEXT]]},
        "storage": {name: [] for name in lists} | {
            "value_types": [{"scalar": "real", "dimensions": [], "record_name": None, "record_fields": []}],
            "variables": [
                {"name": "k", "role": "parameter", "value_type": 0, "declaration": at("k = 3"),
                 "attributes": nothing | {"binding": 0, "start": 0}},
                {"name": "x", "role": "state", "value_type": 0, "declaration": at("x(start"),
                 "attributes": nothing | {"start": 1, "fixed": [True], "unit": "m"}},
                {"name": "y", "role": "algebraic", "value_type": 0, "declaration": at("y;"),
                 "attributes": nothing | {"start": 11}},
            ],
            "expressions": {
                "nodes": [
                    {"literal": {"integer": 3}}, {"literal": {"real": 1.0}},
                    {"coordinate": {"derivative": 1}}, {"coordinate": {"parameter": 0}}, {"coordinate": {"state": 1}},
                    {"binary": {"operator": "multiply", "lhs": 3, "rhs": 4}},
                    {"unary": {"operator": "negate", "operand": 5}},
                    {"binary": {"operator": "subtract", "lhs": 2, "rhs": 6}},
                    {"coordinate": {"algebraic": 2}}, {"array": {"operand_count": 2}},
                    {"index": {"base": 9, "subscript_count": 1}}, {"literal": {"real": 0.0}},
                    {"binary": {"operator": "subtract", "lhs": 8, "rhs": 10}},
                ],
                "provenance": [at("3")] * 11 + [at("y;")] + [at("y = 2*x")],
                "operands": [0, 5], "subscripts": [{"kind": {"index": 0}}],
            },
            "continuous_equation_operations": [
                {"residual": {"residual": 7, "provenance": at("Real x")}},
                {"residual": {"residual": 12, "provenance": at("y = 2*x")}},
            ],
        },
    }  # fmt: skip


def test_a_dictionary_by_hand():
    flat = read_rumoca(by_hand(), "Decay")
    assert [(d.name, d.line) for d in flat.model.declarations] == [("k", 2), ("x", 3), ("y", 3)]
    assert [e.line for e in flat.model.equations] == [3, 5]
    assert "start" not in flat.model.declarations[2].modifiers  # rumoca's own, which stands where the variable does
    with pytest.raises(ModelError, match=r"Decay, line 5: the subscript 3 is outside of 1:2"):
        FlatComponent(EqnEnv(), "m", flat)


@pytest.mark.parametrize("model", SOURCES)
def test_parameters_stay_symbols(model):
    """Each Real parameter of the source is a parameter of the system, arrays by their entries."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    flat = read_rumoca(stored(model), model)
    diagram.add(FlatComponent(ev, "m", flat))
    system = AcausalCompiler(ev, diagram)()
    parameters = {d.name for d in flat.model.declarations if "parameter" in d.prefixes and d.type == "Real"}
    assert parameters, model
    assert {f"m.{name}" for name in parameters} <= set(system.parameters.names)


@pytest.mark.parametrize("model", SOURCES)
def test_the_stored_dictionaries_are_those_of_rumoca(model):
    import rumoca

    assert without_places(rumoca.Session().loads(SOURCES[model], model=model).to_dict("dae")) == stored(model)
    flat = load(SOURCES[model], model)
    assert flat.experiment["StopTime"] > 0
    assert [d.name for d in flat.model.declarations] == [d.name for d in read_rumoca(stored(model)).model.declarations]


def changed(change):
    dae = copy.deepcopy(by_hand())
    change(dae["storage"])
    return dae


@pytest.mark.parametrize(
    "dae, told",
    [
        (by_hand() | {"schema_version": 44}, r'reads schema 43 .* this is schema 44. pip install "rumoca==0.10.2"'),
        ({"variables": {}, "equations": []}, r"names no schema. pip install"),
        (
            changed(lambda s: s["expressions"]["nodes"].__setitem__(12, {"curl": {"operand": 3}})),
            r"Decay, line 5: an expression of the kind 'curl' is not read",
        ),
        (
            changed(lambda s: s["continuous_equation_operations"][0].__setitem__("residual", {"residual": 99})),
            r"Decay: the dictionary has no expression 99",
        ),
        (
            changed(lambda s: s["variables"][1].__setitem__("role", "shadow")),
            r"Decay, line 3: the variable 'x' of the kind real shadow is not read",
        ),
        (
            changed(lambda s: s["variables"][0]["attributes"].update(binding=None, start=None)),
            r"the parameter 'k' has no value",
        ),
    ],
)
def test_what_is_not_read_is_said(dae, told):
    with pytest.raises(ModelError, match=told):
        FlatComponent(EqnEnv(), "m", read_rumoca(dae, "Decay"))


@pytest.mark.parametrize(
    "source, model, told",
    [
        ("model A\n Real x;\nequation\n x = ;\nend A;", "A", r"Modelica, line 4, column 6: unexpected `;`"),
        ("model A\n Lib.Part p;\nend A;", "A", r"line 2: the type reference 'Lib.Part' is not found; roots="),
        ("model A\n Real x;\nequation\n x = foo(3);\nend A;", "A", r"line 4: the function call 'foo' is not found"),
        ("model A\n Real x, y;\nequation\n x = 1;\nend A;", "A", r"'A' has 1 equation for 2 unknowns"),
        (BALL, "Bal", r"there is no model 'Bal': did you mean 'Ball'\?"),
    ],
)
def test_bad_sources(source, model, told):
    with pytest.raises(ModelError, match=told):
        load(source, model)


FOREIGN = """package Plant
  model Broken
    Unknown.Part p;
  end Broken;
  model Late
    Real x(start = 1.0, fixed = true);
  equation
    der(x) = -delay(x, 0.1);
  end Late;
  model Fine
    Real x(start = 0.0, fixed = true);
  equation
    der(x) = 2.0;
    when x >= 1.0 then
      terminate("full");
    end when;
  end Fine;
end Plant;
"""


def test_sources_from_elsewhere(tmp_path):
    """A byte order mark; a package in one file, of which one class is broken, and one reads the past."""
    marked, file = tmp_path / "Lag.mo", tmp_path / "Plant.mo"
    marked.write_text("\ufeffmodel Lag\n  Real x;\nequation\n  x = time;\nend Lag;\n", encoding="utf-8")
    file.write_text(FOREIGN, encoding="utf-8")
    for path, model in ((marked, "Lag"), (file, "Plant.Fine")):
        assert [d.name for d in load(path, model).model.declarations] == ["x"]
    with pytest.raises(ModelError, match=r"line 3: the type reference 'Unknown\.Part' is not found"):
        load(file, "Plant.Broken")
    assert [d.is_constant for d in FlatComponent(EqnEnv(), "m", load(file, "Plant.Late")).delays] == [True]


def test_ranges_that_fall_and_the_order_of_iterators():
    """All values of 3:-1:1 count, the last iterator counts the rows (Modelica Language Specification 3.6, section
    10.4.1.1), and a function of scalars is applied to the entries of arrays (section 12.4.6)."""
    source = """package P
  function square input Real u; output Real y; algorithm y := u * u; end square;
  function rows input Real u; output Real y[2, 2]; algorithm y := {i + 10 * j * u for i in 1:2, j in 1:2}; end rows;
  model M
    Real a[3], b[2], c[2, 2], d;
  equation
    for i in 3:-1:1 loop a[i] = i * time; end for;
    b = square({time, 2 * time});
    c = rows(time);
    d = sum({10 * time * k for k in 3:-2:1});
  end M;
end P;
"""
    c = FlatComponent(EqnEnv(), "m", load(source, "P.M"))
    found = {str(s): v for e in c.equations for s, v in sympy.solve(e.subs(c.ev.t, 1), dict=True)[0].items()}
    assert [found[f"a[{k}]"] for k in (1, 2, 3)] == [1, 2, 3]
    assert [found["b[1]"], found["b[2]"], found["d"]] == [1, 4, 40]
    assert [found[f"c[{i},{j}]"] for i in (1, 2) for j in (1, 2)] == [11, 12, 21, 22]
