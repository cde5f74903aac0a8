"""Sizes of unknowns of which nothing is declared, and starts that rest on them."""

import jax
import numpy as np
import pytest
import scipy.sparse as sp
from problems import compiled
from sympy import Abs, Eq, Piecewise, cos, exp, sign, sqrt

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.compile.model.natural_sizes import Factors


class Branches(Component):
    """A turbulent pipe and an orifice from one reservoir to another, and a supply beside them; no guess anywhere."""

    def __init__(self, ev, name, pressure, flow):
        super().__init__(ev, name)
        p0, q0 = self.parameter("p0", pressure), self.parameter("q0", flow)
        k, c = self.parameter("k", pressure / flow**2), self.parameter("c", flow / pressure**0.5)
        middle, end, q, r, x = (self.variable(n) for n in ("middle", "end", "q", "r", "x"))
        self.add_equations(
            Eq(p0 - middle, k * q * Abs(q)),
            Eq(r, c * sign(middle - end) * sqrt(Abs(middle - end))),
            Eq(q, r),
            Eq(q + q0, x),
            Eq(end, -p0),
            Eq(der(self.variable("h", start=0.0, fixed=True)), x),
        )


SIZES = [(1e5, 1e-3), (2e7, 1e-4), (1.0, 1.0), (1e-9, 1e6)]


@pytest.mark.parametrize(("pressure", "flow"), SIZES)
def test_sizes_come_from_data(pressure, flow):
    system = compiled(Branches(EqnEnv(), "b", pressure, flow))
    for name, size in (("b.middle", pressure), ("b.q", flow)):
        quantity = system.plan.resolve([name])[0][0]
        assert 0.1 < system.typical_sizes[quantity] / size < 10


@pytest.mark.parametrize(("pressure", "flow"), [SIZES[1], SIZES[3]])
def test_they_follow_the_parameters(pressure, flow):
    """They were those of the values that a model was compiled with, whatever it was given."""
    system, other = compiled(Branches(EqnEnv(), "b", *SIZES[2])), compiled(Branches(EqnEnv(), "b", pressure, flow))
    given = {name: other.parameters[name] for name in other.parameters}
    np.testing.assert_array_equal(system.with_parameters(given).typical_sizes, other.typical_sizes)
    back = system.with_parameters(given).with_parameters(dict(system.parameters.items()))
    np.testing.assert_array_equal(back.typical_sizes, system.typical_sizes)


class Bound(Component):
    """(x/u)² + x/u = c, of a decaying c."""

    def __init__(self, ev, name, unit):
        super().__init__(ev, name)
        u = self.parameter("u", unit)
        x, c = self.variable("x", start=0.7 * u), self.variable("c", start=1.0, fixed=True)
        self.add_equations(Eq(der(c), -c), Eq((x / u) ** 2 + x / u, c))


def test_blocks_in_other_units_than_they_were_compiled_with():
    """A block was called solved that was off by 10 %."""
    system = compiled(Bound(EqnEnv(), "b", 1.0))
    read = jax.jit(lambda s, z: s.observe("b.x", 0.0, z))
    for unit in (1e-18, 1e-9, 1e12):
        changed = system.with_parameters({"b.u": unit})
        for guess in (0.0, 0.4 * unit, 10 * unit):
            found = float(read(changed, np.array([1.0, guess])))
            assert found / unit == pytest.approx((np.sqrt(5) - 1) / 2, rel=1e-12)


