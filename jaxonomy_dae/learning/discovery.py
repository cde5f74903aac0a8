"""Closed forms in a network's place, refitted through the model on the trajectories.

A learned law is a curve with an error that is correlated along it, so that a regression on the curve finds the wrong
terms where the experiments say little. Here each candidate stands in the equations and is fitted to the data
themselves, with everything else that is estimated. Candidates are compared by Schwarz's criterion (1978, Annals of
Statistics 6:461)

    BIC = Σ (r/σ)² + Σ ln σ² + k ln n

with k terms and n samples: half of it approximates the negative logarithm of the evidence. Forms within 2 of each other
are not told apart by the data (Kass & Raftery 1995, J. Am. Stat. Assoc. 90:773); of these the one of fewest terms is
chosen.

All candidates are one program: which terms count is an argument of it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
import sympy
from jaxtyping import Array, Float

from ..errors import ModelError, SimulationError, nearest, whole_number
from ..programs.cache import compiled
from ..system.system import AcausalSystem
from .blocks import Block, block_of
from .libraries import Library
from .table import Row, Table
from .term import AbstractTerm, ClosedForm

if TYPE_CHECKING:
    from .estimate import Estimate

WORTH_MENTIONING = 2.0  # differences of the criterion below are "not worth more than a bare mention" (Kass & Raftery)
SIGNIFICANT = 1e-3  # the probability below which a closed form is said not to explain what the network does


@dataclasses.dataclass(frozen=True, repr=False)
class Candidate:
    """A closed form as it was fitted: its `estimate`, and the criterion, of which less is better."""

    name: str
    block: Block
    estimate: "Estimate"
    bic: float

    @functools.cached_property
    def law(self) -> ClosedForm:
        """The closed form, with the terms that it has."""
        return self.estimate.system.neural[self.name].chosen()

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms."""
        return tuple(term.name for term in self.law.terms)

    @property
    def spread(self) -> Float[np.ndarray, " terms"]:
        """Standard deviations of the coefficients."""
        at = [self.estimate.objective.coordinates.names.index(n) for n in _labels(self.name, self._present)]
        return self.estimate.spread[at]

    @property
    def _present(self) -> list[int]:
        return np.flatnonzero(np.asarray(self.estimate.system.neural[self.name].present)).tolist()

    def coefficients(self, level: float = 0.95) -> Table:
        """The coefficients by term, with linear intervals."""
        factor = self.estimate.quantile(level)
        values = np.asarray(self.law.coefficients, float)
        rows = [
            Row(term, c, c - factor * s, c + factor * s, "", "" if s < abs(c) else "may be zero")
            for term, c, s in zip(self.terms, values.tolist(), self.spread.tolist(), strict=True)
        ]
        return Table(tuple(rows), level)

    @property
    def equations(self) -> tuple[sympy.Eq, ...]:
        """One for each output of the block: its variable, and the law in its inputs' names, as real symbols."""
        one = self.block.inputs[0]
        names = one if len(self.block.inputs) == 1 else tuple(n.rpartition(".")[2] for n in one)
        symbols = [sympy.Symbol(n, real=True) for n in names]
        written = self.law.expressions(*symbols)
        pairs = zip(self.block.outputs, written, strict=True)
        return tuple(_equation(sympy.Symbol(n, real=True), e) for n, e in pairs)

    def __repr__(self):
        rows = zip(self.law.coefficients.tolist(), self.spread.tolist(), self.terms, strict=True)
        return " + ".join(f"({c:.6g} ± {s:.2g})*{term}" for c, s, term in rows)


