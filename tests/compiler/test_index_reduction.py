"""Index reduction and exact cancellation, on the literature's own examples."""

import numpy as np
import pytest
import sympy
from problems import rc_ladder
from testset import PROBLEMS

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, StructuralError, der
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.translational import FixedPosition, Mass, Rod

EV = EqnEnv()


def compiled(*components, **options):
    diagram = AcausalDiagram()
    diagram.add(*components)
    return AcausalCompiler(EV, diagram, **options)()


def written(equations, starts=None, name="m"):
    """A component with the variables that `equations(v)` asks for by name."""
    starts = starts or {}

    class Written(Component):
        def __init__(self):
            super().__init__(EV, name)

            class Variables(dict):
                def __missing__(variables, key):  # noqa: N805
                    start = starts.get(key)
                    variables[key] = self.variable(key, start=start, fixed=start is not None)
                    return variables[key]

            self.add_equations(*equations(Variables()))

    return Written()


def counts(system):
    """Differentiations by equation text, without the component's name."""
    return {text.split(": ", 1)[1]: n for text, n in system.report.differentiated}


# --- the literature --------------------------------------------------------------------------------------------


def test_pantelides_pendulum():
    # Pantelides (1988), example: x'' = xT, y'' = yT − g, x² + y² = L² in first-order form: the constraint twice, the
    # two definitions of velocities once.
    def equations(v):
        x, y, w, z, tension = v["x"], v["y"], v["w"], v["z"], v["T"]
        return (
            der(x) - w,
            der(y) - z,
            der(w) - tension * x,
            der(z) - tension * y + 1,
            x**2 + y**2 - 1,
        )

    system = compiled(written(equations, {"x": 0.6, "w": 0.0}))
    assert sorted(counts(system).values()) == [1, 1, 2]
    assert counts(system)["0 = x**2 + y**2 - 1"] == 2
    assert system.report.index == 3 and system.report.degrees_of_freedom == 2


def test_mattsson_soederlind_linear_example():
    # Mattsson & Söderlind (1993), the linear example of section 2: x₁ + x₂ + u₁ = 0, x₁ + x₂ + x₃ + u₂ = 0,
    # x₁ + x₃' + x₄ + u₃ = 0, 2x₁'' + x₂'' + x₃'' + x₄' + u₄ = 0. Pantelides' algorithm differentiates the equations
    # (2, 2, 1, 0) times, and two degrees of freedom are left.
    def equations(v):
        x1, x2, x3, x4, t = v["x1"], v["x2"], v["x3"], v["x4"], EV.t
        return (
            x1 + x2 + sympy.sin(t),
            x1 + x2 + x3 + sympy.cos(t),
            x1 + der(x3) + x4 + t,
            2 * der(der(x1)) + der(der(x2)) + der(der(x3)) + der(x4) + 1,
        )

    system = compiled(written(equations))
    found = counts(system)
    assert [n for text, n in found.items() if "cos" in text] == [2]
    assert [n for text, n in found.items() if "sin" in text] == [2]
    assert [n for text, n in found.items() if "der(x3) + x1" in text or "x1 + x4 + der(x3)" in text] == [1]
    assert len(found) == 3
    assert system.report.degrees_of_freedom == 2 and len(system.states) == 2


def test_exothermic_reactor_with_prescribed_temperature():
    # The exothermic reactor (Pantelides 1988; Unger, Kröner & Marquardt 1995): concentration C and temperature T with
    # reaction rate R, cooled so that C or T follows a given path; the cooling temperature Tc is the unknown. A path on
    # T is differentiated once: index 2. One on C is differentiated twice, its balance and the rate law once: index 3.
    def path_on(which):
        def equations(v):
            c, temperature, rate, cooling = v["C"], v["T"], v["R"], v["Tc"]
            path = c - (0.5 + 0.1 * sympy.exp(-EV.t)) if which == "C" else temperature - (1.0 + 0.1 * sympy.sin(EV.t))
            return (
                der(c) - (1 - c) + rate,
                der(temperature) - (1 - temperature) - 2 * rate + 3 * (temperature - cooling),
                rate - 4 * sympy.exp(-2 / temperature) * c,
                path,
            )

        return equations

    on_c = compiled(written(path_on("C"), {"T": None}))
    assert on_c.report.index == 3 and on_c.report.degrees_of_freedom == 0
    assert sorted(counts(on_c).values()) == [1, 1, 2]
    on_t = compiled(written(path_on("T"), {"C": 0.9}))
    assert on_t.report.index == 2 and on_t.report.degrees_of_freedom == 1
    assert list(counts(on_t).values()) == [1]


def test_two_inertias_on_a_gear():
    # A rigid gear phi1 = n·phi2 between two inertias: index 3, the gear's equation twice, two degrees of freedom.
    def equations(v):
        phi1, phi2, w1, w2, tau = v["phi1"], v["phi2"], v["w1"], v["w2"], v["tau"]
        return (der(phi1) - w1, der(phi2) - w2, 2 * der(w1) + tau - 1, 3 * der(w2) - 10 * tau, phi1 - 10 * phi2)

    system = compiled(written(equations, {"phi1": 0.0, "w1": 0.0}))
    assert system.report.index == 3 and system.report.degrees_of_freedom == 2 and len(system.states) == 2
    assert counts(system)["0 = phi1 - 10*phi2"] == 2


