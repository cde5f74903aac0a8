"""How often the equations of a model stand in its programs: what a first call costs grows with the copies."""

import jax
import jax.numpy as jnp
import pytest
from hybrid_models import Ball
from hybrid_models import compiled as hybrid
from planar_models import double_pendulum
from problems import pendulum

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


def marked(slope):
    """The same values, by an operation that the model has nowhere else."""
    return slope + 0.0 * jnp.tanh(slope)
