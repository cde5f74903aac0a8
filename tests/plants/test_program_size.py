"""How often the equations of a model stand in its programs: what a first call costs grows with the copies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cell_arrays import ladder
from hybrid_models import Ball
from hybrid_models import compiled as hybrid
from planar_models import double_pendulum
from problems import compiled, drag_on, mlp, pendulum

from jaxonomy_dae import AcausalSystem, EqnEnv, simulate
from jaxonomy_dae.library import electrical as el


def motor() -> AcausalSystem:
    ev = EqnEnv()
    machine, source = el.DCMotor(ev, "motor", R=1.0, L=0.5, k=0.1, J=0.01, d=0.1), el.SignalVoltage(ev, "source")
    ground = el.Ground(ev, "ground")
    return compiled(machine, source, ground, connect=[(source.p, machine.p), (source.n, machine.n, ground.p)])


def driven() -> AcausalSystem:
    """By a wave, whose frequency is a parameter."""
    ev = EqnEnv()
    source, r = el.SineVoltage(ev, "source", amplitude=10.0, frequency=50.0), el.Resistor(ev, "r", 10.0)
    c, ground = el.Capacitor(ev, "c", 1e-3, initial_voltage=0.0), el.Ground(ev, "ground")
    return compiled(source, r, c, ground, connect=[(source.p, r.p), (r.n, c.p), (c.n, source.n, ground.p)])


def rectifier() -> AcausalSystem:
    """The diode's voltage is implicit."""
    ev = EqnEnv()
    source, r, d = el.SignalVoltage(ev, "source"), el.Resistor(ev, "r", 10.0), el.Diode(ev, "d")
    c, load, ground = el.Capacitor(ev, "c", 1e-3), el.Resistor(ev, "load", 500.0), el.Ground(ev, "ground")
    ends = (source.p, r.p), (r.n, d.p), (d.n, c.p, load.p), (c.n, load.n, source.n, ground.p)
    return compiled(source, r, d, c, load, ground, connect=ends)


# Once each: the first step's size, the solver's first slope, the stages of a step, which are a loop; in a gradient also
# the first step of what rests, its second run, and a step backwards. There the six stages of a field with few
# operations are written out: a pendulum's gradient then runs in 0.29 ms instead of 0.37. The steps recorded, and those
# run again, are one function. Events look at slopes at three more places; Rodas5P's stages have Jacobians.
# Then the lines of both programs, with some percent to spare for other versions of JAX.
MODELS = {
    "pendulum": (pendulum, "pend.m", (3, 11), (3500, 9100)),
    "double pendulum": (lambda: double_pendulum("auto"), "a.m", (3, 7), (11800, 30500)),
    "ball": (lambda: hybrid(Ball, "ball"), "ball.e", (6, 17), (5200, 12000)),
    "motor": (motor, "motor.R", (3, 11), (2100, 5700)),
    "driven": (driven, "r.R", (3, 11), (2200, 5600)),
    "rectifier": (rectifier, "r.R", (5, 23), (6700, 13800)),
    "ladder": (lambda: ladder(100, False), "source.V", (3, 11), (1900, 5300)),
}


@pytest.mark.long("programs are traced and lowered, not compiled")
@pytest.mark.parametrize("model", MODELS)
def test_copies_of_the_field(model, monkeypatch):
    """A pendulum's field stood 11 times in its run and 31 times in the gradient."""
    build, name, most, lines = MODELS[model]
    system = build()
    for field in ("vector_field", "semi_explicit"):
        method = getattr(AcausalSystem, field)
        monkeypatch.setattr(AcausalSystem, field, lambda self, *given, method=method: marked(method(self, *given)))
    inputs = {given: 1.0 for given in system.inputs} or None

    def end(value):
        return jnp.sum(simulate(system.with_parameters({name: value}), 1.0, ts=jnp.array([1.0]), inputs=inputs).states)

    value = system.parameters[name]
    texts = [jax.jit(f).lower(value).as_text() for f in (end, jax.grad(end))]
    counts, sizes = ([text.count(what) for text in texts] for what in ("stablehlo.tanh", "\n"))
    assert 1 < counts[0] <= most[0] and 1 < counts[1] <= most[1], counts
    assert sizes[0] <= lines[0] and sizes[1] <= lines[1], sizes


@pytest.mark.long("programs are traced and lowered, not compiled")
def test_starts_that_are_numbers_take_no_lines():
    """Where weights alone are trained, the search for a consistent start was 44 % of a pendulum's program."""
    network = mlp(1, 1)
    system = pendulum(drag_on("vx", network=network))
    trained, rest = eqx.partition(network, eqx.is_inexact_array)

    def end(weights):
        learned = eqx.tree_at(lambda s: s.neural["drag"], system, eqx.combine(weights, rest))
        return jnp.sum(simulate(learned, 1.0, ts=jnp.array([1.0])).states)

    assert jax.jit(end).lower(trained).as_text().count("\n") < 2800  # 5,900 with the search and all stages written out
    np.testing.assert_allclose(jax.jit(end)(trained), end(trained), rtol=1e-12)


def marked(slope):
    """The same values, by an operation that the model has nowhere else."""
    return slope + 0.0 * jnp.tanh(slope)
