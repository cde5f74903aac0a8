"""Modelica classes become classes of components with open ports. NumPy only."""

import csv
import json
import re
import zipfile

import numpy as np
import pytest
from device_library import DEVICES, written_to

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, keep_programs
from jaxonomy_dae.compile.model.consistent_point import initial_point
from jaxonomy_dae.compile.model.tables import Declared
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.host import kept
from jaxonomy_dae.library import electrical, thermal
from jaxonomy_dae.modelica import Library, component
from jaxonomy_dae.modelica.__main__ import main
from jaxonomy_dae.modelica.complex_sources import with_real_equations
from jaxonomy_dae.modelica.front_end import FrontEnd
from jaxonomy_dae.modelica.left_out import LEFT_OUT
from jaxonomy_dae.modelica.readable_sources import with_readable_sources
from jaxonomy_dae.modelica.shelf import pack
from jaxonomy_dae.modelica.sources import Sources
from jaxonomy_dae.modelica.stored import read, written
from jaxonomy_dae.write import Electrical, Rotational, Thermal
from jaxonomy_dae.write.ports import Port


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    before = list(kept._CHOSEN)
    keep_programs(None)
    yield Library(written_to(tmp_path_factory.mktemp("devices")))
    kept._CHOSEN[:] = before


def domains(part):
    return {name: port.domain for name, port in part.ports.items()}


def test_connectors_are_ports_of_our_domains(library):
    ev = EqnEnv()
    R = library.component("Devices.Resistor", useHeatPort=True)
    assert domains(R(ev, "r", R=2.0)) == {"p": Electrical, "n": Electrical, "heatPort": Thermal}
    assert set(domains(library["Devices.Resistor"](ev, "r", R=2.0))) == {"p", "n"}
    assert domains(library["Devices.Inertia"](ev, "j")) == {"a": Rotational}
    gap = library["Devices.Gap"](ev, "g")
    assert gap.a.domain == gap.b.domain
    assert (gap.a.domain.across, gap.a.domain.through) == ((("V_m", "A"),), (("Phi", "Wb"),))
    load = library["Devices.Load"](ev, "l", R=[1.0, 2.0, 3.0])
    assert [(p.name, p.domain) for p in load.plug] == [(f"plug.pin[{k}]", Electrical) for k in (1, 2, 3)]
    assert isinstance(load.star, Port)
    assert len(library.component("Devices.Load", m=2)(ev, "l").plug) == 2


def test_only_the_equations_that_close_connectors_go_out(library):
    """The sensor's own `p.i = 0` stays. Each class lacks one equation for each flow of its ports."""
    counts = {}
    for name in ("Resistor", "Conductor", "Sensor", "Brake", "Load"):
        of = library[f"Devices.{name}"].opened
        unknowns = [d for d in of.flat.model.declarations if not d.prefixes & {"parameter", "constant", "input"}]
        flows = sum(len(p.flows) for p in of.ports)
        counts[name] = len(unknowns) - len(of.flat.model.equations) - flows
    assert counts == dict.fromkeys(counts, 0)
    assert len(library["Devices.Sensor"].opened.flat.model.equations) == 2


def test_parameters_are_symbols_or_required_or_given_when_the_class_is_opened(library):
    ev = EqnEnv()
    Resistor = library["Devices.Resistor"]
    assert (Resistor.opened.required, Resistor.opened.fixed) == (("R",), ("useHeatPort",))
    assert Resistor(ev, "r", R=3.0, alpha=0.1).parameters["R"].value == 3.0
    load = library["Devices.Load"](ev, "l", R=[1.0, 2.0, 3.0])
    assert [load.parameters[f"R[{k}]"].value for k in (1, 2, 3)] == [1.0, 2.0, 3.0]
    assert str(load.parameters["phase[2].R"].value) == "R[2]"
    start = library["Devices.Capacitor"](ev, "c", start={"v": 0.5})
    assert (start.parameters["initial_v"].value, start.variables["v"].fixed) == (0.5, True)
    with pytest.raises(ModelError, match=r"Devices.Resistor 'r': the class gives no value to 'R': Resistor\(…, R=…\)"):
        Resistor(ev, "r")
    with pytest.raises(ModelError, match=r"'useHeatPort' decides .* component\(\"Devices.Resistor\", …, useHeatPort="):
        Resistor(ev, "r", R=1.0, useHeatPort=True)
    with pytest.raises(ModelError, match=r"the class has no parameter 'Alpha': did you mean 'alpha'\?"):
        Resistor(ev, "r", R=1.0, Alpha=0.0)
    with pytest.raises(ModelError, match=r"the parameter 'R' has the entries 'R\[1\]', .* got the shape \(2,\)"):
        library["Devices.Load"](ev, "l", R=[1.0, 2.0])
    with pytest.raises(ModelError, match=r"start: there is no variable 'V': known names: 'p.v'"):
        library["Devices.Capacitor"](ev, "c", start={"V": 0.5})


