"""What each pass did can be read in the user's names, and a pass of the user's own runs before the others."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, ModelError, der
from jaxonomy_dae.compile.model.tables import ZERO
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.planar import PlanarPendulum


class Reaction(Component):
    """A → B → C, with rates k1 and k2."""

    def __init__(self, ev, name, k1=1.0, k2=1000.0):
        super().__init__(ev, name)
        a = self.variable("A", start=1.0, fixed=True)
        b = self.variable("B", start=0.0, fixed=True)
        c = self.variable("C", start=0.0, fixed=True)
        k1, k2 = self.parameter("k1", k1), self.parameter("k2", k2)
        self.add_equations(Eq(der(a), -k1 * a), Eq(der(b), k1 * a - k2 * b), Eq(der(c), k2 * b))


def quasi_steady(*names):
    """A pass for fast variables."""

    def passed(flat):
        """Sets the derivatives of fast variables to zero."""
        fast = [flat.variables.index[name] for name in names]

        def steady(group):
            hit = np.isin(group.variable, fast) & (group.order == 1)
            columns = {"variable": ZERO, "order": 0, "factor": 0.0}
            changed = {name: np.where(hit, zero, getattr(group, name)) for name, zero in columns.items()}
            return dataclasses.replace(group, **changed) if hit.any() else group

        fixed = flat.variables.fixed.copy()
        fixed[fast] = False  # their starts are guesses now
        variables = dataclasses.replace(flat.variables, fixed=fixed)
        return dataclasses.replace(flat, groups=tuple(map(steady, flat.groups)), variables=variables)

    passed.__name__ = "quasi_steady"
    return passed


def compiled(component, passes=()):
    diagram = AcausalDiagram()
    diagram.add(component)
    compiler = AcausalCompiler(component.ev, diagram, passes=passes)
    return compiler, compiler()


def test_a_pass_of_the_users_own():
    compiler, system = compiled(Reaction(EqnEnv(), "r"), [quasi_steady("r.B")])
    assert compiler.report.states == ["r.A", "r.C"]
    a = 0.25
    assert np.allclose(system.vector_field(0.0, jnp.array([a, 0.0]), None), [-a, a], rtol=1e-14)
    found = compiler.passes["quasi_steady"]
    assert found.does == "Sets the derivatives of fast variables to zero."
    assert len(found.lines) == 1 and found.lines[0].startswith("~ r: ") and "der(B)" in found.lines[0]
    # The names of the passes are in the order in which they ran.
    assert [each.name for each in compiler.passes][:3] == ["flatten", "quasi_steady", "eliminate_aliases"]


def test_a_model_after_a_pass_is_another_one():
    """Kind: a result that hangs on the model that was compiled before."""
    slow = compiled(Reaction(EqnEnv(), "r"))[1]
    fast = compiled(Reaction(EqnEnv(), "r"), [quasi_steady("r.B")])[1]
    again = compiled(Reaction(EqnEnv(), "r"))[1]
    assert slow.plan == again.plan and slow.plan != fast.plan


def test_a_variable_may_be_zero_in_any_equation():
    """The passes that follow take ZERO for a variable in equations of every kind, linear ones too."""

    def without_n(flat):
        ground = flat.variables.index["c.n.v"]

        def zero(group):
            hit = group.variable == ground
            columns = {"variable": ZERO, "order": 0, "factor": 0.0}
            changed = {name: np.where(hit, value, getattr(group, name)) for name, value in columns.items()}
            return dataclasses.replace(group, **changed)

        return dataclasses.replace(flat, groups=(*map(zero, flat.groups[:1]), *flat.groups[1:]))

    (compiler, system), (_, plain) = rc([without_n]), rc()
    assert compiler.passes["without_n"].count > 0
    x = jnp.array([2.0])
    assert system.vector_field(0.0, x, None) == plain.vector_field(0.0, x, None)


def rc(passes=()):
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, r = VoltageSource(ev, "source", V=5.0), Resistor(ev, "r", R=100.0)
    c, ground = Capacitor(ev, "c", C=1e-3), Ground(ev, "ground")
    diagram.connect(source.p, r.p)
    diagram.connect(r.n, c.p)
    diagram.connect(c.n, source.n, ground.p)
    compiler = AcausalCompiler(ev, diagram, passes=passes)
    return compiler, compiler()


def test_what_passes_did_to_a_circuit():
    passes = rc()[0].passes
    assert passes["flatten"].count == 20 == len(passes["flatten"].lines)
    assert {"r.i = −source.i", "c.n.v = 0", "r.n.v = c.v"} <= set(passes["eliminate_aliases"].lines)
    assert passes["select_states"].lines == ["states: c.v"]
    ordered = passes["order_blocks"].lines
    assert [line.partition(" ← ")[0] for line in ordered][-1] == "der(c.v)"
    assert len(ordered) == 4 and passes["schedule"].lines == ["4 equations solved for one unknown each, in closed form"]
    text = str(passes)
    assert "3. reduce_index" in text and "nothing to do" in text and "… and 8 more" in text


def test_what_passes_did_to_a_pendulum():
    """A rod of fixed length: its constraint is differentiated twice (Pantelides 1988)."""
    passes = compiled(PlanarPendulum(EqnEnv(), "p"))[0].passes
    differentiated = passes["reduce_index"].lines
    assert any(line.startswith("2× p: ") for line in differentiated)
    selected = passes["select_states"].lines
    assert any(line.startswith("projected onto: ") for line in selected)
    assert any("together" in line for line in passes["order_blocks"].lines)
    assert any("linear; torn at" in line for line in passes["schedule"].lines)


def test_wrong_passes():
    with pytest.raises(ModelError, match=r"the pass 'nothing' must return a FlatModel; got NoneType"):
        compiled(Reaction(EqnEnv(), "r"), [nothing])
    with pytest.raises(ModelError, match=r"passes is a list of functions of a FlatModel; entry 0 is 'alias'"):
        compiled(Reaction(EqnEnv(), "r"), ["alias"])
    ev = EqnEnv()
    with pytest.raises(ModelError, match="nothing has been compiled yet"):
        _ = AcausalCompiler(ev, AcausalDiagram()).passes
    with pytest.raises(KeyError, match="there is no pass 'blocks': flatten, eliminate_aliases"):
        rc()[0].passes["blocks"]


def nothing(flat):
    """Returns nothing."""
