"""Gradient steps on a problem beside the same optimizer on closed forms: x' = −k·x + g, with k and g trained."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.learning.gradient import Batches
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

pytestmark = pytest.mark.slow  # residuals and their Jacobian compile for ten seconds, for each number of experiments

K, GAIN, SIGMA = 0.7, 0.2, 0.01


class Decay(Component):
    def __init__(self, ev, name="d"):
        super().__init__(ev, name)
        k, g = self.parameter("k", 1.2, bounds=POSITIVE), self.parameter("g", 0.5)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * x + g))


def closed_form(k, g, x0, t):
    return g / k + (x0 - g / k) * jnp.exp(-k * t)


STARTS = (1.0, -0.5, 2.0, 0.3, 1.5)


def record(e, held_out=False):
    times = np.linspace(0.0, 2.0 + 0.3 * e, 12 + e)[1:]
    noise = SIGMA * np.random.default_rng(e).standard_normal(len(times))
    x = np.asarray(closed_form(K, GAIN, STARTS[e], times)) + noise
    return learning.Experiment(times, {"d.x": x}, sigma=SIGMA, initial={"d.x": STARTS[e]}, holdout=held_out)


@functools.cache
def problem(held_out=False):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Decay(ev))
    data = learning.Data(*(record(e, held_out and e == 4) for e in range(5)))
    return learning.Problem(AcausalCompiler(ev, diagram)(), data, train=["d.k", "d.g"], rtol=1e-9, atol=1e-11)


def reference_loss(z, experiments):
    """½ (residual/σ)² for each sample of all five experiments, for which those chosen stand in proportion, in
    [log k, g / |start of g|]."""
    parts, chosen = [], list(experiments)
    samples = sum(len(record(e).times) for e in range(5))
    for e in chosen:
        one = record(e)
        x = closed_form(jnp.exp(z[0]), 0.5 * z[1], STARTS[e], jnp.asarray(one.times))
        parts.append((x - one.data["d.x"]) / SIGMA)
    return 0.5 * jnp.sum(jnp.concatenate(parts) ** 2) * (5 / len(chosen)) / samples


def test_gradients_are_those_of_the_closed_form():
    objective = problem()._prepared(None, (), None, None)
    z = np.array([0.1, 0.7])
    weights = objective.weights(z, objective.evaluate(z))
    for size, step in ((None, 0), (2, 0), (2, 1), (2, 7)):
        batches = Batches(objective, size, seed=3)
        chosen = batches.chosen(step)
        loss, gradient = batches.cost_and_gradient(z, weights, chosen)
        experiments = range(5) if chosen is None else chosen.tolist()
        expected = jax.value_and_grad(reference_loss)(jnp.asarray(z), experiments)
        np.testing.assert_allclose(loss, expected[0], rtol=1e-6)
        np.testing.assert_allclose(gradient, expected[1], rtol=1e-5)


def test_batches_take_each_experiment_once():
    batches = Batches(problem()._prepared(None, (), None, None), 2, seed=0)
    for first in range(0, 20, 2):
        seen = np.concatenate([batches.chosen(first), batches.chosen(first + 1)])
        assert len(set(seen.tolist())) == 4
    assert len({tuple(batches.chosen(k)) for k in range(40)}) > 5


@pytest.mark.parametrize("size", [None, 2])
def test_steps_are_those_of_optax_on_the_closed_form(size):
    """With a schedule, and clipping."""
    optimizer = optax.chain(optax.clip_by_global_norm(50.0), optax.adam(optax.cosine_decay_schedule(0.05, 40)))
    trained = problem().train(learning.GradientSteps(optimizer, 40, batch=size, seed=5))
    batches = Batches(problem()._prepared(None, (), None, None), size, 5)
    z = jnp.array([np.log(1.2), 1.0])
    state, losses, best = optimizer.init(z), [], (np.inf, z)
    for k in range(41):
        chosen = batches.chosen(k)
        loss, gradient = jax.value_and_grad(reference_loss)(z, range(5) if chosen is None else chosen.tolist())
        losses.append(float(loss))
        if losses[-1] < best[0] or size is not None:
            best = losses[-1], z
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimizer.update(gradient, state, z)
        z = z + updates
    np.testing.assert_allclose(trained.history, losses[:40], rtol=1e-5)
    np.testing.assert_allclose(trained.z, best[1], rtol=1e-6)
    assert trained.step == (40 if size else int(np.argmin(losses)))


def how(**given):
    optimizer = optax.chain(optax.clip_by_global_norm(50.0), optax.adam(optax.cosine_decay_schedule(0.05, 40)))
    return learning.GradientSteps(**({"optimizer": optimizer, "steps": 40, "batch": 2, "every": 7} | given))


def same_bits(one, other):
    assert one.z.tobytes() == other.z.tobytes() and one.history.tobytes() == other.history.tobytes()
    assert [a.tobytes() for a in one.scores] == [a.tobytes() for a in other.scores]
    assert one.step == other.step


@pytest.mark.parametrize("horizons", [(1.0,), (0.4, 0.7, 1.0)])
def test_interrupted_training_ends_as_if_it_had_not_been(tmp_path, horizons):
    given = dict(horizons=horizons)
    whole = problem(True).train(how(**given))
    file = tmp_path / "run.ckpt"

    def interrupt(update):
        if update.step == 17:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        problem(True).train(how(checkpoint=file, callback=interrupt, **given))
    stopped = problem(True).train(how(checkpoint=file, callback=lambda update: update.step == 31, **given))
    assert len(stopped.history) == 31 and "ended by the callback after 31" in stopped.message
    same_bits(problem(True).train(how(checkpoint=file, **given)), whole)
    same_bits(problem(True).train(how(checkpoint=file, **given)), whole)  # nothing is left to do
    assert len(whole.scores[0]) and np.isfinite(whole.scores[1]).all()


def test_checkpoints_of_other_work_are_refused(tmp_path):
    file = tmp_path / "run.ckpt"
    problem().train(how(steps=3, checkpoint=file))
    with pytest.raises(ModelError, match="is of another set of data"):
        problem().train(how(checkpoint=file), learning.Data(*(record(4 - e) for e in range(5))))
    changed = problem().system.with_parameters({"d.k": 1.1})
    with pytest.raises(ModelError, match="is of another set of values"):
        learning.Problem(changed, problem().data, train=["d.k", "d.g"]).train(how(checkpoint=file))
    with pytest.raises(ModelError, match=r"is of another batch \(2 there, 3 here\)"):
        problem().train(how(checkpoint=file, batch=3))
    with pytest.raises(ModelError, match="is of another set of unknowns"):
        problem().train(how(checkpoint=file), freeze=["d.g"])
    with pytest.raises(ModelError, match="is of another optimizer"):
        problem().train(how(checkpoint=file, optimizer=optax.sgd(0.1)))
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Decay(ev, "e"))
    other = learning.Experiment([1.0, 2.0], {"e.x": [0.5, 0.4]}, sigma=SIGMA)
    with pytest.raises(ModelError, match="is of another model"):
        learning.Problem(AcausalCompiler(ev, diagram)(), other, train=["e.k"]).train(how(checkpoint=file))
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ModelError, match="do not fit"):
        problem().train(how(checkpoint=file))
    file.write_text("nothing\n")
    with pytest.raises(ModelError, match="is not a checkpoint of training"):
        problem().train(how(checkpoint=file))


def test_least_squares_after_gradient_steps_share_a_program():
    alone = problem().fit()
    count = len(PROGRAMS)
    first = problem().fit(first=how(batch=None))
    assert len(PROGRAMS) == count
    np.testing.assert_allclose(first.point, alone.point, atol=2e-3 * alone.spread.max())
    assert len(first.training.history) == 40 and first.training.history[-1] < first.training.history[0]
    again = problem().fit(start=first.training)
    np.testing.assert_allclose(again.point, first.point, rtol=1e-14)  # through natural values and back


def test_training_ends_where_held_out_experiments_get_worse():
    """Steps that are far too long: the score is best at some time."""
    trained = problem(True).train(how(optimizer=optax.sgd(3e-4), steps=400, batch=None, every=1, patience=5))
    at, scores = trained.scores
    assert "5 without a better score" in trained.message and len(trained.history) < 400
    assert trained.step == at[np.argmin(scores)] and len(trained.history) == trained.step + 5
    with pytest.raises(ModelError, match="patience needs experiments that are held out"):
        problem().train(how(patience=5))


def test_a_history_is_drawn():
    pytest.importorskip("matplotlib")
    ax = problem(True).train(how(steps=20)).plot()
    assert [line.get_label() for line in ax.lines[:2]] == ["fitted", "held out"]


def test_a_network_is_trained():
    """All weights of a module of Equinox are coordinates, and noise that is to be estimated stays as at first."""

    class Learned(Component):
        def __init__(self, ev):
            super().__init__(ev, "n")
            x = self.variable("x", start=1.0, fixed=True)
            net = eqx.nn.MLP(1, 1, 3, 1, jnp.tanh, key=jax.random.key(1))
            (rate,) = self.learned("rate", net, inputs=[x])
            self.add_equations(Eq(der(x), rate))

    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Learned(ev))
    data = learning.Experiment(record(0).times, {"n.x": record(0).data["d.x"]})
    system = AcausalCompiler(ev, diagram)()
    fit = learning.Problem(system, data).fit(first=learning.GradientSteps(optax.adam(0.03), 60))
    assert fit.training.history.min() < 0.1 * fit.training.history[0]
    assert fit.sigma["n.x"] < 3 * SIGMA
