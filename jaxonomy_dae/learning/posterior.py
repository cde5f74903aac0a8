"""Samples of the posterior: what is known where no linearization holds."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..base.errors import ModelError, nearest, whole_number
from ..compile.diagnosis.wording import quoted
from ..host.cache import compiled
from .band import Band, law_of, law_values
from .chains import begin, blackjax, chain
from .density import coordinates_at, posed
from .prediction import Prediction, under
from .program import Conditions, Owns, Runs, Setting
from .table import Row, Table

if TYPE_CHECKING:
    from .estimate import Estimate

MIXED = 1.01  # R̂ above which chains disagree (Vehtari et al. 2021)
ENOUGH = 400  # effective draws for means and intervals (as above)


@dataclasses.dataclass(frozen=True, repr=False)
class Posterior:
    """Draws of all estimated quantities, from `Estimate.sample`.

    - `points`: all coordinates, as `estimate.objective.coordinates` names them, shape `(chains, draws, p)`.
    - `sigma`: noise levels that were estimated, by name, shape `(chains, draws)`.
    - `log_density`: ln p up to a constant, shape `(chains, draws)`.
    - `diverged`: the number of diverging trajectories of each chain. They occur in sharp corners of the density, and
        the region beyond is then missing.
    - `steps`: the number of gradients of each chain.

    `posterior["pend.L"]` are the values of a parameter, start, weight or noise level, shape `(chains, draws)`.
    """

    estimate: "Estimate"
    points: Float[np.ndarray, "c d p"]
    sigma: dict[str, Float[np.ndarray, "c d"]]
    log_density: Float[np.ndarray, "c d"]
    diverged: Int[np.ndarray, " c"]
    steps: Int[np.ndarray, " c"]

    def __len__(self) -> int:
        return self.points.shape[0] * self.points.shape[1]

    def __getitem__(self, name: str) -> Float[np.ndarray, "c d"]:
        c = self.estimate.objective.coordinates
        if name in c.names:
            k = c.names.index(name)
            return np.apply_along_axis(c.natural, -1, self.points)[..., k]
        short = name.removeprefix("sigma of ")
        if short in self.sigma:
            return self.sigma[short]
        known = [*c.names, *(f"sigma of {one}" for one in self.sigma)]
        raise ModelError(f"'{name}' was not estimated: " + nearest(name, known))

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the sampled quantities."""
        c, free = self.estimate.objective.coordinates, self.estimate.objective.free
        return (*np.array(c.names)[free].tolist(), *(f"sigma of {name}" for name in self.sigma))

    @functools.cached_property
    def _sampled(self) -> Float[np.ndarray, "c d u"]:
        logs = [np.log(values)[..., None] for values in self.sigma.values()]
        return np.concatenate([self.points[..., self.estimate.objective.free], *logs], axis=-1)

    @functools.cached_property
    def rhat(self) -> dict[str, float]:
        """R̂ by name: how much wider all chains are than each; 1 where they agree (rank-normalized and split, Vehtari,
        Gelman, Simpson, Carpenter & Bürkner 2021, Bayesian Analysis 16:667)."""
        return self._diagnosed(blackjax().diagnostics.rhat)

    @functools.cached_property
    def effective(self) -> dict[str, float]:
        """By name, how many independent draws would tell as much (of the bulk, as above)."""
        return self._diagnosed(blackjax().diagnostics.ess_bulk)

    def _diagnosed(self, measure: Callable) -> dict[str, float]:
        with jax.numpy_dtype_promotion("standard"):
            found = np.atleast_1d(np.asarray(measure(jnp.asarray(self._sampled)), float))
        return dict(zip(self.names, found.tolist(), strict=True))

    @property
    def mixed(self) -> bool:
        """True if the draws are reliable: chains agree, there are enough draws, and no trajectory diverged."""
        return not self._complaints

    @functools.cached_property
    def _complaints(self) -> list[str]:
        far = [name for name, value in self.rhat.items() if not value <= MIXED]
        few = [name for name, value in self.effective.items() if not value >= ENOUGH]
        found = []
        if far:
            found.append(f"chains disagree about {quoted(far, 4)}: more draws= or a longer warmup=")
        if few:
            found.append(f"fewer than {ENOUGH} effective draws of {quoted(few, 4)}: more draws=")
        if self.diverged.any():
            found.append(f"{self.diverged.sum()} trajectories diverged: corners of the posterior may be missing")
        return found

    def __repr__(self):
        chains, draws = self.points.shape[:2]
        head = (
            f"Posterior({chains} chains of {draws} draws: R̂ up to {max(self.rhat.values()):.3f}, at least "
            f"{min(self.effective.values()):.0f} effective draws)"
        )
        return "\n".join([head, *self._complaints])

    def table(self, level: float = 0.95) -> Table:
        """A table of parameters, starts and noise levels: medians and intervals with equal tails. It marks quantities
        on which chains disagree."""
        c, rows = self.estimate.objective.coordinates, []
        units = dict(zip(c.names, c.units, strict=True))
        weights = {name for name, w in zip(c.names, c.is_weight, strict=True) if w and name.endswith("]")}
        for name in self.names:
            if name not in weights:
                low, value, high = np.quantile(self[name], [0.5 - level / 2, 0.5, 0.5 + level / 2])
                note = "" if self.rhat[name] <= MIXED else f"chains disagree: R̂ {self.rhat[name]:.2f}"
                rows.append(Row(name, float(value), float(low), float(high), units.get(name, ""), note))
        return Table(tuple(rows), level)

    def _thinned(self, count: int) -> Float[np.ndarray, "n p"]:
        """So many points, evenly from all chains."""
        whole_number(count, "draws")
        flat = self.points.reshape(len(self), -1)
        return flat[np.unique(np.linspace(0, len(flat) - 1, count).round().astype(int))]

    def predict(
        self, names: str | Sequence[str], ts: Any = None, experiment: int | str = 0, level: float = 0.95,
        draws: int = 200,
    ) -> Prediction:  # fmt: skip
        """As `Estimate.predict`, but from runs at several draws: their mean, standard deviation and quantiles."""
        objective, k, chosen, conditions = under(self.estimate.objective, names, ts, experiment)
        points = self._thinned(draws)
        parts = [objective.numbers(objective.coordinates.natural(point)) for point in points]
        shared, own = jnp.stack([part[0] for part in parts]), jnp.stack([part[1][k] for part in parts])
        found = _runs(objective.setting, shared, own, conditions)
        outputs = np.asarray(found, np.float64)
        ends = np.quantile(outputs, [0.5 - level / 2, 0.5 + level / 2], axis=0)
        parts = outputs.mean(axis=0), outputs.std(axis=0), *ends
        return Prediction(
            np.asarray(conditions.times[0], np.float64), *(dict(zip(chosen, a.T, strict=True)) for a in parts)
        )  # fmt: skip

    def band(
        self, name: str, grid: Any, law: Callable | None = None, along: Any = None, level: float = 0.95,
        draws: int = 200,
    ) -> Band:  # fmt: skip
        """As `Estimate.band`, but from several draws."""
        module, law, called = law_of(self.estimate, name, grid, law)
        c = self.estimate.objective.coordinates
        columns = np.array([g == name for g in c.group]) & c.is_weight
        flat = jnp.asarray(self._thinned(draws)[:, columns], called.dtype)
        values = np.asarray(law_values(module, law, flat, called), float)
        low, high = np.quantile(values, [0.5 - level / 2, 0.5 + level / 2], axis=0)
        explored = self.estimate.explored(name, along)
        return Band(np.asarray(grid, float), values.mean(axis=0), values.std(axis=0), low, high, explored)