def test_modifications_decide_the_equations(library):
    cubic = library.component("Devices.Conductor", law="Devices.Law.cubic", G=0.25)
    assert "v**3" in str(cubic(EqnEnv(), "g").equations).replace("v*v*v", "v**3")
    assert cubic(EqnEnv(), "g").parameters["G"].value == 0.25
    inner = library.component("Devices.Load", **{"phase.alpha": [0.1, 0.2, 0.3]})
    load = inner(EqnEnv(), "l")
    assert [load.parameters[f"phase[{k}].alpha"].value for k in (1, 2, 3)] == [0.1, 0.2, 0.3]
    with pytest.raises(ModelError, match=r"'Devices.Resistor' has no 'usePort' to modify: did you mean 'useHeatPort'"):
        library.component("Devices.Resistor", usePort=True)
    with pytest.raises(ModelError, match=r"'Devices.Resistor' has no 'usePort' to modify: did you mean 'useHeatPort'"):
        library.component("Devices.Resistor", "usePort = true")
    with pytest.raises(ModelError, match=r"the modification 'G' is a number, a truth"):
        library.component("Devices.Conductor", G=object())


def test_a_network_of_open_classes_and_own_parts_is_square(library):
    """A heated resistor of Modelica between our source, our capacity and our inertia by an adaptor of ours."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    r = library.component("Devices.Resistor", useHeatPort=True)(ev, "r", R=2.0)
    v, g, c = electrical.VoltageSource(ev, "v", V=1.0), electrical.Ground(ev, "g"), thermal.HeatCapacitor(ev, "c", 3.0)
    motor, j = electrical.DCMotor(ev, "m"), library["Devices.Inertia"](ev, "j", J=0.1)
    diagram.add(r, v, g, c, motor, j)
    diagram.connect(v.p, r.p)
    diagram.connect(r.n, motor.p)
    diagram.connect(motor.n, v.n, g.p)
    diagram.connect(r.heatPort, c.heat)
    diagram.connect(motor.flange, j.a)
    system = AcausalCompiler(ev, diagram)()
    assert "j.w" in system.variables and "r.heatPort.Q_flow" in system.variables
    with pytest.raises(ModelError, match=r"cannot connect 'j.a' \(Rotational\) to 'r.p' \(Electrical\)"):
        AcausalDiagram().connect(r.p, j.a)


@pytest.mark.parametrize(
    "name, told",
    [
        ("Devices.Open", r"'Devices.Open' has 2 .* for 3 unknowns; .* lack one. Variables: p, x.*names x$"),
        ("Devices", r"'Devices' is a package: only models and blocks are components"),
        ("Devices.OnePort", r"'Devices.OnePort' is partial: open a class that extends it"),
        ("Devices.Resistorr", r"'Devices' has no class 'Resistorr': did you mean 'Resistor'"),
        ("Device.Resistor", r"'Device.Resistor' is in none of the roots: .*Devices.mo; roots="),
    ],
)
def test_classes_that_do_not_open(library, name, told):
    with pytest.raises(ModelError, match=told):
        library[name]


def test_connectors_may_be_called_as_the_mapping_of_ports():
    """Sources and tanks of fluids call their connectors `ports`."""
    text = """
