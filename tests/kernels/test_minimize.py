"""Losses of one's own: the best iterate is kept, nothing is compiled twice, and what goes wrong is said."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import rc_circuit

from jaxonomy_dae import ModelError, compilations
from jaxonomy_dae.host import program
from jaxonomy_dae.learning import minimize


class Bowl(eqx.Module):
    """A plain Equinox module: a point to be moved to a minimum, and a label that is not an array."""

    x: jax.Array
    y: jax.Array
    label: str = "bowl"


def bowl(x=3.0, y=-2.0):
    return Bowl(jnp.asarray(x), jnp.asarray(y))


def distance(model, target):
    return (model.x - target) ** 2 + 0.5 * model.y**2


# --- fit ---------------------------------------------------------------------------------------------------------


def test_few_steps_do_not_wait_for_optimization(monkeypatch):
    """The tutorial's 25 steps take 10 ms; their program was optimized first, for 10 of 15.5 processor seconds."""
    monkeypatch.setattr(program, "quick", lambda: {"xla_llvm_disable_expensive_passes": True})
    minimize(bowl(), distance, optax.sgd(0.1), 2, args=(jnp.array(1.0),), progress=False)
    assert compilations()[-1].how == "quick"


def test_gradient_descent_follows_its_closed_form():
    result = minimize(bowl(), distance, optax.sgd(0.1), 4, args=(jnp.array(1.0),), progress=False)
    k = np.arange(5)
    # x − 1 shrinks by 1 − 2·0.1, y by 1 − 0.1 a step.
    np.testing.assert_allclose(result.history, (2.0 * 0.8**k) ** 2 + 0.5 * (2.0 * 0.9**k) ** 2, rtol=1e-12)
    assert (result.best_step, result.best_loss) == (4, result.history[4])
    assert float(result.model.x) == pytest.approx(1 + 2.0 * 0.8**4) and result.model.label == "bowl"
    assert "all 4 steps" in result.message


def test_the_best_iterate_is_kept():
    # The step 1.05 overshoots ever further in x (factor −1.1), from the first step on.
    result = minimize(bowl(y=0.0), distance, optax.sgd(1.05), 6, args=(jnp.array(1.0),), progress=False)
    np.testing.assert_allclose(result.history, 4.0 * 1.21 ** np.arange(7), rtol=1e-12)
    assert result.best_step == 0 and float(result.model.x) == 3.0
    # A learning rate that shrinks, then explodes: the best is in the middle.
    rate = optax.piecewise_constant_schedule(0.25, {3: 10.0})
    result = minimize(bowl(y=0.0), distance, optax.sgd(rate), 6, args=(jnp.array(1.0),), progress=False)
    assert result.best_step == 3
    assert float(result.model.x) == pytest.approx(1 + 2.0 * 0.5**3)
    assert result.best_loss == min(result.history) < result.history[-1]


def test_compiled_once():
    traces = []

    def loss(model, target):
        traces.append(1)
        return distance(model, target)

    minimize(bowl(), loss, optax.adam(0.1), 20, args=(jnp.array(1.0),), progress=False)
    assert len(traces) == 1


def test_zero_steps_evaluate_the_model():
    result = minimize(bowl(), distance, optax.adam(0.1), 0, args=(jnp.array(1.0),), progress=False)
    assert list(result.history) == [6.0] and eqx.tree_equal(result.model, bowl())


def test_a_filter_chooses_what_is_trained():
    only_x = eqx.tree_at(lambda m: m.x, jax.tree.map(lambda _: False, bowl()), True)
    result = minimize(bowl(), distance, optax.sgd(0.5), 1, train=only_x, args=(jnp.array(1.0),), progress=False)
    assert (float(result.model.x), float(result.model.y)) == (1.0, -2.0)


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_what_is_not_finite_stops_the_run(what):
    def loss(model):
        # log(x): steps of 1/x from 1 go 1, 0, −∞; |x|^0.5: the derivative at 0 is infinite, the value is not.
        return jnp.log(model.x) if what == "loss" else jnp.sqrt(jnp.maximum(model.x, 0.0))

    start, rate = (1.0, 0.5) if what == "loss" else (4.0, 16.0)  # one or two steps to x ≤ 0
    with pytest.warns(RuntimeWarning, match=rf"stopped after \d updates: the {what}.*best iterate.*smaller"):
        result = minimize(bowl(start), loss, optax.sgd(rate), 50, progress=False)
    assert len(result.history) < 51 and np.isfinite(result.history).all()
    assert result.best_loss == min(result.history)
    assert np.isfinite(float(loss(result.model))) and "stopped" in result.message


def test_progress_is_shown(capsys):
    minimize(bowl(), distance, optax.sgd(0.1), 3, args=(jnp.array(1.0),), progress=True)
    assert "3/3" in capsys.readouterr().err


# --- wrong use ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: minimize(rc_circuit(), lambda s: 0.0, optax.sgd(1.0), 1, progress=False), r"no networks.*train=\["),
        (
            lambda: minimize(rc_circuit(), lambda s: 0.0, optax.sgd(1.0), 1, train=["r.r"], progress=False),
            r"'r\.r' is neither a network nor a parameter: did you mean 'r\.R'",
        ),
        (
            lambda: minimize(bowl(), lambda m: jnp.stack([m.x, m.y]), optax.sgd(1.0), 1, progress=False),
            r"real scalar; got shape \(2,\) of float64",
        ),
        (lambda: minimize(bowl(), lambda m: None, optax.sgd(1.0), 1, progress=False), "real scalar; got None"),
        (
            lambda: minimize(bowl(), lambda m: jnp.array(1), optax.sgd(1.0), 1, progress=False),
            r"real scalar; got shape \(\) of int64",
        ),
        (lambda: minimize(bowl(), 3.0, optax.sgd(1.0), 1, progress=False), r"loss\(model, \*args\); got 3.0"),
        (
            lambda: minimize(bowl(), distance, optax.sgd(1.0), 1, args=jnp.ones(1), progress=False),
            r"args is a tuple .*, args=\(data,\); got ",
        ),
        (
            lambda: jax.jit(lambda x: minimize(bowl(x), lambda m: m.x, optax.sgd(1.0), 1, progress=False))(1.0),
            "outside jit, grad and vmap",
        ),
        (lambda: minimize(bowl(), lambda m: m.x, optax.sgd(1.0), -1, progress=False), r"updates ≥ 0; got -1"),
        (lambda: minimize(bowl(), lambda m: m.x, optax.sgd(1.0), True, progress=False), r"updates ≥ 0; got True"),
        (
            lambda: minimize(bowl(x=np.nan), lambda m: m.x, optax.sgd(1.0), 3, progress=False),
            r"the loss is nan at the start: check args",
        ),
        (
            lambda: minimize(Bowl(1.0, 2.0), lambda m: m.x, optax.sgd(1.0), 1, progress=False),
            r"nothing is to be trained",
        ),
        (
            lambda: minimize(
                bowl(),
                lambda m, d: m.x * d["t"][0],
                optax.sgd(1.0),
                1,
                args=({"t": jnp.array([np.nan])},),
                progress=False,
            ),
            r"arguments are not finite: args\[0\]\['t'\]",
        ),
    ],
)
def test_wrong_use(call, message):
    with pytest.raises(ModelError, match=message):
        call()
