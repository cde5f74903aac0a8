"""Units decide nothing: the same model in other units has the same verdicts, states and digits."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component
from shared_models import charge, charge_of, cubic_of, orifices, orifices_of, scaled_cubic, triangle
from sympy import Abs, Eq, log, sqrt

from jaxonomy_dae import Component, EqnEnv, InitializationError, der


class Written(Component):
    """A component written by a function."""

    def __init__(self, ev, write):
        super().__init__(ev, "c")
        write(self)


def model(write):
    return compiled(Written(EqnEnv(), write))


def found(system, *names):
    """The initial values of variables."""
    return np.asarray(_found(system, list(names)))


@eqx.filter_jit
def _found(system, names):
    return system.observe(names, 0.0, system.initialize())


# --- contradictions ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "unit, nominal",
    [
        (1e-15, False),
        pytest.param(1e-9, True, marks=pytest.mark.slow),
        pytest.param(1e9, False, marks=pytest.mark.slow),
    ],
)
def test_a_contradiction_is_one_at_any_scale(unit, nominal):
    """The same beside quantities of 1e7, which do not excuse what is wrong in an equation of small ones."""
    with pytest.raises(
        InitializationError, match=r"c\.y and c\.x are fixed at 3e[-+]\d+ and 1e[-+]\d+, which contradict"
    ):
        triangle(unit, nominal, y=3.0).initialize()
    right = found(triangle(unit, nominal), "c.x", "c.y", "c.z")
    np.testing.assert_allclose(right, [unit, 2 * unit, 3 * unit], rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("v", [1e-16, 1e-9])
def test_velocities_that_are_rounding_errors(v):
    """A mass held by two rods is at rest; another falls beside it and tells how fast is fast."""

    def write(self):
        start = {"x": 0.5, "y": math.sqrt(0.75), "vx": v, "vy": -2 * v, "z": 1.0, "vz": 1.5}
        x, y, vx, vy, z, vz = (self.variable(n, start=s, fixed=True) for n, s in start.items())
        a, b = self.variable("a"), self.variable("b")
        self.add_equations(
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(der(vx), -a * x - b * (x - 1)),
            Eq(der(vy), -(a + b) * y - 9.81),
            Eq(x**2 + y**2, 1),
            Eq((x - 1) ** 2 + y**2, 1),
            Eq(der(z), vz),
            Eq(der(vz), -9.81),
        )

    system = model(write)
    if v > 1e-15:
        with pytest.raises(InitializationError, match=r"off by|contradict|fixed at"):
            system.initialize()
    else:
        np.testing.assert_allclose(found(system, "c.vx", "c.vy", "c.vz"), [0, 0, 1.5], rtol=1e-15, atol=1e-15)


# --- rows of one model in a process with others ---------------------------------------------------------------------


def pinned(p):
    """x = 0 by its equation, with a start p."""

    def write(self):
        q = self.parameter("p", p)
        x, y = self.variable("x", start=q, fixed=True), self.variable("y", start=1.0, fixed=True)
        self.add_equations(Eq(x, 0), Eq(der(y), -y + x))

    return model(write)


@pytest.mark.slow
def test_rows_do_not_depend_on_the_values_they_were_chosen_with():
    first = pinned(0.0)
    assert first.initialization_report().consistent
    for system in (first.with_parameters({"c.p": 1.0}), pinned(1.0)):
        with pytest.raises(
            InitializationError, match=r"start of c\.x, 1: off by 1.*|c\.x is fixed at 1, but the equations"
        ):
            system.initialize()

    def start(p, throw=None):
        return first.with_parameters({"c.p": p}).initialize(throw=throw)

    assert np.isnan(jax.jit(start)(1.0)).all() and np.isnan(jax.grad(lambda p: start(p)[0])(1.0))
    with pytest.raises(Exception, match="no consistent initial point"):
        jax.block_until_ready(jax.jit(lambda p: start(p, throw=True))(1.0))


# --- the same model in other units -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("k", [1e-12, 1e9])
def test_a_multiplied_equation(k):
    assert found(scaled_cubic(k, False), "c.z")[0] == pytest.approx(0.5 ** (1 / 3), rel=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("c0", [1e-15, 1e-9, 1e6])
def test_charges_in_any_unit(c0):
    assert found(charge(c0), "c.v")[0] == pytest.approx(1.0, rel=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("pascal, flow", [(1.0, 1.0), (1e-6, 1.0), (1e9, 1e6)])
def test_orifices_in_series(pascal, flow):
    assert found(orifices(pascal, flow), "c.pm")[0] == pytest.approx(1.005e7 * pascal, rel=1e-13)


@pytest.mark.slow
def test_roots_in_many_units():
    """The same beside each other, so that one program finds them all: none tells another what is small."""
    parts, expected = [], {}

    def add(write, variable, root):
        name = f"c{len(parts)}"
        parts.append(component(write, name))
        expected[f"{name}.{variable}"] = root

    for k in (1e-12, 1.0, 1e9):
        add(cubic_of(k), "z", 0.5 ** (1 / 3))
    for c0 in (1e-15, 1e-9, 1e6):
        add(charge_of(c0), "v", 1.0)
    for pascal, flow in ((1.0, 1.0), (1e-6, 1.0), (1e9, 1e6)):
        add(orifices_of(pascal, flow), "pm", 1.005e7 * pascal)
    np.testing.assert_allclose(found(compiled(*parts), *expected), list(expected.values()), rtol=1e-13)


# --- guesses -----------------------------------------------------------------------------------------------------


def circle(x, y, radius=1.0, nominal=None):
    """A pendulum given by guesses alone."""

    def write(self):
        r = self.parameter("r", radius)
        gx, gy = self.parameter("gx", x), self.parameter("gy", y)
        x_ = self.variable("x", start=gx, nominal=nominal)
        y_ = self.variable("y", start=gy, nominal=nominal)
        vx, vy, lam = self.variable("vx", start=0.0), self.variable("vy", start=0.0), self.variable("lam")
        self.add_equations(
            Eq(der(x_), vx),
            Eq(der(y_), vy),
            Eq(der(vx), -lam * x_),
            Eq(der(vy), -lam * y_ - 9.81),
            Eq(x_**2 + y_**2, r**2),
        )

    return model(write)


@pytest.fixture(scope="module")
def free_pendulum():
    return circle(1.1, 1.1)


@pytest.mark.parametrize("x, y", [(1.1, 1.1), (0.1, -1.2), (0.9, 0.1), (3.0, 4.0), (0.0, -1.1)])
def test_guesses_yield_to_the_nearest_point(free_pendulum, x, y):
    system = free_pendulum.with_parameters({"c.gx": x, "c.gy": y})
    np.testing.assert_allclose(
        found(system, "c.x", "c.y", "c.vx", "c.vy"),
        [*(np.array([x, y]) / np.hypot(x, y)), 0, 0],
        rtol=1e-13,
        atol=1e-15,
    )


@pytest.mark.slow
def test_a_report_of_guesses_that_moved(free_pendulum):
    x, y = 3.0, 4.0
    system = free_pendulum.with_parameters({"c.gx": x, "c.gy": y})
    report = system.initialization_report()
    moved = {g.name: g.moved for g in report.guesses}
    assert moved["c.x"] == pytest.approx(x / np.hypot(x, y) - x, abs=1e-13)
    assert "c.y = " in str(report) and ", moved by " in str(report)


@pytest.mark.slow
def test_gradients_of_the_nearest_point(free_pendulum):
    """x = r·g/|g|, by hand and by the same program: curvature enters."""

    def place(g, r):
        return free_pendulum.with_parameters({"c.gx": g[0], "c.gy": g[1], "c.r": r}).initialize()[jnp.array([0, 2])]

    g, r = np.array([1.1, 0.3]), 2.0
    size = np.linalg.norm(g)
    value, (of_guess, of_radius) = jax.jit(lambda g, r: (place(g, r), jax.jacrev(place, (0, 1))(g, r)))(g, r)
    np.testing.assert_allclose(value, r * g / size, rtol=1e-13)
    np.testing.assert_allclose(of_guess, r / size * (np.eye(2) - np.outer(g, g) / size**2), rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(of_radius, g / size, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-12, 1e-3, 1e9])
def test_the_nearest_point_in_other_units(unit):
    system = circle(3 * unit, 4 * unit, unit)
    np.testing.assert_allclose(found(system, "c.x", "c.y"), [0.6 * unit, 0.8 * unit], rtol=1e-13)


@pytest.mark.slow
def test_guesses_at_which_blocks_are_singular_are_stepped_off():
    """q·|q| = x is singular at the guess 0, for which the start of x is not blamed; √r + r = y has no slope there."""

    def write(self):
        x, q = self.variable("x", start=0.5, fixed=True), self.variable("q")
        y, r = self.variable("y", start=0.75, fixed=True), self.variable("r")
        self.add_equations(Eq(q * Abs(q), x), Eq(der(x), -q), Eq(sqrt(r) + r, y), Eq(der(y), -r))

    np.testing.assert_allclose(found(model(write), "c.x", "c.q", "c.r"), [0.5, math.sqrt(0.5), 0.25], rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    "c", [8e-30, pytest.param(8.0, marks=pytest.mark.slow), pytest.param(8e30, marks=pytest.mark.slow)]
)
def test_a_power_without_slope_at_the_start(c):
    """x³ = c from 0, where nothing tells the size of x to first order."""

    def write(self):
        x, y = self.variable("x"), self.variable("y", start=1.0, fixed=True)
        self.add_equations(Eq(x**3, c), Eq(der(y), -y))

    assert found(model(write), "c.x")[0] == pytest.approx(2 * (c / 8) ** (1 / 3), rel=1e-13)


@pytest.mark.slow
def test_flows_without_guesses():
    """Turbulent pipes in series from a tank, k·q·|q| of 2e7 Pa at 2e-4 m³/s, whose flows have no slope at rest."""
    k, pressure = 2e7 / 2e-4**2, 6e7

    def write(self):
        p = self.variable("p", start=pressure, fixed=True)
        p1, p2, q1, q2, q3 = (self.variable(n) for n in ("p1", "p2", "q1", "q2", "q3"))
        self.add_equations(
            Eq(der(p), -q1 * 1e9),
            Eq(p - p1, k * q1 * Abs(q1)),
            Eq(p1 - p2, k * q2 * Abs(q2)),
            Eq(p2, k * q3 * Abs(q3)),
            Eq(q1, q2),
            Eq(q2, q3 + 0 * p1),
        )

    np.testing.assert_allclose(found(model(write), "c.q1", "c.p1", "c.p2"), [2e-4, 4e7, 2e7], rtol=1e-12)


# --- bounds --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_bounds_keep_the_search_where_logarithms_are_real():
    """ln z + z = x: Newton's step from 100 lands at −3.6, where there is no logarithm."""

    def write(self):
        x = self.variable("x", start=0.0, fixed=True)
        z = self.variable("z", start=100.0, bounds=(0.0, math.inf))
        self.add_equations(Eq(log(z) + z, x), Eq(der(x), -z))

    system = model(write)
    assert found(system, "c.z")[0] == pytest.approx(0.5671432904097838, rel=1e-14)  # the omega constant
