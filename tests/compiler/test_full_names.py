"""Full names are made when they are asked for, and found without a table of all."""

import numpy as np
import pytest

from jaxonomy_dae import AcausalDiagram, Component, Electrical, EqnEnv, der
from jaxonomy_dae.compile.passes.flatten import flatten
from jaxonomy_dae.library.electrical import Capacitor, Resistor


class Pair(Component):
    """Two resistors in an array inside an array, with a start of a derivative."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        r = self.add_array("r", Resistor, 2)
        x = self.variable("x", start=1.0, fixed=True)
        self.start(der(x), 0.5)
        self.add_equations(der(x) + x)
        self.connect(p, r[0].p)
        self.connect(r[0].n, r[1].p)
        self.connect(r[1].n, n)


@pytest.fixture(scope="module")
def flat():
    ev, diagram = EqnEnv(), AcausalDiagram()
    pairs = diagram.add_array(ev, "pair", Pair, (2, 3))
    one = Capacitor(ev, "one")
    diagram.connect(pairs.p, one.p)
    diagram.connect(pairs.n, one.n)
    return flatten(diagram)


def test_every_name_is_found_at_its_place(flat):
    """A table of twelve million names took a quarter of the memory of a large model."""
    for names in (flat.variables.names, flat.parameters.names, flat.ports.names):
        every = list(names)
        assert len(set(every)) == len(every) == len(names)
        assert [names.number[name] for name in every] == list(range(len(every)))
        assert [names[k] for k in range(len(every))] == every and list(names[:5]) == every[:5]
    assert "pair[1,2].r[0].p.v" in flat.variables.names and "pair[1,2].r[0].R" in flat.parameters.names
    assert any(name.startswith("der(pair[0,1].x)") for name in flat.variables.names)


def test_names_that_nothing_has_are_not_found(flat):
    names = flat.variables.names
    for name in ("", ".", "one", "one.", "one.v.", "pair.x", "pair[2,0].x", "pair[0,0].r[2].v", "der(one.v)", "x", 3):
        assert name not in names and name not in names.number
    with pytest.raises(ValueError, match="is not one of these names"):
        names.index("one.w")
    assert names[-1] == list(names)[-1] and names.followed_by(["more"]).number["more"] == len(names)
    assert np.all([names.index(name) == k for k, name in enumerate(names)])
