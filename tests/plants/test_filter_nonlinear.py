"""The extended filter: through constraints and nonlinear blocks, against filters in minimal coordinates whose
moments SciPy integrates."""

import numpy as np
import pytest
import scipy.integrate
from sympy import Max, cos, sin

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

pytestmark = pytest.mark.slow


def compiled(component):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(component(ev))
    return AcausalCompiler(ev, diagram)()


def at_start(problem):
    """(objective, its evaluation, −ln L) at the start."""
    objective = problem.objective_of(problem._stacked, problem._coordinates(problem._stacked, (), None, None))
    z = objective.coordinates.z_start[objective.free]
    found = objective.evaluate(z)
    weights = objective.weights(z, found)
    return objective, found, weights, weights.cost(z, found.residual)


def extended(field, jacobian, intensity, output, slope, sigma, x, p, times, y):
    """(−ln L, predictions, variances) of an extended Kalman filter in n coordinates, whose moments are integrated to
    1e-11."""
    n, cost, now, seen = len(x), 0.0, 0.0, []

    def moments(t, s):
        x, p = s[:n], s[n:].reshape(n, n)
        a = jacobian(x)
        return np.concatenate([field(x), (a @ p + p @ a.T + intensity(x)).ravel()])

    for t, sample in zip(times, y, strict=True):
        s = np.concatenate([x, p.ravel()])
        s = scipy.integrate.solve_ivp(moments, (now, t), s, "DOP853", rtol=1e-11, atol=1e-14).y[:, -1]
        x, p, now = s[:n], s[n:].reshape(n, n), t
        h = slope(x)
        e, variance = sample - output(x), h @ p @ h + sigma**2
        cost += 0.5 * (e**2 / variance + np.log(variance))
        gain = p @ h / variance
        seen.append((output(x), variance))
        x, p = x + gain * e, p - np.outer(gain, gain) * variance
    return cost, *np.array(seen).T


# --- constraints ------------------------------------------------------------------------------------------------------

LENGTH, MASS, GRAVITY = 1.1, 0.7, 9.81


class Swing(Component):
    """A bob on a rod in Cartesian coordinates, pushed sideways by a force."""

    def __init__(self, ev, name="bob"):
        super().__init__(ev, name)
        m, length = self.parameter("m", MASS, bounds=POSITIVE), self.parameter("L", LENGTH, bounds=POSITIVE)
        push = self.input("F", default=0.0)
        angle = self.parameter("angle", 0.5)
        x = self.variable("x", start=length * sin(angle), fixed=True)
        y = self.variable("y", start=-length * cos(angle))
        vx, vy = self.variable("vx", start=0.0, fixed=True), self.variable("vy", start=0.0)
        tension = self.variable("T")
        self.add_equations(
            Eq(der(x), vx), Eq(der(y), vy), Eq(m * der(vx), push - tension * x),
            Eq(m * der(vy), -tension * y - m * GRAVITY), Eq(x**2 + y**2, length**2),
        )  # fmt: skip


def test_a_mechanism_that_is_pushed_by_noise():
    """White noise of a force: four states of which two are redundant, against the angle and its speed."""
    intensity, sigma = 1e-3, 2e-4
    rng = np.random.default_rng(0)
    times = np.linspace(0, 2.0, 41)[1:]

    def field(s):
        return np.array([s[1], -GRAVITY / LENGTH * np.sin(s[0])])

    def jacobian(s):
        return np.array([[0, 1], [-GRAVITY / LENGTH * np.cos(s[0]), 0]])

    def driven(s):
        return np.diag([0.0, (intensity * np.cos(s[0]) / (MASS * LENGTH)) ** 2])

    s, y, now = np.array([0.5, 0.0]), np.zeros(40), 0.0
    for k, t in enumerate(times):
        for _ in range(50):
            h = (t - now) / 50
            s = s + h * field(s + h / 2 * field(s)) + np.sqrt(driven(s) * h) @ rng.standard_normal(2)
        y[k], now = LENGTH * np.sin(s[0]) + sigma * rng.standard_normal(), t
    expected = extended(
        field, jacobian, driven, lambda s: LENGTH * np.sin(s[0]), lambda s: np.array([LENGTH * np.cos(s[0]), 0.0]),
        sigma, np.array([0.5, 0.0]), np.zeros((2, 2)), times, y,
    )  # fmt: skip
    system = compiled(Swing)
    assert len(system.states) == 4 and system.is_constrained
    one = learning.Experiment(times, {"bob.x": y}, sigma=sigma)
    method = learning.Filter({"bob.F": learning.Unknown(intensity)}, substeps=2)
    problem = learning.Problem(system, one, train=["bob.m", "bob.L"], method=method, rtol=1e-9, atol=1e-11)
    objective, found, _, cost = at_start(problem)
    np.testing.assert_allclose(found.variance, expected[2], rtol=2e-3)
    # Corrections differ to second order: they are moved onto the constraints.
    np.testing.assert_allclose(found.residual, expected[1] - y, atol=2e-3 * sigma)
    np.testing.assert_allclose(cost, expected[0], atol=0.02)
    fit = problem.fit(freeze=["bob.m"])
    assert fit.minimum.converged
    c = fit.objective.coordinates
    off = fit.point - c.scaled(np.array([MASS, LENGTH, intensity]))
    np.testing.assert_array_less(np.abs(off[1:]), 4 * fit.spread[1:])
    np.testing.assert_array_less(fit.spread[1:], [5e-4, 1.0])
    # Mass and intensity enter as their ratio alone.
    assert "bob.m" in repr(problem.fit().identifiability().directions)
    smooth = fit.smoothed(["bob.x", "bob.y", "bob.T"])
    np.testing.assert_allclose(np.hypot(smooth.mean["bob.x"], smooth.mean["bob.y"]), fit.values["bob.L"], rtol=1e-5)


