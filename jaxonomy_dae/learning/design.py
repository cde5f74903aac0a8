"""Which experiment tells most: the Fisher information after it.

With the information H at hand (priors included) and M that of a candidate, linearized around the values at hand, the
experiment is expected to tell

    ½ ln det(H + M) − ½ ln det H

nats about what is estimated (Lindley 1956, Annals of Mathematical Statistics 27:986): the greatest is the D-optimal
choice (Atkinson & Donev 1992, Optimum Experimental Designs, §10). For some names alone, det of their own block of the
inverse takes the place of det H (Ds-optimality, ibid. §10.3), so that what is known of others counts only as far as it
helps.

What is not known at all is taken to be known to its natural scale (`identifiability`): a positive parameter to a
factor of e, another to its own size or what moves predictions as much as data vary, an unknown start to its spread. So
directions that nothing determines yet have a finite worth (Chaloner & Verdinelli 1995, Statistical Science 10:273).
"""

import dataclasses
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from ..base.errors import InitializationError, ModelError, SimulationError, explained_keywords, nearest, whole_number
from .coordinates import Coordinates
from .data import Stacked
from .estimate import Estimate
from .experiment import Planned, Unknown
from .filter_program import Ahead
from .identifiability import natural_scale
from .objective import Objective
from .problem import Problem
from .program import Layout, Owns, Shared, predict_and_differentiate
from .runs import run

DRAWS = 64  # records of innovations at most, for the information of a filter: exact up to 63 samples


@dataclasses.dataclass(frozen=True, repr=False)
class Advice:
    """A printable comparison of candidates.

    - `labels`: of the candidates.
    - `gain`: the expected information of each candidate, in nats; ln 2 = 0.69 halves the spread of one parameter. NaN
        if its run fails.
    - `chosen`: the positions of the best candidates. Each further one is the best in addition to those before it.
    - `before`: the present standard deviations of parameters and shared starts, by name, on the coordinates' scale
        (relative for positive parameters); `after`: those with each candidate, shape `(candidates,)`.
    """

    labels: tuple[str, ...]
    gain: Float[np.ndarray, " c"]
    chosen: tuple[int, ...]
    before: dict[str, float]
    after: dict[str, Float[np.ndarray, " c"]]

    @property
    def best(self) -> int:
        """The position of the most informative candidate."""
        return self.chosen[0]

    def __repr__(self):
        names = list(self.before)[:4]
        header = ["", "gain [nat]", *(f"spread of {name}" for name in names)]
        rows = [["(now)", "", *(f"{self.before[name]:.3g}" for name in names)]] if names else []
        for k in np.argsort(np.where(np.isnan(self.gain), np.inf, -self.gain), kind="stable").tolist():
            mark = "* " if k in self.chosen else "  "
            told = "its run fails" if np.isnan(self.gain[k]) else f"{self.gain[k]:.3f}"
            rows.append([mark + self.labels[k], told, *(f"{self.after[name][k]:.3g}" for name in names)])
        widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in [header, *rows]]
        if len(self.chosen) > 1:
            lines.append("in this order: " + ", ".join(self.labels[k] for k in self.chosen))
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class Known:
    """The information at hand of what experiments share, and how it is measured.

    `scale` is d(natural value)/d(coordinate); `chosen` are the coordinates about which experiments are to tell.
    """

    problem: Problem
    objective: Objective
    point: Float[np.ndarray, " p"]  # all coordinates
    information: Float[np.ndarray, "s s"]
    free: Bool[np.ndarray, " shared"]
    chosen: Bool[np.ndarray, " s"]

    def worth(self, information: Float[np.ndarray, "s s"]) -> float:
        """ln det of the information, or of what it says of the chosen coordinates."""
        whole = _log_det(information)
        return whole if self.chosen.all() else whole - _log_det(information[np.ix_(~self.chosen, ~self.chosen)])

    def spreads(self, information: Float[np.ndarray, "s s"]) -> dict[str, float]:
        """Standard deviations of what is not a weight, by name."""
        c = self.objective.coordinates
        size = np.sqrt(np.diag(information))
        variance = np.diag(np.linalg.inv(information / np.outer(size, size))) / size**2
        names = np.array(c.names[: c.n_shared])[self.free]
        plain = ~c.is_weight[: c.n_shared][self.free]
        return {n: float(v) for n, v in zip(names[plain], np.sqrt(variance[plain]), strict=True)}