package Lib
  connector Pin Real v(unit = "V"); flow Real i(unit = "A"); end Pin;
  model Bridge
    parameter Real G = 2;
    Pin ports[2];
  equation
    ports[1].i = G*(ports[1].v - ports[2].v);
    ports[1].i + ports[2].i = 0;
  end Bridge;
end Lib;
"""
    ev, d = EqnEnv(), AcausalDiagram()
    bridge = component("Lib.Bridge", source=text)(ev, "bridge")
    v, g = electrical.VoltageSource(ev, "v", V=3.0), electrical.Ground(ev, "g")
    d.add(bridge, v, g)
    d.connect(v.p, bridge.ports["ports[1]"])
    d.connect(v.n, g.p, bridge.ports["ports[2]"])
    system = AcausalCompiler(ev, d)()
    quantity, factor = system.plan.resolve(["bridge.ports[1].i"])
    point = initial_point(system.plan.model, Declared(np.asarray(system.parameters.values), {}))
    assert point.values[quantity] * factor == pytest.approx(6.0, rel=1e-14)


def test_a_real_variable_does_not_determine_an_integer_input():
    """y = u of a block from Integer to Real: u was taken for what y is, and no equation was left."""
    text = """
package Lib
  connector IntegerInput = input Integer;
  connector RealOutput = output Real;
  block Converted IntegerInput u; RealOutput y; equation y = u; end Converted;
end Lib;
"""
    x = component("Lib.Converted", source=text)(EqnEnv(), "x")
    assert x.opened.inputs == ("u",) and "u" in x.variables
    assert any("y" in map(str, e.free_symbols) for e in x.equations)


def test_roots_that_do_not_exist():
    with pytest.raises(ModelError, match=r"roots: there is no '/nowhere/libraries'"):
        component("A", roots="/nowhere/libraries")


def test_what_enters_by_a_stream_is_not_what_leaves(library):
    """`h_outflow = inStream(h_outflow)` hands on what the tank beside it offers."""
    Pipe = library["Devices.Pipe"]
    assert [(p.name, p.flows, p.streams) for p in Pipe.opened.ports] == [("a", (("m_flow", ""),), (("h_outflow", ""),))]
    ev, diagram = EqnEnv(), AcausalDiagram()
    pipe = Pipe(ev, "pipe")

    class Offer(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            a = self.port("a", pipe.a.domain)
            self.add_equations(Eq(a.p, 2), Eq(a.h_outflow, 7))

    diagram.add(pipe, offer := Offer(ev, "offer"))
    diagram.connect(pipe.a, offer.a)
    system = AcausalCompiler(ev, diagram)()
    quantity, factor = system.plan.resolve(["pipe.a.m_flow", "pipe.a.h_outflow"])
    point = initial_point(system.plan.model, Declared(np.asarray(system.parameters.values), {}))
    found = point.values[quantity] * factor
    np.testing.assert_allclose(found, [2.0, 7.0], rtol=1e-12)


def test_a_part_of_a_system_opens_as_a_whole():
    """Streams are mixed inside a text; its flanges and pins are open."""
    text = DEVICES.replace(
        "end Devices;",
        """
  model Heater "two pipes in a row, the second driven by a signal"
    RealInput power;
    RealOutput h;
    Pipe2 first, second;
    Boundary inlet(h = 7), outlet(h = 3);
  equation
    connect(inlet.port, first.a);
    connect(first.b, second.a);
    connect(second.b, outlet.port);
    first.Q = 0;
    second.Q = power;
    h = second.b.h_outflow;
  end Heater;
  model Boundary
    parameter Real h = 1, flow_out = 0;
    FluidPort port;
  equation
    port.h_outflow = h;
    port.p = h;
  end Boundary;
  model Pipe2
    FluidPort a, b;
    Real Q;
  equation
    a.m_flow + b.m_flow = 0;
    a.m_flow = a.p - b.p;
    b.h_outflow = inStream(a.h_outflow) + Q;
    a.h_outflow = inStream(b.h_outflow) + Q;
  end Pipe2;
