"""Eager, `jit`, `vmap` over one and many, `jit(vmap)`, `scan` and inside `grad`: values, refusals and codes alike."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component
from sympy import Eq

from jaxonomy_dae import ModelError, SimulationError, der, simulate
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, Tsit5, solve_dae

TS = jnp.array([0.5, 1.0])


def write(self, ev):
    """x' = k·x² + u: infinite at t = 1/k if u = 0."""
    k, u = self.parameter("k", 1.0), self.input("u", default=0.0)
    self.add_equations(Eq(der(self.variable("x", start=1.0, fixed=True)), k * self.x**2 + u))


@pytest.fixture(scope="module")
def system():
    return compiled(component(write))


@pytest.fixture(scope="module")
def run(system):
    def run(k, times=None, values=None, **options):
        inputs = {} if times is None else {"c.u": (times, values)}
        solution = simulate(system.with_parameters({"c.k": k}), 1.0, ts=TS, inputs=inputs, **options)
        return solution["c.x"], solution.result._value

    return run


KS = jnp.array([0.5, 1.5, -1.0])


def in_all_modes(f, batch):
    """The values of f over the batch, by mode."""
    zero = jax.tree.map(lambda v: v[:1], batch)
    yield "vmap", jax.vmap(f)(*batch)
    yield "jit", jax.tree.map(lambda *rows: jnp.stack(rows), *(jax.jit(f)(*row) for row in zip(*batch, strict=True)))
    yield "jit(vmap)", jax.jit(jax.vmap(f))(*batch)
    yield "scan", jax.lax.scan(lambda _, row: (0.0, f(*row)), 0.0, batch)[1]
    one = jax.vmap(f)(*zero)
    yield "vmap over one", jax.tree.map(lambda v: jnp.repeat(v, len(batch[0]), 0), one)


@pytest.mark.slow
def test_failing_members_are_alike(run):
    """Kind: `jax.vmap` outside of jit raised for the whole batch and did not say for which member, where jit(vmap)
    gives NaN in its rows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = dict(in_all_modes(run, (KS,)))
    expected = 1 / (1 - np.outer(KS, TS))
    expected[1, 1] = np.nan
    for mode, (x, code) in found.items():
        first = slice(0, 1) if mode == "vmap over one" else slice(None)
        np.testing.assert_allclose(x[first], expected[first], rtol=1e-5, err_msg=mode)
        np.testing.assert_array_equal(code[first], found["jit"][1][first], err_msg=mode)


@pytest.mark.slow
def test_failing_members_are_named(run):
    """Kind: as above; and nested, in any order of axes."""
    with pytest.warns(RuntimeWarning, match=r"under jax.vmap, member 1 of 3: no step was short enough"):
        x, _ = jax.vmap(run)(KS)
    assert np.isnan(x).tolist() == [[False, False], [False, True], [False, False]]
    with pytest.raises(SimulationError, match=r"member 1 of 3"):
        jax.vmap(lambda k: run(k, throw=True))(KS)
    with pytest.warns(RuntimeWarning, match=r"member \(1, 2\) of 2 by 3"):
        jax.vmap(jax.vmap(run), in_axes=1)(jnp.array([[0.5, -1.0], [0.2, 0.1], [0.3, 1.5]]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.vmap(lambda k: run(k, throw=False))(KS)


@pytest.mark.long("a batch outside of jit")
def test_failing_members_of_equations_without_a_model():
    """Kind: as above, by `solve_dae`."""

    def last(k):
        term = DAETerm(lambda t, x, z, k: z, lambda t, x, z, k: z - k * x**2)
        one = jnp.ones(1)
        return solve_dae(term, t1=1.0, y0=(one, k * one), args=k, ts=TS).ys[0][:, 0]

    with pytest.warns(RuntimeWarning, match="member 1 of 3"):
        x = jax.vmap(last)(KS)
    assert np.isnan(x).tolist() == [[False, False], [False, True], [False, False]]


SAMPLES = {
    "short": ([0.0, 0.4, 0.9], [0.0, 1.0, 2.0], "reach from"),
    "late": ([0.2, 0.4, 1.0], [0.0, 1.0, 2.0], "reach from"),
    "unsorted": ([0.0, 0.6, 0.4], [0.0, 1.0, 2.0], "increase"),
    "not finite": ([0.0, 0.5, 1.0], [0.0, np.nan, 2.0], "nan"),
}


@pytest.mark.slow
def test_samples_are_judged_alike(run):
    """Kind: what is refused outside jit goes on inside: samples that end before t1 were extrapolated."""
    fine = np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0, 2.0])
    rows = [*((np.array(t), np.array(v)) for t, v, _ in SAMPLES.values()), fine]
    batch = -jnp.ones(len(rows)), jnp.stack([t for t, _ in rows]), jnp.stack([v for _, v in rows])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = dict(in_all_modes(run, batch))
    reference = run(-1.0, *fine)[0]
    for mode, (x, code) in found.items():
        if mode != "vmap over one":
            np.testing.assert_allclose(x[-1], reference, rtol=1e-7, err_msg=mode)
            assert np.isnan(x[:-1]).all() and np.isfinite(x[-1]).all(), mode
        assert (code[0] == diffrax.RESULTS.nonfinite._value) and np.isnan(x[0]).all(), mode
    with pytest.warns(RuntimeWarning, match=r"members 0, 1, 2 and 3 of 5: .*samples of an input"):
        jax.vmap(run)(*batch)


@pytest.mark.parametrize("kind", SAMPLES)
def test_samples_are_refused_by_name(run, kind):
    times, values, said = SAMPLES[kind]
    with pytest.raises(ModelError, match=f"'c.u'.*{said}"):
        run(-1.0, np.array(times), np.array(values))


def test_samples_are_not_extrapolated_at_a_point(system):
    """Kind: a state was initialized, and a variable read, at times that samples do not reach."""
    inputs = {"c.u": (np.array([0.0, 1.0]), np.array([0.0, 1.0]))}
    with pytest.raises(ModelError, match="'c.u'.*t=2 is not among them"):
        system.initialize(2.0, inputs)
    with pytest.raises(ModelError, match="'c.u'.*t=2 is not among them"):
        system.observe("der(c.x)", 2.0, jnp.ones(1), inputs)
    np.testing.assert_allclose(system.observe("der(c.x)", 1.0, jnp.ones(1), inputs), 2.0)


# --- traced arguments ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lag():
    """x' = u − x."""

    def write(self, ev):
        x, u = self.variable("x", start=1.0, fixed=True), self.input("u", default=0.0)
        self.add_equations(Eq(der(x), u - x))

    return compiled(component(write))


