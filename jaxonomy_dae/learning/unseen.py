"""A fit under new data: what it predicts, and how well."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..base.errors import ModelError, SimulationError, whole_number
from .data import Data, Stacked
from .experiment import Experiment
from .factors import Factors
from .objective import Objective
from .runs import why_not

if TYPE_CHECKING:
    from .estimate import Estimate


@dataclasses.dataclass(frozen=True)
class Score:
    """The score of a prediction of new data.

    - `rms`: root mean square errors by name, in the variables' units.
    - `relative`: the root mean square of all errors in units of the noise: about one for a right model.
    - `log_likelihood`: ln L of these data.
    """

    rms: dict[str, float]
    relative: float
    log_likelihood: float

    def __repr__(self):
        errors = ", ".join(f"{name}: {value:.4g}" for name, value in self.rms.items())
        return f"Score({self.relative:.3g} σ; {errors})"


@dataclasses.dataclass(frozen=True)
class Unseen:
    """A new experiment under what was found: its objective, all its coordinates, and A of their covariance A Aᵀ."""

    objective: Objective
    point: Float[np.ndarray, " p"]
    root: Float[np.ndarray, "p r"]

    @classmethod
    def of(cls, estimate: "Estimate", experiment: object, first: int | None) -> "Unseen":
        """An experiment with everything shared as it was found. Its own unknown starts are fitted to its `first`
        rows, or to all of them.

        **Raises:**

        - `ModelError` for data that do not fit the model; `SimulationError` where no run can be made.
        """
        if not isinstance(experiment, Experiment):
            raise ModelError(f"new data are an Experiment; got a {type(experiment).__name__}")
        first = None if first is None else whole_number(first, "first, the number of rows,")
        problem, fitted = estimate.problem, estimate.objective
        stacked = with_noise_of(fitted, problem.stacked(Data(experiment.changed(holdout=False, weight=1.0))))
        c = problem.coordinates_of(fitted.setting._replace(layout=problem.layout_of(stacked)), stacked)
        known = estimate.values
        shared = [k for k in range(c.n_shared) if c.names[k] in known]
        new = [c.names[k] for k in range(c.n_shared) if c.names[k] not in known]
        if new:
            raise ModelError(f"'{new[0]}' was not estimated: give the new experiment a number for it in initial=")
        start, fixed = np.array(c.start), np.array(c.fixed)
        start[shared], fixed[shared] = [known[c.names[k]] for k in shared], True
        c = dataclasses.replace(c, start=start, fixed=fixed)
        whole = problem.objective_of(stacked, c, penalties={}).with_noise(estimate.sigma)
        whole = whole.at_tolerance(fitted.tolerance)
        own = whole if first is None else whole.first_rows(first)
        point, places = whole.coordinates.z_start, [estimate.position(c.names[k]) for k in shared]
        root = np.zeros((len(point), estimate.root.shape[1]))
        moves = fitted.coordinates.moved(estimate.point, estimate.root)[places]
        root[shared] = moves / c.slope(point)[shared][:, None]
        if not own.free.any():
            return cls(whole, point, root)
        check_noise(own)
        found = own.lowest(point[own.free])
        if found is None:
            raise SimulationError(why_not(own))
        point = own.full(found.z)
        # The starts follow from what is shared by the same least squares, and have an uncertainty of their own.
        free = own.free
        moving = dataclasses.replace(c, start=c.natural(point), fixed=np.zeros(len(c), bool))
        found_all = dataclasses.replace(own, coordinates=moving).evaluate(point)
        assert found_all is not None
        rows = found.weights.row[:, None] * found_all.jacobian
        prior = found.weights.prior(found.z).jacobian
        by_own = np.concatenate([rows[:, free], prior])
        by_shared = np.concatenate([rows[:, shared], np.zeros((len(prior), len(shared)))])
        factors = Factors.of(np.zeros(len(by_own)), by_own, found.noise)
        alone = factors.root(factors.rank(found.noise))
        root = np.concatenate([root, np.zeros((len(point), alone.shape[1]))], axis=1)
        count = estimate.root.shape[1]
        root[free, :count] = -alone @ (alone.T @ (by_own.T @ (by_shared @ root[shared, :count])))
        root[free, count:] = alone
        return cls(whole, point, root)

    def score(self) -> Score:
        """How well the samples are met.

        **Raises:**

        - `ModelError` where neither the experiment nor the fit says how large the noise is.
        """
        o = self.objective
        check_noise(o)
        s, rows = o.stacked, o.rows
        u, level = o.standardized(self.point, {}, rows)
        errors = o.outputs(self.point)[rows] - s.values[rows]
        rms = {
            name: float(np.sqrt(np.mean(errors[rows[2] == j] ** 2)))
            for j, name in enumerate(s.outputs)
            if (rows[2] == j).any()
        }
        likelihood = -float(np.sum(o.surprises(u, rows[2]) + np.log(level) + 0.5 * np.log(2 * np.pi)))
        likelihood -= o.colour.log_scale(np.ones(len(u)))
        return Score(rms, float(np.sqrt(np.mean(u**2))), likelihood)


def with_noise_of(fit: Objective, new: Stacked) -> Stacked:
    """New data, in which outputs whose experiment says nothing of their noise have that of the fit: its level, its
    distribution and correlation, or the name of the level that was estimated. Levels that the fit has for each sample
    go with its samples, and stay NaN."""
    fitted = fit.stacked
    sigma, level_of, tails, rho = np.array(new.sigma), list(new.level_of), np.array(new.tails), np.array(new.rho)
    for j, name in enumerate(new.outputs):
        if name not in fitted.outputs:
            continue
        k = fitted.outputs.index(name)
        is_bare = new.level_of[j] == name and np.isinf(new.tails[j]).all() and np.all(new.unit[..., j] == 1)
        is_silent = is_bare and np.isnan(new.sigma[..., j]).all()
        rho[j] = fit.rho[k] if np.isnan(rho[j]) or (is_silent and rho[j] == 0) else rho[j]
        if not is_silent:
            continue
        seen = fitted.observed[..., k]
        levels, units = np.unique(fitted.sigma[..., k][seen]), np.unique(fitted.unit[..., k][seen])
        if len(levels) == 1 and units.tolist() == [1.0]:
            sigma[..., j], level_of[j], tails[j] = levels[0], fitted.level_of[k], fitted.tails[k]
        else:
            level_of[j] = ""
    return dataclasses.replace(new, sigma=sigma, level_of=tuple(level_of), tails=tails, rho=np.nan_to_num(rho))


def check_noise(objective: Objective) -> None:
    """Refuses samples of which nothing says how large their noise is."""
    s = objective.stacked
    for j in np.unique(objective.rows[2]) if not objective.has_variances else ():
        if np.isnan(s.sigma[..., j]).any():
            why = "has another level for each sample or record" if s.level_of[j] == "" else "was not estimated"
            raise ModelError(
                f"the noise of '{s.outputs[j]}' {why} in the fit: say how large it is here, "
                f"Experiment(…, sigma={{'{s.outputs[j]}': …}})"
            )
