"""Terms, the combinations of them that stand in a network's place, and the search for the best."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxonomy_dae import ModelError
from jaxonomy_dae.learning import ClosedForm, powers, terms
from jaxonomy_dae.learning.discovery import _Start, beam_search

X, Y = sympy.symbols("x y", real=True)
POINTS = np.array([[0.3, -1.2], [-2.0, 0.5], [1e-3, 4.0]])


def whole(library, inputs, outputs):
    """A closed form of all terms of a library, with coefficients 1, 2, …"""
    chosen = library.of(inputs, outputs, "here")
    return ClosedForm(jnp.arange(1.0, len(chosen) + 1), jnp.ones(len(chosen), bool), chosen)


@pytest.mark.parametrize(
    "library, inputs, outputs, names",
    [
        (powers(4), ("c.v",), 1, ["v", "v*|v|", "v*|v|^2", "v*|v|^3"]),
        (powers(3), ("c.vx", "c.vy"), 2, ["[vx, vy]", "[vx, vy]*|[vx, vy]|", "[vx, vy]*|[vx, vy]|^2"]),
        (terms("v*Abs(v)", sympy.tanh(X / 0.1)), ("c.v",), 1, ["v*Abs(v)", "tanh(10.0*x)"]),
        (terms(("vx*vy", "vx")), ("c.vx", "c.vy"), 2, ["[vx*vy, vx]"]),
        (terms("sin(x)"), ("a.x", "b.y"), 2, ["sin(x) in output 0", "sin(x) in output 1"]),
        (terms(sympy.Symbol("a.x") * sympy.Symbol("b.x")), ("a.x", "b.x"), 1, ["a.x*b.x"]),
        (powers(1) + terms("v", "v**2"), ("c.v",), 1, ["v", "v", "v**2"]),
    ],
)
def test_terms_are_what_they_say(library, inputs, outputs, names):
    law = whole(library, inputs, outputs)
    assert [term.name for term in law.terms] == names
    symbols = (X, Y)[: len(inputs)]
    written = sympy.lambdify(symbols, law.expressions(*symbols), "numpy")
    for u in POINTS[:, : len(inputs)]:
        np.testing.assert_allclose(law(jnp.asarray(u)), written(*u), rtol=1e-12)
    again = whole(library, inputs, outputs)
    assert again.terms == law.terms and hash(again.terms) == hash(law.terms)


def test_powers_are_smooth_at_rest_as_far_as_they_are():
    law = whole(powers(4), ("c.x", "c.y"), 2)
    for slope in jax.jit(lambda u: (jax.jacfwd(law)(u), jax.jacrev(law)(u)))(jnp.zeros(2)):
        np.testing.assert_array_equal(slope, np.eye(2))  # of the first power alone


def test_functions_as_terms():
    def plateau(x, y):
        return jnp.tanh(x / 0.1) + y

    law = whole(terms("x", plateau=plateau, swapped=lambda x, y: jnp.stack([y, x])), ("c.x", "c.y"), 2)
    assert [t.name for t in law.terms] == [
        "x in output 0", "x in output 1", "plateau[0]", "plateau[1]", "swapped",
    ]  # fmt: skip
    x, y = 0.04, -0.3
    p = np.tanh(x / 0.1) + y
    np.testing.assert_allclose(law(jnp.array([x, y])), [x + 3 * p + 5 * y, 2 * x + 4 * p + 5 * x], rtol=1e-14)
    first, second = law.expressions(X, Y)
    plateau_of, swapped = sympy.Function("plateau")(X, Y), sympy.Function("swapped1")(X, Y)
    assert second == 2.0 * X + 4.0 * plateau_of + 5.0 * swapped and first.has(sympy.Function("swapped0"))


def test_what_is_absent_is_not_evaluated():
    """log x and 1/x are infinite at zero, and so are their slopes."""
    chosen = terms("log(x)", "x", "1/x").of(("c.x",), 1, "here")
    law = ClosedForm(jnp.array([0.0, 2.0, 0.0]), jnp.array([False, True, False]), chosen)
    zero = jnp.zeros(1)

    @jax.jit
    def at_rest(coefficients):
        def called(c, u):
            return ClosedForm(c, law.present, law.terms)(u)[0]

        by_coefficients = jax.grad(called)(coefficients, zero + 3.0)
        by_input = [jacobian(called, 1)(coefficients, zero) for jacobian in (jax.jacfwd, jax.jacrev)]
        return called(coefficients, zero), by_coefficients, *by_input

    value, by_coefficients, forward, reverse = at_rest(law.coefficients)
    assert value == 0.0 and forward == 2.0 and reverse == 2.0
    np.testing.assert_array_equal(by_coefficients, [0.0, 3.0, 0.0])
    short = law.chosen()
    assert [t.name for t in short.terms] == ["x"] and short.expressions(X) == (2.0 * X,)


INNER = {"v_s": (0.01, 2.0), "p": (0.5, 3.0)}


@pytest.mark.slow
def test_numbers_inside_terms():
    """Only combinations of known functions could be found: a width or an exponent had to be guessed beforehand."""
    library = terms("v", "tanh(v/v_s)", "sign(v)*Abs(v)**p", "v*exp(-(v/v_s)**2)", **INNER)
    chosen = library.of(("c.v",), 1, "here")
    law = ClosedForm(jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.ones(4, bool), chosen, jnp.log(jnp.array([0.3, 1.7])))
    assert {name: round(float(v), 12) for name, v in law.numbers.items()} == {"v_s": 0.3, "p": 1.7}
    (written,) = law.expressions(X)
    for v in (-0.8, 0.02, 0.4):
        right = v + 2 * np.tanh(v / 0.3) + 3 * np.sign(v) * abs(v) ** 1.7 + 4 * v * np.exp(-((v / 0.3) ** 2))
        np.testing.assert_allclose(law(jnp.array([v])), [right], rtol=1e-13)
        np.testing.assert_allclose(float(written.subs(X, v)), right, rtol=1e-13)
    short = ClosedForm(law.coefficients, jnp.array([True, False, True, False]), chosen, law.inner).chosen()
    assert list(short.numbers) == ["p"] and float(short.numbers["p"]) == pytest.approx(1.7, rel=1e-14)
    (free,) = terms("v**3/(k + v**2)").of(("c.v",), 1, "here")
    assert [one.name for one in free.inner] == ["k"] and free.inner[0].range is None
    signed = terms("tanh(v - v0)", v0=(-1.0, 1.0)).of(("c.v",), 1, "here")
    law = ClosedForm(jnp.ones(1), jnp.ones(1, bool), signed, jnp.array([-0.5]))
    np.testing.assert_allclose(law(jnp.array([0.2])), [np.tanh(0.7)], rtol=1e-14)


def test_numbers_inside_begin_where_they_meet_the_networks_curve():
    v = np.linspace(-1, 1, 81)[:, None]
    chosen = terms("v", "tanh(v/v_s)", "sign(v)*Abs(v)**p", p=(1.2, 4.0)).of(("c.v",), 1, "here")
    values = 0.3 * v + 0.5 * np.tanh(v / 0.2)
    inner = [one.name for term in chosen for one in term.inner]
    ends = {"v_s": (1e-3, 10.0), "p": (1.2, 4.0)}
    low, high = np.log([ends[n] for n in inner]).T
    start = _Start(chosen, v, values, low, high)
    best = start.laws((0, 1))[0]
    assert float(best.numbers["v_s"]) == pytest.approx(0.2, rel=1e-3)
    np.testing.assert_allclose(best.coefficients, [0.3, 0.5, 0.0], atol=1e-3)
    left = start._fitted((0, 2), start._features(np.asarray(start.laws((0, 2))[0].inner)[None])[0])[1]
    grid = low + np.linspace(0, 1, 9)[:, None] * (high - low)
    assert left <= min(start._fitted((0, 2), f)[1] for f in start._features(grid)) * (1 + 1e-6)
    assert len(start.laws((0,))) == 1


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: terms("a*v"), "'a' in term 'a.v' is no input .* it does what the term's coefficient does"),
        (lambda: terms("v**2/b**3"), "'b' in term .* it does what the term's coefficient does"),
        (lambda: terms("tanh(v/w)", w=(2.0, 1.0)), "the range of 'w' is a pair low < high"),
        (lambda: terms("tanh(v/w)", w=3.0), r"'w' needs a function of the block's inputs, or a range"),
        (lambda: terms("tanh(v/w)", v=(1.0, 2.0)), "'v' is an input of the block, and cannot be a number"),
        (lambda: terms("exp(a/b)"), "'a' in term 'exp.a/b.' is no input of the block"),
        (
            lambda: terms("tanh(v/w)", w=(1.0, 2.0)) + terms("v*exp(-v/w)", w=(1.0, 3.0)),
            "'w' stands in several terms, with several ranges",
        ),
    ],
)
def test_numbers_inside_that_do_not_fit(make, words):
    with pytest.raises(ModelError, match=words):
        make().of(("c.v",), 1, "here")


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: powers(0), r"powers: highest is a whole number ≥ 1; got 0"),
        (lambda: terms(), "at least one expression or function"),
        (lambda: terms(drag=3.0), "'drag' needs a function of the block's inputs, or a range .* got 3.0"),
        (lambda: terms(None), "takes SymPy expressions, texts, or functions by name.*got None"),
        (
            lambda: powers(2).of(("c.x", "c.y"), 1, "here"),
            "here: powers.*2 inputs and 1 outputs: name terms of your own",
        ),
        (lambda: terms("z*x").of(("c.x", "c.y"), 1, "here"), "'z' in term 'z.x' is no input of the block: .*'x'"),
        (lambda: terms("x +* 2").of(("c.x",), 1, "here"), "is no expression that SymPy reads"),
        (lambda: terms(("x", "x", "x")).of(("c.x",), 1, "here"), "has 3 entries, but the block 1 outputs"),
        (lambda: terms("f(x)").of(("c.x",), 1, "here"), "here: term 'f.x.'"),
        (lambda: terms(f=lambda x: jnp.ones(3)).of(("c.x",), 1, "here"), "'f' returns 3 values, but the block has 1"),
    ],
)
def test_wrong_terms(make, words):
    with pytest.raises(ModelError, match=words):
        make()


# --- the search --------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(2, 5))
def test_a_wide_beam_is_exhaustive(seed, count):
    """With scores that fall from size to size somewhere, the best subset up to the first size without gain is found."""
    rng = np.random.default_rng(seed)
    scores = {s: float(rng.normal()) for k in range(count) for s in itertools.combinations(range(count), k + 1)}
    found = beam_search(scores.__getitem__, count, width=100, most=count)
    assert all(scores[s] == v for s, v in found.items())
    best = np.inf
    for size in range(1, count + 1):
        level = [v for s, v in scores.items() if len(s) == size]
        best, before = min(best, *level), best
        assert sum(len(s) == size for s in found) == len(level)
        if min(level) >= before:
            break
    assert min(found.values()) == best


def test_a_narrow_beam_on_a_regression():
    """BIC of a linear regression: x₁ and x₃ among six, of which two are nearly the same."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=(200, 6))
    x[:, 5] = x[:, 1] + 0.1 * rng.normal(size=200)
    y = 2.0 * x[:, 1] - 0.7 * x[:, 3] + 0.1 * rng.normal(size=200)
    tried = []

    def bic(subset):
        tried.append(subset)
        left = y - x[:, subset] @ np.linalg.lstsq(x[:, subset], y, rcond=None)[0]
        return 200 * np.log(left @ left) + len(subset) * np.log(200)

    found = beam_search(bic, 6, width=2, most=4)
    assert min(found, key=found.__getitem__) == (1, 3)
    assert len(tried) == len(set(tried)) < 30 and max(map(len, found)) == 3  # none of three is better: it ends


def test_scores_that_are_infinite_are_not_followed():
    assert beam_search(lambda s: np.inf, 3, 2, 3) == {(0,): np.inf, (1,): np.inf, (2,): np.inf}
