"""The errors that new users meet most, provoked as they provoke them, beside their texts on the page of errors."""

import pathlib
import re
import traceback

import diffrax
import jax
import pytest
from problems import slow

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    Electrical,
    Eq,
    EqnEnv,
    JaxonomyDaeError,
    der,
    log,
    reinit,
    sign,
    simulate,
    sqrt,
)
from jaxonomy_dae.library import electrical as el
from jaxonomy_dae.library import signal as sg
from jaxonomy_dae.library import thermal as th

PAGE = pathlib.Path(__file__).parents[2] / "docs" / "errors.md"
LINE = re.compile(r"\(\w+\.py:\d+\)")  # the lines of code here are others than a user's


def on_the_page() -> dict[str, str]:
    """The texts of the page's section, by the titles of their blocks."""
    section = PAGE.read_text().partition("## In full\n")[2].partition("\n## ")[0]
    return {title: text for title, text in re.findall(r'^```text title="([^"]+)"\n(.*?)\n```$', section, re.M | re.S)}


def written(write, name="a", **options):
    """A compiled model of one component with these equations, not yet made."""

    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            write(self)

    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(Written(ev, name)), **options)


def circuit(*loop, ground=True):
    """A compiler for components with pins p and n in a ring."""
    ev, diagram = loop[0].ev, AcausalDiagram()
    for one, other in zip(loop, (*loop[1:], loop[0]), strict=True):
        diagram.connect(one.n, other.p)
    diagram.connect(loop[0].n, el.Ground(ev, "ground").p)
    return AcausalCompiler(ev, diagram)


def discharge():
    ev = EqnEnv()
    return circuit(el.Capacitor(ev, "c", C=1.0, initial_voltage=1.0), el.Resistor(ev, "r", R=1.0))


class Forgetful(Component):
    """A resistor without the equation of its second pin."""

    def __init__(self, ev, name, twice=False):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v = self.variable("v", unit="V")
        self.add_equations(Eq(v, p.v - n.v), Eq(p.i, v / 3))
        if twice:
            self.add_equations(Eq(p.i + n.i, 0), Eq(v, 2 * p.i + 1))


def the_equation_of_a_port_forgotten():
    ev = EqnEnv()
    circuit(Forgetful(ev, "c"), el.VoltageSource(ev, "s", V=1.0))()


def an_equation_too_many():
    ev = EqnEnv()
    circuit(Forgetful(ev, "c", twice=True), el.Resistor(ev, "r"), el.VoltageSource(ev, "s", V=1.0))()


def capacitors_in_parallel():
    ev = EqnEnv()
    a, b = (el.Capacitor(ev, name, C=1.0, initial_voltage=v) for name, v in (("a", 1.0), ("b", 2.0)))
    diagram = AcausalDiagram().connect(a.p, b.p).connect(a.n, b.n, el.Ground(ev, "g").p)
    AcausalCompiler(ev, diagram)().initialize()


def an_input_not_given():
    ev = EqnEnv()
    simulate(circuit(el.SignalVoltage(ev, "source"), el.Resistor(ev, "r"))(), 1.0)


def a_name_inside_a_list():
    written(lambda c: c.add_equations(Eq(der(c.variable("x")), 1)), prefer_states=[["a.x"]])


def a_linear_solver_of_another_kind():
    written(lambda c: c.add_equations(Eq(der(c.variable("x")), 1)), linear_solver=[1])


def a_solver_by_name():
    simulate(discharge()(), 1.0, solver="Radau")  # pyright: ignore


def a_solver_not_made():
    simulate(discharge()(), 1.0, solver=diffrax.Tsit5)  # pyright: ignore


def an_option_of_scipy():
    simulate(discharge()(), 1.0, method="BDF")  # pyright: ignore


def a_keyword_of_a_component():
    el.Resistor(EqnEnv(), "r", resistance=100.0)  # pyright: ignore


def a_root_of_a_negative_number():
    def write(c):
        x, y, z = c.variable("x", start=1.0, fixed=True), c.variable("y"), c.variable("z", start=0.0, fixed=True)
        c.add_equations(Eq(der(x), -1), Eq(y, sqrt(x) + log(x)), Eq(der(z), y))

    simulate(written(write)(), 2.0)


def chattering():
    def write(c):
        x = c.variable("x", start=1.0, fixed=True)
        c.add_equations(Eq(der(x), 0.5 - sign(x)))

    simulate(written(write)(), 5.0)


def a_ball_that_comes_to_rest():
    def write(c):
        h, v = c.variable("h", start=1.0, fixed=True), c.variable("v", start=0.0, fixed=True)
        c.add_equations(Eq(der(h), v), Eq(der(v), -9.81))
        c.when(h <= 0, reinit(v, -0.8 * v))

    simulate(written(write, "ball")(), 10.0)


