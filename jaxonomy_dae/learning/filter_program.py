"""The compiled programs of filters: samples one after the other, from each to the next by the system's own
integration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..host.cache import compiled
from ..run.system.system import AcausalSystem
from .data import Stacked
from .filter_data import Told, told_of
from .filter_steps import corrected_by, model_of, moved_by, onwards, read, read_values, start_of
from .filtering import Structure
from .program import AbstractPredictor, Conditions, Layout, Outputs, Own, Owns, Setting, Shared, with_kinds


class Track(Outputs):
    """The results of a filter at each time: outputs predicted from all samples before, with the variances of their
    innovations (those of one output given the outputs before it), and

    - `before`, `p_before`, `after`, `p_after`: states and covariances, as predicted, and as corrected by the samples.
    - `flow`: Φ from the time before.
    - `discrete`: the discrete values.
    """

    before: Float[Array, "*n x"]
    p_before: Float[Array, "*n f f"]
    after: Float[Array, "*n x"]
    p_after: Float[Array, "*n f f"]
    flow: Float[Array, "*n f f"]
    discrete: Float[Array, "*n q"] | None


class Ahead(AbstractPredictor):
    """Predictions one step ahead, by a filter or with a constant gain."""

    structure: Structure = eqx.field(static=True)

    @property
    def has_variances(self) -> bool:
        """Innovations of a filter have them."""
        return self.structure.is_filter

    @property
    def levels(self) -> tuple[int, ...]:
        """The outputs whose noise levels are coordinates."""
        return self.structure.sigma

    def told(self, system: AcausalSystem, layout: Layout, stacked: Stacked, conditions: Conditions) -> Told:
        """The samples as well."""
        return told_of(self.structure, system, layout, stacked, conditions)

    def __call__(self, setting: Setting, shared: Shared, own: Own, told: Told) -> Track:
        structure, layout = self.structure, setting.layout
        model = model_of(setting, structure, shared, own, told)

        def step(carry, row):
            t, ends, y, seen, inputs = row
            m = model._replace(inputs=with_kinds(inputs, layout))
            x, p, phi, discrete = onwards(m, layout, structure, ends, *carry)
            if structure.is_filter:
                outputs, slopes = read(m, layout, t, x, discrete)
                row = y, outputs, slopes, seen, m.sigma
                d, corrected, (variance, predicted) = corrected_by(x, p, row, structure.is_drawn)
            else:
                corrected, variance = p, None
                predicted = read_values(m, layout, t, x, discrete)
                y = jax.lax.stop_gradient(predicted + m.sigma * y) if structure.is_drawn else y
                d = m.gain @ jnp.where(seen, y - predicted, 0.0)
            after, p_after = moved_by(m, t, x, d, corrected, discrete)
            out = Track(
                predicted, variance, before=x, p_before=p, after=after, p_after=p_after, flow=phi, discrete=discrete
            )
            return (after, p_after), out

        start = start_of(setting, structure, shared, own, told)
        rows = told.times, told.ends, told.values, told.observed, told.inputs
        return jax.lax.scan(step, start, rows)[1]


@compiled
def read_states(
    setting: Setting,
    shared: Shared,
    own: Owns,
    told: Told,
    x: Float[Array, "e n x"],
    p: Float[Array, "e n f f"],
    discrete: Float[Array, "e n q"] | None,
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
    setting: Setting, structure: Structure, steps: int, shared: Shared, own: Own, told: Told, found: Track
) -> tuple[Float[Array, "n x"], Float[Array, "n f f"], Float[Array, "n q"] | None]:
    """States, covariances and discrete values `steps` times further on, of the first n − steps times of one experiment,
    with nothing measured on the way, from what the filter found there."""
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
    return jax.vmap(one)(told.ends[ahead], inputs, found.after[: n - steps], found.p_after[: n - steps])