@dataclasses.dataclass(frozen=True, repr=False)
class Discovery:
    """Closed forms that replace a network.

    - `candidates`: all forms that could be fitted, the best first.
    - `chosen`: the form with the fewest terms among those that the data cannot distinguish from the best.
    - `lack_of_fit`: the probability that noise alone makes the chosen form fit the data as much worse than the network.
        If it is small, the library lacks a term.
    """

    name: str
    candidates: tuple[Candidate, ...]
    chosen: Candidate
    lack_of_fit: float

    @property
    def law(self) -> ClosedForm:
        """The closed law, an Equinox module: `law(u)`, `law.expressions(*symbols)`."""
        return self.chosen.law

    @property
    def estimate(self) -> "Estimate":
        """The fit of the closed form, and of everything that was estimated with it."""
        return self.chosen.estimate

    @property
    def equations(self) -> tuple[sympy.Eq, ...]:
        """The closed law, one equation for each output of the block."""
        return self.chosen.equations

    @property
    def coefficients(self) -> Table:
        """The coefficients with 95 % intervals."""
        return self.chosen.coefficients()

    @functools.cached_property
    def system(self) -> AcausalSystem:
        """The system with the closed law where the network was, and everything else as refitted with it."""
        system = self.estimate.system
        return eqx.tree_at(lambda s: s.neural, system, system.neural | {self.name: self.law})

    def __repr__(self):
        least = self.candidates[0].bic
        lines = [f"{e.lhs} = {_rounded(e.rhs)}" for e in self.equations]
        lines.append(f"of {len(self.candidates)} closed forms, by BIC:")
        for candidate in self.candidates[:5]:
            mark = "*" if candidate is self.chosen else " "
            lines.append(f" {mark} {candidate.bic - least:+8.2f}  {candidate!r}")
        if self.lack_of_fit < SIGNIFICANT:
            lines.append(
                f"the network explains the data better (probability {self.lack_of_fit:.1g} by noise alone): the "
                "library lacks a term"
            )
        return "\n".join(lines)


def _equation(left: Any, right: Any) -> Any:
    return sympy.Eq(left, right, evaluate=False)


def _rounded(expression: Any) -> Any:
    return expression.xreplace({n: n.n(6) for n in expression.atoms(sympy.Float)})


def discover(
    estimate: "Estimate", name: str, library: Any, width: int, most: int
) -> Discovery:  # fmt: skip
    """Implements `Estimate.discover`."""
    where = f"discover('{name}')"
    modules = [n for n in estimate.objective.layout.modules if n in estimate.system.neural]
    if name not in modules:
        raise ModelError(f"{where}: there is no network of this name that was trained: " + nearest(name, modules))
    if not isinstance(library, Library):
        raise ModelError(f"{where}: terms is a library, learning.powers(4) or learning.terms('v', …); got {library!r}")
    whole_number(width, f"{where}: width")
    whole_number(most, f"{where}: most")
    block = block_of(estimate.system.plan, name)
    assert block is not None
    terms = library.of(block.inputs[0], len(block.outputs), where)
    start = _Start.of(estimate, name, block, terms)
    found: dict[tuple[int, ...], Candidate] = {}
    reasons: list[str] = []

    def score(subset: tuple[int, ...]) -> float:
        try:
            fitted = _refitted(estimate, name, terms, subset, start)
        except SimulationError as error:
            reasons.append(f"{', '.join(terms[k].name for k in subset)}: {error}")
            return np.inf
        found[subset] = Candidate(name, block, fitted, criterion(fitted, len(subset)))
        return found[subset].bic

    beam_search(score, len(terms), width, most)
    if not found:
        raise SimulationError(f"{where}: no closed form can be simulated; {reasons[0]}")
    candidates = sorted(found.values(), key=lambda c: (c.bic, c.terms))
    close = [c for c in candidates if c.bic <= candidates[0].bic + WORTH_MENTIONING]
    chosen = min(close, key=lambda c: len(c.terms))  # the first, and best, of them
    return Discovery(name, tuple(candidates), chosen, _lack_of_fit(estimate, chosen.estimate, name))


def criterion(fitted: "Estimate", terms: int) -> float:
    """Schwarz's criterion; what all candidates have in common, such as other parameters, is left out."""
    weights = fitted.minimum.weights
    return 2 * fitted.minimum.cost - 2 * weights.log_rows + terms * float(np.log(weights.samples))


def _lack_of_fit(network: "Estimate", closed: "Estimate", name: str) -> float:
    """The probability of the increase of χ² where the closed form is right: with γ weights that the data determine, the
    network would take up χ²(γ) of the noise."""
    row = network.minimum.weights.row
    increase = float(np.sum((row * closed.minimum.found.residual) ** 2)) - network.chi2
    return float(scipy.stats.chi2.sf(increase, max(network.effective[name], 1.0)))