end Devices;""",
    )
    Heater = component("Devices.Heater", source=text)
    assert (Heater.opened.inputs, Heater.opened.outputs, Heater.opened.ports) == (("power",), ("h",), ())
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Heater(ev, "heater"))
    assert "heater.h" in AcausalCompiler(ev, diagram)().variables


def test_a_known_class_needs_no_front_end(tmp_path, monkeypatch):
    """The second library reads what the first has kept; a changed source is another library."""
    before = list(kept._CHOSEN)
    keep_programs(tmp_path / "kept")
    try:
        file = written_to(tmp_path)
        first = Library(file).component("Devices.Conductor", law="Devices.Law.cubic").opened
        with monkeypatch.context() as without:
            without.setattr(FrontEnd, "flatten", lambda *_: pytest.fail("the front end was asked"))
            assert Library(file).component("Devices.Conductor", law="Devices.Law.cubic").opened == first
        file.write_text(DEVICES.replace("parameter Real G = 0.5", "parameter Real G = 0.75"))
        changed = Library(file)["Devices.Conductor"](EqnEnv(), "g")
        assert changed.parameters["G"].value == 0.75
        for kept_class in (tmp_path / "kept" / "modelica").glob("*.gz"):
            kept_class.write_bytes(b"not whole")
        assert Library(file)["Devices.Conductor"](EqnEnv(), "g").parameters["G"].value == 0.75
    finally:
        kept._CHOSEN[:] = before


def test_classes_are_data(library, tmp_path):
    """All of a class comes back from JSON; a pack of classes is a library, byte for byte the same each time."""
    names = ["Resistor", "Conductor", "Switch", "Load", "Brake"]
    classes = [library[f"Devices.{n}"].opened for n in names]
    for each in classes:
        assert read(json.loads(json.dumps(written(each)))) == each
    for file in ("a.zip", "b.zip"):
        pack(tmp_path / file, classes, {"of": "Devices"})
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    packed = Library(tmp_path / "a.zip")
    assert packed["Devices.Load"](EqnEnv(), "l").ports.keys() == library["Devices.Load"](EqnEnv(), "l").ports.keys()
    with pytest.raises(
        ModelError, match=r"there is no class 'Devices.Swich' in .*a.zip: did you mean 'Devices.Switch'"
    ):
        packed["Devices.Swich"]
    with pytest.raises(ModelError, match=r"'Devices.Load' is packed without the modifications 'm = 2': roots="):
        packed.component("Devices.Load", m=2)
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("A.json", json.dumps({"format": 0}))
    with pytest.raises(ModelError, match=r"this is no class of format 6: it has format 0"):
        Library(tmp_path / "c.zip")["A"]
    (tmp_path / "d.zip").write_bytes(b"none")
    with pytest.raises(ModelError, match=r"'.*d.zip' is not a file of packed classes"):
        Library(tmp_path / "d.zip")["A"]


def test_parameters_by_look_ups_in_tables_become_initial_equations(tmp_path):
    """Lines stay where they are, and other files are read through links."""
    clutch = """within Parts;
model Clutch
  parameter Real table[:, 2] = [0, 1];
  final parameter Real mu0(unit = "1") =
    if table[1, 1] > 0 then getTable1DValue(tableID, 1, 0)
    else getTable1DValueNoDer(tableID, 1, 0)
    "at rest";
initial equation
  w = 0;
equation
  tau = mu0;
