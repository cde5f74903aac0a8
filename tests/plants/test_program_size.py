"""How often the equations of a model stand in its programs: what a first call costs grows with the copies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hybrid_models import Ball
from hybrid_models import compiled as hybrid
from planar_models import double_pendulum
from problems import drag_on, mlp, pendulum

from jaxonomy_dae import AcausalSystem, simulate

# Of a field with few operations the six stages of a step are written out: a pendulum's gradient then runs in 0.29 ms
# instead of 0.37. Once each: a consistent start, the first step, the solver's first slope; in a gradient also the first
# step of what rests, its second run, and the stages of a step backwards. The steps recorded, and those run again, are
# one function. Events look at slopes at three more places.
MODELS = {
    "pendulum": (pendulum, "pend.m", (9, 18)),
    "double pendulum": (lambda: double_pendulum("auto"), "a.m", (4, 8)),
    "ball": (lambda: hybrid(Ball, "ball"), "ball.e", (12, 23)),
}


@pytest.mark.long("programs are traced and lowered, not compiled")
@pytest.mark.parametrize("model", MODELS)
def test_copies_of_the_field(model, monkeypatch):
    """A pendulum's field stood 11 times in its run and 31 times in the gradient."""
    build, name, most = MODELS[model]
    field, system = AcausalSystem.vector_field, build()
    monkeypatch.setattr(AcausalSystem, "vector_field", lambda self, t, x, args=None: marked(field(self, t, x, args)))

    def end(value):
        return jnp.sum(simulate(system.with_parameters({name: value}), 1.0, ts=jnp.array([1.0])).states)

    value = system.parameters[name]
    counts = [jax.jit(f).lower(value).as_text().count("stablehlo.tanh") for f in (end, jax.grad(end))]
    assert 1 < counts[0] <= most[0] and 1 < counts[1] <= most[1], counts


@pytest.mark.long("programs are traced and lowered, not compiled")
def test_starts_that_are_numbers_take_no_lines():
    """Where weights alone are trained, the search for a consistent start was 44 % of a pendulum's program."""
    network = mlp(1, 1)
    system = pendulum(drag_on("vx", network=network))
    trained, rest = eqx.partition(network, eqx.is_inexact_array)

    def end(weights):
        learned = eqx.tree_at(lambda s: s.neural["drag"], system, eqx.combine(weights, rest))
        return jnp.sum(simulate(learned, 1.0, ts=jnp.array([1.0])).states)

    assert jax.jit(end).lower(trained).as_text().count("\n") < 3600  # 5,900 with the search
    np.testing.assert_allclose(jax.jit(end)(trained), end(trained), rtol=1e-12)


def marked(slope):
    """The same values, by an operation that the model has nowhere else."""
    return slope + 0.0 * jnp.tanh(slope)
