"""What is minimised where equations have errors: one-step predictions in the place of runs."""

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .descent import Minimum, descend
from .evaluation import Evaluation, Weights
from .evidence import Evidence
from .experiment import Unknown
from .filter_program import Track, misfit_ahead, predict_ahead, track
from .filter_steps import Told
from .filtering import Structure
from .likelihood import Likelihood, Scoring
from .objective import Misfit, Objective, Predicted, Weigh
from .program import Weighted


@dataclasses.dataclass(frozen=True)
class AheadObjective(Objective):
    """Least squares of errors of predictions one step ahead, with a constant gain."""

    structure: Structure

    @functools.cached_property
    def told(self) -> Told:
        """The data for the programs, as arrays of the system's dtype."""
        s, c, dtype = self.stacked, self.conditions, self.system.parameters.values.dtype
        table = set(self.system.parameters.table.names)

        def spread(name: str, value: Any) -> float:
            given = isinstance(value, Unknown) and name not in table
            return float(value.spread or 0.0) if given else 0.0

        spreads = [[spread(name, s.starts[name][k]) for name in self.layout.known] for k in range(len(s.labels))]
        estimated = np.isin(np.arange(len(s.outputs)), self.structure.sigma)
        sigma = np.where(s.estimated & ~estimated, 1.0, s.levels)
        return Told(
            c.times, c.t0, c.known, self._windows, jnp.asarray(s.values, dtype), jnp.asarray(s.observed),
            jnp.asarray(sigma, dtype), jnp.asarray(np.array(spreads, float).reshape(c.known.shape), dtype),
            jnp.asarray(self._ends, dtype),
        )  # fmt: skip

    @property
    def _ends(self) -> Float[np.ndarray, "e n m"]:
        """The ends of the parts of the time before each row in which no input has a kink or jump; parts that a row does
        not need have no length."""
        s = self.stacked
        before = np.concatenate([s.t0[:, None], s.times[:, :-1]], axis=1)
        inside = []
        for k in range(len(before)):
            knots = np.unique(np.concatenate([[], *(times[k] for times, _ in s.inputs.values())]))
            inside.append([knots[(knots > a) & (knots < b)] for a, b in zip(before[k], s.times[k], strict=True)])
        most = max(len(row) for rows in inside for row in rows) if self.structure.is_linear else 0
        ends = np.repeat(s.times[:, :, None], most + 2, axis=2)
        ends[:, :, 0] = before
        if most:
            for k, rows in enumerate(inside):
                for n, row in enumerate(rows):
                    ends[k, n, 1 : 1 + len(row)] = row
        return ends

    @property
    def _windows(self) -> dict[str, Any]:
        """For each input, its samples around the time between each row and the one before, of shape (e, n, w)."""
        s, dtype, kinds = self.stacked, self.system.parameters.values.dtype, dict(self.stacked.kinds)
        before = np.concatenate([s.t0[:, None], s.times[:, :-1]], axis=1)
        found = {}
        for name, (times, values) in s.inputs.items():
            if kinds[name] == "cubic":  # whose slopes follow from all samples
                first, width = np.zeros(before.shape, int), times.shape[1]
            else:
                first = np.stack([np.searchsorted(*a, side="right") - 1 for a in zip(times, before, strict=True)])
                last = np.stack([np.searchsorted(*a) for a in zip(times, s.times, strict=True)])
                width = min(max(int((last - first).max()) + 1, 2), times.shape[1])
                first = np.clip(first, 0, times.shape[1] - width)
            place = first[..., None] + np.arange(width)
            rows = np.arange(len(times))[:, None, None]
            found[name] = (jnp.asarray(times[rows, place], dtype), jnp.asarray(values[rows, place], dtype))
        return found

    @property
    def misfit(self) -> Misfit:
        """As `Objective.misfit`, for predictions one step ahead."""
        return Misfit(misfit_ahead, self.structure, self.weighted(self.told))

    def track(self, z: Float[np.ndarray, " p"]) -> Track:
        """All that the filter finds, of all experiments."""
        shared, own = self.numbers(self.coordinates.natural(z))
        return track(self.setting, self.structure, shared, own, self.told)

    def _ahead(self, z: Float[np.ndarray, " p"]) -> tuple[Predicted, Predicted]:
        """Predictions and their variances with derivatives."""
        shared, own = self.numbers(self.coordinates.natural(z))
        found = predict_ahead(self.setting, self.structure, shared, own, self.told)
        first, second = ([np.asarray(pair[k], np.float64) for pair in found] for k in (0, 1))
        return Predicted(*first), Predicted(*second)

    def predicted(self, z: Float[np.ndarray, " p"], of: Bool[np.ndarray, " e"] | None = None) -> Predicted:
        """Predictions one step ahead, of all experiments, whatever is asked for."""
        return self._ahead(z)[0]

    def outputs(self, z: Float[np.ndarray, " p"]) -> Float[np.ndarray, "e n k"]:
        """Predictions one step ahead, of all experiments."""
        return np.asarray(self.track(z).predicted, np.float64)

    def residual(self, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, " m"] | None:
        """Errors of predictions alone; None where a run that counts fails."""
        found = self.outputs(self.full(z))[self.rows] - self.stacked.values[self.rows]
        return found if np.isfinite(found).all() else None


