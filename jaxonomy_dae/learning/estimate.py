"""What a fit returns: values, how well they are known, and what follows from them."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.stats
from jaxtyping import Float

from ..base.errors import ModelError, explained_keywords, nearest
from ..base.optional import Axes
from ..run.system.system import AcausalSystem
from .agreement import Whiteness, correlated, log_likelihood, rms_by_name, whiteness
from .at_bounds import AtBound, at_bounds
from .axes import AxesGiven
from .band import Band, band, explored
from .density import LogDensity, log_density
from .descent import Minimum
from .discovery import Discovery, discover
from .experiment import Experiment
from .factors import Factors
from .figures import plot_correlations, plot_history, plot_residuals, plot_runs
from .identifiability import Identifiability, identifiability, natural_scale, spreads
from .intervals import checked_level, intervals, noise_intervals, profile
from .law_process import LawProcess
from .objective import Objective
from .prediction import Prediction, at_samples, prediction
from .program import with_values
from .properties import Properties, properties
from .smoothing import followed
from .table import Table
from .training import Training
from .unseen import Score, Unseen
from .verdict import asks_for_starts, reasons

if TYPE_CHECKING:
    from .problem import Problem


@dataclasses.dataclass(frozen=True, repr=False)
class Estimate:
    """The result of `Problem.fit`.

    - `system`: the system with the values found; `observers`: the fitted sensor laws.
    - `minimum`: the end of the descent: its `history`, `converged` and `message`, and the residuals and the Jacobian,
        weighted with `minimum.weights`.
    - `point`: the values of all coordinates at the estimate; `objective.coordinates` has their names.
    - `training`: the training before least squares, with `first=`.
    - `tried`: the number of starting points of the search.
    """

    problem: "Problem"
    objective: Objective
    minimum: Minimum
    point: Float[np.ndarray, " p"]
    system: AcausalSystem
    observers: dict[str, Any]
    training: Training | None = None
    tried: int = 1

    @classmethod
    def of(
        cls, problem: "Problem", objective: Objective, minimum: Minimum, training: Training | None = None
    ) -> "Estimate":
        """The estimate at a minimum."""
        point = objective.with_own_starts(minimum.z, minimum.weights)
        shared, _ = objective.numbers(objective.coordinates.natural(point))
        system, observers, _ = with_values(objective.setting, shared)
        return cls(problem, objective, minimum, point, system, observers, training)

    def __repr__(self):
        score = f", held out {self.holdout_score:.3g} σ" if self.objective.stacked.holdout.any() else ""
        return f"Estimate({self.message}: χ² {self.chi2:.4g} of {max(self.freedom, 0.0):.1f} degrees of freedom{score})"

    @functools.cached_property
    def reasons(self) -> tuple[str, ...]:
        """What is against this fit, each with what to try next; empty if it can be relied on. The first time that
        residuals of a problem are no noise, a program is compiled that looks for what its equations lack."""
        return reasons(self)

    @property
    def asks_for_starts(self) -> bool:
        """True if other starting points might lead to a better fit: the search did not end at a minimum that explains
        the data."""
        return asks_for_starts(self)

    @property
    def ok(self) -> bool:
        """True if the search converged, χ² agrees with the noise levels, residuals look like white noise, and all
        unknowns are determined by the data, none of which push one against its bound. `reasons` lists what is
        wrong."""
        return not self.reasons

    # --- values ------------------------------------------------------------------------------------------------

    @property
    def message(self) -> str:
        """Why the descent ended."""
        return self.minimum.message

    @property
    def values(self) -> dict[str, float]:
        """Parameters, starts and weights by name."""
        c = self.objective.coordinates
        return dict(zip(c.names, c.natural(self.point).tolist(), strict=True))

    @property
    def starts(self) -> dict[str, Any]:
        """The estimated starts: a number if shared, else shape `(experiments,)`."""
        layout, (shared, own) = self.objective.layout, self.objective.coordinates.split(
            self.objective.coordinates.natural(self.point)
        )  # fmt: skip
        first = len(shared) - len(layout.shared)
        found: dict[str, Any] = {name: float(shared[first + k]) for k, name in enumerate(layout.shared)}
        return found | {name: own[:, k] for k, name in enumerate(layout.own)}

    @property
    def sigma(self) -> dict[str, float]:
        """Noise levels that were estimated, by name."""
        return self.objective.sigma(self.minimum.z, self.minimum.weights)

    @property
    def rho(self) -> dict[str, float]:
        """Correlations of errors one sampling step apart that were estimated, by name."""
        s = self.objective.stacked
        return {name: float(self.objective.rho[j]) for j, name in enumerate(s.outputs) if np.isnan(s.rho[j])}

    # --- uncertainty -------------------------------------------------------------------------------------------

    @functools.cached_property
    def _linear(self) -> tuple[Factors, np.ndarray]:
        """Factors of the columns that can move, and which of all coordinates these are: not frozen, not on a bound."""
        z, (low, high) = self.minimum.z, self.objective.bounds
        residual, jacobian = self.minimum.weights.expected(z, self.minimum.found)
        moves = ~((z <= low) | (z >= high))
        factors = Factors.of(residual, jacobian[:, moves], self.minimum.noise)
        return factors, np.flatnonzero(self.objective.free)[moves]

    @functools.cached_property
    def at_bounds(self) -> dict[int, AtBound]:
        """By their places among all coordinates, those that ended at a bound, and how strongly the data push them
        against it."""
        _, moving = self._linear
        free = np.flatnonzero(self.objective.free)
        rows = self.minimum.weights.expected(self.minimum.z, self.minimum.found)
        found = at_bounds(rows, np.isin(free, moving), self.minimum.noise)
        return {int(free[k]): one for k, one in found.items()}

    @functools.cached_property
    def root(self) -> Float[np.ndarray, "p r"]:
        """A, with the covariance A Aᵀ of all coordinates, as far as the data and priors determine them."""
        factors, chosen = self._linear
        small = factors.root(factors.rank(self.minimum.noise))
        out = np.zeros((len(self.point), small.shape[1]))
        out[chosen] = small
        return out

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        """The covariance of all coordinates, on their scale (`objective.coordinates.log` says which are logarithms),
        shape (p, p)."""
        return self.root @ self.root.T

    @property
    def correlation(self) -> Float[np.ndarray, "p p"]:
        """The correlations of all coordinates, shape (p, p); zero for those that cannot move."""
        spread = np.linalg.norm(self.root, axis=1)
        scale = np.where(spread > 0, spread, 1.0)
        return self.covariance / np.outer(scale, scale)

    @functools.cached_property
    def spread(self) -> Float[np.ndarray, " p"]:
        """Standard deviations on the coordinates' scale: 0 for what cannot move, infinite where not determined."""
        factors, chosen = self._linear
        out = np.zeros(len(self.point))
        out[chosen] = spreads(factors, self.minimum.noise)
        return out

    @property
    def jacobian(self) -> Float[np.ndarray, "m f"]:
        """The derivatives of the residuals, in units of the noise, by the coordinates that were searched."""
        return self.minimum.weights.scale[:, None] * self.minimum.found.jacobian

    @property
    def residuals(self) -> dict[str, dict[str, np.ndarray]]:
        """Predictions less data of the experiments that were fitted, by experiment and name, in units of the noise: a
        number for each row of the record, NaN where nothing was measured. Where noise is correlated, `rho`, they are
        what the sample before leaves open, so that they are independent."""
        return self._by_record(self.minimum.weights.scale * self.minimum.found.residual)

    def _by_record(self, values: Float[np.ndarray, " m"]) -> dict[str, dict[str, np.ndarray]]:
        """Numbers of all samples that were fitted, by experiment and name."""
        s = self.objective.stacked
        scaled = np.full(s.values.shape, np.nan)
        scaled[self.objective.rows] = values
        found: dict[str, dict[str, np.ndarray]] = {}
        for k, label in enumerate(s.labels):
            for j, name in enumerate(s.outputs):
                own = scaled[k, : s.counts[k], j]
                if np.isfinite(own).any():
                    found.setdefault(label, {})[name] = own
        return found

    @functools.cached_property
    def freedom(self) -> float:
        """Degrees of freedom: samples, each as often as its experiment's weight says, less the effective number of
        coordinates (the sum of leverages)."""
        return self.minimum.weights.samples - float(np.sum(self.taken))

    @functools.cached_property
    def taken(self) -> Float[np.ndarray, " m"]:
        """Of the noise of each sample that was fitted, what the estimates took: leverages."""
        root = self.root[self.objective.free]
        return np.sum((self.minimum.weights.informing[:, None] * self.minimum.found.jacobian @ root) ** 2, axis=1)

    @property
    def chi2(self) -> float:
        """The sum of squared residuals in units of the noise; about `freedom` if model and noise levels are right."""
        weights = self.minimum.weights
        return float(np.sum((weights.share * weights.scores(self.minimum.found.residual)) ** 2))

    @property
    def effective(self) -> dict[str, float]:
        """The number of weights of each network that the data determine."""
        c, free, out = self.objective.coordinates, self.objective.free, {}
        # By the data's share, not by what priors leave: stiff priors and what nothing determines round away from one.
        data = self.minimum.weights.informing[:, None] * self.minimum.found.jacobian
        root = self.root[free]
        along = data @ root
        for name in dict.fromkeys(g for g, w in zip(c.group, c.is_weight, strict=True) if w):
            chosen = np.array([g == name for g in c.group])[free]  # what is frozen is not determined
            out[name] = float(np.sum(along * (data[:, chosen] @ root[chosen])))
        return out

    @property
    def whiteness(self) -> dict[str, dict[str, Whiteness]]:
        """Tests whether residuals look like noise, by experiment and name. If they do not, intervals are too narrow."""
        scores = self._by_record(self.minimum.weights.scores(self.minimum.found.residual))
        return {label: {n: whiteness(r) for n, r in by.items()} for label, by in scores.items()}

    @functools.cached_property
    def correlated_spread(self) -> Float[np.ndarray, " p"]:
        """Standard deviations like `spread`, which hold if residuals are correlated in time."""
        o, m = self.objective, self.minimum
        if o.has_variances:
            return self.spread
        v, slope = m.weights.bent(m.found.residual)
        scores = v[:, None] * slope[:, None] * m.found.jacobian
        middle = correlated(scores, o.rows[0], o.rows[1])
        prior = m.weights.prior(m.z).jacobian
        small = self.root[o.free]
        inner = small.T @ (middle + prior.T @ prior) @ small
        out = np.array(self.spread)
        wide = np.sqrt(np.maximum(np.einsum("pr,rs,ps->p", self.root, inner, self.root), 0.0))
        known = np.isfinite(out) & (out > 0)
        out[known] = wide[known]
        return out

    def quantile(self, level: float) -> float:
        """Half of the width of an interval in standard deviations: a quantile of the normal distribution, or if the
        noise was estimated, of Student's distribution."""
        upper = 0.5 * (1 + checked_level(level))
        if self.objective.evidence.labels:
            return float(scipy.stats.t.ppf(upper, max(self.freedom, 1.0)))
        return float(scipy.stats.norm.ppf(upper))

    @explained_keywords()
    def table(self, level: float = 0.95, *, white: bool = True) -> Table:
        """Parameters and starts with linearized intervals on the coordinates' scale, so that intervals of positive
        parameters are positive. Notes mark values that reached a bound, are not determined, or were frozen. The
        interval of a value that reached a bound is the part inside the bound. Estimated noise levels have χ² intervals.
        With `white=False` the intervals hold if residuals are correlated in time."""
        factor = self.quantile(level)
        noise = noise_intervals(self.objective, self.minimum, self.taken, level)
        spread = self.spread if white else self.correlated_spread
        return intervals(self.objective, self.point, spread, self._unknown, factor, level, noise, self.at_bounds)

    @functools.cached_property
    def _unknown(self) -> Float[np.ndarray, " p"]:
        """The spread at which each coordinate counts as not determined: a factor of e, or half of what a number without
        a scale of its own would have to change by to matter, of which an interval then contains all."""
        c, m, free = self.objective.coordinates, self.minimum, self.objective.free
        out = np.full(len(c), np.inf)
        out[free] = natural_scale(self.objective, m.z, m.found)
        return np.where(c.log | np.isfinite(c.spread), out, out / 2)

    def identifiability(self) -> Identifiability:
        """The directions that the data determine, at the values found."""
        m = self.minimum
        return identifiability(self.objective, m.weights, m.found, m.z, self.minimum.noise)

    @explained_keywords()
    def profile(self, names: Sequence[str] | str, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Intervals by profile likelihood: inside them the cost, with everything else refitted, exceeds the minimum by
        less than half a quantile of χ². They need no linearization. An infinite end is not determined.

        Noise levels and precisions stay as found.
        """
        chosen = [names] if isinstance(names, str) else list(names)
        return {name: self._profile(self._position(name), level) for name in chosen}

    def _profile(self, position: int, level: float) -> tuple[float, float]:
        spread = float(self.spread[position])
        return profile(self.objective, self.minimum, self.point, spread, position, level, self.problem.reach)

    def position(self, name: str) -> int:
        """The place of a coordinate among all."""
        return self.objective.coordinates.names.index(name)

    def _position(self, name: str) -> int:
        c = self.objective.coordinates
        found = [k for k in np.flatnonzero(self.objective.free) if c.names[k] == name]
        if not found:
            raise ModelError(f"'{name}' was not estimated: " + nearest(name, np.array(c.names)[self.objective.free]))
        return int(found[0])

    # --- what follows ------------------------------------------------------------------------------------------

    @explained_keywords()
    def band(
        self,
        name: str,
        grid: Any,
        law: Callable[[Any, Any], Any] | None = None,
        along: str | Callable[[Any], Any] | None = None,
        level: float = 0.95,
    ) -> Band:
        """A learned law over a grid, with its spread and the explored region.

        Of a raw `equinox.nn.MLP` whose prior the evidence chooses, two models of the law are weighted by their
        evidence: the network's weights, linearized, and a Gaussian process, which allows for kinks that no weight sets.
        The first call for a law compiles a program. Of other networks, the spread is that of the weights.

        **Arguments:**

        - `name`: the name of a trained network or sensor law.
        - `grid`: shape `(n,)`, or `(n, inputs)`.
        - `law`: `law(network, u)` at one grid point, a number; default: the network's first output.
        - `along`: the quantity whose explored range is shown: a variable's name, or a function of a solution; default:
            the network's inputs.
        """
        return band(self, name, grid, law, along, self.quantile(level))

    @explained_keywords()
    def predict(
        self, names: str | Sequence[str], ts: Any = None, experiment: int | str | Experiment = 0, level: float = 0.95,
        *, first: int | None = None,
    ) -> Prediction:  # fmt: skip
        """Any variables under the conditions of an experiment, measured or not, with bands.

        **Arguments:**

        - `ts`: increasing times from its start on; default: its own.
        - `experiment`: the index or name of one of the problem's experiments, or a new experiment. Unknown starts of a
            new experiment are fitted to its samples, and everything else is kept.
        - `first`: the number of rows of a new experiment to which its unknown starts are fitted; default: all.
        """
        objective, point, root, experiment = self._under(experiment, first)
        return prediction(objective, point, root, names, ts, experiment, self.quantile(level))

    @explained_keywords()
    def score(self, experiment: Experiment, *, first: int | None = None) -> Score:
        """Scores the prediction of a new experiment. Its unknown starts are fitted to its `first` rows (default: all),
        which count, too. Where it has no `sigma`, that of the fit counts.

        ```python
        print(fit.score(learning.Experiment(ts, {"pend.x": x}, initial={"pend.theta": 0.3})))
        ```
        """
        return Unseen.of(self, experiment, first).score()

    def _under(self, experiment: Any, first: int | None) -> tuple[Objective, np.ndarray, np.ndarray, int | str]:
        """(objective, all coordinates, A of their covariance A Aᵀ, place or name) of an experiment."""
        if not isinstance(experiment, Experiment):
            if first is not None:
                raise ModelError("first= goes with a new experiment: the problem's own were fitted")
            return self.objective, self.point, self.root, experiment
        new = Unseen.of(self, experiment, first)
        return new.objective, new.point, new.root, 0

    def law_process(self, name: str) -> LawProcess | None:
        """A learned law as a Gaussian process, with the probability that it is the better model of it; None of networks
        that promise more than to be functions."""
        if name not in self._processes:
            self._processes[name] = LawProcess.of(self, name)
        return self._processes[name]

    @functools.cached_property
    def _processes(self) -> dict[str, LawProcess | None]:
        return {}

    def explored(self, name: str, along: str | Callable[[Any], Any] | None = None) -> Float[np.ndarray, "inputs 2"]:
        """The range of values that the experiments contain, of each input of a learned law, or of the quantity
        `along`."""
        return explored(self, name, along)

    def log_density(self) -> LogDensity:
        """ln of the posterior density, whose maximum is the fit, as a function of JAX, for samplers such as BlackJAX's.
        Use them if intervals from a linearization are not good enough.

        ```python
        density = fit.log_density()
        warmup = blackjax.window_adaptation(blackjax.nuts, density)
        (state, tuned), _ = warmup.run(jax.random.key(0), jnp.zeros(density.size), 200)
        ```

        Coordinates, bounds and priors are those of the fit. Estimated noise levels are among the arguments. Precisions
        of weights keep their estimated values. Each gradient costs as much as a Jacobian of the fit.

        **Raises:**

        - `ModelError` if the density has no finite integral; the text names what neither data, priors nor bounds
            determine.
        """
        return log_density(self.objective, self.minimum, self.point)

    @explained_keywords()
    def filtered(
        self, names: str | Sequence[str], experiment: int | str | Experiment = 0, level: float = 0.95
    ) -> Prediction:
        """Estimates of any variables at the times of an experiment, each from the samples up to that time. Needs
        `method=Filter(...)`. Bands follow from the covariance of the states, without the uncertainty of parameters.

        Rows without measurements are predictions: with NaN in the last hours, the result is a forecast.
        """
        return self._followed(names, experiment, "filtered", 1, level)

    @explained_keywords()
    def smoothed(
        self, names: str | Sequence[str], experiment: int | str | Experiment = 0, level: float = 0.95
    ) -> Prediction:
        """As `filtered`, but from all samples of the experiment, including later ones (Rauch, Tung & Striebel 1965)."""
        return self._followed(names, experiment, "smoothed", 1, level)

    @explained_keywords()
    def ahead(
        self, names: str | Sequence[str], steps: int = 1, experiment: int | str | Experiment = 0, level: float = 0.95
    ) -> Prediction:
        """As `filtered`, but from samples that are at least `steps` rows old. The first `steps` rows are NaN if `steps`
        is above one. Also works with `method=Innovations(...)`, without bands."""
        return self._followed(names, experiment, "ahead", steps, level)

    def _followed(self, names: str | Sequence[str], experiment: Any, how: str, steps: int, level: float) -> Any:
        objective, point, _, experiment = self._under(experiment, None)
        return followed(objective, point, names, experiment, how, steps, self.quantile(level))

    @property
    def log_likelihood(self) -> float:
        """ln L of the fitted samples, without priors. Prefer the model with the smallest 2p − 2 ln L (Akaike) or p ln n
        − 2 ln L (Schwarz), for p coordinates and n samples."""
        return log_likelihood(self.objective, self.minimum)

    @explained_keywords()
    def discover(self, name: str, terms: Any, *, width: int = 3, most: int = 3) -> Discovery:
        """Replaces a network by closed forms: combinations of terms that are refitted to the data through the model,
        together with all other unknowns, and compared by BIC.

        ```python
        law = fit.discover("drag", learning.powers(4))
        print(law)
        closed = law.system
        ```

        **Arguments:**

        - `name`: the name of a trained network, from `learned` or a `NeuralDAEBlock`.
        - `terms`: `learning.powers(4)`, `learning.terms("v*Abs(v)", "tanh(v/0.1)")`, or both, joined by +.
        - `width`: the number of forms of each length that the search extends further.
        - `most`: the largest number of terms of a form.

        **Raises:**

        - `ModelError` for names, and for terms that do not fit the block.
        - `SimulationError` if no closed form can be simulated.
        """
        return discover(self, name, terms, width, most)

    def properties(self, name: str) -> Properties:
        """Whether a learned law is zero at zero, odd, a function of its input's size alone, rising or falling, by the
        evidence. Each property is built into the network, and the problem is fitted again with it.

        ```python
        found = fit.properties("drag")
        print(found)
        better = found.fit
        ```

        **Arguments:**

        - `name`: the name of a trained `equinox.nn.MLP` whose prior the evidence chooses.

        **Raises:**

        - `ModelError` for other names and networks.
        """
        return properties(self, name)

    @explained_keywords()
    def plot(
        self, names: str | Sequence[str] | None = None, *, axes: AxesGiven = None, level: float = 0.95
    ) -> np.ndarray:
        """Draws samples, and fitted runs with their bands at the times of the samples. Rows of axes are names; columns
        are the first four experiments. Returns Matplotlib axes."""
        outputs, spread = self.at_samples
        return plot_runs(self.objective, outputs, self.quantile(level) * spread, names, axes)

    def plot_residuals(self, *, axes: AxesGiven = None) -> np.ndarray:
        """Draws residuals in units of the noise over time, and their autocorrelation; returns Matplotlib axes."""
        return plot_residuals(self.objective, self.minimum, axes)

    def plot_history(self, ax: Axes | None = None) -> Axes:
        """Draws the misfit over the steps; returns Matplotlib axes."""
        return plot_history(self.minimum, ax)

    def plot_correlations(self, ax: Axes | None = None) -> Axes:
        """Draws the correlations of parameters and starts; returns Matplotlib axes."""
        return plot_correlations(self.objective, self.correlation, ax)

    @functools.cached_property
    def at_samples(self) -> tuple[Float[np.ndarray, "e n k"], Float[np.ndarray, "e n k"]]:
        """All outputs at the times of the samples, as `objective.stacked` has them, and their standard deviations."""
        return at_samples(self.objective, self.point, self.root)

    @functools.cached_property
    def rms(self) -> dict[str, dict[str, float]]:
        """Root mean square errors by experiment and name, in the variables' units, those held out included: of runs, or
        with `Filter` and `Innovations`, of predictions one step ahead."""
        return rms_by_name(self.objective, self.minimum, self.point)

    @functools.cached_property
    def holdout_score(self) -> float:
        """The root mean square of residuals of experiments held out, in units of the noise; NaN if there are none."""
        if not self.objective.stacked.holdout.any():
            return float("nan")
        return self.objective.holdout_score(self.minimum.z, self.minimum.weights)