def known_of(source: Problem | Estimate, names: Sequence[str] | str | None, alone: bool) -> Known:
    """The information of a problem at its nominal values, or of an estimate at its own."""
    if isinstance(source, Estimate):
        problem, objective = source.problem, source.objective
        weights, found, z = source.minimum.weights, source.minimum.found, source.minimum.z
    else:
        problem = source
        objective, weights, found, z = source.nominal()
    c, free = objective.coordinates, objective.free
    shared = free[: c.n_shared]
    if not shared.any():
        raise ModelError("only starts of single experiments are unknown: no other experiment can tell about these")
    prior = np.where(weights.precision > 0, weights.precision, 1 / natural_scale(objective, z, found) ** 2)
    count = int(shared.sum())
    information = np.diag(prior[:count])
    if not alone:
        jacobian = dataclasses.replace(weights, precision=np.zeros_like(prior)).applied(z, found).jacobian
        whole = jacobian.T @ jacobian + np.diag(prior)
        information = _without(whole, count)
    return Known(problem, objective, objective.full(z), information, shared, _chosen(objective, shared, names))


def _chosen(
    objective: Objective, shared: Bool[np.ndarray, " shared"], names: Sequence[str] | str | None
) -> Bool[np.ndarray, " s"]:
    c = objective.coordinates
    if names is None:
        return np.ones(int(shared.sum()), bool)
    chosen = np.zeros(len(c), bool)
    for name in [names] if isinstance(names, str) else names:
        members = c.members(name) & np.concatenate([shared, np.zeros(len(c) - c.n_shared, bool)])
        if not members.any():
            known = [n for n, ok in zip(c.group[: c.n_shared], shared, strict=True) if ok]
            raise ModelError(f"names: '{name}' is not estimated from all experiments: " + nearest(name, known))
        chosen |= members
    return chosen[: c.n_shared][shared]


@explained_keywords()
def next_experiment(
    source: Problem | Estimate,
    candidates: Sequence[Planned],
    names: Sequence[str] | str | None = None,
    *,
    count: int = 1,
    alone: bool = False,
) -> Advice:
    """Chooses the most informative experiments among candidates.

    ```python
    plans = [learning.Planned(ts, {"pend.x": 1e-3}, initial={"pend.initial_theta": a}) for a in (-1.2, 0.0, 0.5)]
    print(learning.next_experiment(fit, plans, names=["drag"]))
    ```

    One compiled program serves all candidates; shorter ones are padded. Derivatives pass through events of the model.

    **Arguments:**

    - `source`: an estimate, with its values and data; or before any fit, a problem with its nominal values.
    - `candidates`: the possible experiments: times, inputs, starts, and measured variables.
    - `names`: the parameters, networks and shared starts of interest; default: all.
    - `count`: the number of experiments to choose. One candidate may be chosen repeatedly.
    - `alone`: whether to ignore the present data.

    **Returns:**

    `Advice`. Its gains hold for the present values, so a design is as good as these values are.

    **Raises:**

    - `ModelError` for names and candidates that do not fit; `SimulationError` if every candidate's run fails, with the
        reason of the first.
    """
    known = known_of(source, names, alone)
    plans: list[Planned] = [] if isinstance(candidates, Planned) else list(candidates)
    if not plans or not all(isinstance(one, Planned) for one in plans):
        raise ModelError("candidates are a list of learning.Planned(times, {'m.x': sigma}, ...), at least one")
    whole_number(count, "count")
    labels, gained = informations(known, plans)
    fails = np.array([not np.isfinite(m).all() for m in gained])
    if fails.all():
        raise SimulationError(_why(known, plans))
    chosen, now, gains = [], known.information, None
    for _ in range(count):
        worth = np.array([np.nan if f else known.worth(now + m) for f, m in zip(fails, gained, strict=True)])
        here = 0.5 * (worth - known.worth(now))
        gains = here if gains is None else gains
        chosen.append(int(np.nanargmax(here)))
        now = now + gained[chosen[-1]]
    assert gains is not None
    before = known.spreads(known.information)
    each = [
        dict.fromkeys(before, np.nan) if f else known.spreads(known.information + m)
        for f, m in zip(fails, gained, strict=True)
    ]
    after = {name: np.array([one[name] for one in each]) for name in before}
    return Advice(labels, gains, tuple(chosen), before, after)


