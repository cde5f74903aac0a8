"""What is printed stays short, whatever part or batch of a system it is, and notebooks get tables."""

import html.parser

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import compiled, pendulum, rc_circuit

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, ModelError, der
from jaxonomy_dae.learning import fit


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


def test_a_fit_in_one_line(rc):
    result = fit(rc, lambda s: s.parameters["r.R"] ** 2, optax.sgd(0.25), 2, train="r.R", progress=False)
    assert repr(result) == "Fit(loss 4 → 0.25, best after 2 steps: all 2 steps were taken)"
    assert "0.25" in result._repr_html_()


# --- vectors of variables ----------------------------------------------------------------------------------------


class Rotor(Component):
    """r' = ω × r, in the plane: r[0]' = −ω·r[1], r[1]' = ω·r[0]."""

    def __init__(self, ev, name, start):
        super().__init__(ev, name)
        w = self.parameter("w", 2.0)
        r = self.vector("r", 2, start=start, fixed=True)
        self.add_equations(der(r[0]) + w * r[1], der(r[1]) - w * r[0])


@pytest.mark.parametrize(
    "start, expected", [((3.0, 4.0), [3.0, 4.0]), (1.5, [1.5, 1.5]), (np.array([1.0, 2.0]), [1, 2])]
)
def test_vectors(start, expected):
    system = compiled(Rotor(EqnEnv(), "c", start))
    assert system.variables == ["c.r[0]", "c.r[1]"] and set(system.states) == set(system.variables)
    state = system.initialize()
    np.testing.assert_allclose(system.observe(["c.r[0]", "c.r[1]"], 0.0, state), expected)
    slopes = system.observe(["der(c.r[0])", "der(c.r[1])"], 0.0, state)
    np.testing.assert_allclose(slopes, [-2.0 * expected[1], 2.0 * expected[0]])


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