@pytest.mark.slow
def test_lists_may_hold_what_is_traced(lag):
    """Kind: what is traced is allowed wherever its value is. `jump_ts=[te]` under `grad`, and samples and times in
    lists, were JAX's bare TracerArrayConversionError. x(1) = 1/e + 1 − exp(te − 1) for a step at te."""

    def stepped(te):
        inputs = {"c.u": lambda t: jnp.where(t >= te, 1.0, 0.0)}
        return simulate(lag, 1.0, ts=[0.5, 1.0], inputs=inputs, jump_ts=[te])["c.x"][1]

    def sampled(te):
        inputs = {"c.u": ([0.0, te, 1.0], [1.0, 1.0, te])}
        return simulate(lag, 1.0, ts=[te, 1.0], inputs=inputs)["c.x"][0]

    value, slope = jax.value_and_grad(stepped)(0.3)
    np.testing.assert_allclose([value, slope], [np.exp(-1) + 1 - np.exp(-0.7), -np.exp(-0.7)], rtol=1e-5)
    np.testing.assert_allclose(jax.jit(stepped)(0.3), value, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(sampled)(0.3), 0.0, atol=1e-5)  # x = 1 as long as u = 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["max_steps", "max_events", "save_events", "throw", "progress"])
def test_what_the_program_hangs_on_is_refused_if_traced(lag, name):
    """Kind: as above. A traced `save_events` became part of the key under which programs are kept, and every later call
    of the process failed at its comparison."""
    with pytest.raises(ModelError, match=rf"{name} must be .*traced value"):
        jax.jit(lambda v: simulate(lag, 1.0, **{name: v})["c.x"])(1 if name.startswith("max") else True)
    with pytest.raises(ModelError, match=f"{name} must be"):
        simulate(lag, 1.0, **{name: 0.5})
    assert np.isfinite(simulate(lag, 1.0, ts=TS)["c.x"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Tsit5(), Rodas5P(), BDF()])
def test_saved_times_do_not_move_the_solution(system, solver):
    """Kind: what is asked changes the answer. x = 1/(1 + t) for k = −1."""
    decaying = system.with_parameters({"c.k": -1.0})
    few = simulate(decaying, 1.0, ts=TS, solver=solver)
    many = simulate(decaying, 1.0, ts=jnp.sort(jnp.append(jnp.linspace(0.01, 0.99, 40), TS)), solver=solver)
    places = np.searchsorted(many.ts, TS)
    np.testing.assert_allclose(many["c.x"][places], few["c.x"], rtol=1e-13)
    assert many.stats["num_steps"] == few.stats["num_steps"]
    np.testing.assert_allclose(few["c.x"], 1 / (1 + np.asarray(TS)), rtol=2e-5)
