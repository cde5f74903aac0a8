"""Parameters within bounds as free numbers, and back: a bijection, in the working precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component, mlp

from jaxonomy_dae import Eq, Interval, ModelError, der
from jaxonomy_dae.run.system.bounds import Ends, constrained, unconstrained
from jaxonomy_dae.write.interval import NONNEGATIVE, POSITIVE

INTERVALS = [
    POSITIVE, NONNEGATIVE, Interval(3.0), Interval(high=-2.0), Interval(-1.0, 2.0), Interval(0.1, 0.3, True, True),
    Interval(), Interval(5.0, 5.0),
]  # fmt: skip
ENDS = Ends.of(INTERVALS)


@jax.jit
def there_and_back(z):
    x = constrained(z, ENDS)
    slopes = jax.jvp(lambda z: constrained(z, ENDS), (z,), (jnp.ones_like(z),))[1]
    return x, unconstrained(x, ENDS), slopes


def test_the_formulas():
    """By hand at z = 1.5, in the order of INTERVALS."""
    z, s = 1.5, 1 / (1 + np.exp(-1.5))
    x, back, slopes = there_and_back(jnp.full(8, z))
    e = np.exp(z)
    assert np.allclose(x, [e, e, 3 + e, -2 - 1 / e, -1 + 3 * s, 0.1 + 0.2 * s, z, 5.0], rtol=1e-15)
    assert np.allclose(back, [*[z] * 7, 0.0], rtol=1e-13)
    d = s * (1 - s)
    assert np.allclose(slopes, [e, e, e, 1 / e, 3 * d, 0.2 * d, 1.0, 0.0], rtol=1e-13)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rounding_stays_inside_and_derivatives_are_finite(dtype):
    """Far out, values would be rounded onto open ends, and exponentials of other entries overflow."""
    for z in (-300.0, -40.0, 40.0, 80.0):
        x, _, slopes = there_and_back(jnp.full(8, z, dtype))
        x = np.asarray(x)
        assert x.dtype == dtype and ENDS.admit(x).all(), (z, x)
        assert np.isfinite(slopes).all() and (np.asarray(slopes) >= 0).all()


def test_what_is_admitted():
    at = np.array([0.0, 0.0, 3.0, -2.0, 2.0, 0.3, np.inf, 5.0])
    for kind in (np.asarray, jnp.asarray):
        assert np.array_equal(ENDS.admit(kind(at)), [False, True, True, True, True, False, False, True])
    assert not ENDS.admit(np.full(8, np.nan)).any()
    # A number declared as an end is inside in single precision too, where it is another number.
    assert Ends.of([Interval(0.1, 0.3)]).admit(np.array([0.1], np.float32)).all()
    assert Ends.of([Interval(0.1, 0.3)]).admit(np.array([0.3], np.float32)).all()


def test_an_end_at_infinity_is_no_bound_however_it_is_written():
    """(−∞, ∞) and (−∞, 0.5]: what is written as an open end at infinity leaves nothing out."""
    z = jnp.array([-3.0, 2.0])
    everything, below = Interval(-np.inf, np.inf, True, True), Interval(-np.inf, 0.5, open_low=True)
    assert everything == Interval()
    np.testing.assert_allclose(constrained(z, Ends.of([everything] * 2)), z)
    np.testing.assert_allclose(constrained(z, Ends.of([below] * 2)), 0.5 - np.exp(-np.asarray(z)))


def test_ends_in_single_precision():
    """0.3 is 0.30000001 there: the end of the interval, and no value beyond it."""

    def write(c, ev):
        x = c.variable("x", start=c.parameter("b", 0.2, bounds=(0.1, 0.3)), fixed=True)
        c.add_equations(Eq(der(x), 1))

    with jax.enable_x64(False):
        system = compiled(component(write))
        for z, end in ((200.0, 0.3), (-200.0, 0.1)):
            assert system.constrain({"c.b": jnp.array(z)}).parameters["c.b"] == np.float32(end)
            assert system.with_parameters({"c.b": np.float32(end)}).parameters["c.b"] == np.float32(end)
        for value in (0.301, 0.099, 1e300):
            with pytest.raises(ModelError, match=r"must lie in \[0\.1, 0\.3\]"):
                system.with_parameters({"c.b": value})


def test_of_systems():
    """Parameters and the weights of a network in one dictionary, which changes nothing when it is put back."""

    def write(self, ev):
        a, b = self.parameter("a", 0.25, bounds=(0.0, 1.0)), self.parameter("b", 4.0, bounds=POSITIVE)
        self.parameter("end", 0.0, bounds=(0.0, 1.0))
        self.parameter("twice", 2 * a)
        (law,) = self.learned("law", mlp(1, 1), inputs=[self.variable("x", start=1.0)])
        self.add_equations(law + a * self.x - b)

    system = compiled(component(write))
    free = system.unconstrain("c.law", "c.a", "c.b")
    assert list(free) == ["c.law", "c.a", "c.b"]
    assert float(free["c.a"]) == pytest.approx(np.log(0.25 / 0.75)) and float(free["c.b"]) == pytest.approx(np.log(4))
    changed = system.constrain({**free, "c.a": 0.0, "c.law": jax.tree.map(lambda w: 2 * w, free["c.law"])})
    assert float(changed.parameters["c.a"]) == 0.5 and float(changed.parameters["c.twice"]) == 1.0
    assert float(changed.parameters["c.b"]) == pytest.approx(4.0, rel=1e-15)
    before, after = (jax.tree.leaves(s.neural) for s in (system, changed))
    assert all(np.array_equal(2 * a, b) for a, b in zip(before, after, strict=True) if isinstance(a, jax.Array))
    with pytest.raises(ModelError, match=r"'c\.end' lies on the end of its bounds \[0, 1\].*start inside"):
        system.unconstrain("c.end")
    with pytest.raises(ModelError, match=r"'c\.A' is neither a network nor a parameter: did you mean"):
        system.unconstrain("c.A")
    with pytest.raises(ModelError, match=r"'c\.twice' is 2\*c\.a, computed from others"):
        system.constrain({"c.twice": 1.0})