@pytest.mark.parametrize("unit", [1e-18, 1.0])
def test_a_start_is_no_rounding_error_where_nothing_else_tells_a_size(unit):
    """exp(x/u) − 2 = 0 has no slope near x = 1, so x = 1e-16 was taken for a rounding error of 1, and its equation for
    singular."""

    class Logarithm(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            u = self.parameter("u", unit)
            x, c = self.variable("x", start=0.5 * u), self.variable("c", start=1.0, fixed=True)
            self.add_equations(Eq(der(c), -c), Eq(exp(x / u), 2 * c))

    system = compiled(Logarithm(EqnEnv(), "b"))
    x = system.initialize()
    assert float(system.observe("b.x", 0.0, x)) / unit == pytest.approx(np.log(2), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pressure", "flow"), [SIZES[0], *(pytest.param(*s, marks=pytest.mark.slow) for s in SIZES[1:])]
)
def test_starts_rest_on_them(pressure, flow):
    """The pressures of reservoirs and flows of supplies are terms of their equations, and all else follows."""
    system = compiled(Branches(EqnEnv(), "b", pressure, flow))
    # p0 − m = k q², q² = c² (m + p0) with k c² = 1: m = 0, q = c √p0.
    found = jax.jit(lambda: system.observe(["b.middle", "b.q"], 0.0, system.initialize()))()
    np.testing.assert_allclose(found, [0.0, flow], rtol=1e-9, atol=1e-9 * pressure)


@pytest.mark.parametrize("n", [20, 700])
def test_declared_sizes_hold_in_models_of_any_size(n):
    """Of more than 600 unknowns all sizes were 1, so that states of 1e-6 might leave their constraints by all of
    themselves at an event."""

    class Chain(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.vector("x", n, nominal=1e-6, start=0.0)
            self.add_equations(*(Eq(der(a), -a) for a in x))

    system = compiled(Chain(EqnEnv(), "c"))
    quantities, _ = system.plan.resolve([f"c.x[{k}]" for k in range(n)])
    assert (np.abs(np.log2(np.asarray(system.typical_sizes)[quantities] / 1e-6)) <= 1).all()


@pytest.mark.parametrize("n", [20, pytest.param(700, marks=pytest.mark.slow)])
def test_sizes_come_from_data_in_models_of_any_size(n):
    """Of more than 600 unknowns those that were not declared were 1."""

    class Chain(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, tau = self.vector("x", n), self.parameter("tau", 1e3)
            supply = self.parameter("supply", 1e-6)
            before = [supply, *x[:-1]]
            self.add_equations(*(Eq(tau * der(a), b - a) for a, b in zip(x, before, strict=True)))

    system = compiled(Chain(EqnEnv(), "c"))
    quantities, _ = system.plan.resolve([f"c.x[{k}]" for k in range(n)])
    assert (np.abs(np.log10(np.asarray(system.typical_sizes)[quantities] / 1e-6)) <= 1).all()


@pytest.mark.parametrize("power", [2, 3])
def test_a_quantity_that_stands_in_two_places_counts_once(power):
    """Where variables are equal, the slots of a product are one quantity: aᵖ = c has a = c^(1/p)."""

    class Product(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            parts = [self.variable(f"a{k}") for k in range(power)]
            c, h = self.parameter("c", 1e-12), self.variable("h", start=0.0, fixed=True)
            product = parts[0]
            for part in parts[1:]:
                product = product * part
                self.add_equations(Eq(part, parts[0]))
            self.add_equations(Eq(product, c), Eq(der(h), parts[0]))

    system = compiled(Product(EqnEnv(), "p"))
    quantity = system.plan.resolve(["p.a0"])[0][0]
    assert abs(np.log10(system.typical_sizes[quantity] / 1e-12 ** (1 / power))) < 0.5


def size_of(system, name):
    return float(system.typical_sizes[system.plan.resolve([name])[0][0]])


class Heated(Component):
    """A pressure in bar, its force by a large area, and what follows."""

    def __init__(self, ev, name, **declared):
        super().__init__(ev, name)
        p, force = self.variable("p", **declared), self.variable("force")
        x, area = self.variable("x", start=0.0, fixed=True), self.parameter("area", 1e5)
        self.add_equations(Eq(p, ev.t + 1), Eq(force, area * p), Eq(der(x), 2 * force))


@pytest.mark.parametrize("what", ["nominal", "start"])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_a_size_of_one_is_declared_as_any_other(what, size):
    """Unknown was written as 1, so that nominal=1.0 and start=±1 counted as not declared, and sizes jumped between 1.0
    and 1.0000001."""
    signs = (1.0, -1.0) if what == "start" else (1.0,)
    found = [
        [size_of(compiled(Heated(EqnEnv(), "c", **{what: sign * value})), f"c.{n}") for n in ("p", "force", "x")]
        for sign in signs
        for value in (size, size * (1 + 1e-7), size * (1 - 1e-7))
    ]
    assert found == [found[0]] * len(found)
    assert 0.7 < found[0][0] / size < 1.5


class Spring(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        length, k = self.parameter("length", 1.0), self.parameter("k", 2.0)
        x, v = self.variable("x"), self.variable("v")
        self.add_equations(Eq(der(x), v), Eq(der(v), -k * (x - length)))


def test_sizes_follow_parameters_that_are_solved_for():
    """They stayed those of the values from which the search began."""
    system = compiled(Spring(EqnEnv(), "s"))
    values = {"s.x": 1e6, "s.v": 0.0, "der(s.v)": 0.0}
    _, found = system.initialize(initial=values, solve_for=["s.length"])
    assert float(found.parameters["s.length"]) == pytest.approx(1e6, rel=1e-9)
    given = system.with_parameters({"s.length": found.parameters["s.length"]})
    np.testing.assert_array_equal(found.typical_sizes, given.typical_sizes)
    assert (np.asarray(found.typical_sizes) != np.asarray(system.typical_sizes)).any()


class Gas(Component):
    """p·(V − b·n) = n·RT, of so little that n is below the rounding of a size that its equation alone suggests."""

    def __init__(self, ev, name, amount, pressure, how):
        super().__init__(ev, name)
        heat = 2494.0
        volume, b = self.parameter("V", 1.3 * amount * heat / pressure), self.parameter("b", 0.325 * heat / pressure)
        start = self.parameter("n0", amount) if how == "parameter" else amount
        n, p = self.variable("n", start=start, fixed=True), self.variable("p")
        if how == "derivative":
            rate = self.variable("rate", start=-amount, fixed=True)
            self.add_equations(Eq(der(rate), -rate))
        self.add_equations(Eq(der(n), -n), Eq(p * (volume - b * n), n * heat))


@pytest.mark.parametrize("how", ["number", "parameter", "derivative"])
@pytest.mark.parametrize(("amount", "pressure"), [(1e-18, 1e12), (1e-15, 1e-6), (1e9, 1e-12)])
def test_a_start_tells_the_size_of_its_variable(amount, pressure, how):
    """A start of 1e-18 was taken for the rounding of a size that another equation tells, and the model for singular."""
    system = compiled(Gas(EqnEnv(), "c", amount, pressure, how))
    assert 0.7 < size_of(system, "c.n") / amount < 1.5
    found = float(system.observe("c.p", 0.0, system.initialize()))
    assert found == pytest.approx(pressure / 0.975, rel=1e-9)


class Turning(Component):
    """A crank of inertia J with friction at its slider, whose mode starts where there is none."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        phi, w = self.variable("phi", start=1.0, fixed=True), self.variable("w", start=0.0, fixed=True)
        f, mode = self.variable("f"), self.discrete("mode", start=2)
        self.add_equations(
            Eq(der(phi), w),
            Eq(0.02 * der(w), -cos(phi) * f),
            Eq(f, Piecewise((0, Eq(mode, 2)), (30.0 * mode, True))),
        )


def test_a_branch_tells_a_size_before_its_mode_begins():
    """The force was taken for 0.5 N, as the mode starts where it is zero."""
    system = compiled(Turning(EqnEnv(), "c"))
    force, speed = (float(system.typical_sizes[system.plan.resolve([name])[0][0]]) for name in ("c.f", "c.w"))
    assert 0.1 < force / 30.0 < 10
    assert 0.1 < speed / (30.0 / 0.02) ** 0.5 < 10  # one radian


def test_sizes_that_only_errors_of_differences_tell():
    """Powers are known to a few digits. In a crank that nothing drives, what was left of a singular value moved the
    force by 950 decades."""
    matrix = sp.csr_array([[1.0, -1.0], [1.0, -1.0 + 1e-5]])
    found = Factors().least_squares(matrix, np.array([0.3, -0.2]))
    assert np.abs(found).max() < 1.0
    assert found[0] - found[1] == pytest.approx(0.05, abs=1e-3)  # which is told