# --- one candidate ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Start:
    """The network's values where the experiments went, and the terms' there: from these, coefficients to begin with."""

    values: Float[np.ndarray, " m"]
    features: Float[np.ndarray, "m terms"]

    @classmethod
    def of(cls, estimate: "Estimate", name: str, block: Block, terms: tuple[AbstractTerm, ...]) -> "_Start":
        dtype = estimate.system.parameters.values.dtype
        u = jnp.asarray(estimate.objective.seen(estimate.point)[name], dtype)
        whole = ClosedForm(jnp.ones(len(terms), dtype), jnp.ones(len(terms), bool), terms)
        values, features = _values_and_features(estimate.system.neural[name], block, whole, u)
        values, features = np.asarray(values, float).ravel(), np.asarray(features, float).reshape(-1, len(terms))
        known = np.isfinite(values) & np.isfinite(features).all(axis=1)
        return cls(values[known], features[known])

    def coefficients(self, subset: tuple[int, ...]) -> Float[np.ndarray, " terms"]:
        """The best combination of a subset, zero elsewhere."""
        out, chosen = np.zeros(self.features.shape[1]), list(subset)
        columns = self.features[:, chosen]
        norms = np.linalg.norm(columns, axis=0)
        scale = np.where(norms > 0, norms, 1.0)
        out[chosen] = np.linalg.lstsq(columns / scale, self.values, rcond=1e-6)[0] / scale
        return out


@compiled
def _values_and_features(
    network: Any, block: Any, whole: ClosedForm, u: Float[Array, "n inputs"]
) -> tuple[Float[Array, "n outputs"], Float[Array, "n outputs terms"]]:
    times = [j for j in range(u.shape[1]) if j in block.opaque.time_positions]

    def values(one):
        return block.opaque(network, one[times[0]] if times else jnp.zeros((), u.dtype), one)

    def features(one):
        return jnp.stack([term(one) for term in whole.terms], axis=-1)

    return jax.vmap(values)(u), jax.vmap(features)(u)


def _labels(name: str, positions: Any) -> list[str]:
    """The names of the coefficients' coordinates."""
    return [f"{name}.coefficients[{k}]" for k in positions]


def _refitted(
    estimate: "Estimate", name: str, terms: tuple[AbstractTerm, ...], subset: tuple[int, ...], start: _Start
) -> "Estimate":
    """The fit with a closed form in the network's place, which begins where the estimate ended."""
    system, c = estimate.system, estimate.objective.coordinates
    dtype = system.parameters.values.dtype
    present = np.isin(np.arange(len(terms)), subset)
    law = ClosedForm(jnp.asarray(start.coefficients(subset), dtype), jnp.asarray(present), terms)
    problem = estimate.problem.with_law(name, law, estimate.objective.stacked)
    natural = c.natural(estimate.point)
    others = [k for k in range(len(c)) if c.group[k] != name]
    numbers = [k for k in others if not c.is_weight[k]]
    frozen = [c.names[k] for k in others if c.fixed[k]] + _labels(name, np.flatnonzero(~present))
    return problem.fit(
        start={c.names[k]: float(natural[k]) for k in others},
        bounds={c.names[k]: (float(c.low[k]), float(c.high[k])) for k in numbers},
        freeze=frozen,
        warn=False,
    )


def beam_search(
    score: Callable[[tuple[int, ...]], float], count: int, width: int, most: int
) -> dict[tuple[int, ...], float]:
    """The scores of all subsets that were looked at, ascending tuples of 0, …, count − 1; less is better.

    All subsets of one; then, from the `width` best subsets of k, all of k + 1 that contain one of them; until none of a
    size is better than the best of all smaller ones, or `most` are in.
    """
    found: dict[tuple[int, ...], float] = {}
    level: list[tuple[int, ...]] = [(k,) for k in range(count)]
    while level:
        best = min(found.values(), default=float("inf"))
        scores = {subset: score(subset) for subset in level}
        found |= scores
        if len(level[0]) >= most or not min(scores.values()) < best:
            break
        beam = sorted(scores, key=lambda s: (scores[s], s))[:width]
        level = sorted({tuple(sorted((*s, k))) for s in beam for k in range(count) if k not in s})
    return found
