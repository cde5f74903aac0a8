"""The compiled programs of filters: samples one after the other, from each to the next by the system's own
integration."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..programs.cache import compiled
from .devices import each, each_with_slopes
from .filter_steps import Told, corrected_by, model_of, moved_by, onwards, read, read_values, start_of
from .filtering import Structure
from .program import Setting, Weighted, with_kinds


class Track(NamedTuple):
    """The results of a filter at each time.

    - `predicted`, `variance`: the outputs predicted from all samples before, and the variances of their innovations
        (those of one output given the outputs before it).
    - `before`, `p_before`, `after`, `p_after`: states and covariances, as predicted, and as corrected by the samples.
    - `flow`: Φ from the time before.
    - `discrete`: the discrete values.
    """

    predicted: Float[Array, "*e n k"]
    variance: Float[Array, "*e n k"]
    before: Float[Array, "*e n x"]
    p_before: Float[Array, "*e n f f"]
    after: Float[Array, "*e n x"]
    p_after: Float[Array, "*e n f f"]
    flow: Float[Array, "*e n f f"]
    discrete: Any


def _track(setting: Setting, structure: Structure, shared: Any, own: Any, told: Told) -> Track:
    """Runs the filter over one experiment."""
    layout, model = setting.layout, model_of(setting, structure, shared, own, told)

    def step(carry, row):
        t, ends, y, seen, inputs = row
        m = model._replace(inputs=with_kinds(inputs, layout))
        x, p, phi, discrete = onwards(m, layout, structure, ends, *carry)
        if structure.is_filter:
            outputs, slopes = read(m, layout, t, x, discrete)
            row = y, outputs, slopes, seen, m.sigma
            d, corrected, (variance, predicted) = corrected_by(x, p, row, structure.is_drawn)
        else:
            corrected = p
            predicted = read_values(m, layout, t, x, discrete)
            variance = jnp.ones_like(predicted)
            y = jax.lax.stop_gradient(predicted + m.sigma * y) if structure.is_drawn else y
            d = m.gain @ jnp.where(seen, y - predicted, 0.0)
        after, p_after = moved_by(m, t, x, d, corrected, discrete)
        out = Track(predicted, variance, x, p, after, p_after, phi, discrete)
        return (after, p_after), out

    start = start_of(setting, structure, shared, own, told)
    rows = told.times, told.ends, told.values, told.observed, told.inputs
    return jax.lax.scan(step, start, rows)[1]


def misfit_ahead(setting: Setting, structure: Structure, shared: Any, own: Any, c: Weighted) -> Float[Array, " k"]:
    """For one experiment and each output, the sum of squared weighted errors of predictions, or of a filter, Σ w (r²/s
    + ln s) of innovations r and their variances s."""
    found = _track(setting, structure, shared, own, c.told)
    seen, residual = c.row > 0, found.predicted - c.values
    if not structure.is_filter:
        return jnp.sum(jnp.where(seen, c.row * residual, 0.0) ** 2, axis=0)
    s = jnp.where(seen, found.variance, 1.0)
    return jnp.sum(jnp.where(seen, c.row**2 * (residual**2 / s + jnp.log(s)), 0.0), axis=0)


@compiled
def track(setting: Setting, structure: Structure, shared: Any, own: Any, told: Told) -> Track:
    """All that a filter finds, of all experiments; NaN from where a run failed."""
    return each(lambda s, o, c: _track(setting, structure, s, o, c), setting.layout.mesh, shared, own, told)


@compiled
def predict_ahead(setting: Setting, structure: Structure, shared: Any, own: Any, told: Told) -> tuple[Any, Any, Any]:
    """(predictions, variances), each of shape (e, n, k), and their derivatives by the shared numbers, shape
    (e, n, k, s), and by each experiment's own."""

    def one(shared, own, c):
        return _track(setting, structure, shared, own, c)[:2]

    return each_with_slopes(one, setting.layout.mesh, shared, own, told)


@compiled
def read_states(
    setting: Setting, shared: Any, own: Any, told: Told, x: Any, p: Any, discrete: Any
) -> tuple[Float[Array, "e n k"], Float[Array, "e n k"]]:
    """The outputs of states at n times, and their standard deviations, of covariances P."""

    def one(shared, own, told, x, p, discrete):
        layout, model = setting.layout, model_of(setting, Structure(), shared, own, told)

        def at(t, inputs, x, p, q):
            m = model._replace(inputs=with_kinds(inputs, layout))
            found, slopes = read(m, layout, t, x, q)
            return found, jnp.sqrt(jnp.maximum(jnp.sum((slopes @ p) * slopes, axis=1), 0.0))

        return jax.vmap(at)(told.times, told.inputs, x, p, discrete)

    return jax.vmap(one, in_axes=(None, 0, 0, 0, 0, 0))(shared, own, told, x, p, discrete)


@compiled
def go_on(
    setting: Setting, structure: Structure, steps: int, shared: Any, own: Any, told: Told, x: Any, p: Any
) -> tuple[Any, Any, Any]:
    """States, covariances and discrete values `steps` times further on, of the first n − steps times of one experiment,
    with nothing measured on the way."""
    layout, model = setting.layout, model_of(setting, structure, shared, own, told)
    n = len(told.times)
    ahead = jnp.asarray(np.arange(n - steps)[:, None] + np.arange(1, steps + 1))

    def one(ends, inputs, x, p):
        def step(carry, row):
            ends, inputs = row
            m = model._replace(inputs=with_kinds(inputs, layout))
            x, p, _, discrete = onwards(m, layout, structure, ends, *carry)
            return (x, p), discrete

        (x, p), discrete = jax.lax.scan(step, (x, p), (ends, inputs))
        return x, p, None if discrete is None else discrete[-1]

    inputs = jax.tree.map(lambda a: a[ahead], told.inputs)
    return jax.vmap(one)(told.ends[ahead], inputs, x[: n - steps], p[: n - steps])