@dataclasses.dataclass(frozen=True)
class FilterObjective(AheadObjective):
    """The likelihood of an extended Kalman filter."""

    @property
    def has_variances(self) -> bool:
        """Innovations have."""
        return True

    def evaluate(self, z: Float[np.ndarray, " f"]) -> Evaluation | None:
        """Errors of predictions and their variances, with Jacobians; None where a run that counts fails."""
        full = self.full(z)
        predicted, variance = self._ahead(full)
        slope = self.coordinates.slope(full)
        s = variance.outputs[self.rows]
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            logs = (variance.jacobian(self.rows) / s[:, None] * slope)[:, self.free]
            jacobian = (predicted.jacobian(self.rows) * slope)[:, self.free]
        residual = predicted.outputs[self.rows] - self.stacked.values[self.rows]
        if not (s > 0).all() or not all(np.isfinite(a).all() for a in (residual, jacobian, s, logs)):
            return None
        return Evaluation(residual, jacobian, s, logs)

    def weighted(self, told: Any) -> Weighted:
        """As `Objective.weighted`; the model says how large innovations should be."""
        plain = super().weighted(told)
        share = jnp.asarray(np.sqrt(self.stacked.weight), plain.row.dtype)[:, None, None]
        return dataclasses.replace(plain, row=jnp.where(plain.row > 0, share, 0.0))

    def weights(self, z: Float[np.ndarray, " f"], found: Evaluation) -> Weights:
        """Weights by the variances at this point, and priors."""
        base = super().weights(z, found)
        assert found.variance is not None
        return Likelihood(
            base.share / np.sqrt(found.variance), base.precision, base.mean, base.share, base.bends, base.stiffness
        )

    @functools.cached_property
    def evidence(self) -> Evidence:
        """As `Objective.evidence`, for precisions alone: noise levels are coordinates."""
        chosen_by_data = [name for name, given in self.penalties.items() if given == "evidence" and self.near is None]
        groups = [self._group(name) for name in chosen_by_data]
        chosen = tuple(group for group in groups if group.any())
        return Evidence(np.full(len(self.rows[0]), -1), (), np.zeros(0), chosen)

    def lowest(
        self, start: Float[np.ndarray, " f"], steps: int = 200, weights: Weights | None = None
    ) -> Minimum | None:
        """As `Objective.lowest`, by scoring."""

        def held(z, found):
            here = self.weights(z, found)
            return here if weights is None else here.with_priors_of(weights)

        reweigh = self.evidence.reweigh if weights is None and not self.evidence.is_idle else None
        return descend(self._scoring(held), start, self.limits, reweigh, steps, self.watch)

    def _scoring(self, weigh: Weigh) -> Scoring:
        def finer(factor: float) -> Scoring | None:
            other = self.finer(factor)
            return None if other is None else other._scoring(weigh)

        return Scoring(self.evaluate, weigh, self.tolerance, finer, self.hidden, self.coordinates.log[self.free])

    def sigma(self, z: Float[np.ndarray, " f"], weights: Weights) -> dict[str, float]:
        """Noise levels that were estimated."""
        natural = dict(zip(self.coordinates.names, self.coordinates.natural(self.full(z)), strict=True))
        names = (self.stacked.outputs[j] for j in self.structure.sigma)
        return {name: float(natural[f"sigma of {name}"]) for name in names}

    def standardized(
        self, full: Float[np.ndarray, " p"], sigma: dict[str, float], rows: tuple[np.ndarray, ...]
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """(innovations of chosen samples in units of their standard deviations, these)."""
        predicted, variance = self._ahead(full)
        with np.errstate(invalid="ignore"):
            level = np.sqrt(variance.outputs[rows])
        return (predicted.outputs[rows] - self.stacked.values[rows]) / level, level
