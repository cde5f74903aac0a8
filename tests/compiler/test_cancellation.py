"""Derivatives that cancel in float coefficients, and questions of rank in any units."""

import numpy as np
import pytest
import sympy
from attack import descriptors

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der
from jaxonomy_dae.base.tolerances import ILL_CONDITIONED
from jaxonomy_dae.compile.passes.combine_equations import combine, quantity_label
from jaxonomy_dae.compile.passes.combined_errors import errors_of_combination
from jaxonomy_dae.compile.passes.null_vectors import cancels, left_null_vectors
from jaxonomy_dae.errors import StructuralError
from jaxonomy_dae.graph.expressions.differentiate import directional_derivative
from jaxonomy_dae.graph.expressions.functions import apply
from jaxonomy_dae.graph.expressions.kernel import Kernel
from jaxonomy_dae.graph.expressions.node import compare, constant, leaf, linear, multiply, power, scale, select
from jaxonomy_dae.graph.judgement.rank import are_evident, rank_of, rounding
from jaxonomy_dae.graph.judgement.scaling import geometric_scales


class _Written(Component):
    def __init__(self, ev, names, equations):
        super().__init__(ev, "d")
        self.add_equations(*equations(*(self.variable(name) for name in names), ev.t))


def _compiled(names, equations):
    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(_Written(ev, names, equations)))()


def _chain(n: int, seed: int, singular: bool) -> tuple[np.ndarray, np.ndarray]:
    """Aliases a·x = b·y around a ring, with ratios up to 1e60: singular if the product of the ratios is 1. The matrix
    and its left null vector in that case."""
    rng = np.random.default_rng(seed)
    plain = np.eye(n) - np.roll(np.eye(n), 1, axis=1)
    plain[0, 0] = 1.0 if singular else 3.0
    rows, columns = (10.0 ** rng.uniform(-15, 15, n) for _ in range(2))
    return rows[:, None] * plain * columns, 1 / rows


@pytest.mark.parametrize("n", [2, 7, 30])
@pytest.mark.parametrize("seed", range(3))
def test_units_do_not_decide_a_rank(n, seed):
    regular, _ = _chain(n, seed, singular=False)
    singular, null = _chain(n, seed, singular=True)
    assert not are_evident(singular[None], rounding(singular)[None])[0]
    assert rank_of(regular, rounding(regular)).condition < ILL_CONDITIONED
    assert rank_of(regular, rounding(regular)).is_regular and not rank_of(singular, rounding(singular)).is_regular
    assert left_null_vectors(regular, rounding(regular)) == []
    (found,) = left_null_vectors(singular, rounding(singular))
    assert cancels(found, singular)
    np.testing.assert_allclose(found / null, found[0] / null[0], rtol=1e-13)  # some hundred roundings


def test_scales_undo_any_scaling():
    rng = np.random.default_rng(0)
    plain = rng.uniform(0.5, 1.5, (6, 5)) * (rng.random((6, 5)) < 0.7)
    scaled = 10.0 ** rng.uniform(-30, 30, (6, 1)) * plain * 10.0 ** rng.uniform(-30, 30, 5)

    def freed(matrix):
        r, c = geometric_scales(matrix)
        return r[:, None] * matrix * c

    np.testing.assert_allclose(freed(scaled), freed(plain), rtol=0.05)


class _Slow(Component):
    """(p − q)·x' + x = 0."""

    def __init__(self, ev, p, q):
        super().__init__(ev, "d")
        x, p, q = self.variable("x"), self.parameter("p", p), self.parameter("q", q)
        self.add_equations((p - q) * der(x) + x)


@pytest.mark.parametrize("unit", [1.0, 1e9, 1e-12])
def test_a_coefficient_that_is_a_rounding_error(unit):
    """p − q determines nothing if p and q are equal to rounding; a difference of 1e-9 is a difference."""

    def compiled(p, q):
        ev = EqnEnv()
        return AcausalCompiler(ev, AcausalDiagram().add(_Slow(ev, p * unit, q * unit)))()

    for q in (0.1 + 0.2, 0.3):
        with pytest.raises(StructuralError, match="determines nothing for d.p"):
            compiled(0.3, q)
    assert compiled(0.3, 0.3 + 1e-9).states == ["d.x"]


@pytest.mark.parametrize("factor", [1.0, 1e-12, 1e9])
def test_a_sum_over_equal_variables_that_rounding_leaves(factor):
    """0.1 a + 0.2 b − 0.3 c + u = 0 where a = b = c: 5e-17 a is none of it, so that u = 0 and nothing determines a."""

    def equations(a, b, c, u, v, t):
        total = factor * (0.1 * a + 0.2 * b - 0.3 * c + u)
        return (a - b, b - c, total, der(v) + v + u)

    assert 0.1 + 0.2 - 0.3 != 0.0
    with pytest.raises(StructuralError):
        _compiled("abcuv", lambda a, b, c, u, v, t: (*equations(a, b, c, u, v, t), u + v - sympy.cos(t)))
    system = _compiled("abcuv", lambda a, b, c, u, v, t: (*equations(a, b, c, u, v, t), der(a) + a))
    assert sorted(system.states) == ["d.a", "d.v"]