def informations(known: Known, plans: list[Planned]) -> tuple[tuple[str, ...], Float[np.ndarray, "c s s"]]:
    """Labels, and the information of each planned experiment on what is shared and free; NaN where its run fails."""
    layout, stacked, shared, own = _placed(known, plans)
    planned = _objective(known, layout, stacked)
    column = _columns(known, planned.coordinates)
    starts = _start_scales(stacked, layout)
    joint = [np.zeros((0, 0))] * len(plans)
    told = list(_told(planned, shared, own))
    for one in told:
        for k in range(len(plans)):
            seen = stacked.observed[k]
            own_free = ~np.array([_is_known(stacked, name, k) for name in layout.own], bool)
            rows = []
            for by_shared, by_own in one:
                a = np.zeros((int(seen.sum()), len(known.point)))
                a[:, column] = by_shared[k][seen]
                a = known.objective.coordinates.pulled(known.point, a)[:, : len(known.free)]
                b = by_own[k][seen] * starts[k]
                rows.append(np.concatenate([a[:, known.free], b[:, own_free]], axis=1))
            whole = stacked.weight[k] * sum(r.T @ r for r in rows) / len(told)
            joint[k] = joint[k] + whole if len(joint[k]) else whole
    out, n = np.full((len(plans), *known.information.shape), np.nan), int(known.free.sum())
    for k, whole in enumerate(joint):
        if np.isfinite(whole).all():
            own_starts = np.arange(n, len(whole))
            whole[own_starts, own_starts] += 1.0  # their spread is the unit
            out[k] = _without(whole, n)
    return stacked.labels, out


def _told(planned: Objective, shared: Shared, own: Owns) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], ...]]:
    """Pairs of derivatives by shared and own numbers, of shapes (c, n, k, s) and (c, n, k, o), whose squares the
    information is the sum of: those of predictions, in units of the noise, and of a filter those of the logarithms of
    the variances as well (`likelihood`). What a filter predicts depends on its samples: of these, some records of
    innovations ±1 are drawn, orthogonal to each other as columns of a Hadamard matrix are, so that their mean is the
    expectation where predictions are linear in the samples."""
    s, predictor, records = planned.stacked, planned.predictor, [planned.told]
    if isinstance(predictor, Ahead):
        predictor = Ahead(dataclasses.replace(predictor.structure, is_drawn=True))
        count = min(2 ** int(np.ceil(np.log2(s.values[0].size + 1))), DRAWS)
        signs = scipy.linalg.hadamard(count)[:, 1 + np.arange(s.values[0].size) % (count - 1)]
        drawn = (np.broadcast_to(row.reshape(s.values[0].shape), s.values.shape) for row in signs)
        dtype = planned.told.values.dtype
        records = (dataclasses.replace(planned.told, values=jnp.asarray(values, dtype)) for values in drawn)
    for told in records:
        mean, *slopes = predict_and_differentiate(planned.setting, predictor, shared, own, told)
        if mean.variance is None:
            yield (_scaled(mean.values, [by.values for by in slopes], s.sigma),)
            continue
        variance = np.asarray(mean.variance, np.float64)
        with np.errstate(invalid="ignore"):
            level = np.sqrt(variance)
        by_variance = [by.variance for by in slopes if by.variance is not None]
        yield (
            _scaled(mean.values, [by.values for by in slopes], level),
            _scaled(variance, by_variance, np.sqrt(2) * variance),
        )


