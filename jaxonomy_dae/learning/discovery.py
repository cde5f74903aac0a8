"""Closed forms in a network's place, refitted through the model on the trajectories.

A learned law is a curve with an error that is correlated along it, so that a regression on the curve finds the wrong
terms where the experiments say little. Here each candidate stands in the equations and is fitted to the data
themselves, with everything else that is estimated. Candidates are compared by Schwarz's criterion (1978, Annals of
Statistics 6:461)

    BIC = −2 ln L + k ln n,    of white noise Σ (r/σ)² + Σ ln σ² + k ln n,

with k numbers (coefficients, and those inside terms) and n samples: half of it approximates the negative logarithm of
the evidence. Forms within 2 of each other are not told apart by the data (Kass & Raftery 1995, J. Am. Stat. Assoc.
90:773); of these the one of fewest numbers is chosen.

All candidates are one program: which terms count is an argument of it. Numbers inside terms begin where the terms fit
the network's own curve best (variable projection; Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413), over a grid of
their ranges, from the two best valleys of it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.optimize
import scipy.stats
import sympy
from jaxtyping import Array, Float

from ..base.errors import ModelError, SimulationError, nearest, whole_number
from ..host.cache import compiled
from ..run.system.system import AcausalSystem
from .blocks import Block, block_of
from .libraries import Library
from .table import Row, Table
from .term import AbstractTerm, ClosedForm, Inner, inner_of

if TYPE_CHECKING:
    from .estimate import Estimate

WORTH_MENTIONING = 2.0  # differences of the criterion below are "not worth more than a bare mention" (Kass & Raftery)
GRID = 400  # points of the ranges of numbers inside terms: 400 of one, 20 × 20 of two, 7 × 7 × 7 of three
# Points of the grid in one call: with 400 samples and ten terms, 2 MB.
TOGETHER = 50
# Numbers inside terms are fitted to the data from the bottoms of so many valleys of the network's curve.
VALLEYS = 2
# The range of a number inside, if nothing is said, around 1 and around the size of the inputs. Smaller scales lie below
# what sampling resolves, and larger ones beyond what was explored.
NARROW, WIDE = 1e-3, 10.0
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
    def count(self) -> int:
        """How many numbers it has: coefficients, and those inside terms."""
        return len(self.law.coefficients) + len(self.law.inner)

    @property
    def spread(self) -> Float[np.ndarray, " terms"]:
        """Standard deviations of the coefficients."""
        return self._spread(_labels(self.name, self._present))

    def _spread(self, labels: list[str]) -> Float[np.ndarray, " n"]:
        return self.estimate.spread[[self.estimate.objective.coordinates.names.index(n) for n in labels]]

    @property
    def numbers(self) -> Table:
        """The numbers inside the terms by name, with linear intervals at 95 %."""
        return self._numbers(0.95)

    def _numbers(self, level: float) -> Table:
        factor, law = self.estimate.quantile(level), self.law
        all_of, own = inner_of(self.estimate.system.neural[self.name].terms), inner_of(law.terms)
        spread = self._spread(_inside(self.name, [all_of.index(one) for one in own]))
        rows = []
        for one, x, s in zip(own, np.asarray(law.inner, float).tolist(), spread.tolist(), strict=True):
            value, low, high = (float(one.natural(end)) for end in (x, x - factor * s, x + factor * s))
            rows.append(Row(one.name, value, low, high, "", ""))
        return Table(tuple(rows), level)

    @property
    def _present(self) -> list[int]:
        return np.flatnonzero(np.asarray(self.estimate.system.neural[self.name].present)).tolist()

    def coefficients(self, level: float = 0.95) -> Table:
        """The coefficients by term, and the numbers inside terms by name, with linear intervals."""
        factor = self.estimate.quantile(level)
        values = np.asarray(self.law.coefficients, float)
        rows = [
            Row(term, c, c - factor * s, c + factor * s, "", "" if s < abs(c) else "may be zero")
            for term, c, s in zip(self.terms, values.tolist(), self.spread.tolist(), strict=True)
        ]
        return Table((*rows, *self._numbers(level)), level)

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
        written = " + ".join(f"({c:.6g} ± {s:.2g})*{term}" for c, s, term in rows)
        inside = [f"{row.name} = {row.value:.4g} in [{row.low:.4g}, {row.high:.4g}]" for row in self.numbers]
        return ", ".join([written, *inside])


@dataclasses.dataclass(frozen=True, repr=False)
class Discovery:
    """Closed forms that replace a network.

    - `candidates`: all forms that could be fitted, the best first.
    - `chosen`: the form with the fewest numbers among those that the data cannot distinguish from the best.
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
        """The coefficients, and the numbers inside terms, with 95 % intervals."""
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
        for law in start.laws(subset):
            try:
                fitted = _refitted(estimate, name, law, start)
            except SimulationError as error:
                reasons.append(f"{', '.join(terms[k].name for k in subset)}: {error}")
                continue
            one = Candidate(name, block, fitted, criterion(fitted, len(subset) + len(_numbers_of(terms, subset))))
            if subset not in found or one.bic < found[subset].bic:
                found[subset] = one
        return found[subset].bic if subset in found else np.inf

    beam_search(score, len(terms), width, most)
    if not found:
        raise SimulationError(f"{where}: no closed form can be simulated; {reasons[0]}")
    candidates = sorted(found.values(), key=lambda c: (c.bic, c.terms))
    close = [c for c in candidates if c.bic <= candidates[0].bic + WORTH_MENTIONING]
    chosen = min(close, key=lambda c: c.count)  # the first, and best, of them
    return Discovery(name, tuple(candidates), chosen, _lack_of_fit(estimate, chosen.estimate, name))