@pytest.mark.parametrize("force", [lambda t, y: t, lambda t, y: sympy.sin(t) * y, lambda t, y: sympy.exp(y)])
def test_terms_of_one_quantity_that_cancel(force):
    """v = y' and y' = v + y + f, however f is written, determine y by y + f = 0: y has no freedom. An equation of the
    same shape in which nothing meets determines z'."""

    def equations(v, y, w, z, t):
        return der(y) - v, der(y) - v - y - force(t, y), der(z) - w - z - force(t, z), w - sympy.cos(t)

    system = _compiled("vywz", equations)
    assert system.report.degrees_of_freedom == 1 and "d.z" in system.states
    (note,) = [n for n in system.report.notes if "cancel" in n]
    assert note.startswith("highest derivatives cancel in d: 0 = ")


def test_terms_of_one_quantity_that_cancel_for_some_parameters():
    class Scaled(Component):
        def __init__(self, ev, p):
            super().__init__(ev, "d")
            v, y, p = self.variable("v"), self.variable("y"), self.parameter("p", p)
            self.add_equations(der(y) - v, p * der(y) - v - sympy.sin(y))

    def compiled(p):
        ev = EqnEnv()
        return AcausalCompiler(ev, AcausalDiagram().add(Scaled(ev, p)))()

    assert compiled(2.0).states == ["d.y"]
    with pytest.raises(StructuralError, match="singular for d.p = 1, though not in general"):
        compiled(1.0)


X, Y, DX, DY = (quantity_label(v, order) for v, order in ((0, 0), (1, 0), (0, 1), (1, 1)))


@pytest.mark.parametrize("size", [1.0, 1e6, 1e12])
@pytest.mark.parametrize(
    ("term", "stays"),
    [
        (lambda x: scale(1e-6, power(x, 3)), True),
        (lambda x: apply("exp", linear([(1, x)], -990)), True),
        (lambda x: linear([(0.1, x), (0.2, x), (-0.3, x)]), False),
        (lambda x: linear([(1e-3, power(apply("sin", x), 2)), (1e-3, power(apply("cos", x), 2))]), False),
    ],
    ids=["cube", "exponential", "rounding", "identity"],
)
def test_what_remains_of_a_quantity_stays(term, stays, size):
    """x' + y' + size·x in two equations, and a term of x beside it in one. Near x = 1 the cube was not seen: at 1,000
    it is as large as y."""
    x, y, dx, dy = map(leaf, (X, Y, DX, DY))
    one = linear([(1, dx), (1, dy), (size, x)])
    other = linear([(1, dx), (1, dy), (size, x), (1, y), (-1, term(x))])
    combined = combine([one, other], [constant(-1), constant(1)], [DX, DY], np.zeros(0), np.zeros(0, int), dict)
    assert combined is not None and combined.leaves == ({X, Y} if stays else {Y})


# --- branches ------------------------------------------------------------------------------------------------------


class _Branching(Component):
    """x' + y' = 1 and x' + c·y' = 3 − y/2 + sin(t), where c is 1 up to x = 1000 and not beyond."""

    def __init__(self, ev, coefficient):
        super().__init__(ev, "d")
        x = self.variable("x", start=2000.0, fixed=True, nominal=2000.0)
        y = self.variable("y", start=1.0, fixed=True)
        self.add_equations(
            sympy.Eq(der(x) + der(y), 1),
            sympy.Eq(der(x) + coefficient(x) * der(y), 3 - y / 2 + sympy.sin(ev.t)),
        )


@pytest.mark.parametrize(
    "coefficient",
    [
        lambda x: sympy.Piecewise((2, x > 1000), (1, True)),
        lambda x: 1 + sympy.Max(0, x - 1000) / 1000,
        lambda x: 1 + sympy.Heaviside(x - 1000),
    ],
    ids=["Piecewise", "Max", "Heaviside"],
)
def test_what_cancels_on_one_branch_only_stays(coefficient):
    """The second equation was replaced by 0 = 2 − y/2 + sin(t), which holds below x = 1000 only."""
    ev = EqnEnv()
    system = AcausalCompiler(ev, AcausalDiagram().add(_Branching(ev, coefficient)))()
    assert sorted(system.states) == ["d.x", "d.y"] and not any("cancel" in note for note in system.report.notes)


P = ("of model", 0)


