"""Compiled programs hold no host callbacks: they can be exported, and JAX's persistent cache keeps them."""

import diffrax
import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from problems import run

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, solve_dae

TS = jnp.array([0.5, 1.0])


class Decay(Component):
    """x' = −k·x."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        k, x = self.parameter("k", 2.0), self.variable("x", start=1.0, fixed=True)
        self.add_equations(der(x) + k * x)


@pytest.fixture(scope="module")
def decay():
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Decay(ev, "c"))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.slow
def test_a_simulation_is_exported(decay):
    def final(k):
        return simulate(decay.with_parameters({"c.k": k}), 1.0, ts=TS)["c.x"]

    for f, expected in ((final, np.exp(-1.5 * TS)), (lambda k: jax.jacrev(final)(k), -TS * np.exp(-1.5 * TS))):
        assert "callback" not in str(jax.make_jaxpr(f)(1.5))
        exported = jax.export.export(jax.jit(f))(1.5)
        np.testing.assert_allclose(exported.call(1.5), expected, rtol=1e-5)


@pytest.mark.slow
def test_traced_solves_raise_only_if_told_to(decay):
    term = DAETerm(lambda t, x, z, a: -x, lambda t, x, z, a: z**2 - x)
    start = jnp.ones(1), jnp.full(1, 2.0)  # inconsistent
    found = eqx.filter_jit(lambda k: solve_dae(term, k, start, solver=BDF()))(1.0)
    assert not diffrax.is_okay(found.result) and all(np.isnan(y).all() for y in found.ys)
    with pytest.raises(Exception, match="inconsistent start"):
        eqx.filter_jit(lambda k: solve_dae(term, k, start, solver=BDF(), throw=True).ys)(1.0)


@pytest.mark.slow
def test_times_that_do_not_fit(decay):
    """Inside a program, where nobody can look at them before it runs."""

    def run(times, throw):
        solution = simulate(decay, times[0], t0=times[1], ts=times[2:], throw=throw)
        return solution["c.x"], diffrax.is_okay(solution.result)

    quiet, loud = eqx.filter_jit(lambda times: run(times, None)), eqx.filter_jit(lambda times: run(times, True))
    for find in (quiet, loud):
        x, okay = find(jnp.array([1.0, 0.0, 0.5, 1.0]))
        np.testing.assert_allclose(x, np.exp(-2.0 * TS), rtol=1e-5)
        assert okay
    wrong = {"unsorted": [1.0, 0.0, 1.0, 0.5], "outside": [1.0, 0.0, 0.5, 1.1], "not a number": [np.nan, 0.0, 0.5, 1.0]}
    wrong["backwards"] = [0.0, 1.0, 0.5, 0.6]
    for times in map(jnp.array, wrong.values()):
        x, okay = quiet(times)
        assert np.isnan(x).all() and not okay
        with pytest.raises(Exception, match="(?s)times do not fit"):
            jax.block_until_ready(loud(times))


@pytest.mark.slow
def test_prescribed_steps_and_time_that_runs_backwards():
    """y' = −2·y from t = 1 back to 0; and the derivative by the time at which it is saved."""
    term = DAETerm(lambda t, y, a: -a * y, mass=[1.0])

    def solved(times, ts):
        control = diffrax.StepTo(times)
        return solve_dae(term, 0.0, jnp.ones(1), t0=1.0, ts=ts, args=2.0, solver=Rodas5P(), stepsize_controller=control)

    steps = jnp.linspace(1.0, 0.0, 65)
    read = eqx.filter_jit(lambda *given: (solved(*given).ys[:, 0], diffrax.is_okay(solved(*given).result)))
    y, okay = read(steps, TS[:1])
    np.testing.assert_allclose(y, [np.exp(1.0)], rtol=1e-8)
    assert okay
    y, okay = read(steps[::-1], TS[:1])
    assert np.isnan(y).all() and not okay
    slope = jax.grad(lambda t: solved(steps, jnp.atleast_1d(t)).ys[0, 0])(0.5)
    np.testing.assert_allclose(slope, -2 * np.exp(1.0), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.long("two processes")
def test_a_second_process_finds_its_programs_in_the_cache(tmp_path):
    code = (
        "import jax, diffrax\n"
        "jax.config.update('jax_enable_x64', True)\n"
        f"jax.config.update('jax_compilation_cache_dir', {str(tmp_path)!r})\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0)\n"
        "jax.config.update('jax_persistent_cache_min_entry_size_bytes', -1)\n"
        "from jax import monitoring\n"
        "import jax.numpy as jnp\n"
        "from jaxonomy_dae.solvers import DAETerm, Rodas5P, solve_dae\n"
        "names = []\n"
        "monitoring.register_event_listener(lambda name, **_: names.append(name))\n"
        "term = DAETerm(lambda t, y, a: -a * y, mass=[1.0])\n"
        "import equinox as eqx\n"
        "def end(a): return solve_dae(term, 1.0, jnp.ones(1), args=a, solver=Rodas5P(), ts=jnp.array([1.0])).ys[0, 0]\n"
        "eqx.filter_jit(eqx.filter_grad(end))(2.0)\n"
        "print(sum(n.endswith('cache_hits') for n in names), sum(n.endswith('cache_misses') for n in names))\n"
    )
    first, second = ([int(n) for n in run(code).split()[-2:]] for _ in range(2))
    assert first[1] > 0 and second[0] > 0 and second[1] == 0


@pytest.mark.slow
def test_a_user_s_own_diffrax_solve_keeps_its_checks(decay):
    def own(ts):
        term = diffrax.ODETerm(lambda t, y, a: -y)
        return diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.1, 1.0, saveat=diffrax.SaveAt(ts=ts)).ys

    simulate(decay, 1.0, ts=TS)
    assert "callback" in str(jax.make_jaxpr(own)(TS))
