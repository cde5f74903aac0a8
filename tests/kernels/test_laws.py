"""Laws keep what they promise for a thousand draws of weights, large ones too, and inputs of all sizes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import Component, EqnEnv, ModelError, NeuralDAEBlock
from jaxonomy_dae.learning import (
    AbstractPassive,
    Bounded,
    Conservative,
    Dissipation,
    IsotropicPassive,
    Monotone,
    Odd,
    Passive,
    PortHamiltonian,
    Positive,
)

COUNT, POINTS = 1000, 12
EPS = np.finfo(float).eps


def drawn(make, largest=3.0):
    """A batch of laws with weights up to 10**largest times as large as at first."""
    factor_key, key = jax.random.split(jax.random.key(0))
    factors = 10.0 ** jax.random.uniform(factor_key, (COUNT,), minval=-1.0, maxval=largest)

    def one(key, factor):
        return jax.tree.map(lambda leaf: leaf * factor if eqx.is_inexact_array(leaf) else leaf, make(key))

    return eqx.filter_jit(eqx.filter_vmap(one))(jax.random.split(key, COUNT), factors)


def points(inputs, largest=6.0):
    """Inputs for each law, shape (laws, points, inputs): of all sizes, and zero."""
    size_key, key = jax.random.split(jax.random.key(1))
    sizes = 10.0 ** jax.random.uniform(size_key, (COUNT, POINTS, 1), minval=-largest, maxval=largest)
    u = sizes * jax.random.normal(key, (COUNT, POINTS, inputs))
    return u.at[:, 0].set(0.0)


def over(laws, u, function=lambda law, u: law(u)):
    """A function of each law and each of its inputs."""
    batched = eqx.filter_vmap(lambda law, us: jax.vmap(lambda one: function(law, one))(us))
    return jax.tree.map(np.asarray, eqx.filter_jit(batched)(laws, u))


def rounding(law, u):
    """By how much v·N may be off: so many units in the last place of the products that it is summed of."""
    scaled = u[: law.size] / jnp.asarray(law.inputs[: law.size])
    network = law.network
    w = network(
        (u / jnp.asarray(law.inputs))[law.size :] if isinstance(law, Dissipation) else u / jnp.asarray(law.inputs)
    )
    w = jnp.abs(w.reshape(law.size, law.size))
    lower = jnp.tril(w, -1) + jnp.eye(law.size)
    products = (lower * jax.nn.softplus(jnp.abs(jnp.diagonal(w)))) @ lower.T + w + w.T
    return 8 * law.size * EPS * law.power * (jnp.abs(scaled) @ products @ jnp.abs(scaled))


def most(network):
    """The largest value of a network, its last bias aside."""
    return jnp.sum(jnp.abs(network.layers[-1].weight))


# --- no energy ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("size, context", [pytest.param(2, 0, marks=pytest.mark.slow), (3, 2)])
def test_passive(size, context):
    sizes = tuple(10.0 ** (k - 1) for k in range(size + context))
    laws = drawn(lambda key: Passive(size, key=key, context=context, inputs=sizes, power=3.0))
    u = points(size + context)
    power, slack = over(laws, u, lambda law, u: (jnp.sum(law(u) * u[:size]), rounding(law, u)))
    assert (power <= slack).all() and (power < 0).mean() > 0.7
    np.testing.assert_array_equal(over(laws, u)[:, 0], 0.0)


@pytest.mark.slow
def test_passive_with_one_output_is_so_in_rounded_numbers():
    u = points(1)
    assert (over(drawn(lambda key: Passive(key=key, inputs=0.2, power=7.0)), u) * np.asarray(u) <= 0).all()


@pytest.mark.slow
def test_isotropic_passive():
    laws, u = drawn(lambda key: IsotropicPassive(2, key=key, inputs=3.0)), points(2)
    found = over(laws, u)
    assert (found * np.asarray(u) <= 0).all()
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    size = np.abs(found).max(axis=-1, keepdims=True)
    assert (np.abs(over(laws, u @ turn.T) - found @ turn.T) <= 1e-6 * size).all()  # weights of 1e3 enlarge rounding
    law = IsotropicPassive(2, key=jax.random.key(3), inputs=3.0, power=2.0)
    v = jnp.array([1.2, -0.9])
    np.testing.assert_allclose(law(v), -law.rate(jnp.asarray(1.5)) * v, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("states", [0, 2])
def test_dissipation(states):
    sizes = (1.0, 0.1, 20.0, *[5.0] * states)
    laws = drawn(lambda key: Dissipation(3, states, key=key, inputs=sizes, power=0.5))
    u = points(3 + states)

    def parts(law, u):
        R, J = law.R(u[3:]), law.J(u[3:])
        return R, J, law(u), (J - R) @ u[:3]

    R, J, f, expected = over(laws, u, parts)
    np.testing.assert_array_equal(R, R.swapaxes(-2, -1))
    np.testing.assert_array_equal(J, -J.swapaxes(-2, -1))
    own = np.sqrt(np.einsum("...ii->...i", R))  # in units in which the diagonal is one, as units are far apart
    own = np.where(own > 0, own, 1.0)
    lowest = np.linalg.eigvalsh(R / own[..., :, None] / own[..., None, :])[..., 0]
    assert (lowest > -1e-14).all()
    size = np.abs(R) @ np.abs(np.asarray(u))[..., :3, None] + np.abs(J) @ np.abs(np.asarray(u))[..., :3, None]
    assert (np.abs(f - expected) <= 1e-11 * size[..., 0]).all()


@pytest.mark.slow
def test_port_hamiltonian_never_gains_energy():
    laws, u = drawn(lambda key: PortHamiltonian(3, key=key, inputs=(1.0, 2.0, 0.5), energy=3.0, time=0.1)), points(3)

    def parts(law, u):
        scaled = u / jnp.asarray(law.inputs)
        e = jax.grad(law._energy)(scaled)  # dH/dt in units of energy/time, which the law multiplies by
        rate = e @ (law(u) / jnp.asarray(law.inputs)) * law.time
        floor = 0.5 * jnp.sum(scaled**2) - 2 * most(law.storage)
        w = law.network(scaled).reshape(3, 3)
        lower = jnp.abs(jnp.tril(w, -1)) + jnp.eye(3)
        products = (lower * jax.nn.softplus(jnp.diagonal(w))) @ lower.T + jnp.abs(w) + jnp.abs(w.T)
        return rate, 32 * EPS * (jnp.abs(e) @ products @ jnp.abs(e)), law.energy(u), floor * law.scale

    rate, slack, energy, floor = over(laws, u, parts)
    assert (rate <= slack).all() and (rate < 0).mean() > 0.7
    assert (energy >= floor).all()
    assert (np.abs(energy[:, 0]) <= 1e-12 * over(laws, u[:, :1], lambda law, u: 3 * most(law.storage))[:, 0]).all()


@pytest.mark.slow
def test_conservative_forces_do_what_the_potential_says():
    """The work along a straight path, by Gauss's quadrature of F, is the difference of potentials."""
    laws = drawn(lambda key: Conservative(2, key=key, inputs=(2.0, 0.5), energy=4.0), largest=0.5)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    nodes, weights = jnp.asarray(nodes), jnp.asarray(weights)
    u = 0.5 * jax.random.normal(jax.random.key(5), (COUNT, POINTS, 4)) * jnp.array([2.0, 0.5, 2.0, 0.5])

    def work(law, u):
        a, b = u[:2], u[2:]
        along = a + (b - a) * (nodes[:, None] + 1) / 2
        return jnp.sum(weights * (jax.vmap(law)(along) @ (b - a)) / 2), law.potential(a) - law.potential(b)

    found, expected = over(laws, u, work)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    laws = drawn(lambda key: Conservative(2, key=key, energy=4.0))
    bound = 2 * 4.0 * over(laws, u[:, :1], lambda law, u: most(law.network))
    assert (np.abs(over(laws, points(2), lambda law, u: law.potential(u))) <= bound * (1 + 1e-12)).all()


