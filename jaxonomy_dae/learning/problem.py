"""A problem: a system, data of experiments, and what is to be learned from them."""

import copy
import dataclasses
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ..base.errors import (
    ModelError,
    SimulationError,
    by_name,
    explained_keywords,
    keywords_of,
    whole_number,
    wrong_keyword,
)
from ..run.simulation.simulate import simulate
from ..run.system.system import AcausalSystem
from ..solve.methods.solve import check_tolerances, default_tolerances
from .asked import METHODS, as_asked, check_start, checked_method, dead_times, names_to_train, penalties, started
from .beginnings import GROWING as GRADUAL
from .beginnings import beginning, silent
from .clock import Clock
from .colour import check_steps
from .colour_search import correlated
from .coordinates import Coordinate, Coordinates, coordinates
from .data import Data, Stacked, stack
from .descent import OFFSET, Minimum
from .devices import check_mesh
from .estimate import Estimate
from .evaluation import Evaluation, Weights
from .experiment import Experiment, Unknown
from .filter_program import Ahead
from .filtering import Filter, Innovations, structure_and_extras
from .identifiability import Identifiability, identifiability
from .multiple_shooting import Shooting, shoot
from .objective import Objective
from .priors import priors_by_name
from .program import AbstractPredictor, Layout, Runs, Setting
from .progress import reporter
from .ranges import in_ranges
from .resolution import resolved
from .runs import residuals, run, why_not
from .smoother import smoother
from .starting_points import adam_steps, starting_points
from .training import GradientSteps, Training, shares_of_time, train
from .verdict import FitWarning

GROWING = tuple(k / 10 for k in range(1, 11))  # shares of the time
# So many more starts of a network follow where χ² is improbable. Of four fits of Stribeck's friction, two end in a
# local minimum, so that all of three starts do in one of eight cases.
AGAIN = 2
MORE = 4  # the same of parameters alone: of 30 records of two tanks, a third ended in a local minimum
ENOUGH = 100  # evaluations of these, unless the search before took more: they cost no more than it did
LONG = 60.0  # seconds that a search may take, so that others follow without being asked for
ALIKE = 1e-3  # of −ln L, by which minima count as one


# Options of `simulate` that a problem hands on: the others it gives itself.
OPTIONS = tuple(
    name for name in keywords_of(simulate)
    if name not in ("system", "t1", "t0", "ts", "inputs", "initial", "adjoint", "throw")
)  # fmt: skip
ELSEWHERE = {
    "inputs": "inputs= in each Experiment",
    "initial": "initial= in each Experiment",
    "sigma": "sigma= in each Experiment",
    "noise": "sigma= in each Experiment, or method=Filter(noise)",
    "bounds": "bounds= in fit",
    "freeze": "freeze= in fit",
}


