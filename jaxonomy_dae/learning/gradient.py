"""The cost of some experiments and its gradient, by the program of least squares: the gradient is Jᵀr."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float, Int

from .evaluation import Weights
from .objective import Objective
from .program import predict_and_differentiate


@dataclasses.dataclass(frozen=True)
class Batches:
    """An objective whose cost is looked at by so many experiments at a time; None: by all that count."""

    objective: Objective
    size: int | None
    seed: int

    @property
    def counted(self) -> Int[np.ndarray, " e"]:
        """The experiments that count."""
        return np.unique(self.objective.rows[0])

    def chosen(self, step: int) -> Int[np.ndarray, " b"] | None:
        """The experiments of one step, a pure function of the seed and the step: every experiment comes once before any
        comes again, but for the few left over where the size does not divide their number. None: all."""
        counted = self.counted
        if self.size is None:
            return None
        size = min(self.size, len(counted))
        rounds = len(counted) // size
        order = np.random.default_rng([self.seed, step // rounds]).permutation(counted)
        place = step % rounds * size
        return np.sort(order[place : place + size])

    def cost_and_gradient(
        self, z: Float[np.ndarray, " f"], weights: Weights, chosen: Int[np.ndarray, " b"] | None
    ) -> tuple[float, Float[np.ndarray, " f"]] | None:
        """½ Σ (weighted residuals)² and the priors' part, for each sample of all experiments that count; None where a
        run fails. The sum over the chosen experiments stands for that over all, in proportion to their number: so the
        mean over batches is the cost of all, and priors count once."""
        o = self.objective
        full = o.full(z)
        shared, own = o.numbers(o.coordinates.natural(full))
        experiment, index, output = o.rows
        counted, place, conditions, samples = weights, experiment, o.told, weights.samples
        if chosen is not None:
            samples *= len(chosen) / len(self.counted)
            inside = np.isin(experiment, chosen)
            counted = weights.part(inside)
            experiment, index, output = experiment[inside], index[inside], output[inside]
            place = np.searchsorted(chosen, experiment)
            own = own[chosen]
            conditions = jax.tree.map(lambda a: a[chosen], conditions)
        found = predict_and_differentiate(o.setting, o.predictor, shared, own, conditions)
        outputs, by_shared, by_own = (np.asarray(part.values, np.float64) for part in found)
        at = place, index, output
        residual, row = counted.bent(outputs[at] - o.stacked.values[experiment, index, output])
        c = o.coordinates
        gradient = np.zeros(len(c))
        gradient[: c.n_shared] = by_shared[at].T @ (row * residual)
        if c.n_own:
            each = np.zeros((c.experiments, c.n_own))
            np.add.at(each, experiment, (row * residual)[:, None] * by_own[at])
            gradient[c.n_shared :] = each.ravel()
        off, by = weights.prior(z)
        pull, prior = by.T @ off, 0.5 * float(off @ off) / weights.samples
        cost = 0.5 * float(residual @ residual) / samples + prior
        slope = c.pulled(full, gradient)[o.free] / samples + pull / weights.samples
        return (cost, slope) if np.isfinite(cost) and np.isfinite(slope).all() else None