def starts_off_a_circle():
    def write(c):
        x, y = c.variable("x", start=1.0, fixed=True), c.variable("y", start=0.5, fixed=True)
        c.add_equations(Eq(x**2 + y**2, 1), Eq(der(x), -y))

    written(write, "p")().initialize()


def units():
    def write(c):
        m, force, v = c.parameter("m", 1.0, unit="kg"), c.variable("F", unit="N"), c.variable("v", unit="m/s")
        c.add_equations(Eq(force, m * v), Eq(der(v), -force / m))

    written(write, "p", check_units=True)()


def two_domains():
    ev = EqnEnv()
    AcausalDiagram().connect(th.HeatCapacitor(ev, "h").heat, el.Resistor(ev, "r").p)


class Loop(Component):
    """A gain whose input is bound by an equation, or which was not added."""

    def __init__(self, ev, name, added=True):
        super().__init__(ev, name)
        gain = sg.Gain(ev, "gain", k=2.0)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x))
        if added:
            self.add(gain)
            self.add_equations(Eq(gain.u, x))
        else:
            self.connect(x, gain.u)


def the_input_of_a_child_bound_by_an_equation():
    ev = EqnEnv()
    AcausalCompiler(ev, AcausalDiagram().add(Loop(ev, "loop")))()


def a_child_not_added():
    ev = EqnEnv()
    AcausalCompiler(ev, AcausalDiagram().add(Loop(ev, "loop", added=False)))()


def a_port_that_does_not_exist():
    ev = EqnEnv()
    r = el.Resistor(ev, "r")
    AcausalDiagram().connect(r, "plus", el.Ground(ev, "g"), "p")


PROVOKED = [
    the_equation_of_a_port_forgotten, an_equation_too_many, capacitors_in_parallel, an_input_not_given,
    a_name_inside_a_list, a_linear_solver_of_another_kind, a_solver_by_name, a_solver_not_made, an_option_of_scipy,
    a_keyword_of_a_component, a_root_of_a_negative_number, chattering, a_ball_that_comes_to_rest, starts_off_a_circle,
    units, two_domains, the_input_of_a_child_bound_by_an_equation, a_child_not_added, a_port_that_does_not_exist,
]  # fmt: skip


def seen(provoke) -> str:
    """What a user sees below the traceback, with the lines of code made anonymous."""
    with pytest.raises(JaxonomyDaeError) as caught:
        provoke()
    text = "".join(traceback.format_exception_only(caught.value)).strip()
    return LINE.sub("(models.py:57)", text.removeprefix(f"{type(caught.value).__module__}."))


def title(provoke) -> str:
    return provoke.__name__.replace("_", " ").replace("scipy", "SciPy")


@pytest.mark.parametrize("provoke", slow(PROVOKED, chattering, a_ball_that_comes_to_rest), ids=title)
def test_the_text_on_the_page(provoke):
    assert on_the_page()[title(provoke)] == seen(provoke)


def test_the_page_has_no_others():
    assert [*on_the_page()] == [title(provoke) for provoke in PROVOKED]


def test_the_lines_are_those_of_the_code():
    """The line of `add_equations` where a component of one's own wrote an equation, else where the library's component
    was made."""
    here = pathlib.Path(__file__).read_text().splitlines()
    with pytest.raises(JaxonomyDaeError) as caught:
        an_equation_too_many()
    lines = [int(k) for k in re.findall(r"test_errors_in_full\.py:(\d+)", str(caught.value))]
    assert len(lines) >= 3 and all("add_equations" in here[k - 1] or "super().__init__" in here[k - 1] for k in lines)


def test_where_a_model_is_written_does_not_change_it():
    """Lines of code are for messages: two models that differ in them share plans, and so programs."""
    ev = EqnEnv()
    first = el.Resistor(ev, "r")
    one = circuit(el.VoltageSource(ev, "s", V=1.0), first)().plan
    ev = EqnEnv()
    other = circuit(el.VoltageSource(ev, "s", V=1.0), el.Resistor(ev, "r"))().plan
    assert one == other and one.digest == other.digest


if __name__ == "__main__":  # writes the section
    jax.config.update("jax_enable_x64", True)
    texts = [f'```text title="{title(provoke)}"\n{seen(provoke)}\n```' for provoke in PROVOKED]
    before, mark, rest = PAGE.read_text().partition("## In full\n")
    section, after, rest = rest.partition("\n## ")
    PAGE.write_text("\n\n".join([before + mark + section.partition("\n```")[0].rstrip(), *texts]) + "\n" + after + rest)