# --- shapes ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_odd():
    laws, u = drawn(lambda key: Odd(2, 3, key=key, inputs=(0.1, 10.0), outputs=(1.0, 2.0, 3.0))), points(2)
    np.testing.assert_array_equal(over(laws, -u), -over(laws, u))
    np.testing.assert_array_equal(over(laws, u)[:, 0], 0.0)
    assert (over(laws, u)[:, 1:] != 0).mean() > 0.9


@pytest.mark.parametrize("depth", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_monotone(depth):
    laws, u = (
        drawn(lambda key: Monotone(2, 2, (True, False), key=key, depth=depth, outputs=0.1), largest=2.0),
        points(2),
    )
    slopes = over(laws, u, lambda law, u: jax.jacfwd(law)(u))
    assert (slopes * np.array([1.0, -1.0]) >= 0).all() and (slopes != 0).any()
    a, b = np.asarray(u), np.asarray(u) + np.abs(np.asarray(u[:, ::-1])) * np.array([1.0, -1.0])
    low, high = over(laws, u), over(laws, jnp.asarray(b))
    slack = 16 * EPS * np.maximum(np.abs(low), np.abs(high))
    terms = 64 * EPS * over(laws, jnp.abs(u), lambda law, u: jnp.sum(law.roots[-1] ** 2)) * 0.1
    assert (a[..., 0] <= b[..., 0]).all() and (high - low >= -slack - terms[..., None]).all()


def test_bounded():
    low, high = (-0.1, 1.0 / 3), (1e6 / 3, 0.7)
    laws, u = drawn(lambda key: Bounded(low, high, 2, 2, key=key)), points(2)
    found = over(laws, u)
    assert (found >= np.array(low)).all() and (found <= np.array(high)).all()
    assert (np.ptp(found, axis=(0, 1)) > 0.99 * (np.array(high) - np.array(low))).all()


def test_positive():
    found = over(drawn(lambda key: Positive(2, 2, key=key, outputs=(1e-3, 5.0)), largest=5.0), points(2))
    assert (found > 0).all() and np.isfinite(found).all() and found.min() < 1e-5


# --- all of them -------------------------------------------------------------------------------------------------

KEY = jax.random.key(7)
LAWS = {
    "passive": lambda s: Passive(2, key=KEY, inputs=s, power=1.5),
    "isotropic": lambda s: IsotropicPassive(2, key=KEY, inputs=s, power=1.5),
    "dissipation": lambda s: Dissipation(1, 1, key=KEY, inputs=s, power=1.5),
    "conservative": lambda s: Conservative(2, key=KEY, inputs=s, energy=1.5),
    "port-hamiltonian": lambda s: PortHamiltonian(2, key=KEY, inputs=s, energy=1.5),
    "odd": lambda s: Odd(2, 2, key=KEY, inputs=s),
    "monotone": lambda s: Monotone(2, 2, key=KEY, inputs=s),
    "bounded": lambda s: Bounded(-1.0, 2.0, 2, key=KEY, inputs=s),
    "positive": lambda s: Positive(2, 2, key=KEY, inputs=s),
}


@pytest.mark.parametrize("name", [n if n == "isotropic" else pytest.param(n, marks=pytest.mark.slow) for n in LAWS])
def test_twice_differentiable_at_rest(name):
    law = LAWS[name](1.0)

    @jax.jit
    def at(u):
        slope = jax.jacfwd(law)(u)
        return slope, jax.jacrev(law)(u), jax.jacfwd(jax.jacrev(law))(u), jax.jacfwd(jax.jacfwd(law))(u)

    zero, h = jnp.zeros(2), 1e-4
    slope, reverse, second, forward = at(zero)
    np.testing.assert_allclose(slope, reverse, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(second, forward, rtol=1e-10, atol=1e-12)
    steps = h * np.eye(2)
    by_differences = np.stack([(at(zero + d)[0] - at(zero - d)[0]) / (2 * h) for d in steps], axis=-1)
    size = max(float(np.abs(by_differences).max()), 1.0)
    np.testing.assert_allclose(second, by_differences, rtol=0, atol=1e-3 * size)
    values = np.stack([(law(zero + d) - law(zero - d)) / (2 * h) for d in steps], axis=-1)
    np.testing.assert_allclose(slope, values, rtol=0, atol=1e-4 * max(float(np.abs(values).max()), 1.0))


PER_INPUT = ("passive", "isotropic", "dissipation", "conservative")  # their outputs are power or energy per input


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_other_units(name):
    """Inputs in millimetre per second instead of metre per second, the same weights: the same law."""
    u = jnp.array([0.4, -1.1])
    expected, found = LAWS[name](1.0)(u), LAWS[name](1000.0)(1000 * u)
    factor = 1e-3 if name in PER_INPUT else 1e3 if name == "port-hamiltonian" else 1.0
    np.testing.assert_allclose(found, factor * expected, rtol=1e-12)


@pytest.mark.slow
def test_precision_of_weights_is_kept():
    single = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, LAWS["passive"](1.0)
    )
    assert single(jnp.ones(2, jnp.float32)).dtype == jnp.float32


# --- kinds -------------------------------------------------------------------------------------------------------


class Slide(Component):
    """Whatever slides it takes a passive law only."""

    def __init__(self, ev, law, kind=AbstractPassive):
        super().__init__(ev, "slide")
        v = self.variable("v")
        self.learned("friction", law, [v], kind=kind)


@pytest.mark.parametrize("law", [Passive(key=KEY), IsotropicPassive(key=KEY), Dissipation(1, key=KEY)])
def test_a_slot_takes_laws_of_its_kind(law):
    assert len(Slide(EqnEnv(), law).learned_terms) == 1


@pytest.mark.parametrize("law, found", [(Odd(key=KEY), "Odd"), (jnp.tanh, "PjitFunction"), (Passive, "Passive")])
def test_a_slot_refuses_others(law, found):
    with pytest.raises(
        ModelError, match=rf"'slide\.friction'.*kind AbstractPassive may stand here; got {found}.*N\(v, …\)·v ≤ 0"
    ):
        Slide(EqnEnv(), law)


def test_a_block_refuses_others():
    targets = ["slide.v"]
    assert NeuralDAEBlock(Passive(key=KEY), targets=targets, name="drag", kind=AbstractPassive).targets
    with pytest.raises(ModelError, match="neural block 'drag': only a law of kind AbstractPassive or Odd may.*got MLP"):
        NeuralDAEBlock(eqx.nn.MLP(1, 1, 2, 1, key=KEY), targets=targets, name="drag", kind=(AbstractPassive, Odd))


def test_a_kind_is_a_class():
    with pytest.raises(ModelError, match="kind is a class such as learning.AbstractPassive.*got 'passive'"):
        Slide(EqnEnv(), Passive(key=KEY), kind="passive")


@pytest.mark.parametrize(
    "make, words",
    [
        (functools.partial(Passive, 0), "Passive: size is a whole number ≥ 1; got 0"),
        (
            functools.partial(Passive, 2, inputs=(1.0, 2.0, 3.0)),
            "Passive: inputs is a typical size > 0, or one for each of 2",
        ),
        (functools.partial(Passive, power=-1.0), "Passive: power is a typical size > 0.*got -1"),
        (functools.partial(Passive, inputs="m/s"), "typical size > 0.*got 'm/s'"),
        (functools.partial(Bounded, 2.0, 1.0), "low and high are finite and ascend.*got 2.0 and 1.0"),
        (functools.partial(Bounded, (0.0, 1.0), 2.0), r"a number, or one for each of 1 outputs; got \(0.0, 1.0\)"),
        (functools.partial(Monotone, 2, 1, (True,)), r"one for each of 2 inputs; got \(True,\)"),
        (functools.partial(Conservative, 2, depth=0), "Conservative: depth is a whole number ≥ 1"),
    ],
)
def test_wrong_settings(make, words):
    with pytest.raises(ModelError, match=words):
        make(key=KEY)
