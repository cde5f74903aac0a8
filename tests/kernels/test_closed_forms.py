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
from jaxonomy_dae.learning.discovery import beam_search

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


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: powers(0), r"powers\(highest\) takes a whole number ≥ 1; got 0"),
        (lambda: terms(), "at least one expression or function"),
        (lambda: terms(drag=3.0), "'drag' needs a function of the block's inputs; got 3.0"),
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