@compiled
def _runs(setting: Setting, shared: Float[Array, "d s"], own: Owns, conditions: Conditions) -> Float[Array, "d n k"]:
    """The outputs of one experiment for several values, one after the other: as a batch, each would take as many steps
    as the longest."""
    c = jax.tree.map(lambda a: a[0], conditions)
    return jax.lax.map(lambda at: Runs(None)(setting, at[0], at[1], c).values, (shared, own))


def sample(estimate: "Estimate", draws: int, chains: int, warmup: int, seed: int) -> Posterior:
    """Draws from the posterior around an estimate."""
    for what, value, least in (("draws", draws, 4), ("chains", chains, 1), ("warmup", warmup, 0)):
        whole_number(value, what, least)
    blackjax()
    program, told, names = posed(estimate)
    rng, found = np.random.default_rng(seed), []
    with jax.numpy_dtype_promotion("standard"):  # BlackJAX mixes dtypes
        for k in range(chains):
            point = begin(program, told, rng)
            # Of 32 bits, one is dropped: a larger number is no signed integer of 32 bits.
            key = jnp.asarray(np.random.SeedSequence([seed, k]).generate_state(1)[0] >> 1, jnp.int32)
            found.append(chain(program, told, warmup, draws, point, key))
    u, density, diverged, steps = (np.stack([np.asarray(one[j]) for one in found]) for j in range(4))
    z, logs, _ = coordinates_at(told, jnp.asarray(u, told.centre.dtype))
    points = np.broadcast_to(estimate.point, (*u.shape[:2], len(estimate.point))).copy()
    points[..., estimate.objective.free] = np.asarray(z, np.float64)
    sigma = {name: np.exp(np.asarray(logs[..., k], np.float64)) for k, name in enumerate(names)}
    return Posterior(estimate, points, sigma, density, diverged.sum(axis=1), steps.sum(axis=1))
