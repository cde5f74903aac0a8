"""Starts of models whose derivatives cancel in float coefficients."""

import jax.numpy as jnp
import numpy as np
import pytest
from attack import descriptors

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der
from jaxonomy_dae.errors import InitializationError


class _Written(Component):
    def __init__(self, ev, names, equations):
        super().__init__(ev, "d")
        self.add_equations(*equations(*(self.variable(name) for name in names), ev.t))


def _compiled(names, equations):
    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(_Written(ev, names, equations)))()


@pytest.mark.parametrize("seed", range(4))
def test_derivatives_that_cancel_in_floats(seed):
    s = 10.0 ** np.random.default_rng(seed).uniform(-12, 9, 4)

    def equations(x, y, t):
        current = 1e-6 * (s[0] * der(x) - s[1] * der(y))
        return s[2] * (current + 0.3 * s[0] * x - 0.1), s[3] * (-current + 0.7 * s[1] * y - 0.2)

    system = _compiled(["x", "y"], equations)
    assert len(system.states) == 1
    start = system.initialize(initial={"d.x": 1 / s[0]})
    # The sum of the equations is 0.3·X + 0.7·Y = 0.3, in X = s₀·x and Y = s₁·y.
    np.testing.assert_allclose(np.asarray(system.observe("d.x", 0.0, start)) * s[0], 1, rtol=1e-9)
    np.testing.assert_allclose(np.asarray(system.observe("d.y", 0.0, start)) * s[1], 0, atol=1e-9)
    rate = {"d.x": -0.14e6 / s[0], "d.y": 0.06e6 / s[1]}[system.states[0]]
    np.testing.assert_allclose(np.asarray(system.vector_field(0.0, start)), [rate], rtol=1e-9)


@pytest.mark.slow
def test_given_values_that_follow_from_equations_move_nothing():
    # Values that the equations alone determine have gradients of rounding errors.
    case = descriptors.make(10)
    system = AcausalCompiler(case.ev, case.diagram)()
    x = system.initialize(initial=case.initial)
    np.testing.assert_allclose(x, [case.initial[n] for n in system.states], rtol=1e-9)
    rates = [case.rates[n].value for n in system.states]
    np.testing.assert_allclose(system.vector_field(0.0, x), rates, rtol=1e-8)


def test_a_given_value_that_is_a_rounding_error():
    """y = p·x − q·x with p = q to rounding: given as zero, it must not move x, which is given, too; given as more, it
    contradicts it."""

    class Difference(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, y, z = (self.variable(k) for k in "xyz")
            p, q = self.parameter("p", 0.1 + 0.2), self.parameter("q", 0.3)
            self.add_equations(der(x) + x - y, y + z - p * x, z - q * x)

    ev = EqnEnv()
    system = AcausalCompiler(ev, AcausalDiagram().add(Difference(ev, "d")))()
    found = system.initialize(initial={"d.y": 0.0, "d.x": 0.7})
    np.testing.assert_allclose(found, [0.7], rtol=1e-14)
    with pytest.raises(InitializationError, match="contradict"):
        system.initialize(initial={"d.y": 1e-9, "d.x": 0.7})


def test_what_rounding_leaves_of_a_sum_is_zero():
    """0.1 a + 0.2 b − 0.3 c + u = 0 where a = b = c: 5e-17 a is none of it, so that u = 0."""

    def equations(a, b, c, u, v, t):
        return a - b, b - c, 0.1 * a + 0.2 * b - 0.3 * c + u, der(v) + v + u, der(a) + a

    system = _compiled("abcuv", equations)
    assert float(system.observe(["d.u"], 0.0, jnp.array([1e3, 2.0]))[0]) == 0.0
