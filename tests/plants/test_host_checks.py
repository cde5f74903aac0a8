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
from jaxonomy_dae.adjoint.host_checks import without_host_checks
from jaxonomy_dae.solvers import BDF, DAETerm, solve_dae

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


def test_a_simulation_is_exported(decay):
    def final(k):
        return simulate(decay.with_parameters({"c.k": k}), 1.0, ts=TS, throw=False)["c.x"]

    for f, expected in ((final, np.exp(-1.5 * TS)), (lambda k: jax.jacrev(final)(k), -TS * np.exp(-1.5 * TS))):
        assert "callback" not in str(jax.make_jaxpr(f)(1.5))
        exported = jax.export.export(jax.jit(f))(1.5)
        np.testing.assert_allclose(exported.call(1.5), expected, rtol=1e-5)


def test_a_traced_solve_that_throws_still_does(decay):
    term = DAETerm(lambda t, x, z, a: -x, lambda t, x, z, a: z**2 - x)
    start = jnp.ones(1), jnp.full(1, 2.0)  # inconsistent
    with pytest.raises(Exception, match="inconsistent start"):
        eqx.filter_jit(lambda k: solve_dae(term, k, start, solver=BDF()).ys)(1.0)
    with pytest.raises(Exception, match="(?s)out of|increasing|smaller|sorted|ascending"):
        jax.block_until_ready(eqx.filter_jit(lambda ts: simulate(decay, 1.0, ts=ts)["c.x"])(TS[::-1]))


def test_only_what_is_traced_inside_is_left_out():
    def traced():
        return "callback" in str(jax.make_jaxpr(lambda x: checked(x))(1.0))  # anew: traces are cached by function

    def checked(x):
        return eqx.error_if(x, x < 0, "negative")

    with without_host_checks():
        assert not traced()
        with pytest.raises(RuntimeError, match="negative"):
            checked(jnp.array(-1.0))
        with without_host_checks():
            assert not traced()
        assert not traced()
    with without_host_checks(False):
        assert traced()
    assert traced()
    with pytest.raises(RuntimeError, match="negative"):
        eqx.filter_jit(checked)(jnp.array(-1.0))


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
        "solve_dae(term, 1.0, jnp.ones(1), args=2.0, solver=Rodas5P())\n"
        "print(sum(n.endswith('cache_hits') for n in names), sum(n.endswith('cache_misses') for n in names))\n"
    )
    first, second = ([int(n) for n in run(code).split()[-2:]] for _ in range(2))
    assert first[1] > 0 and second[0] > 0 and second[1] == 0


def test_a_user_s_own_diffrax_solve_keeps_its_checks(decay):
    def own(ts):
        term = diffrax.ODETerm(lambda t, y, a: -y)
        return diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.1, 1.0, saveat=diffrax.SaveAt(ts=ts)).ys

    simulate(decay, 1.0, ts=TS, throw=False)
    assert "callback" in str(jax.make_jaxpr(own)(TS))
