"""Fits from several sets of weights: what depends on where a network began is not known."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..base.aliases import PyTree
from ..base.errors import ModelError, SimulationError, check_handed_on, explained_keywords, nearest, whole_number
from ..run.simulation.solution import Solution
from ..run.system.system import AcausalSystem
from .band import Band
from .estimate import Estimate
from .prediction import Prediction
from .problem import Problem

Network = TypeVar("Network", bound=PyTree)

OWN = ("members", "seed", "networks")
REJECTED = 1e-3  # the probability below which noise is no excuse for a worse fit


@dataclasses.dataclass(frozen=True, repr=False)
class Ensemble:
    """Estimates from several seeds.

    - `estimates`: all fits that succeeded, the best first.
    - `kept`: the fits that the data cannot distinguish from the best: noise alone would explain the difference of the
        log-likelihoods, except once in a thousand, for as many weights as the data determine. Others are local minima.
    """

    estimates: tuple[Estimate, ...]
    kept: tuple[Estimate, ...]

    @property
    def best(self) -> Estimate:
        """The most likely."""
        return self.estimates[0]

    def __len__(self) -> int:
        return len(self.kept)

    def __repr__(self):
        chi2 = ", ".join(f"{one.chi2:.4g}" for one in self.kept)
        left = len(self.estimates) - len(self.kept)
        return f"Ensemble(of {len(self.kept)}, χ² {chi2}" + f"; {left} more ended in worse minima" * bool(left) + ")"

    @explained_keywords()
    def band(
        self,
        name: str,
        grid: ArrayLike | Sequence[float],
        law: Callable[[PyTree, Array], ArrayLike] | None = None,
        along: str | Callable[[Solution], ArrayLike] | None = None,
        level: float = 0.95,
    ) -> Band:
        """A learned law over a grid, as `Estimate.band`: the mean of the members. Its spread combines their
        disagreement, `between`, and the spread of each member."""
        bands = [one.band(name, grid, law, along, level) for one in self.kept]
        mean, between, spread = _mixed([b.mean for b in bands], [b.spread for b in bands])
        factor = self.best.quantile(level)
        ends = np.stack([b.explored for b in bands])
        explored = np.stack([ends[..., 0].min(axis=0), ends[..., 1].max(axis=0)], axis=-1)
        return Band(
            bands[0].grid, mean, spread, mean - factor * spread, mean + factor * spread, explored, between
        )  # fmt: skip

    @explained_keywords()
    def predict(
        self,
        names: str | Sequence[str],
        ts: ArrayLike | Sequence[float] | None = None,
        experiment: int | str = 0,
        level: float = 0.95,
    ) -> Prediction:
        """Any variables, as `Estimate.predict`, with the members' disagreement in the band."""
        found = [one.predict(names, ts, experiment, level) for one in self.kept]
        factor, parts = self.best.quantile(level), ({}, {}, {}, {})
        for name in found[0].mean:
            mean, _, spread = _mixed([f.mean[name] for f in found], [f.spread[name] for f in found])
            for part, values in zip(parts, (mean, spread, mean - factor * spread, mean + factor * spread), strict=True):
                part[name] = values
        return Prediction(found[0].ts, *parts)


