"""Residuals and their Jacobian in the coordinates that are free, from one program.

Rows are the samples that count: those observed in experiments that are fitted. Coordinates that are frozen have their
columns left out, so another set of frozen ones is the same program.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int
from scipy.special import chdtrc

from ..base.aliases import PyTree
from ..run.system.system import AcausalSystem
from .blocks import Block, block_of
from .clock import Clock
from .colour import Colour
from .coordinates import Coordinates
from .data import Stacked
from .descent import AbstractMerit, Minimum, descend
from .evaluation import Evaluation, Weights
from .evidence import Evidence
from .experiment import Unknown
from .laws.properties import is_raw
from .least_squares import SumOfSquares
from .likelihood import Likelihood, Scoring
from .noise import Tails
from .program import (
    AbstractPredictor,
    Conditions,
    Layout,
    Outputs,
    Owns,
    Runs,
    SensorLaw,
    Setting,
    Shared,
    Weighted,
    predict,
    predict_and_differentiate,
)
from .smoothness import Bends, Law, spread_out


@dataclasses.dataclass(frozen=True)
class Predicted:
    """The results of the program, in NumPy: natural outputs of e experiments, and their derivatives by natural
    values."""

    outputs: Float[np.ndarray, "e n k"]
    by_shared: Float[np.ndarray, "e n k s"]
    by_own: Float[np.ndarray, "e n k o"]

    def jacobian(self, rows: tuple[np.ndarray, ...]) -> Float[np.ndarray, "m p"]:
        """The Jacobian of chosen samples, (experiments, times, outputs), with the columns of `Coordinates`."""
        shared, own = self.by_shared[rows], self.by_own[rows]
        m, n_own, experiments = len(own), own.shape[-1], len(self.outputs)
        columns = np.zeros((m, experiments, n_own))
        columns[np.arange(m), rows[0]] = own
        return np.concatenate([shared, columns.reshape(m, experiments * n_own)], axis=1)


FINEST = 1e3  # roundings, to which an integration of some hundred steps can be told to keep
# Factor by which a positive number without bounds may leave the start of its search: a guess in another unit (nano) is
# still within reach, and what runs further is not held by the data.
AWAY = 1e9
FAR = AWAY**2  # the same of other numbers in units of their start, which may itself be next to nothing
# Sums of a million squares of residuals, divided by noise of 1e-10, are below the largest float of double precision.
LARGEST = 1e140
FEW = 8  # columns up to which residuals alone cost almost as much as with their Jacobian, and a program of their own
MANY = 40  # numbers of one experiment beyond which a gradient backwards costs less: of 97, 6 ms where forwards it is 14


# The precision with which a search for a raw network begins where the evidence chooses it, beside that of weights as
# large as those drawn. It stays as long as residuals are large. At 1, four of fourteen searches for a spring with a
# gap, and all with 32 units in one layer, ended at a χ² of 430 of 190, from where a weaker prior led on to 187. At 0.1,
# none does; at 0.01, one for a drag took 40 CPU s, by laws that steepen on the way.
LOOSE = 0.1
DOUBTED = 0.02  # the probability of χ² below which a fit goes on from another start: that at which it is not `ok`

Same = TypeVar("Same", bound="Objective")
Weigh = Callable[[np.ndarray, Evaluation], Weights]


@dataclasses.dataclass(frozen=True)
class Objective:
    """The function that a fit minimises: a system with what stands around it, data, coordinates, and which experiments
    count. `fine` is the factor by which the tolerances of the problem are tightened."""

    system: AcausalSystem
    observers: dict[str, SensorLaw]
    layout: Layout
    fine: float
    stacked: Stacked
    coordinates: Coordinates
    penalties: dict[str, float | str | None]  # "evidence" or a precision, by the name of a group
    counted: Bool[np.ndarray, " e"]
    # The centre of the priors of weights, by free coordinates, in a search over a part of the time. None stands for
    # zero, in one over all of it.
    near: Float[np.ndarray, " f"] | None = dataclasses.field(default=None, kw_only=True)
    # What is told of each step: its number, the cost, χ² for each sample, and what remains.
    watch: Callable[[int, float, float, float], None] | None = dataclasses.field(default=None, kw_only=True)
    clock: Clock | None = dataclasses.field(default=None, kw_only=True)  # what ends searches early
    # Networks with a prior of smoothness, and where they have it.
    laws: tuple[Law, ...] = dataclasses.field(default=(), kw_only=True)
    predictor: AbstractPredictor = dataclasses.field(default=Runs(), kw_only=True)
    # The correlation of neighbouring errors of each output. None stands for what the data say, and for zero where they
    # do not say it.
    correlations: Float[np.ndarray, " k"] | None = dataclasses.field(default=None, kw_only=True)

    @property
    def rho(self) -> Float[np.ndarray, " k"]:
        """The correlation of neighbouring errors of each output."""
        return np.nan_to_num(self.stacked.rho) if self.correlations is None else self.correlations

    def with_rho(self: Same, rho: Float[np.ndarray, " k"]) -> Same:
        """A copy with these correlations of neighbouring errors."""
        return dataclasses.replace(self, correlations=rho)

    @property
    def white(self: Same) -> Same:
        """A copy whose errors are independent."""
        return self.with_rho(np.zeros(len(self.rho)))

    @functools.cached_property
    def colour(self) -> Colour:
        """The filter that makes errors of the samples that count independent."""
        return Colour.of(self.stacked, self.rows, self.rho)

    @property
    def has_variances(self) -> bool:
        """True if the model itself says how large residuals are."""
        return self.predictor.has_variances

    @property
    def setting(self) -> Setting:
        """What the programs are made for."""
        fine = jnp.asarray(self.fine, self.system.parameters.values.dtype)
        return Setting(self.system, self.observers, self.layout, fine)

    def until(self, share: float, near: Float[np.ndarray, " f"]) -> "Objective":
        """A copy with a share of each experiment's time. Over a part of it, priors of weights have their centre at
        `near`, and precisions that stay: what the first samples do not need may be needed later. Towards zero, inner
        layers shrink to where tanh is linear, and a search over more time hardly gets away from there."""
        near_part = None if share >= 1 else near
        return dataclasses.replace(self, stacked=self.stacked.until(share), near=near_part)

    @functools.cached_property
    def rows(self) -> tuple[Int[np.ndarray, " m"], ...]:
        """(experiments, times, outputs) of the samples that count."""
        heavy = self.counted & (self.stacked.weight > 0)
        return np.nonzero(self.stacked.observed & heavy[:, None, None])

    @functools.cached_property
    def free(self) -> Bool[np.ndarray, " p"]:
        """The coordinates that are searched: not frozen, and not of experiments without weight or that do not count."""
        c = self.coordinates
        return ~c.fixed & self.owned(self.counted, shared=True) & ~self.has_no_weight

    @property
    def has_no_weight(self) -> Bool[np.ndarray, " p"]:
        """True for the own coordinates of experiments of weight zero, of which nothing is asked."""
        return self.owned(self.stacked.weight == 0)

    def owned(self, each: Bool[np.ndarray, " e"], shared: bool = False) -> Bool[np.ndarray, " p"]:
        """For each coordinate, what holds of the experiment that owns it, or of those that experiments share."""
        c = self.coordinates
        owner = np.repeat(np.arange(len(each)), c.n_own)
        return np.concatenate([np.full(c.n_shared, shared), each[owner]])

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(lower, upper) bounds of the free coordinates, shape (f,) each."""
        low, high = self.coordinates.z_bounds
        return low[self.free], high[self.free]

    @functools.cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """(lower, upper) ends of a search for the free coordinates, shape (f,) each: bounds, and where there is none,
        so far from the start that the data do not hold the coordinate."""
        c, (low, high) = self.coordinates, self.bounds
        reach = np.where(c.is_weight, np.inf, np.where(c.log, np.log(AWAY), FAR))[self.free]
        start = c.z_start[self.free]
        return np.where(np.isfinite(low), low, start - reach), np.where(np.isfinite(high), high, start + reach)

    def ran_away(self, full: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
        """True for coordinates whose search ended so far from its start that the data do not hold them."""
        (low, high), (least, most) = self.limits, self.bounds
        z, out = full[self.free], np.zeros(len(full), bool)
        out[self.free] = ((z <= low) & (low > least)) | ((z >= high) & (high < most))
        return out

    @functools.cached_property
    def conditions(self) -> Conditions:
        """The conditions of all experiments, for the programs, as arrays of the system's dtype."""
        s, dtype = self.stacked, self.system.parameters.values.dtype

        def number(value: float | Unknown) -> float:
            return float(value.guess if isinstance(value, Unknown) else value)

        known = [[number(s.starts[name][k]) for name in self.layout.known] for k in range(len(s.labels))]
        inputs = {n: (jnp.asarray(t, dtype), jnp.asarray(v, dtype)) for n, (t, v) in s.inputs.items()}
        return Conditions(
            jnp.asarray(s.times, dtype),
            jnp.asarray(s.t0, dtype),
            jnp.asarray(np.array(known, float).reshape(len(s.labels), len(self.layout.known)), dtype),
            inputs,
            self._lengths,
        )

    @property
    def _lengths(self) -> Int[Array, " e"] | None:
        """The place of each experiment's number of times among those that sensor laws are evaluated for."""
        lengths = self.layout.lengths
        return jnp.asarray([lengths.index(count) for count in self.stacked.counts]) if lengths else None

    @functools.cached_property
    def told(self) -> PyTree:
        """What programs are told of all experiments."""
        return self.predictor.told(self.system, self.layout, self.stacked, self.conditions)

    @property
    def has_many(self) -> bool:
        """True if the gradient of a scalar costs less backwards."""
        return self.coordinates.n_shared + self.coordinates.n_own > MANY

    @property
    def weighted(self) -> Weighted:
        """What programs are told, with samples and their weights."""
        s, dtype = self.stacked, self.system.parameters.values.dtype
        level = np.ones(s.values.shape) if self.has_variances else np.where(np.isnan(s.sigma), s.unit, s.sigma)
        row = np.zeros(s.values.shape)
        row[self.rows] = (np.sqrt(s.weight)[:, None, None] / level)[self.rows]
        return Weighted(self.told, jnp.asarray(s.values, dtype), jnp.asarray(row, dtype))

    def full(self, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, " p"]:
        """All coordinates, those that are not searched at their starts."""
        out = self.coordinates.z_start
        out[self.free] = z
        return out

    def numbers(self, natural: Float[np.ndarray, " p"]) -> tuple[Shared, Owns]:
        """(shared, own) natural values as the program takes them."""
        dtype = self.system.parameters.values.dtype
        shared, own = self.coordinates.split(natural)
        return jnp.asarray(shared, dtype), jnp.asarray(own, dtype)

    def predicted(self, z: Float[np.ndarray, " p"]) -> Predicted:
        """All outputs at a point with their derivatives, by the program."""
        return self._differentiated(z, np.ones(len(self.counted), bool))[0]

    def _differentiated(
        self, z: Float[np.ndarray, " p"], of: Bool[np.ndarray, " e"]
    ) -> tuple[Predicted, Predicted | None]:
        """(outputs, their variances if the predictor says them) at a point, with derivatives; NaN for the outputs of
        experiments that are not asked for."""
        (shared, own), told = self.numbers(self.coordinates.natural(z)), self.told
        if self.has_variances:  # the same program tells the variances of experiments that are held out
            of = np.ones(len(of), bool)
        if not of.all():
            own, told = own[of], jax.tree.map(lambda a: a[of], told)
        found = predict_and_differentiate(self.setting, self.predictor, shared, own, told)

        def whole(parts: Iterable[ArrayLike]) -> Predicted:
            arrays = [np.asarray(a, np.float64) for a in parts]
            wide = [np.full((len(of), *a.shape[1:]), fill) for a, fill in zip(arrays, (np.nan, 0.0, 0.0), strict=True)]
            for all_of, few in zip(wide, arrays, strict=True):
                all_of[of] = few
            return Predicted(*wide)

        variances = [part.variance for part in found if part.variance is not None]
        return whole(part.values for part in found), whole(variances) if variances else None

    def outputs(self, z: Float[np.ndarray, " p"]) -> Float[np.ndarray, "e n k"]:
        """The outputs of all experiments at a point, without derivatives."""
        if isinstance(self.predictor, Runs):
            return self._runs(z)[..., : len(self.layout.outputs)]
        return np.asarray(self.predictions(z).values, np.float64)

    def predictions(self, z: Float[np.ndarray, " p"]) -> Outputs:
        """All that the predictor finds of all experiments at a point."""
        shared, own = self.numbers(self.coordinates.natural(z))
        return predict(self.setting, self.predictor, shared, own, self.told)

    def evaluate(self, z: Float[np.ndarray, " f"]) -> Evaluation | None:
        """Residuals and Jacobian of the free coordinates, with their variances if the predictor says them; None where a
        run that counts fails, or leads beyond what can be squared. Where errors are correlated, residuals are their
        innovations."""
        full = self.full(z)
        found, variance = self._differentiated(full, self.counted)
        c = self.coordinates
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            parts = [
                found.outputs[self.rows] - self.stacked.values[self.rows],
                c.pulled(full, found.jacobian(self.rows))[:, self.free],
            ]
            if variance is not None:
                s = variance.outputs[self.rows]
                slope = c.pulled(full, variance.jacobian(self.rows) / s[:, None])
                parts += [np.where(s > 0, s, np.nan), slope[:, self.free]]
            elif self.rho.any():
                parts = [self.colour.whitened(part) for part in parts]
        # What is not a number is not below it, either.
        return Evaluation(*parts) if all((np.abs(a) < LARGEST).all() for a in parts) else None

    def residual(self, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, " m"] | None:
        """Residuals alone; None where a run that counts fails."""
        found = self.outputs(self.full(z))[self.rows] - self.stacked.values[self.rows]
        if self.rho.any():
            found = self.colour.whitened(found)
        return found if np.isfinite(found).all() else None

    def _runs(self, full: Float[np.ndarray, " p"]) -> Float[np.ndarray, "e n _"]:
        """The outputs of all experiments, and after them the inputs of trained networks, by one program."""
        shared, own = self.numbers(self.coordinates.natural(full))
        outputs = (*self.layout.outputs, *self._inputs)
        setting = self.setting._replace(layout=dataclasses.replace(self.layout, outputs=outputs))
        return np.asarray(predict(setting, Runs(), shared, own, self.conditions).values, np.float64)

    @functools.cached_property
    def blocks(self) -> dict[str, Block]:
        """The trained networks that stand in the equations."""
        found = {name: block_of(self.system.plan, name) for name in self.layout.modules if name in self.system.neural}
        return {name: block for name, block in found.items() if block is not None}

    @functools.cached_property
    def _inputs(self) -> tuple[str, ...]:
        names = dict.fromkeys(n for block in self.blocks.values() for row in block.inputs for n in row)
        return tuple(n for n in names if n not in self.layout.outputs)

    def seen(self, full: Float[np.ndarray, " p"]) -> dict[str, Float[np.ndarray, "m inputs"]]:
        """The inputs of each trained network at the samples' times of the experiments that count, by runs from a
        point."""
        runs, names = self._runs(full), (*self.layout.outputs, *self._inputs)
        counts = [k for k in np.flatnonzero(self.counted) if self.stacked.counts[k]]
        rows = np.concatenate([runs[k, : self.stacked.counts[k]] for k in counts])
        found = {}
        for name, block in self.blocks.items():
            found[name] = np.concatenate([rows[:, [names.index(n) for n in row]] for row in block.inputs])
        return found

    def explored(self, z: Float[np.ndarray, " f"]) -> "Objective":
        """A copy whose networks have a prior of smoothness where runs from a point lead them."""
        chosen = [name for name in self.blocks if self.penalties.get(name) == "evidence" and self._group(name).any()]
        full, laws = self.full(z), []
        seen = self.seen(full) if chosen else {}
        for name in chosen:
            points = seen[name][np.isfinite(seen[name]).all(axis=1)]
            if len(points):
                columns = np.flatnonzero([name == group for group in self.coordinates.group])
                network, block = self.system.neural[name], self.blocks[name]
                laws.append(Law(network, block.opaque, columns, spread_out(points), 0.5 * np.ptp(points, axis=0)))
        return dataclasses.replace(self, laws=tuple(laws))

    @functools.cached_property
    def bends(self) -> Bends | None:
        """The derivatives of networks whose prior is smoothness."""
        c = self.coordinates
        return Bends.of(self.laws, c, np.flatnonzero(self.free)) if self.laws else None

    def lowest(
        self, start: Float[np.ndarray, " f"], steps: int = 200, weights: Weights | None = None,
        first: Weights | None = None,
    ) -> Minimum | None:  # fmt: skip
        """The minimum next to a start, None if that cannot be evaluated; with `weights` that stay as they are, or those
        that the data choose, beginning with the priors of `first`."""

        def weigh(z: np.ndarray, found: Evaluation) -> Weights:
            if weights is not None and not self.has_variances:
                return weights
            priors, here = weights or first, self.weights(z, found, LOOSE)
            return here if priors is None else here.with_priors_of(priors)

        reweigh = self.evidence.reweigh if weights is None and not self.evidence.is_idle else None
        return descend(self._merit(weigh), start, self.limits, reweigh, steps, self.watch, self.clock)

    def _merit(self, weigh: Weigh) -> AbstractMerit:
        def finer(factor: float) -> AbstractMerit | None:
            other = self.finer(factor)
            return None if other is None else other._merit(weigh)

        given = self.evaluate, weigh, self.tolerance, finer, self.hidden
        if self.has_variances:
            return Scoring(*given, limited=self.coordinates.log[self.free])
        columns = self.coordinates.n_shared + self.coordinates.n_own  # of the program, whatever is frozen
        return SumOfSquares(*given, residual=self.residual if columns > FEW else None)

    @property
    def hidden(self) -> Bool[np.ndarray, " f"]:
        """The free coordinates that are weights."""
        return self.coordinates.is_weight[self.free]

    @property
    def tolerance(self) -> float:
        """The relative tolerance of the integration, and so of Jacobians."""
        return float(dict(self.layout.options)["rtol"]) * self.fine

    def finer(self: Same, factor: float) -> Same | None:
        """A copy whose tolerances are less by a factor, as far as the precision goes; None where it goes no further, or
        where steps are not controlled by tolerances."""
        least = FINEST * float(jnp.finfo(self.system.parameters.values.dtype).eps)
        tolerance = max(self.tolerance * factor, least)
        if tolerance > 0.5 * self.tolerance or "stepsize_controller" in dict(self.layout.options):
            return None
        return self.at_tolerance(tolerance)

    def at_tolerance(self: Same, tolerance: float) -> Same:
        """A copy with this relative tolerance, and the absolute one in proportion."""
        return dataclasses.replace(self, fine=self.fine * tolerance / self.tolerance)

    def sigma(self, z: Float[np.ndarray, " f"], weights: Weights) -> dict[str, float]:
        """Noise levels that were estimated, by name, at a minimum: by the evidence, or as coordinates."""
        natural = dict(zip(self.coordinates.names, self.coordinates.natural(self.full(z)), strict=True))
        names = (self.stacked.outputs[j] for j in self.predictor.levels)
        return self.evidence.sigma(weights) | {name: float(natural[f"sigma of {name}"]) for name in names}

    def is_improbable(self, found: Minimum) -> bool:
        """True if residuals at a minimum are larger than their known noise makes them, whatever a fit takes of it."""
        known = (self.evidence.noise < 0) & (not self.has_variances)
        chi2 = np.sum(found.weights.bent(found.found.residual)[0][known] ** 2)
        return bool(known.any() and chdtrc(np.sum(found.weights.share[known] ** 2), chi2) < DOUBTED)

    def surprise(self, found: Minimum) -> float:
        """−ln (likelihood) at a minimum, less a constant, with the priors that were given: by it, minima of the same
        data compare, whatever noise levels they found. Priors of precisions that each chose for itself are left out."""
        given = np.array(found.weights.precision)
        for group in self.evidence.groups:
            given[group] = 0.0
        weights = dataclasses.replace(found.weights, precision=given, bends=None)
        return weights.cost(found.z, found.found.residual) - weights.log_rows + self.colour.log_scale(weights.share)

    def standardized(
        self, full: Float[np.ndarray, " p"], sigma: dict[str, float], rows: tuple[np.ndarray, ...]
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """(residuals of chosen samples in units of the noise, or of correlated noise, their innovations; the units)."""
        s, variance = self.with_noise(sigma).stacked, None
        if self.has_variances:
            found, variance = self._differentiated(full, np.ones(len(self.counted), bool))
            outputs = found.outputs
        else:
            outputs = self.outputs(full)
        with np.errstate(invalid="ignore"):
            level = np.where(np.isnan(s.sigma), s.unit, s.sigma) if variance is None else np.sqrt(variance.outputs)
            errors = outputs[rows] - s.values[rows]
            if self.rho.any():
                errors = Colour.of(s, rows, self.rho).whitened(errors)
        return errors / level[rows], level[rows]

    # --- experiments that are held out ---------------------------------------------------------------------------

    def with_own_starts(self, z: Float[np.ndarray, " f"], weights: Weights) -> Float[np.ndarray, " p"]:
        """All coordinates after a fit. The unknown starts of experiments that were held out are fitted to these with
        all else fixed: that is what they alone can tell, and all that is taken from them."""
        full, held, c = self.full(z), self.stacked.holdout, self.coordinates
        if not held.any() or not c.n_own:
            return full
        fixed = np.array(c.fixed)
        fixed[: c.n_shared] = True
        c = dataclasses.replace(c, start=c.natural(full), fixed=fixed)
        known = self.with_noise(self.sigma(z, weights))
        alone = dataclasses.replace(known, coordinates=c, counted=held, penalties={}, laws=(), watch=None, clock=None)
        if not alone.free.any() or not len(alone.rows[0]):
            return full
        best = alone.lowest(full[alone.free])
        return full if best is None else alone.full(best.z)

    def held_out(self, z: Float[np.ndarray, " f"], weights: Weights) -> tuple[float, float]:
        """Of experiments that are held out, (root mean square of the residuals in units of the noise, −ln (likelihood)
        less a constant): the first tells how well they are met, the second compares points of different noise levels.
        Infinite where a run fails; NaN if none counts."""
        held = self.stacked.holdout & (self.stacked.weight > 0)
        rows = np.nonzero(self.stacked.observed & held[:, None, None])
        if not len(rows[0]):
            return np.nan, np.nan
        u, level = self.standardized(self.with_own_starts(z, weights), self.sigma(z, weights), rows)
        if not np.isfinite(u).all():
            return np.inf, np.inf
        count, surprise = self.stacked.weight[rows[0]], self.surprises(u, rows[2]) + np.log(level)
        scale = Colour.of(self.stacked, rows, self.rho).log_scale(np.sqrt(count))
        return float(np.sqrt(np.average(u**2, weights=count))), float(np.sum(count * surprise)) + scale

    def surprises(self, u: Float[np.ndarray, " m"], output: Int[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """−ln of the density of residuals in units of the noise, times √(2π)."""
        tails = Tails(*self.stacked.tails[output].T)
        return 0.5 * tails.bent(u)[0] ** 2 - tails.log_peak()

    def holdout_score(self, z: Float[np.ndarray, " f"], weights: Weights) -> float:
        """The root mean square of the residuals of experiments that are held out, in units of the noise."""
        return self.held_out(z, weights)[0]

    # --- weights -----------------------------------------------------------------------------------------------

    @functools.cached_property
    def evidence(self) -> Evidence:
        """The noise levels and precisions that the evidence determines: of precisions alone, if the predictor says how
        large residuals are."""
        s, (_, _, output) = self.stacked, self.rows
        unknown = np.isnan(s.sigma[self.rows]) & (not self.has_variances)
        chosen = tuple(dict.fromkeys(s.level_of[j] for j in np.unique(output[unknown])))
        place = np.array([chosen.index(name) if name in chosen else -1 for name in s.level_of])
        noise, unit = np.where(unknown, place[output], -1), s.unit[self.rows]
        values = s.values[self.rows] / unit
        sizes = [np.max(np.abs(values[noise == k]), initial=0.0) for k in range(len(chosen))]
        floor = np.maximum(np.array(sizes) * np.finfo(self.system.parameters.values.dtype).eps, np.finfo(float).tiny)
        chosen_by_data = [name for name, given in self.penalties.items() if given == "evidence" and self.near is None]
        groups = [self._group(name) for name in chosen_by_data]
        return Evidence(
            noise,
            chosen,
            floor,
            tuple(group for group in groups if group.any()),
            unit,
            self._laws,
        )

    @property
    def _laws(self) -> tuple[np.ndarray, ...]:
        """The weights of each law that has a prior of smoothness."""
        places = np.flatnonzero(self.free)
        return () if self.near is not None else tuple(np.isin(places, law.columns) for law in self.laws)

    def weights(self, z: Float[np.ndarray, " f"], found: Evaluation, loose: float = 1.0) -> Weights:
        """The first weights: priors, those that the evidence chooses as precise as weights are large, of raw networks
        `loose` times as precise; and noise levels that are known, as large as residuals, or by the variances."""
        s, c, experiment = self.stacked, self.coordinates, self.rows[0]
        sigma = s.sigma[self.rows]
        row = np.sqrt(s.weight[experiment]) / np.where(np.isnan(sigma), 1.0, sigma)
        spread = c.spread[self.free]
        precision = np.where(np.isfinite(spread), 1 / np.where(np.isfinite(spread), spread, 1.0) ** 2, 0.0)
        mean = np.where(precision > 0, c.centre[self.free], 0.0)
        for name, given in self.penalties.items():
            group = self._group(name)
            if group.any() and given is not None:
                # The sizes of the weights that the problem came with; if all are zero, of order one.
                size = float(np.sum(c.centre[self.free][group] ** 2))
                first = group.sum() / size if size > 0 else 1.0
                # Of other modules, the size of the law is the user's: with a tenth of the precision, a factor of an
                # outflow near one led to runs that ended beyond the data.
                first *= loose if is_raw(self.system.neural.get(name)) else 1.0
                precision[group] = first if given == "evidence" else float(given)
                if given == "evidence" and self.near is not None:
                    mean[group] = self.near[group]
        first = Weights(row, precision, mean, np.sqrt(s.weight[experiment]), tails=self.tails)
        if self.bends is not None and self.near is None:
            first = dataclasses.replace(first, bends=self.bends, stiffness=self.bends.first(z))
        if found.variance is None:
            return self.evidence.first(first, found)
        plain = Likelihood(first.share / np.sqrt(found.variance), first.precision, first.mean, first.share)
        return plain.with_priors_of(first)

    @functools.cached_property
    def tails(self) -> Tails | None:
        """The distributions of the samples that count; None: all are normal."""
        freedom, knee = self.stacked.tails[self.rows[2]].T
        return Tails(freedom, knee) if np.isfinite([freedom, knee]).any() else None

    def _group(self, name: str) -> Bool[np.ndarray, " f"]:
        chosen = np.array([name == group for group in self.coordinates.group], bool)
        return chosen[self.free]

    def first_rows(self: Same, count: int) -> Same:
        """A copy in which only the first rows of each record count."""
        s = self.stacked
        early = np.arange(s.observed.shape[1]) < count
        return dataclasses.replace(self, stacked=dataclasses.replace(s, observed=s.observed & early[:, None]))

    def with_noise(self: Same, sigma: dict[str, float]) -> Same:
        """A copy with these noise levels in place of those to be estimated."""
        s = self.stacked
        row = np.array([sigma.get(name, math.nan) for name in s.level_of])
        known = np.where(np.isnan(s.sigma), row * s.unit, s.sigma)
        return dataclasses.replace(self, stacked=dataclasses.replace(s, sigma=known))