def _scaled(values: ArrayLike, slopes: Sequence[ArrayLike], unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by shared and own numbers in units of shape (c, n, k); not-a-number where a run fails."""
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(np.isfinite(np.asarray(values)), 1.0, np.nan) / unit
    by_shared, by_own = (np.asarray(a, np.float64) * factor[..., None] for a in slopes)
    return by_shared, by_own


def _placed(known: Known, plans: list[Planned]) -> tuple[Layout, Stacked, Shared, Owns]:
    """Layout, data, and the numbers that the program is told."""
    problem, o = known.problem, known.objective
    layout, stacked = problem.laid_out([one.experiment(o.system.plan) for one in plans])
    base = o.layout
    missing = [name for name in layout.shared if name not in base.shared]
    if missing:
        raise ModelError(
            f"candidates share the unknown start of '{missing[0]}', and the experiments at hand do not: leave "
            "shared=True out"
        )
    at = _objective(known, layout, stacked)
    own, natural = at.coordinates.split(at.coordinates.start)[1], o.coordinates.natural(known.point)
    return layout, stacked, *at.numbers(np.concatenate([natural[_columns(known, at.coordinates)], own.ravel()]))


def _objective(known: Known, layout: Layout, stacked: Stacked) -> Objective:
    """What planned experiments are looked at by: runs, or the method of the estimate at hand."""
    o, counted = known.objective, np.ones(len(stacked.labels), bool)
    c = known.problem.coordinates_of(o.setting._replace(layout=layout), stacked)
    predictor = known.problem.errors(stacked)[0]
    return Objective(o.system, o.observers, layout, o.fine, stacked, c, {}, counted=counted, predictor=predictor)


def _columns(known: Known, planned: Coordinates) -> np.ndarray:
    """The places of shared numbers among those of the estimate at hand. Noise levels of its samples are not there:
    those of planned ones are given."""
    place = {name: k for k, name in enumerate(known.objective.coordinates.names)}
    return np.array([place[name] for name in planned.names[: planned.n_shared]], int)


def _is_known(stacked: Stacked, name: str, k: int) -> bool:
    return isinstance(stacked.starts[name][k], float)


def _start_scales(stacked: Stacked, layout: Layout) -> np.ndarray:
    """The uncertainty of each own start before any data: its spread, or its own size; shape (candidates, own)."""

    def scale(given: float | Unknown) -> float:
        if not isinstance(given, Unknown):
            return 1.0
        return float(given.spread) if given.spread is not None else abs(float(given.guess)) or 1.0

    rows = [[scale(stacked.starts[name][k]) for name in layout.own] for k in range(len(stacked.labels))]
    return np.array(rows, float).reshape(len(stacked.labels), len(layout.own))


def _without(information: Float[np.ndarray, "p p"], count: int) -> Float[np.ndarray, "s s"]:
    """The information on the first `count` coordinates with the others unknown (a Schur complement)."""
    first, cross, rest = information[:count, :count], information[:count, count:], information[count:, count:]
    if not len(rest):
        return first
    size = np.sqrt(np.diag(rest))
    cross = cross / size
    found = first - cross @ np.linalg.solve(rest / np.outer(size, size), cross.T)
    return (found + found.T) / 2


def _log_det(information: Float[np.ndarray, "s s"]) -> float:
    size = np.sqrt(np.diag(information))
    sign, value = np.linalg.slogdet(information / np.outer(size, size))
    return float(value + 2 * np.sum(np.log(size))) if sign > 0 else -np.inf


def _why(known: Known, plans: list[Planned]) -> str:
    """The reason for which the first candidate's run fails."""
    layout, stacked, shared, own = _placed(known, plans)
    at = _objective(known, layout, stacked)
    point = np.concatenate([np.asarray(shared, float), np.asarray(own, float).ravel()])
    try:
        run(at, at.coordinates.scaled(point), 0)
    except (InitializationError, ModelError, SimulationError) as error:
        return f"no candidate can be simulated; the first, {stacked.labels[0]}, fails: {error}"
    return f"no candidate can be simulated; the first, {stacked.labels[0]}: its predictions are not finite"