class Problem:
    """Parameters, networks, sensor laws and starts of a system that are learned from experiments.

    Its program is compiled once, at the first fit. Other data of the same shapes, noise levels, starts, bounds, frozen
    values and weights of priors compile nothing.

    **Arguments:**

    - `system`: from an `AcausalCompiler`. The search begins at its parameters and weights.
    - `data`: `Data`, or one `Experiment`.
    - `train`: names of parameters (also of arrays of them), of networks, and of sensor laws in `observe`; default: all
        networks. Parameters that must be positive are searched on a logarithmic scale; declared bounds hold.
    - `starts`: `Unknown(...)` or numbers by variables' names, for experiments that do not name them in `initial`.
    - `priors`: what is known of parameters beforehand, by name: `learning.Normal(mean, spread)`,
        `learning.LogNormal(median, factor)`, or a range `(low, high)`. Every method takes them.
    - `regularize`: of the weights of networks and sensor laws, by name: `"evidence"`, a normal prior whose precision
        the data choose; a number, its precision; None, no prior. Default: `"evidence"` for networks, None for sensor
        laws.
    - `observe`: derived outputs by name, `{"gauge.y": law}`, with `law(solution)` of shape `(n,)`: a function, or an
        Equinox module whose weights may be trained.
    - `delay`: dead times (s) of inputs and of what is measured, by name, in fits of runs: known numbers, or
        `Unknown(guess)`. An input acts late, u(t − τ), with its first sample before; a sensor shows y(t − τ), and first
        what it would show at the start.
    - `method`: `"single"`, each experiment is one run; `"growing"`, the same with growing `horizons`;
        `Shooting(...)`, multiple shooting, for what diverges; or for equations with errors, `Filter(...)`, the
        likelihood of a Kalman filter, or `Innovations(...)`, predictions one step ahead.
    - `rtol`, `atol`, `max_steps`, and others in `options`: as in `simulate`, whose defaults hold.
    - `mesh`: devices among which the experiments are divided, `jax.make_mesh((jax.device_count(),), ("experiments",))`;
        of several processes too, each of which runs the same program with the same data (`jax.distributed`).

    **Raises:**

    - `ModelError` for unknown names, for a trainable without numbers, for a parameter that nothing in the model reads,
        for an unknown start of an algebraic variable, and for data that do not fit.
    """

    def __init__(
        self,
        system: AcausalSystem,
        data: Data | Experiment,
        train: Sequence[str] | str | None = None,
        *,
        starts: Mapping[str, Any] | None = None,
        priors: Mapping[str, Any] | None = None,
        regularize: Mapping[str, Any] | str | float | None = "evidence",
        observe: Mapping[str, Any] | None = None,
        delay: Mapping[str, float | Unknown] | None = None,
        method: str | Shooting | Filter | Innovations = "single",
        rtol: float | None = None,
        atol: float | None = None,
        max_steps: int = 4096,
        mesh: Mesh | None = None,
        **options: Any,
    ):
        known = list(dict.fromkeys([*keywords_of(Problem.__init__), *OPTIONS]))
        for name in options:
            if name not in OPTIONS:
                raise ModelError(wrong_keyword("Problem", name, known, ELSEWHERE))
        if not isinstance(system, AcausalSystem):
            raise ModelError(f"Problem needs an AcausalSystem (call the AcausalCompiler); got {type(system).__name__}")
        self.system = system
        self.observers = by_name("observe", observe, "'gauge.y': law")
        for name, law in self.observers.items():
            if not callable(law):
                raise ModelError(f"observe: '{name}' needs a function of a solution; got {law!r}")
            if name in system.neural or name in system.plan.variable_index:
                raise ModelError(f"observe: '{name}' is the name of a network or variable: choose another")
        self.data = data if isinstance(data, Data) else Data(data)
        self.starts = by_name("starts", starts, "'motor.w': Unknown(0.0)")
        dtype = system.parameters.values.dtype
        rtol, atol = default_tolerances(rtol, atol, dtype)
        check_tolerances(rtol, atol, dtype)
        self._options = {"rtol": rtol, "atol": atol, "max_steps": max_steps, **options}
        self._mesh = check_mesh(mesh)
        # Names of parameters, one by one, and of networks and sensor laws.
        self.trained = names_to_train(system, self.observers, train)
        self.method = checked_method(system, method)
        self.delay = by_name("delay", delay, "'motor.u': Unknown(0.1)")
        self._stacked = self._read(self.data, None)
        unseen = [n for n in self.observers if n in self.trained[1] and n not in self._stacked.outputs]
        if unseen:
            raise ModelError(f"train: there are no data of '{unseen[0]}' to train its sensor law with")
        self._layout = self.layout_of(self._stacked)
        unknown = [*self.trained[0], *self._layout.shared, *self._layout.own]
        table = system.parameters.table
        self.priors = priors_by_name(
            by_name("priors", priors, "'motor.R': Normal(1.2, 0.1)"),
            table,
            [name for name in unknown if name in table.names],
        )
        self.penalties = penalties(system, self.trained[1], regularize)

    # --- set-up ------------------------------------------------------------------------------------------------

    def stacked(self, data: Data | Experiment) -> Stacked:
        """The data, checked against the model, as arrays."""
        return self._read(data, self._stacked)

    def _read(self, data: Data | Experiment, like: Stacked | None) -> Stacked:
        whole = data if isinstance(data, Data) else Data(data)
        stacked = stack(whole, self.system.plan, tuple(self.observers), self.starts, like)
        if not stacked.observed[~stacked.holdout & (stacked.weight > 0)].any():
            raise ModelError("nothing is to be fitted: what has samples is held out, or has the weight 0")
        return stacked

    def layout_of(self, stacked: Stacked) -> Layout:
        """The names of arguments and results of a program for these data."""
        parameters, modules = self.trained
        _, extras = self.errors(stacked)
        shared, own, known = [], [], []
        for name, values in stacked.starts.items():
            unknown = [v for v in values if isinstance(v, Unknown)]
            check_start(self.system, self.trained[0], name, bool(unknown))
            kind = known if not unknown or self._is_marginal(name, unknown) else shared if unknown[0].shared else own
            kind.append(name)
        if not parameters and not modules and not shared and not own and all(e.fixed for e in extras):
            raise ModelError(
                "nothing is to be learned: name parameters, networks or sensor laws in train=, or make a start or "
                "a delay Unknown"
            )
        lengths = tuple(sorted(set(stacked.counts))) if self.observers else ()
        return Layout(
            stacked.outputs, parameters=tuple(parameters), modules=tuple(modules), shared=tuple(shared),
            own=tuple(own), known=tuple(known), kinds=stacked.kinds, options=tuple(self._options.items()),
            extra=tuple(e.name for e in extras), delayed=tuple(self.delay),
            lengths=lengths if len(lengths) > 1 else (), mesh=self._mesh,
        )  # fmt: skip

    @property
    def _setting(self) -> Setting:
        return Setting(self.system, self.observers, self._layout, 1.0)

    def errors(self, stacked: Stacked) -> tuple[AbstractPredictor, tuple[Coordinate, ...]]:
        """How the method predicts outputs, and the coordinates that come with it."""
        if self.delay:
            return Runs(), dead_times(self.delay, stacked, self.method)
        if not isinstance(self.method, Filter | Innovations):
            return Runs(), ()
        structure, extras = structure_and_extras(self.method, self.system, stacked)
        return Ahead(structure), extras

    def coordinates_of(self, setting: Setting, stacked: Stacked) -> Coordinates:
        """The coordinates for these data, with the problem's priors."""
        return coordinates(setting, stacked, self.errors(stacked)[1], self.priors)

    def _is_marginal(self, name: str, unknown: list[Unknown]) -> bool:
        """True if the prior of a start is that of a filter, which needs no search."""
        own = all(u.spread is not None and not u.shared for u in unknown)
        return isinstance(self.method, Filter) and own and name not in self.system.parameters.table.names

    # --- residuals ---------------------------------------------------------------------------------------------

    @explained_keywords()
    def residuals(
        self,
        model: AcausalSystem | None = None,
        *,
        starts: Mapping[str, Any] | None = None,
        delay: Mapping[str, Any] | None = None,
        observe: Mapping[str, Any] | None = None,
        adjoint: Any = None,
    ) -> dict[str, dict[str, Any]]:
        """Predictions minus data by experiment and name, in units of the noise if it is known, and zero where there is
        no sample. Use them in losses of your own, also inside jit and grad.

        **Arguments:**

        - `model`: a system like the problem's, such as `equinox.combine(trainable, frozen)`; default: the problem's.
        - `starts`: unknown starts by names, scalars if shared, else shape `(experiments,)`; default: their guesses.
        - `delay`: dead times by name, in place of the problem's numbers and guesses.
        - `observe`: sensor laws by name, in place of the problem's.
        - `adjoint`: as in `simulate`; `diffrax.ForwardMode()` for Jacobians.

        **Returns:**

        `{experiment: {name: array of shape (n,)}}`; NaN where a run fails.
        """
        s = self._stacked
        objective = self.objective_of(s, self.coordinates_of(self._setting, s))
        model = self.system if model is None else model.merged()
        return residuals(objective, model, dict(starts or {}), dict(delay or {}), dict(observe or {}), adjoint)

    def objective_of(self, stacked: Stacked, c: Coordinates, penalties: dict[str, Any] | None = None) -> Objective:
        """The function that a fit minimises."""
        if self.method not in METHODS:
            stacked.check_plain(f"method={type(self.method).__name__}")
        check_steps(stacked)
        return Objective(
            self.system, self.observers, self.layout_of(stacked), 1.0, stacked, c,
            penalties=self.penalties if penalties is None else penalties, counted=~stacked.holdout,
            predictor=self.errors(stacked)[0],
        )  # fmt: skip

    # --- fitting -----------------------------------------------------------------------------------------------

    @explained_keywords()
    def fit(
        self,
        data: Data | Experiment | None = None,
        *,
        freeze: Mapping[str, float] | Iterable[str] = (),
        start: "Mapping[str, float] | AcausalSystem | Training | None" = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        first: GradientSteps | None = None,
        starts: int | None = None,
        seed: int = 0,
        adam: int = 0,
        learning_rate: float = 0.02,
        horizons: Sequence[float] | None = None,
        steps: int = 500,
        warn: bool = True,
        progress: Any = None,
        timeout: float | None = None,
    ) -> Estimate:
        """Finds the most probable values, by least squares in units of the noise with the given priors.

        **Arguments:**

        - `data`: other data than the problem's. Data with the same shapes and unknown starts compile nothing.
        - `freeze`: parameters, starts and networks that keep their values, or `{name: value}`.
        - `start`: the start of the search: values by name, a system such as that of an earlier estimate, or a result of
            `train`.
        - `bounds`: narrower than those declared, by name.
        - `first`: steps of an Optax optimizer before least squares; `estimate.training` is their history.
        - `starts`: the number of starting points; None: one, and where what it leaves over is no noise and its search
            took less than a minute, up to four more, over growing shares of the time; of networks up to two. All but
            the first are drawn around it by `seed`: parameters within a factor of e or their bounds, starts by their
            spread, networks with weights of the same sizes. The best result is the one with the greatest likelihood of
            held-out experiments, or without any, and for a `Filter`, of fitted ones.
        - `adam`: the number of gradient steps before least squares, with `learning_rate` on the scale of the
            coordinates.
        - `horizons`: shares of the record that are fitted one after the other, such as `(0.25, 0.5, 1)`, against runs
            that diverge over the whole record. Over a part, inner layers of networks stay close to their start if the
            data allow it. None: the whole record, or with `method="growing"`, ten shares.
        - `steps`: the largest number of steps of least squares.
        - `warn`: whether a `FitWarning` gives the `reasons` if the estimate is not `ok`.
        - `progress`: True prints a line for each step: cost, χ²/n, what remains, seconds left. Or a function that is
            called with a `learning.Progress`.
        - `timeout`: seconds, compilation included, after which no further step begins. Then, and after an interrupt
            (Ctrl-C), the fit is that of the best point so far; its `message` says so.

        Without `start`, `first`, `adam` and `horizons`, networks begin at their own weights or with a last layer of
        zero, whichever is closer to the data. The weights of a raw `equinox.nn.MLP` are measured by the ranges of its
        inputs and the size of its outputs, so units do not matter. If both starts are far from the data, horizons grow.
        At the minimum, the error of the integration is measured. If it counts beside the noise, the search goes on with
        tighter tolerances; so it does if no step reduces the cost because of that error.

        **Raises:**

        - `ModelError` for names, values and shapes that do not fit.
        - `SimulationError` if no start can be simulated; the text gives the reason of the first.
        """
        clock = Clock(timeout)
        count = 1 if starts is None else whole_number(starts, "starts")
        steps, adam = whole_number(steps, "steps", 0), whole_number(adam, "adam", 0)
        objective = self._prepared(data, freeze, start, bounds)
        objective = dataclasses.replace(objective, watch=reporter(progress, OFFSET), clock=clock)
        if first is not None and (adam or (count > 1 and first.checkpoint is not None)):
            other = "adam=" if adam else "a checkpoint with several starts"
            raise ModelError(f"first= does not go with {other}: leave one of them out")
        self._check_steps(adam, horizons, first)
        plain = self.method == "single" and horizons is None and start is None and first is None and not adam
        if horizons is None:
            horizons = GROWING if self.method == "growing" else (1.0,)
        shares = shares_of_time(horizons)
        by_fit = isinstance(self.method, Filter) or not objective.stacked.holdout.any()
        objective, own, fresh = in_ranges(
            objective, silent(objective, self._nominal(objective)), not isinstance(self.method, Shooting)
        )
        has_networks = not np.array_equal(silent(objective, own), own)
        again = self._again(starts, has_networks, plain, first, adam)
        points = starting_points(objective, own, fresh, count + again, seed)
        best: tuple[float, Estimate] | None = None
        tried, spent, most = 0, 0, np.inf  # evaluations, and how many more may follow
        for k, point in enumerate(points):
            if k == count:
                again = again and clock.elapsed < LONG
                most = np.inf if has_networks else spent + max(spent, ENOUGH)
            is_enough = k >= count and not (again and spent < most)
            if best is not None and (
                clock.is_over or is_enough or (k >= count and not self._asks(best[1], has_networks))
            ):
                break
            training, spans, tried = None, shares, k + 1
            if first is not None:
                objective.stacked.check_white("first=")
                training = train(objective, point, first)
                point = training.z
            if plain:
                point, spans = beginning(objective, point, point if k else fresh)
            if k >= count and not has_networks:
                # Over a short time, runs depend on numbers almost linearly: the first start, too, may lead elsewhere.
                point, spans = (own if k == count else point), GRADUAL if shares == (1.0,) else shares
            found = self._descend(objective, point, spans, int(min(steps, most - spent)), adam, learning_rate)
            if found is None:
                continue
            here, lowest = found
            spent += lowest.evaluations
            score = here.surprise(lowest) if by_fit else here.held_out(lowest.z, lowest.weights)[1]
            if best is None or score < best[0] - ALIKE:
                best = score, self._estimate(here, lowest, training, steps)
        if best is None:
            raise SimulationError(why_not(objective))
        fit = dataclasses.replace(best[1], tried=tried)
        if warn and fit.reasons:
            warnings.warn(f"this fit is not to be relied on: {'; '.join(fit.reasons)}", FitWarning, stacklevel=3)
        return fit

    def _asks(self, fit: Estimate, has_networks: bool) -> bool:
        """True if a fit asks for other starts."""
        return fit.objective.is_improbable(fit.minimum) if has_networks else fit.asks_for_starts

    def _again(self, starts: int | None, has_networks: bool, plain: bool, first: Any, adam: int) -> int:
        """How many more starts may follow where the fit asks for them."""
        if starts is not None or first is not None or adam or self.method not in METHODS:
            return 0
        return (AGAIN if plain else 0) if has_networks else MORE

    def _estimate(self, here: Objective, lowest: Minimum, training: Training | None, steps: int) -> Estimate:
        """The estimate at a minimum, integrated as finely as the data ask for."""
        assert here.clock is not None
        if not isinstance(self.method, Shooting) and not here.clock.is_over:
            here, lowest = resolved(here, lowest, steps)
        here = dataclasses.replace(here, watch=None, clock=None)
        return Estimate.of(self, here.at_tolerance(lowest.tolerance), lowest, training)

    @explained_keywords()
    def train(
        self,
        how: GradientSteps,
        data: Data | Experiment | None = None,
        *,
        freeze: Mapping[str, float] | Iterable[str] = (),
        start: "Mapping[str, float] | AcausalSystem | Training | None" = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
    ) -> Training:
        """Takes gradient steps only, on the cost of `fit` and with its arguments.

        Unknown noise levels and precisions of weights keep their first values. Continue with `fit(start=training)`,
        which estimates them.
        """
        if not isinstance(how, GradientSteps):
            raise ModelError(f"train takes learning.GradientSteps(optax.adam(0.02), steps=200); got {how!r}")
        self._check_steps(0, None, how)
        (self._stacked if data is None else self.stacked(data)).check_white("train")
        objective = self._prepared(data, freeze, start, bounds)
        return train(objective, objective.coordinates.z_start[objective.free], how)

    def _prepared(self, data: Any, freeze: Any, start: Any, bounds: Any) -> Objective:
        """The objective, from the arguments of `fit`."""
        stacked = self._stacked if data is None else self.stacked(data)
        same = dataclasses.replace(self.layout_of(stacked), lengths=self._layout.lengths)
        if same != self._layout:
            raise ModelError(
                "these data name other outputs, inputs or unknown starts than the problem's: make a Problem of them"
            )
        objective = self.objective_of(stacked, self._coordinates(stacked, freeze, start, bounds))
        if not objective.free.any():
            raise ModelError("everything is frozen: there is nothing to fit")
        return objective

    def _nominal(self, objective: Objective) -> Float[np.ndarray, " f"]:
        """The problem's own values, wherever a search begins, on the scale of an objective's coordinates."""
        c, own = objective.coordinates, self.coordinates_of(self._setting, objective.stacked)
        start = np.where(c.fixed, c.start, np.clip(own.start, c.low, c.high))
        return dataclasses.replace(c, start=start).z_start[objective.free]

    def _check_steps(self, adam: int, horizons: Any, first: Any) -> None:
        """Raises a `ModelError` for steps that the method does not take."""
        if isinstance(self.method, Shooting) and (adam or horizons is not None):
            raise ModelError("adam and horizons belong to single shooting: leave them out, or use method='single'")
        if isinstance(self.method, Filter | Innovations) and (adam or first is not None):
            raise ModelError(
                f"gradient steps are those of runs, not of {type(self.method).__name__}: train with method='single' "
                "first, and give fit(start=training.values)"
            )

    def _coordinates(self, stacked: Stacked, freeze: Any, start: Any, bounds: Any) -> Coordinates:
        c = self.coordinates_of(self._setting, stacked)
        if isinstance(start, AcausalSystem):
            there = self._setting._replace(system=started(self.system, start))
            c = dataclasses.replace(c, start=self.coordinates_of(there, stacked).start)
        return as_asked(c, freeze, start, bounds)

    def _descend(
        self, objective: Objective, point: np.ndarray, shares: Sequence[float], steps: int, adam: int, rate: float
    ) -> tuple[Objective, Minimum] | None:
        """(the objective as it was in the end, its minimum); None where a start cannot be evaluated."""
        if isinstance(self.method, Shooting):
            found = shoot(objective, self.method, point, steps, self._options["rtol"])
            return None if found is None else (objective, found)
        found, evaluations = None, 0
        for share in shares:
            here = objective.until(share, silent(objective, point))
            if found is not None:
                here = here.at_tolerance(found.tolerance)
            if adam and share == shares[0]:
                point = adam_steps(here, point, adam, rate)
            # Where time is over, the whole record is only looked at.
            found = here.lowest(point, 0 if found is not None and here.clock and here.clock.is_over else steps)
            if found is None:
                return None
            point, evaluations = found.z, evaluations + found.evaluations
        assert found is not None
        objective, found = correlated(objective, dataclasses.replace(found, evaluations=evaluations), steps)
        return smoother(objective, found, steps) or (objective, found)

    def reach(self, objective: Objective, start: np.ndarray, weights: Weights) -> Minimum | None:
        """The minimum next to a start, with constant weights."""
        rtol = self._options["rtol"]
        if isinstance(self.method, Shooting):
            return shoot(objective, self.method, start, 200, rtol, weights)
        if not len(start):
            found = objective.evaluate(start)
            if found is None:
                return None
            cost = weights.cost(start, found.residual)
            return Minimum(
                start, found, weights, cost, history=[cost], evaluations=1, converged=True,
                message="nothing is searched", noise=rtol, left=0.0, tolerance=rtol,
            )  # fmt: skip
        return objective.lowest(start, weights=weights)

    def run(self, objective: Objective, z: Float[np.ndarray, " p"], experiment: int, ts: Any = None) -> Any:
        """An ordinary simulation of one experiment at a point."""
        return run(objective, z, experiment, ts)

    def beginning_at(self, system: AcausalSystem) -> "Problem":
        """A copy whose networks begin at other weights."""
        other = copy.copy(self)
        other.system = system
        return other

    def with_law(self, name: str, law: Any, stacked: Stacked, penalty: str | None = None) -> "Problem":
        """A copy with another law in place of a network, of this prior."""
        dtype = self.system.parameters.values.dtype
        law = jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, law)
        other = copy.copy(self)
        other.system = eqx.tree_at(lambda s: s.neural, self.system, self.system.neural | {name: law})
        other._stacked, other.penalties = stacked, self.penalties | {name: penalty}
        return other

    # --- before a fit ------------------------------------------------------------------------------------------

    @explained_keywords()
    def identifiability(
        self, *, freeze: Mapping[str, float] | Iterable[str] = (), start: Any = None
    ) -> Identifiability:
        """The directions that the data could determine at the nominal values: the Fisher information, before any fit.

        Unknown noise levels are assumed to be as large as the residuals at the start.
        """
        objective, weights, found, z = self.nominal(freeze, start)
        return identifiability(objective, weights, found, z, self._options["rtol"])

    def nominal(
        self, freeze: Mapping[str, float] | Iterable[str] = (), start: Any = None
    ) -> tuple[Objective, Weights, Evaluation, Float[np.ndarray, " f"]]:
        """The start of a search. Returns (objective, first weights, residuals with their Jacobian, free
        coordinates)."""
        objective = self.objective_of(self._stacked, self._coordinates(self._stacked, freeze, start, None))
        z = objective.coordinates.z_start[objective.free]
        found = objective.evaluate(z)
        if found is None:
            raise SimulationError(why_not(objective))
        return objective, objective.weights(z, found), found, z

    def laid_out(self, experiments: Sequence[Experiment]) -> tuple[Layout, Stacked]:
        """The layout and the stacked data of other experiments of the same system, for a program of their own."""
        stacked = stack(Data(*experiments), self.system.plan, tuple(self.observers), self.starts)
        return self.layout_of(stacked), stacked