@pytest.mark.parametrize(
    ("coefficient", "p", "elsewhere"),
    [
        (lambda p: apply("min", p, constant(10)), 1.0, 100.0),
        (lambda p: apply("min", p, constant(10**4)), 1.0, 1e5),  # farther than any sample
        (lambda p: apply("abs", p), 2.0, -2.0),
        (lambda p: apply("max", p, constant(-3)), 1.0, -10.0),
        (lambda p: select(compare("less", p, constant(5)), p, linear([(2, p)])), 1.0, 7.0),
    ],
    ids=["min", "far", "abs", "max", "piecewise"],
)
def test_what_cancels_for_some_parameters_only_is_guarded(coefficient, p, elsewhere):
    """x' + p·y' + x and x' + c(p)·y' + 2·y, where c(p) is p for some p: their difference has no y' then. With
    `with_parameters` to the other side of a branch it was taken for the difference all the same, where the branch lay
    beyond the sample points; where it did not, the model was refused. Neither it nor its derivative has a value
    there."""
    x, y, dx, dy, q = map(leaf, (X, Y, DX, DY, P))
    one = linear([(1, dx), (1, multiply(q, dy)), (1, x)])
    other = linear([(1, dx), (1, multiply(coefficient(q), dy)), (2, y)])
    kept = np.zeros(0, int)
    combined = combine([one, other], [constant(-1), constant(1)], [DX, DY], np.array([p]), kept, dict)
    assert combined is not None and combined.leaves == {X, Y, P}
    rate = directional_derivative(combined, {X: dx, Y: dy})
    with np.errstate(invalid="ignore"):
        values = Kernel([combined, rate], [X, Y, DX, DY, P])(
            [np.full(2, v) for v in (0.3, 0.7, 0.2, 0.5)] + [np.array([p, elsewhere])], "numpy"
        )
    np.testing.assert_allclose([v[0] for v in values], [2 * 0.7 - 0.3, 2 * 0.5 - 0.2], rtol=1e-15)
    assert all(np.isnan(v[1]) for v in values)


def test_what_cancels_in_algebra_is_not_guarded():
    """(p + 1)·y' − p·y' − y' has no y' whatever p is, and the combination asks for nothing at run time."""
    x, y, dy, q = map(leaf, (X, Y, DY, P))
    one = linear([(1, multiply(linear([(1, q)], 1), dy)), (1, x)])
    other = linear([(1, multiply(q, dy)), (1, dy), (2, y)])
    kept = np.zeros(0, int)
    combined = combine([one, other], [constant(-1), constant(1)], [DY], np.array([1.5]), kept, dict)
    assert combined is not None and combined.leaves == {X, Y}


@pytest.mark.parametrize("roundings", [-4, -1, 0, 1, 4])
def test_numbers_that_are_dependent_to_some_roundings(roundings):
    """Rates with a matrix of rank one, whose last entry somebody computed: it is off by some roundings, and means the
    same. Whether it had a null vector, and whether weights were found, was decided by single roundings."""
    a, b, c = 0.99019405712519406, 0.018397215587545368, 1.0953425563846717e-4
    last = c * b / a * (1 + roundings * 2.0**-52)
    system = _compiled(
        "yz", lambda y, z, t: (a * der(y) + b * der(z) + 1.9 * y - 1, c * der(y) + last * der(z) + 0.6 * z)
    )
    assert len(system.states) == 1


@pytest.mark.parametrize("seed", [62000002, 7074])
def test_combinations_of_combinations_know_their_errors(seed):
    """Nilpotent blocks of 2 and 3 behind dense factors: the fifth combination in a row decides whether there is one
    mode or two, and its coefficients are off by a thousand roundings."""
    case = descriptors.make(seed)
    assert len(AcausalCompiler(case.ev, case.diagram)().states) == 1


@pytest.mark.parametrize("seed", range(5))
def test_coefficients_of_a_combination_are_known_to_their_bounds(seed):
    """Where coefficients move by their errors, the combination moves by no more than the bounds, and at worst by more
    than a hundredth of them."""
    rng = np.random.default_rng(seed)
    n = 4
    x, y = ([quantity_label(v, order) for v in range(n)] for order in (1, 0))
    a = 10.0 ** rng.uniform(-3, 3, (n, 1)) * (rng.normal(size=(n, n - 1)) @ rng.normal(size=(n - 1, n)))
    b = rng.normal(size=(n, n))

    def weights(a):
        return np.append(np.linalg.lstsq(a[:-1].T, -a[-1], rcond=None)[0], 1.0)

    equations = [linear((c, leaf(q)) for q, c in zip([*x, *y], [*a[i], *b[i]], strict=True)) for i in range(n)]
    found, worst = weights(a), 0.0
    for _ in range(100):
        # Only moves that keep the matrix singular have a combination.
        u, s, vt = np.linalg.svd((a * (1 + 1e-8 * rng.choice([-1, 1], a.shape))) / a.std(1, keepdims=True))
        moved, other = (
            a.std(1, keepdims=True) * (u[:, :-1] * s[:-1]) @ vt[:-1],
            b * (1 + 1e-8 * rng.normal(size=(n, n))),
        )
        by = np.abs(np.hstack([moved - a, other - b]))
        errors = [dict(zip([*x, *y], row, strict=True)) for row in by.tolist()]
        bounds = errors_of_combination(equations, errors, list(map(constant, found)), n - 1, x, exact=False)
        off = np.abs(weights(moved) @ other - found @ b)
        worst = max(worst, float(np.max(off / [bounds[q] for q in y])))
    assert 0.01 < worst < 1.001  # to first order
