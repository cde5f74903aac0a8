"""How often the equations of a model stand in its programs: what a first call costs grows with the copies."""

import dataclasses

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
from jaxonomy_dae.run.system.system_at import SystemAt
from jaxonomy_dae.run.system.traced_once import traced_once


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


# Field and guards are functions of their own in a program: one for each form in which they are called (as they are,
# along a direction, with and without what goes back through them, at times of another type). Then the lines of both
# programs, with some percent to spare for other versions of JAX.
MODELS = {
    "pendulum": (pendulum, "pend.m", (3, 6), (3500, 8000)),
    "double pendulum": (lambda: double_pendulum("auto"), "a.m", (2, 6), (10000, 28500)),
    "ball": (lambda: hybrid(Ball, "ball"), "ball.e", (2, 7), (5200, 12000)),
    "motor": (motor, "motor.R", (2, 5), (2150, 5100)),
    "driven": (driven, "r.R", (2, 5), (2100, 4700)),
    "rectifier": (rectifier, "r.R", (4, 7), (6700, 11800)),
    "ladder": (lambda: ladder(100, False), "source.V", (2, 5), (1950, 4800)),
}


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_copies_of_the_field(model, monkeypatch):
    """A pendulum's field stood 11 times in its run and 31 times in the gradient, later 3 and 11 times."""
    build, name, most, lines = MODELS[model]
    system = build()
    for field in ("vector_field", "semi_explicit"):
        method = getattr(SystemAt, field).__wrapped__
        monkeypatch.setattr(SystemAt, field, traced_once(lambda self, x, method=method: marked(method(self, x))))
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


@dataclasses.dataclass
class Ramp:
    """An input without a hash, that its owner may change."""

    slope: float

    def __call__(self, t):
        return self.slope * t


@pytest.mark.slow
def test_functions_of_the_user_are_read_anew():
    """What is traced once is so within one program: an input that has changed counts in the next one, whether or not
    it has a hash."""
    system, ramp = motor(), Ramp(1.0)

    def text(given, slope):
        ramp.slope = slope
        return jax.jit(lambda R: end(R, given)).lower(1.0).as_text()

    def end(R, given):
        return simulate(system.with_parameters({"motor.R": R}), 1.0, inputs={"source.u": given})["motor.p.i"][-1]

    assert text(ramp.__call__, 1.5) != text(ramp.__call__, 2.5)
    assert "2.5" in text(ramp, 2.5)


def marked(slope):
    """The same values, by an operation that the model has nowhere else."""
    return slope + 0.0 * jnp.tanh(slope)
