"""Events as they are declared: what is refused, and what is said of it."""

import pytest
import sympy
from problems import compiled, component
from sympy import Eq

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
)
from jaxonomy_dae.library import hydraulic as hyd
from jaxonomy_dae.library import signal as sig
from jaxonomy_dae.write.automatic_events import relations_left_alone
from jaxonomy_dae.write.events import guard_of, has_guard
from jaxonomy_dae.write.symbols import DiscreteSymbol, VariableSymbol
from jaxonomy_dae.write.timed_relations import edges_of, whole_edges


def clock_hand(self):
    """A state that is the time since the last reset."""
    x = self.variable("x", start=0.0, fixed=True)
    self.add_equations(Eq(der(x), 1))
    return x


def model(write):
    return compiled(component(write))


def test_one_state_by_two_names():
    def write(self, ev):
        x, z = clock_hand(self), self.variable("z")
        self.add_equations(Eq(z, -2 * x))
        self.when(x >= 1, reinit(z, 0.0), reinit(x, 0.5))

    with pytest.raises(ModelError, match=r"'c.z' and 'c.x' are one state"):
        model(write)


OUTSIDE = {
    "an equation": lambda self, d: self.add_equations(Eq(self.variable("y"), pre(d))),
    "an output": lambda self, d: self.output("y", pre(d)),
    "the start of a variable": lambda self, d: self.variable("y", start=pre(d)),
    "the start of a discrete variable": lambda self, d: self.discrete("y", start=pre(d)),
    "a period": lambda self, d: self.sampled(pre(d)),
    "a mode": lambda self, d: self.either(Eq(pre(d), 1), self.variable("y"), 0),
    "a condition": lambda self, d: self.when(self.symbol("x") > pre(d), assign(d, 1)),
}


@pytest.mark.parametrize("where", OUTSIDE)
def test_pre_is_for_actions(where):
    def write(self, ev):
        clock_hand(self)
        OUTSIDE[where](self, self.discrete("d"))

    with pytest.raises(ModelError, match=r"pre\(d\)"):
        model(write)


@pytest.mark.parametrize(
    "write",
    [lambda self, y, d: self.either(Eq(d, 1), y > 1, y), lambda self, y, d: self.complementary(y, Eq(y, 2))],
    ids=["either", "complementary"],
)
def test_branches_that_are_not_expressions(write):
    with pytest.raises(ModelError, match=r"component 'c': (either|complementary): .*y.* is not an expression"):
        model(lambda self, ev: write(self, self.variable("y"), self.discrete("d")))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 2 * sympy.I])
def test_values_that_are_not_finite_numbers(value):
    def write(self, ev):
        self.when(clock_hand(self) >= 1, assign(self.discrete("d"), value))

    with pytest.raises(ModelError, match="finite and real"):
        component(write)


class Loop(Component):
    """A sampled block without delay: what it samples at once shows in its output."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, a = self.input("u"), self.discrete("a")
        y = self.variable("y")
        self.add_equations(Eq(y, a))
        self.when(self.sampled(0.1), assign(a, u + 1))


def test_a_sampled_loop_through_equations_is_refused():
    ev, diagram = EqnEnv(), AcausalDiagram()
    one, two, total = Loop(ev, "one"), Loop(ev, "two"), sig.Integrator(ev, "total")
    diagram.add(one, two, total)
    diagram.connect(one.y, two.u, total.u)
    diagram.connect(two.y, one.u)
    with pytest.raises(ModelError, match="need each other's results"):
        AcausalCompiler(ev, diagram)()


def test_what_blocks_refuse():
    ev = EqnEnv()
    with pytest.raises(ModelError, match="denominator"):
        sig.DiscreteTransferFunction(ev, "a", [1.0, 2.0], [1.0])
    with pytest.raises(ModelError, match="samples"):
        sig.SampledDelay(ev, "b", 0)
    with pytest.raises(ModelError, match="period"):
        sig.SampleHold(ev, "c", period=0.0)


def test_a_relief_valve_shuts_below_where_it_opens():
    with pytest.raises(ModelError, match="'valve': p_close must not be above p_open"):
        hyd.ReliefValve(EqnEnv(), "valve", p_open=1e6, p_close=4e6)


def test_whether_a_condition_has_a_guard_is_known_without_making_it(monkeypatch):
    """A condition that joins relations of long sums took SymPy half a minute: it compares all sides of the relations
    when it makes their maximum. Only whether there is a guard was asked."""
    x, y, d = VariableSymbol("x"), VariableSymbol("y"), DiscreteSymbol("d")
    relations = [x > 1, y <= x, Eq(d, 1), Eq(x, 1), sympy.Ne(y, x), d > 0]
    conditions = [*relations, *(join(a, b) for join in (sympy.And, sympy.Or) for a in relations for b in relations)]
    conditions += [sympy.Not(c) for c in conditions]
    expected = []
    for c in conditions:
        try:
            guard_of(c, "")
            expected.append(True)
        except ModelError:
            expected.append(False)
    monkeypatch.setattr(sympy, "Max", None)
    monkeypatch.setattr(sympy, "Min", None)
    assert [has_guard(c) for c in conditions] == expected
    assert {True, False} == set(expected)


def test_a_jump_inside_a_condition_is_an_event():
    """Kind: a jump that was left alone because it makes no difference, though its values do, at the border of a
    relation. sign(w − 1) ≥ 1/3 and sign(w − 1) < 1 exclude each other before w = 1 and after it, so that the sign was
    taken for smooth; its jump onto 1 left the strict relation true, and the branch on."""
    w = VariableSymbol("c.w")
    sign = sympy.sign(w - 1)
    both = sympy.And(sign >= sympy.Rational(1, 3), sign < 1)
    assert relations_left_alone(w - sympy.Piecewise((1, both), (0, True))) == ()
    # A kink that does not jump is still left alone there.
    (left,) = relations_left_alone(w - sympy.Piecewise((1, sympy.Abs(w) >= 1), (0, True)))
    assert left.args[0] == sympy.Abs(w)


def test_a_relation_in_which_time_cancels():
    """Of a·(t + 1) − a·t > ½ nothing is left that turns: it was divided by its slope in time, zero."""

    def write(c, ev):
        a, x = c.parameter("a", 2.0), c.variable("x", start=0.0, fixed=True)
        still = a * (ev.t + 1) - a * ev.t
        assert edges_of(still > 0.5) is whole_edges(still) is None
        c.add_equations(Eq(der(x), sympy.Piecewise((a, still > 0.5), (0, True))))

    assert not model(write).plan.events.n_clocks


@pytest.mark.parametrize("clock", [("0.1",), (0.1, float("nan")), (0.1, float("inf")), (0.1, sympy.I)])
def test_clocks_that_could_not_tick(clock):
    """A clock whose offset is no number never ticked, without a word."""
    with pytest.raises(ModelError, match=r"component 'c': the (period|offset) of sampled (is|must be) "):
        component(lambda c, ev: c.when(c.sampled(*clock), assign(c.discrete("n"), 1)))