def ensemble(
    problem: Problem,
    members: int = 8,
    *,
    seed: int = 0,
    networks: Mapping[str, Sequence[PyTree]] | None = None,
    **options: Any,
) -> Ensemble:
    """Fits from several seeds of the networks' weights, one after the other, with the compiled program of a single fit.

    The band of one fit is linearized around one minimum. Other weights may explain the data equally well, and differ
    where there are no data. Disagreement of the members shows this (Lakshminarayanan, Pritzel & Blundell 2017, NeurIPS
    30).

    **Arguments:**

    - `problem`: a problem that trains networks or sensor laws.
    - `members`: the number of members. The first begins at the problem's own weights, the others at random arrays of
        the same sizes, drawn by `seed`.
    - `networks`: alternatively, the initial networks by name, one for each member: `{"drag": [Drag(key) for key in
        keys]}`.
    - `options`: as for `problem.fit`, but for `start`.

    **Raises:**

    - `ModelError` for names and counts; `SimulationError` if no member can be simulated, with the reason of the first.
    """
    check_handed_on("ensemble", {k: v for k, v in options.items() if k != "start"}, problem.fit, OWN, ("start",))
    modules = [name for name in problem.trained[1] if name in problem.system.neural]
    if not modules:
        raise ModelError("an ensemble needs networks that are trained: name them in the problem's train=")
    if "start" in options:
        raise ModelError(
            "start does not go with an ensemble, whose members begin elsewhere; give networks={name: [...]}"
        )
    # Not in one vmap: on two cores, the Jacobian of eight pendulums with 97 weights takes 0.74 s there, where eight by
    # themselves take 0.20 s, and the program compiles for as long as that of a single one again.
    given: dict[str, Any] = {"warn": False} | options  # members in worse minima are left out
    estimates, reason = [], None
    for system in _starts(problem, modules, members, seed, networks):
        try:
            estimates.append(problem.beginning_at(system).fit(**given))
        except SimulationError as error:
            reason = reason or error
    if not estimates:
        assert reason is not None
        raise reason
    estimates.sort(key=_deviance)
    best = estimates[0]
    allowed = float(scipy.stats.chi2.isf(REJECTED, max(sum(best.effective.values()), 1.0)))
    kept = [one for one in estimates if _deviance(one) <= _deviance(best) + allowed]
    return Ensemble(tuple(estimates), tuple(kept))


def _deviance(estimate: Estimate) -> float:
    """−2 ln (likelihood)."""
    return -2 * estimate.log_likelihood


def _starts(
    problem: Problem, modules: list[str], members: int, seed: int, networks: Mapping[str, Sequence[PyTree]] | None
) -> list[AcausalSystem]:
    system = problem.system
    if networks is None:
        whole_number(members, "members")
        rng = np.random.default_rng(seed)
        drawn = [{name: _drawn(system.neural[name], rng) for name in modules} for _ in range(members - 1)]
        return [system, *(_with(system, one) for one in drawn)]
    counts = {name: len(given) for name, given in networks.items()}
    for name in networks:
        if name not in modules:
            raise ModelError(f"networks: '{name}' is not trained here: " + nearest(name, modules))
    if len(set(counts.values())) != 1 or not min(counts.values()):
        raise ModelError(f"networks: as many of each are needed, at least one; got {counts}")
    return [_with(system, {n: given[k] for n, given in networks.items()}) for k in range(min(counts.values()))]


def _with(system: AcausalSystem, networks: Mapping[str, PyTree]) -> AcausalSystem:
    for name, network in networks.items():
        if jax.tree.structure(network) != jax.tree.structure(system.neural[name]):
            raise ModelError(f"networks: those of '{name}' must be built like the one in the system")
    return eqx.tree_at(lambda s: s.neural, system, {**system.neural, **networks})


def _drawn(network: Network, rng: np.random.Generator) -> Network:
    """A copy of the network with random weights, each array normal and of the size that it has."""
    arrays, rest = eqx.partition(network, eqx.is_inexact_array)

    def other(leaf: Array) -> Array:
        size = float(jnp.sqrt(jnp.mean(leaf**2))) if leaf.size else 0.0
        return jnp.asarray(size * rng.standard_normal(leaf.shape), leaf.dtype)

    return eqx.combine(jax.tree.map(other, arrays), rest)


def _mixed(means: Sequence[np.ndarray], spreads: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, " n"], ...]:
    """Mean, spread between, and whole spread of a mixture of normal distributions."""
    mean = np.mean(means, axis=0)
    between = np.std(means, axis=0, ddof=1) if len(means) > 1 else np.zeros_like(mean)
    return mean, between, np.sqrt(between**2 + np.mean(np.square(spreads), axis=0))
