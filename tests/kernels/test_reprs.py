"""What is printed stays short, whatever part or batch of a system it is, and notebooks get tables."""

import html.parser

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import compiled, pendulum, rc_circuit
from sympy import Piecewise

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    ModelError,
    assign,
    der,
    pre,
    reinit,
    terminate,
)
from jaxonomy_dae.learning import minimize
from jaxonomy_dae.library import signal
from jaxonomy_dae.write import Eq


@pytest.fixture(scope="module")
def rc():
    return rc_circuit(R=2.0, C=0.5)


def test_a_system_in_one_line(rc):
    assert repr(rc) == "AcausalSystem(1 state (c.v), 17 algebraic variables, 4 parameters)"
    text = repr(pendulum())
    assert "\n" not in text and "4 states (pend.x, pend.vx, pend.y, pend.vy)" in text


def test_a_system_has_the_name_of_its_diagram():
    class Decay(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, u = self.variable("x", start=1.0, fixed=True), self.input("u", default=0.0)
            self.add_equations(der(x) + x - u)

    def model(name):
        ev = EqnEnv()
        return AcausalCompiler(ev, AcausalDiagram(name).add(Decay(ev, "c")))()

    assert (
        repr(model("tank"))
        == "AcausalSystem('tank': 1 state (c.x), 0 algebraic variables, 0 parameters, 1 input (c.u))"
    )
    assert model("tank").plan == model("tank").plan != model("vessel").plan


def test_parts_masks_and_batches_print(rc):
    trainable, frozen = rc.partition("r.R")
    gradient = eqx.filter_grad(lambda t: eqx.combine(t, frozen).parameters["r.R"] ** 2)(trainable)
    mask = jax.tree.map(lambda _: False, rc)
    shapes = eqx.filter_eval_shape(lambda s: s, rc)
    batch = eqx.filter_vmap(lambda r: rc.with_parameters({"r.R": r}))(jnp.ones(3))
    for system in (trainable, frozen, gradient, mask, shapes, batch, rc):
        for part in (system, system.parameters):
            assert "\n" not in repr(part) and len(repr(part)) < 300
            assert "<" in part._repr_html_()
    assert "a batch of shape (3,)" in repr(batch)
    assert repr(gradient.parameters) == "Parameters(r.R=4; the others are in the frozen part)"
    printed = []
    jax.jit(lambda s: printed.append(repr(s.parameters)))(rc)
    assert "r.R=" in printed[0]


class Cells(html.parser.HTMLParser):
    """The cells of a table, and whether every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.cells, self.open = [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] == ["td"]:
            self.cells.append(data)


def test_tables_in_notebooks():
    ev = EqnEnv()

    class Held(Component):
        def __init__(self, ev, name, k):
            super().__init__(ev, name)
            self.parameter("k", k, unit="V<", bounds=(0.0, 9.0))
            x = self.variable("x")
            self.add_equations(x - self.k)

    system = compiled(Held(ev, "c", 2.5), Held(ev, "d", 2 * Held(ev, "c", 1.0).k))
    cells = Cells(system.parameters._repr_html_()).cells
    assert cells == ["c.k", "2.5", "V<", "[0, 9]", "d.k", "5", "V<", "[0, 9]", "= 2*c.k"]
    Cells(system._repr_html_().replace("<br>", ""))


def test_what_was_minimized_in_one_line(rc):
    result = minimize(rc, lambda s: s.parameters["r.R"] ** 2, optax.sgd(0.25), 2, train="r.R", progress=False)
    assert repr(result) == "Minimized(loss 4 → 0.25, best after 2 steps: all 2 steps were taken)"
    assert "0.25" in result._repr_html_()


# --- events in reports -------------------------------------------------------------------------------------------


class Everything(Component):
    """An event of each kind, and an equation with two branches."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        T, first = self.parameter("T", 0.1), self.parameter("first", 2.0)
        x = self.variable("x", start=1.0, fixed=True)
        i, y = self.variable("i"), self.variable("y")
        n, mode = self.discrete("n", start=first / 4), self.discrete("mode", start=1)
        self.add_equations(Eq(der(x), -i))
        self.either(Eq(mode, 1), i - x, i)
        self.add_equations(Piecewise((y - n, x > n), (y, True)))  # a relation in a variable is not a mode
        self.when(x < 0.5, reinit(x, 2 * x), assign(mode, 0))
        self.when(x > 9, terminate("too large"))
        self.when(self.sampled(T, 0.05), assign(n, pre(n) + x))


def section(report, title):
    lines = str(report).splitlines()
    start = lines.index(f"{title}:") + 1
    end = next((k for k in range(start, len(lines)) if not lines[k].startswith("    ")), len(lines))
    return [line.strip() for line in lines[start:end]]


def test_a_report_lists_events():
    system = compiled(Everything(EqnEnv(), "c"))
    report = system.report
    assert section(report, "2 discrete variables") == ["c.n = 0.5, c.mode = 1"]
    assert section(report, "2 events") == [
        "c: when(x < 0.5): reinit(c.x, …), assign(c.mode, 0)",
        "c: when(x > 9): terminate('too large')",
    ]
    assert section(report, "1 clock") == ["c: when(sampled(T)), every 0.1 s from 0.05 s: assign(c.n, …)"]
    (mode,) = section(report, "equations that change with a mode")
    assert mode.startswith("c: 0 = Piecewise(") and "Eq(mode, 1)" in mode
    assert "too large" in report._repr_html_() and "<summary>1 clock</summary>" in report._repr_html_()

    # Starts and periods are those of the system at hand; of a batch, and of a part, none is known, and none is said.
    changed = system.with_parameters({"c.T": 0.25, "c.first": 6.0, "c.mode": 0.0})
    assert section(changed.report, "2 discrete variables") == ["c.n = 1.5, c.mode = 0"]
    assert "every 0.25 s" in str(changed.report)
    trainable, frozen = changed.partition("c.T")
    assert "every 0.25 s" in str(eqx.combine(trainable, frozen).report)
    batch = eqx.filter_vmap(lambda T: system.with_parameters({"c.T": T}))(jnp.array([0.2, 0.3]))
    for part in (batch, trainable, frozen, jax.tree.map(lambda _: False, system)):
        assert section(part.report, "1 clock") == ["c: when(sampled(T)): assign(c.n, …)"]
        assert section(part.report, "2 discrete variables") == ["c.n, c.mode"]
    printed = []
    jax.jit(lambda s: printed.append((str(changed.report), str(s.report))))(changed)
    assert "every 0.25 s" in printed[0][0] and "every" not in printed[0][1]  # inside jit values are not known


def test_jumps_of_sources_are_relations_of_a_report():
    report = compiled(signal.Pulse(EqnEnv(), "pulse")).report
    assert not any(word in str(report) for word in ("event", "clock", "discrete", "mode"))
    assert len(report.relations) == 2 and all(text.startswith("pulse: ") for text in report.relations)
    assert "relations at which steps end:\n    pulse: " in str(report)


def test_a_report_without_events(rc):
    report = str(rc.report)
    assert not any(word in report for word in ("event", "clock", "discrete", "mode"))


def test_one_of_each_in_a_report():
    class Decay(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, u, k = self.variable("x", start=1.0, fixed=True), self.input("u", default=0.0), self.parameter("k", 2.0)
            self.add_equations(der(x) + k * x - u)

    lines = str(compiled(Decay(EqnEnv(), "c")).report).splitlines()
    assert lines[0] == "1 equation, 1 unknown, 1 parameter, 1 input"
    assert lines[1] == "0 aliases eliminated, 1 equation of 1 shape remains"
    assert lines[2].endswith(", 1 degree of freedom") and lines[5] == "1 state:"
    several = str(pendulum().report)
    assert "2 degrees of freedom" in several and "4 states:" in several


# --- vectors of variables ----------------------------------------------------------------------------------------


class Rotor(Component):
    """r' = ω × r, in the plane: r[0]' = −ω·r[1], r[1]' = ω·r[0]."""

    def __init__(self, ev, name, start):
        super().__init__(ev, name)
        w = self.parameter("w", 2.0)
        r = self.vector("r", 2, start=start, fixed=True)
        self.add_equations(der(r[0]) + w * r[1], der(r[1]) - w * r[0])


STARTS = [((3.0, 4.0), [3.0, 4.0]), (1.5, [1.5, 1.5]), (np.array([1.0, 2.0]), [1.0, 2.0])]


def test_vectors():
    ev = EqnEnv()
    system = compiled(*(Rotor(ev, f"c{k}", start) for k, (start, _) in enumerate(STARTS)))
    names = [f"c{k}.r[{j}]" for k in range(len(STARTS)) for j in range(2)]
    assert system.variables == names and set(system.states) == set(names)

    @jax.jit
    def started():
        state = system.initialize()
        return system.observe([*names, *(f"der({n})" for n in names)], 0.0, state)

    expected = np.array([values for _, values in STARTS])
    slopes = np.stack([-2.0 * expected[:, 1], 2.0 * expected[:, 0]], 1)
    np.testing.assert_allclose(started(), [*expected.ravel(), *slopes.ravel()])


@pytest.mark.parametrize(
    "write, message",
    [
        (lambda c: c.vector("r", 0), "'c.r' needs a positive number of entries; got 0"),
        (lambda c: c.vector("r", 2, start=[1.0]), "'c.r' needs 2 starts; got 1"),
        (lambda c: (c.vector("r", 2), c.vector("r", 3)), "uses the name 'r' twice: it is a vector variable"),
        (lambda c: (c.vector("r", 2), c.parameter("r", 3.0)), "uses the name 'r' twice: it is a vector variable"),
    ],
)
def test_vectors_that_cannot_be(write, message):
    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            write(self)

    with pytest.raises(ModelError, match=message):
        Written(EqnEnv(), "c")