end Clutch;
"""
    root = tmp_path / "lib"
    (root / "Parts" / "Other").mkdir(parents=True)
    (root / "Parts" / "package.mo").write_text("package Parts\nend Parts;\n")
    (root / "Parts" / "Other" / "package.mo").write_text("within Parts;\npackage Other\nend Other;\n")
    (root / "Parts" / "Clutch.mo").write_text(clutch)
    copies = tmp_path / "copies"
    copies.mkdir()
    [copy] = with_readable_sources([root], copies)
    lines = (copy / "Parts" / "Clutch.mo").read_text().splitlines()
    assert len(lines) == len(clutch.splitlines())
    assert lines[3].strip() == 'final parameter Real mu0(unit = "1", fixed = false)'
    assert lines[9] == (
        "initial equation mu0 = if table[1, 1] > 0 then getTable1DValue(tableID, 1, 0) "
        "else getTable1DValueNoDer(tableID, 1, 0); equation"
    )
    assert (copy / "Parts" / "Other" / "package.mo").read_text().startswith("within Parts;")
    (root / "Parts" / "Clutch.mo").write_text(clutch.replace("getTable1D", "getTable2D"))
    assert with_readable_sources([root], copies) == [root]


def test_errors_under_a_condition_become_assertions(tmp_path):
    """Lines stay where they are. What does more than to end the run stays as it is."""
    controller = """within Parts;
model Controller
  parameter Real start = 0, low = -1, high = 1;
  parameter Boolean begins = false;
equation
  if
      begins and (start < low or
      start > high) then
    Modelica.Utilities.Streams.error("start (=" + String(start) + "; \\"y\\") is "
      + String(low));
  end if;
  if begins then
    x = 1;
  else
    Streams.error("no");
  end if;
end Controller;
"""
    root = tmp_path / "lib"
    (root / "Parts").mkdir(parents=True)
    (root / "Parts" / "package.mo").write_text("package Parts\nend Parts;\n")
    (root / "Parts" / "Controller.mo").write_text(controller)
    (tmp_path / "copies").mkdir()
    [copy] = with_readable_sources([root], tmp_path / "copies")
    new = (copy / "Parts" / "Controller.mo").read_text()
    assert new.count("\n") == controller.count("\n")
    assert new.splitlines()[11:] == controller.splitlines()[11:]
    assert " ".join(new[new.index("assert") : new.index("if begins then")].split()) == (
        'assert(not (begins and (start < low or start > high)), "start (=" + String(start) + "; \\"y\\") is " '
        "+ String(low));"
    )


def test_a_library_is_packed_from_the_command_line(tmp_path, library, capsys):
    file = tmp_path / "devices.zip"
    assert main(["pack", str(file), "Devices", "--root", str(written_to(tmp_path))]) == 0
    rows = {row["name"]: row for row in csv.DictReader((tmp_path / "devices.csv").read_text().splitlines())}
    refused = {"Devices.OnePort", "Devices.Open"}
    assert {name for name, row in rows.items() if row["state"] == "refused"} == refused
    assert "is partial" in rows["Devices.OnePort"]["reason"]
    for name in rows.keys() - refused:
        counts = rows[name]
        assert counts["state"] == "translated", name
        assert int(counts["unknowns"]) == int(counts["equations"]) + int(counts["flows"]), name
    assert f"{file}: {len(rows) - 2} of {len(rows)} classes" in capsys.readouterr().out
    packed = Library(file)["Devices.Resistor"](EqnEnv(), "r", R=1.0)
    assert packed.equations == library["Devices.Resistor"](EqnEnv(), "r", R=1.0).equations
    assert main(["pack", str(file), "Nothing", "--root", str(written_to(tmp_path))]) == 1
    assert "there is no 'Nothing' in" in capsys.readouterr().err


def test_a_part_of_a_text_is_counted_from_one():
    """Transformers of the library find their windings in texts such as "Dy05"."""
    substring = LEFT_OUT["Modelica.Utilities.Strings.substring"]
    assert [substring("Dy05", 1, 1), substring("Dy05", 2, 2), substring("Dy05", 3, 4)] == ["D", "y", "05"]


COMPLEX = """
operator record Complex "a complex number"
  Real re;
  Real im;
  encapsulated operator '*'
    function multiply
      import Complex;
      input Complex a;
      input Complex b;
      output Complex c;
    algorithm
      c := Complex(a.re*b.re - a.im*b.im, a.re*b.im + a.im*b.re);
    end multiply;
  end '*';