# --- nonlinear blocks -------------------------------------------------------------------------------------------------


class Saturating(Component):
    """x' = −z with z + z³ = x."""

    def __init__(self, ev, name="s"):
        super().__init__(ev, name)
        k = self.parameter("k", 1.5, bounds=POSITIVE)
        x, z = self.variable("x", start=3.0, fixed=True), self.variable("z", start=1.2)
        self.add_equations(Eq(der(x), -k * z), Eq(z + z**3, x))


def test_a_nonlinear_block_and_how_the_noise_is_integrated():
    """The noise gathered between samples is right to second order in the substeps."""
    times = np.linspace(0, 6.0, 13)[1:]
    y = 1.2 * np.exp(-0.3 * times) + 0.05 * np.random.default_rng(0).standard_normal(12)

    def z_of(x):
        root = np.roots([1.0, 0.0, 1.0, -x[0]])
        return float(root[np.abs(root.imag).argmin()].real)

    def slope(x):
        return np.array([1 / (1 + 3 * z_of(x) ** 2)])

    expected = extended(
        lambda x: np.array([-1.5 * z_of(x)]), lambda x: -1.5 * slope(x)[None], lambda x: np.array([[0.3**2]]), z_of,
        slope, 0.05, np.array([3.0]), np.zeros((1, 1)), times, y,
    )  # fmt: skip
    system = compiled(Saturating)
    one = learning.Experiment(times, {"s.z": y}, sigma=0.05)
    errors = []
    for substeps in (1, 4):
        method = learning.Filter({"s.x": 0.3}, substeps=substeps)
        problem = learning.Problem(system, one, train=["s.k"], method=method, rtol=1e-9, atol=1e-11)
        objective, found, weights, cost = at_start(problem)
        errors.append(np.abs(found.variance / expected[2] - 1).max())
        np.testing.assert_allclose(cost, expected[0], atol=0.02)
        rho, jacobian = weights.applied(np.zeros(1), found)

        def at(k, objective=objective):
            z = objective.coordinates.z_start[objective.free] + k
            found = objective.evaluate(z)
            return objective.weights(z, found).cost(z, found.residual)

        np.testing.assert_allclose(jacobian.T @ rho, (at(1e-4) - at(-1e-4)) / 2e-4, rtol=1e-5)
    assert errors[0] < 0.01 and errors[1] < errors[0] / 8


# --- kinks ------------------------------------------------------------------------------------------------------------


class Overflowing(Component):
    """x' = u − x − 4·max(x − 1, 0)."""

    def __init__(self, ev, name="tank"):
        super().__init__(ev, name)
        k = self.parameter("k", 4.0, bounds=POSITIVE)
        u = self.input("u")
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), u - x - k * Max(x - 1, 0)))


def test_kinks():
    """Predictions one step ahead pass them: from each sample on in closed form, with derivatives against differences. A
    filter, whose likelihood would need second derivatives through them, refuses."""
    times, u, y = np.array([0.3, 0.9, 1.5]), 3.0, np.array([0.5, 1.3, 1.2])

    def after(x, h):
        """From below, through 1, towards 7/5."""
        if x >= 1:
            return 7 / 5 + (x - 7 / 5) * np.exp(-5 * h)
        kink = np.log((u - x) / (u - 1))
        return u + (x - u) * np.exp(-h) if h < kink else after(1.0, h - kink)

    expected, x, now = [], 0.0, 0.0
    for t, sample in zip(times, y, strict=True):
        x, now = after(x, t - now), t
        expected.append(x)
        x += 0.4 * (sample - x)
    system = compiled(Overflowing)
    one = learning.Experiment(times, {"tank.x": y}, sigma=0.1, inputs={"tank.u": u})
    method = learning.Innovations({("tank.x", "tank.x"): learning.Unknown(0.4)})
    problem = learning.Problem(system, one, train=["tank.k"], method=method, rtol=1e-9, atol=1e-11)
    objective = problem.objective_of(problem._stacked, problem._coordinates(problem._stacked, (), None, None))
    z = objective.coordinates.z_start
    found = objective.evaluate(z)
    np.testing.assert_allclose(found.residual, expected - y, atol=1e-6)
    for k, e in enumerate(1e-4 * np.eye(2)):
        slope = (objective.evaluate(z + e).residual - objective.evaluate(z - e).residual) / 2e-4
        np.testing.assert_allclose(found.jacobian[:, k], slope, atol=1e-6)
    with pytest.raises(ModelError, match="Filter: relations or events of this model .* smooth"):
        learning.Problem(system, one, train=["tank.k"], method=learning.Filter({"tank.x": 0.1}))