def _numbers_of(terms: tuple[AbstractTerm, ...], subset: tuple[int, ...]) -> tuple[Inner, ...]:
    return inner_of([terms[k] for k in subset])


def criterion(fitted: "Estimate", count: int) -> float:
    """Schwarz's criterion; what all candidates have in common, such as other parameters, is left out."""
    weights = fitted.minimum.weights
    scale = fitted.objective.colour.log_scale(weights.share)  # of the density of correlated noise
    return 2 * (fitted.minimum.cost - weights.log_rows + scale) + count * float(np.log(weights.samples))


def _lack_of_fit(network: "Estimate", closed: "Estimate", name: str) -> float:
    """The probability of the increase of χ² where the closed form is right: with γ weights that the data determine, the
    network would take up χ²(γ) of the noise."""
    weights = network.minimum.weights
    misfits = [np.sum(weights.bent(fit.minimum.found.residual)[0] ** 2) for fit in (closed, network)]
    increase = float(misfits[0] - misfits[1])
    return float(scipy.stats.chi2.sf(increase, max(network.effective[name], 1.0)))


# --- one candidate ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Start:
    """The network's curve where the experiments went: from it, coefficients and numbers inside terms to begin with.

    - `low`, `high`: the range of each number inside, on the scale of its search.
    """

    terms: tuple[AbstractTerm, ...]
    inputs: Float[np.ndarray, "m inputs"]
    values: Float[np.ndarray, "m outputs"]
    low: Float[np.ndarray, " inner"]
    high: Float[np.ndarray, " inner"]

    @classmethod
    def of(cls, estimate: "Estimate", name: str, block: Block, terms: tuple[AbstractTerm, ...]) -> "_Start":
        dtype = estimate.system.parameters.values.dtype
        u = np.asarray(estimate.objective.seen(estimate.point)[name], float)
        values = np.asarray(_values(estimate.system.neural[name], block, jnp.asarray(u, dtype)), float)
        known = np.isfinite(values).all(axis=1) & np.isfinite(u).all(axis=1)
        u, values = u[known], values[known]
        size = float(np.quantile(np.abs(u), 0.95)) if u.size else 1.0
        size = size if size > 0 else 1.0
        automatic = (NARROW * min(size, 1.0), WIDE * max(size, 1.0))
        ends = np.array([one.scaled(one.range or automatic) for one in inner_of(terms)], float).reshape(-1, 2)
        return cls(terms, u, values, ends[:, 0], ends[:, 1])

    def laws(self, subset: tuple[int, ...]) -> list[ClosedForm]:
        """Combinations of a subset of the terms that meet the network's curve, the best first."""
        whole, own = inner_of(self.terms), _numbers_of(self.terms, subset)
        places = np.array([whole.index(one) for one in own], int)
        middle = 0.5 * (self.low + self.high)
        if not len(places):
            return [self._law(subset, middle)]
        # Rounding may leave a root just below a whole number, as that of 400 below 20.
        each = max(int(GRID ** (1 / len(places)) + 1e-9), 2)
        axes = [np.linspace(self.low[k], self.high[k], each) for k in places]
        grid = np.tile(middle, (each ** len(places), 1))
        grid[:, places] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(places))
        left = np.array([self._fitted(subset, f)[1] for f in self._features(grid)])
        left = np.reshape(np.where(np.isfinite(left), left, np.inf), (each,) * len(places))
        lowest = (scipy.ndimage.minimum_filter(left, size=3, mode="nearest") == left) & np.isfinite(left)
        marked: Any = scipy.ndimage.label(lowest)
        valleys, flat = marked[0].ravel(), left.ravel()
        bottoms = [np.flatnonzero(valleys == k)[0] for k in range(1, valleys.max(initial=0) + 1)]  # each is flat
        found = sorted(bottoms, key=lambda k: flat[k])[:VALLEYS]
        return [self._law(subset, self._refined(subset, places, grid[k])) for k in found]

    def _refined(self, subset: tuple[int, ...], places: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """Numbers inside that meet the network's curve best, next to those of the grid."""

        def misfit(x: np.ndarray) -> np.ndarray:
            there = np.array(inner)
            there[places] = x
            (features,) = self._features(there[None])
            return self._fitted(subset, features)[2]

        bounds = self.low[places], self.high[places]
        best = scipy.optimize.least_squares(misfit, inner[places], bounds=bounds, xtol=1e-4, ftol=1e-6, max_nfev=30)
        out = np.array(inner)
        out[places] = best.x
        return out

    def _features(self, inner: Float[np.ndarray, "g inner"]) -> Float[np.ndarray, "g m terms"]:
        """All terms on the curve, outputs one after the other."""
        u, rows = jnp.asarray(self.inputs), 1 if len(inner) == 1 else TOGETHER
        ones = jnp.ones(len(self.terms), u.dtype)
        law = ClosedForm(ones, jnp.ones(len(self.terms), bool), self.terms, jnp.zeros(inner.shape[1], u.dtype))
        # Filled up to whole parts, so that all of them are calls of one program.
        padded = np.resize(inner, (-(-len(inner) // rows) * rows, inner.shape[1]))
        parts = [padded[k : k + rows] for k in range(0, len(padded), rows)]
        found = np.concatenate([np.asarray(_features(law, jnp.asarray(part, u.dtype), u), float) for part in parts])
        return found[: len(inner)].reshape(len(inner), -1, len(self.terms))

    def _fitted(
        self, subset: tuple[int, ...], features: Float[np.ndarray, "m terms"]
    ) -> tuple[Float[np.ndarray, " k"], float, Float[np.ndarray, " m"]]:
        """(the best coefficients of a subset, the sum of squares that they leave, what they leave)."""
        columns, values = features[:, list(subset)], self.values.ravel()
        known = np.atleast_1d(np.isfinite(columns).all(axis=1))
        columns = np.where(known[:, None], columns, 0.0)
        norms = np.linalg.norm(columns, axis=0)
        scale = np.where(norms > 0, norms, 1.0)
        best = np.linalg.lstsq(columns / scale, np.where(known, values, 0.0), rcond=1e-6)[0] / scale
        left = columns @ best - values
        return best, float(left @ left), left

    def _law(self, subset: tuple[int, ...], inner: Float[np.ndarray, " inner"]) -> ClosedForm:
        out = np.zeros(len(self.terms))
        (features,) = self._features(inner[None])
        out[list(subset)] = self._fitted(subset, features)[0]
        present = np.isin(np.arange(len(self.terms)), subset)
        return ClosedForm(jnp.asarray(out), jnp.asarray(present), self.terms, jnp.asarray(inner))


@compiled
def _values(network: Any, block: Any, u: Float[Array, "m inputs"]) -> Float[Array, "m outputs"]:
    times = [j for j in range(u.shape[1]) if j in block.opaque.time_positions]

    def values(one):
        return block.opaque(network, one[times[0]] if times else jnp.zeros((), u.dtype), one)

    return jax.vmap(values)(u)


@compiled
def _features(
    law: ClosedForm, inner: Float[Array, "g inner"], u: Float[Array, "m inputs"]
) -> Float[Array, "g m outputs terms"]:
    def features(inner):
        return jax.vmap(eqx.tree_at(lambda law: law.inner, law, inner).features)(u)

    return jax.vmap(features)(inner)


def _labels(name: str, positions: Any) -> list[str]:
    """The names of the coefficients' coordinates."""
    return [f"{name}.coefficients[{k}]" for k in positions]


def _inside(name: str, positions: Any) -> list[str]:
    """The names of the coordinates of numbers inside terms."""
    return [f"{name}.inner[{k}]" for k in positions]


def _refitted(estimate: "Estimate", name: str, law: ClosedForm, start: _Start) -> "Estimate":
    """The fit with a closed form in the network's place, which begins where the estimate ended."""
    c = estimate.objective.coordinates
    present = np.asarray(law.present)
    problem = estimate.problem.with_law(name, law, estimate.objective.stacked)
    natural = c.natural(estimate.point)
    others = [k for k in range(len(c)) if c.group[k] != name]
    numbers = [k for k in others if not c.is_weight[k]]
    whole, own = inner_of(law.terms), inner_of([t for t, is_in in zip(law.terms, present, strict=True) if is_in])
    absent = [k for k, one in enumerate(whole) if one not in own]
    frozen = [c.names[k] for k in others if c.fixed[k]] + _labels(name, np.flatnonzero(~present))
    inside = zip(_inside(name, range(len(whole))), start.low.tolist(), start.high.tolist(), strict=True)
    return problem.fit(
        start={c.names[k]: float(natural[k]) for k in others},
        bounds={c.names[k]: (float(c.low[k]), float(c.high[k])) for k in numbers}
        | {label: (low, high) for label, low, high in inside},
        freeze=frozen + _inside(name, absent),
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
