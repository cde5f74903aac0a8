"""Which waves in time drive a model: their frequencies and phases, as expressions in parameters."""

import numpy as np
import pytest
from sympy import Eq, Piecewise, cos, sin

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, assign, der, pre
from jaxonomy_dae.library import electrical as el


def compiled(write):
    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            write(self)

    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(Written(ev, "d")))()


def waves(system):
    """{(ω, φ)} of the plan, evaluated in NumPy."""
    plan, found = system.plan, set()
    values = plan.flat.parameters.everything(system.parameters.known)
    for group in plan.waves:
        n, given = len(group), group.numbers(values)
        both = [
            np.full(n, np.nan) if part is None else np.broadcast_to(part.residual([], *given, 0.0, None, "numpy"), (n,))
            for part in (group.template, group.phase)
        ]
        found |= {(float(f"{w:.12g}"), float(f"{p:.12g}")) for w, p in zip(*both, strict=True)}
    return found


def driven(force):
    """x' = -x + force, and y = sin(77·t), on which nothing depends."""

    def write(self):
        x, y = self.variable("x", start=0.0, fixed=True), self.variable("y")
        w, p = self.parameter("w", 5.0), self.parameter("p", 0.25)
        self.add_equations(Eq(der(x), -x + force(self.ev.t, w, p, x)), Eq(y, sin(77 * self.ev.t)))

    return write


@pytest.mark.parametrize(
    ("force", "expected"),
    [
        (lambda t, w, p, x: sin(3 * t), {(3.0, 0.0)}),
        (lambda t, w, p, x: cos(w * t + p) ** 2 * x, {(5.0, 0.25)}),
        (lambda t, w, p, x: sin(w * t - p) * sin(2 * w * t), {(5.0, -0.25), (10.0, 0.0)}),
        (lambda t, w, p, x: sin(w * (t - p)), {(5.0, -1.25)}),
        (lambda t, w, p, x: sin(w * t + x), {(5.0, float("nan"))}),  # its phase moves
        (lambda t, w, p, x: sin(w * t**2) + sin(x * t) + sin(x), set()),  # no frequency, or not one
    ],
)
def test_frequencies_and_phases(force, expected):
    found = waves(compiled(driven(force)))
    assert sorted(map(str, found)) == sorted(map(str, expected))


def test_waves_of_library_sources():
    """Each once, whatever is connected to it; three phases are three waves."""
    ev, d = EqnEnv(), AcausalDiagram()
    ground = el.Ground(ev, "g")
    for k in range(6):
        v = el.SineVoltage(ev, f"v{k}", 10.0, 50.0, phase=(k % 3) * 0.5)
        r, c = el.Resistor(ev, f"r{k}"), el.Capacitor(ev, f"c{k}", 1.0, 0.0)
        d.connect(v.p, r.p).connect(r.n, c.p).connect(c.n, v.n, ground.p)
    w = float(f"{100 * np.pi:.12g}")
    assert waves(AcausalCompiler(ev, d)()) == {(w, 0.0), (w, 0.5), (w, 1.0)}


def test_the_frequency_of_a_constraint_and_of_a_condition():
    def write(self):
        x, v = self.variable("x"), self.variable("v")
        n = self.discrete("n", start=0)
        y = self.variable("y", start=1.0, fixed=True)
        self.add_equations(Eq(x, sin(4 * self.ev.t)), Eq(der(x), v), Eq(der(y), v))
        self.when(y - 3 * cos(9 * self.ev.t) <= 0, assign(n, pre(n) + 1))

    assert {w for w, _ in waves(compiled(write))} == {4.0, 9.0}


def weights(system, p):
    """The weights of the waves of the plan where the parameter p is `p`, in NumPy; None where they are not known."""
    plan = system.plan
    values = np.array(plan.flat.parameters.everything(system.parameters.known))
    values[plan.flat.parameters.names.index("d.p")] = p
    found = []
    for group in plan.waves:
        given = [values[c] for c in group.parameter.T], list(group.coefficient.T)
        weight = group.weight
        found.append(None if weight is None else float(np.ravel(weight.residual([], *given, 0.0, None, "numpy"))[0]))
    return found


@pytest.mark.parametrize(
    ("force", "is_zero"),
    [
        (lambda t, w, p, x: p * sin(w * t), True),
        (lambda t, w, p, x: x**2 * p * cos(w * t) ** 3, True),
        (lambda t, w, p, x: p * sin(w * t) + cos(w * t), False),
        (lambda t, w, p, x: (1 + p) * sin(w * t), False),
        (lambda t, w, p, x: x * sin(w * t + p), False),
    ],
)
def test_waves_on_which_nothing_depends(force, is_zero):
    """Kind: a source that is switched off changes the run. Its amplitude is a factor that is zero."""
    system = compiled(driven(force))
    assert [weight == 0.0 for weight in weights(system, 0.0)] == [is_zero]
    assert weights(system, 0.3)[0] > 0.0


def test_branches_have_no_weight():
    """A derivative that is zero on the branch at hand says nothing of the other one."""
    found = weights(compiled(driven(lambda t, w, p, x: Piecewise((sin(w * t), x > 2), (0.0, True)))), 0.0)
    assert found == [None]