def test_slider_crank_closes_its_loop():
    # Crank of radius 1/2, rod of length 1: x = cos(p) + cos(q)/2, 0 = sin(p) + sin(q)/2, as position constraints of
    # (q, x, p): index 3, one degree of freedom in position.
    def equations(v):
        q, x, p, lam, mu = v["q"], v["x"], v["p"], v["lam"], v["mu"]
        return (
            der(der(q)) + lam * sympy.sin(q) / 2 + mu * sympy.cos(q) / 2,
            der(der(x)) + lam,
            2 * der(der(p)) + lam * sympy.sin(p) + mu * sympy.cos(p),
            x - sympy.cos(p) - sympy.cos(q) / 2,
            sympy.sin(p) + sympy.sin(q) / 2,
        )

    system = compiled(written(equations, {"q": 1.0}))
    assert system.report.index == 3 and system.report.degrees_of_freedom == 2
    assert sorted(counts(system).values()) == [2, 2]


def circuit(*parts):
    """A circuit from (component, node of p, node of n); node 0 is ground."""
    diagram, nodes = AcausalDiagram(), {}
    for component, p, n in parts:
        for port, node in ((component.p, p), (component.n, n)):
            if node in nodes:
                diagram.connect(nodes[node], port)
            nodes.setdefault(node, port)
    ground = Ground(EV, "ground")
    diagram.connect(nodes[0], ground.p)
    return AcausalCompiler(EV, diagram)()


def test_two_capacitors_in_parallel():
    c1, c2 = Capacitor(EV, "c1", C=1.0, initial_voltage=1.0), Capacitor(EV, "c2", C=3.0)
    system = circuit((c1, 1, 0), (c2, 1, 0), (Resistor(EV, "r", R=0.5), 1, 0))
    assert system.report.index == 2 and system.report.degrees_of_freedom == 1 and len(system.states) == 1


def test_capacitor_loop_with_a_source():
    source = VoltageSource(EV, "source", V=2.0)
    c1, c2 = Capacitor(EV, "c1", C=1.0), Capacitor(EV, "c2", C=3.0, initial_voltage=0.5)
    system = circuit((source, 1, 0), (c1, 1, 2), (c2, 2, 0), (Resistor(EV, "r", R=1.0), 2, 0))
    assert system.report.index == 2 and system.report.degrees_of_freedom == 1


def test_inductor_cut_set():
    l1, l2 = Inductor(EV, "l1", L=1.0, initial_current=1.0), Inductor(EV, "l2", L=2.0)
    system = circuit((Resistor(EV, "r", R=3.0), 1, 0), (l1, 1, 2), (l2, 2, 0))
    assert system.report.index == 2 and system.report.degrees_of_freedom == 1


def test_rigid_rod_between_masses():
    m1, m2 = Mass(EV, "m1", m=1.0, initial_position=0.0, initial_velocity=2.0), Mass(EV, "m2", m=3.0)
    diagram = AcausalDiagram().connect(m1.flange, (rod := Rod(EV, "rod", length=1.5)).flange_a)
    diagram.connect(rod.flange_b, m2.flange)
    system = AcausalCompiler(EV, diagram)()
    assert system.report.index == 3 and system.states == ["m1.s", "m1.v"]


# --- cancellation that structure cannot see --------------------------------------------------------------------


@pytest.mark.slow
def test_transistor_amplifier_has_five_degrees_of_freedom():
    # Structural index 0, true index 1, five degrees of freedom (Mazzia & Magherini 2008; rank of M is 5).
    system = PROBLEMS["transamp"].compile()
    assert system.report.degrees_of_freedom == 5
    assert len([note for note in system.report.notes if "cancel" in note]) == len(system.report.notes) == 3


def test_dependent_equations_are_named():
    def equations(v):
        x, y = v["x"], v["y"]
        return der(x) + der(y) - 1, 2 * der(x) + 2 * der(y) - 2

    with pytest.raises(StructuralError, match="depend on each other"):
        compiled(written(equations))


# --- size ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(100, 200), pytest.param((100, 10_000), marks=pytest.mark.slow)])
def test_the_program_does_not_grow_with_the_model(sizes):
    import jax

    lengths = []
    for n in sizes:
        system = rc_ladder(n)
        x = np.zeros(n)
        lengths.append(len(jax.make_jaxpr(lambda x, system=system: system.vector_field(0.0, x))(x).eqns))
    assert lengths[0] == lengths[1]


def test_unused_wall_is_fine():
    wall, mass = FixedPosition(EV, "wall", position=1.0), Mass(EV, "m", initial_position=0.0, initial_velocity=1.0)
    system = compiled(wall, mass)
    assert system.states == ["m.s", "m.v"]
