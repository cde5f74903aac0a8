"""A pendulum with drag for tests of fits: the model, and records whose truth is the angle's equation, integrated by
SciPy."""

import jax.numpy as jnp
import numpy as np
import scipy.integrate

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, NeuralDAEBlock
from jaxonomy_dae.learning import Experiment
from jaxonomy_dae.library.planar import PlanarPendulum

LENGTH, DRAG, SIGMA = 1.1, 0.3, 2e-3
RELEASE = "pend.initial_theta"


def drag(t, v, theta):
    return -theta[0] * v


def compiled_pendulum():
    """1 m long, which is not right, with the block `drag`."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    bob = PlanarPendulum(ev, name="pend", m=1.0, L=1.0, initial_theta=-1.0)
    diagram.add(bob)
    block = NeuralDAEBlock(drag, jnp.array([0.1]), targets=[(bob, "vx"), (bob, "vy")], name="drag")
    diagram.add_neural_correction_block(block)
    return AcausalCompiler(ev, diagram)()


def positions(times, release):
    """The bob's (x, y), with a drag proportional to its velocity."""

    def field(t, s):
        return [s[1], -9.81 / LENGTH * np.cos(s[0]) - DRAG * s[1]]

    run = scipy.integrate.solve_ivp(field, (0, times[-1]), [release, 0.0], t_eval=times, rtol=1e-10, atol=1e-12)
    return LENGTH * np.cos(run.y[0]), LENGTH * np.sin(run.y[0])


def record(seed, count, release, **others):
    """Samples of both positions, a few of which are missing."""
    times = np.linspace(0.0, 0.04 * count, count + 1)[1:]
    rng = np.random.default_rng(seed)
    x, y = (p + SIGMA * rng.standard_normal(count) for p in positions(times, release))
    x[3:6] = np.nan
    return Experiment(times, {"pend.x": x, "pend.y": y}, **{"sigma": SIGMA, "initial": {RELEASE: release}} | others)