end Complex;
"""
PHASORS = """
package Phasors
  constant Complex j = Complex(0, 1);
  function conj input Complex c; output Complex d; algorithm d := Complex(c.re, -c.im); end conj;
  function exp input Complex c; output Complex d;
  algorithm d := Complex(Modelica.Math.exp(c.re)*cos(c.im), Modelica.Math.exp(c.re)*sin(c.im)); end exp;
  function real input Complex c; output Real r; algorithm r := c.re; end real;
  partial model Base
    Complex a; Complex b; Complex y; Real w; Real p;
  end Base;
  model Split "its equations, to be filled in"
    extends Base;
  equation
    y = {};
    p = {};
  end Split;
end Phasors;
"""
SPLIT = {
    "a*b": lambda a, b, w: a * b,
    "a/b - w": lambda a, b, w: a / b - w,
    "w - j*w*a": lambda a, b, w: w - 1j * w * a,
    "w/(a + b)": lambda a, b, w: w / (a + b),
    "-conj(a)*b*w": lambda a, b, w: -np.conj(a) * b * w,
    "if w > 0 then Complex(w)*a else b": lambda a, b, w: w * a,
    "exp(a*j)": lambda a, b, w: np.exp(1j * a),
}


@pytest.mark.parametrize("text", SPLIT)
def test_equations_of_complex_numbers_are_two_of_real_ones(text, tmp_path):
    """Beside Python's complex numbers. No line moves."""
    (tmp_path / "Complex.mo").write_text(COMPLEX)
    source = PHASORS.replace("{}", text, 1).replace("{}", f"real({text})")
    (tmp_path / "Phasors.mo").write_text(source)
    new = with_real_equations(Sources([tmp_path]), source)
    assert new.count("\n") == source.count("\n") and text not in new
    a, b, w = 0.3 - 0.7j, 1.1 + 0.4j, 2.0
    found = dict(re.findall(r"(y\.re|y\.im|\bp) = ([^;]*);", new))
    names = {f"{n}_{k}": getattr(x, k2) for n, x in (("a", a), ("b", b)) for k, k2 in (("re", "real"), ("im", "imag"))}
    names |= {"w": w, "exp": np.exp, "sin": np.sin, "cos": np.cos}
    expected = complex(SPLIT[text](a, b, w))
    for name, value in (("y.re", expected.real), ("y.im", expected.imag), ("p", expected.real)):
        python = re.sub(r"\b([ab])\.(re|im)", r"\1_\2", found[name]).replace("Modelica.Math.", "")
        python = re.sub(r"\(if (.*?) then (.*?) else (.*)\)", r"((\2) if \1 else (\3))", python)
        assert eval(python, names) == pytest.approx(value, rel=1e-13), name


def test_a_size_without_a_value_is_asked_for():
    text = "model Bank parameter Integer n; Real x[n]; equation x = fill(time, n); end Bank;"
    with pytest.raises(ModelError, match=r"gives no value to 'n', which decides its equations: component\(…, n=…\)"):
        component("Bank", source=text)
    declared = component("Bank", source=text, n=2).opened.flat.model.declarations
    assert [d.name for d in declared] == ["n", "x[1]", "x[2]"]


def test_a_condition_without_a_value_is_asked_for():
    text = "model Port parameter Boolean used(start = true); Real x = time if used; Real y = 1; end Port;"
    with pytest.raises(ModelError, match=r"nothing says whether there is a 'x': the class gives no value"):
        component("Port", source=text)
    assert "x" in {d.name for d in component("Port", source=text, used=True).opened.flat.model.declarations}


def test_parameters_that_decide_equations_are_not_symbols():
    """The loss of a lossless gear: `ideal` was known to the front end, which chose equations by it, and other losses
    were taken and had no effect."""
    text = """model Gear
  parameter Real loss = 0;
  parameter Real ratio = 2;
  Boolean ideal;
  Boolean simple = not ideal;
  Real y;
equation
  ideal = loss <= 0;
  if ideal then y = ratio * time; else y = (1 - loss) * ratio * time; end if;
end Gear;"""
    Gear = component("Gear", source=text)
    assert Gear.opened.tunable == ("ratio",)
    with pytest.raises(ModelError, match=r"'loss' decides the equations .* give it when the class is opened"):
        Gear(EqnEnv(), "g", loss=0.5)
