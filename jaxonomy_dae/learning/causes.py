"""What residuals that are no noise look like, in one clause, and what that speaks for.

Simple descriptions compete: changes of sensors, of laws, of inputs, and disturbances (`candidates.py`), and correlated
neighbours. Each explains a part R² of the sum of squares. The one is said whose likelihood ratio −n ln(1 − R²), less
ln n for each number that it takes (Schwarz 1978) and 2 ln M for being one of M of its kind (Chen & Chen 2008,
Biometrika 95:759), is greatest.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from .candidates import DAILY, DAY, EDGE, SLOW, WIDEST, Change, Judge, disturbances, inputs, laws, readings
from .form import FINE, periodogram
from .leftover import Leftover, Series
from .linearized import Linearized
from .program import Runs

if TYPE_CHECKING:
    from .estimate import Estimate

CLOSE = 6.0  # in units of 2 ln L, below which evidence is not strong (Kass & Raftery 1995, J. Am. Stat. Ass. 90:773)
RIVALS = 3  # descriptions that are said
DRIFTS = 2  # half waves of a drift, beside a constant
LIKE_A_DAY = 0.05  # relative: by how much a period may miss a day in a record of some days

WHITE = (
    "noise is correlated: intervals are too narrow. Estimate its correlation, sigma={{'{name}': Noise(rho='estimate')}}"
)
# What a signal speaks for, by the beginning of its name.
SPEAKS = {
    "a constant": "a bias of the sensor, or a constant input, is missing",
    "the prediction": "a gain is wrong",
    "the rate of change": "the sensor or an input is late",
    "the direction of its rate": "dry friction or backlash is missing",
    "the sign of the prediction": "dry friction is missing",
    "the rate times its size": "a drag that grows with the square of the speed is missing",
    "the input": "this input acts on the sensor, or passes through something that the model lacks",
    "time": SLOW,
    "the square of time": SLOW,
    "a drift": "a gain drifts, or damping and friction differ from the model's",
    "": "a law is not linear where the model's is, or its form is another",
}


class Description(NamedTuple):
    """A clause about residuals; −n ln(1 − R²) less the price of its numbers; and what it speaks for."""

    clause: str
    worth: float
    speaks: str


def described(fit: "Estimate", left: Leftover) -> list[Description]:
    """The best description of the residuals, and those that speak for something else of which the data hardly say that
    they are worse."""
    judge = Judge.of(fit, left)
    kinds = [_signals(fit, left), _steps(fit, left, judge), _waves(fit, left, judge)]
    if isinstance(fit.objective.predictor, Runs) and len(fit.system.plan.states) <= WIDEST:
        model = Linearized.of(fit.objective, fit.point)
        if model is not None:
            kinds += [laws(model), readings(model, fit), inputs(model, fit), disturbances(model)]
    found = [_correlations(fit, left, judge)]
    found += [_weighed(judge, list(kind)) for kind in kinds]
    by_worth = sorted((one for kind in found for one in kind), key=lambda one: -one.worth)
    rivals: dict[str, Description] = {}
    for one in by_worth:
        if one.worth > by_worth[0].worth - CLOSE:
            rivals.setdefault(one.speaks, one)
    return list(rivals.values())[:RIVALS]


def _weighed(judge: Judge, changes: Sequence[Change]) -> list[Description]:
    return [
        Description(
            one.clause,
            _worth(judge, judge.explained(one.columns)[0], one.numbers) - 2 * np.log(len(changes)),
            one.speaks,
        )
        for one in changes
    ]


def _worth(judge: Judge, explained: float, numbers: int) -> float:
    n = np.count_nonzero(judge.judged)
    share = min(explained / judge.whole, 1 - 1e-12) if judge.whole > 0 else 0.0
    return float(-n * np.log1p(-share) - numbers * np.log(n))


def _signals(fit: "Estimate", left: Leftover) -> Iterator[Change]:
    """Signals that outputs follow."""
    for one in left.signals:
        name = _name(fit, one.at[0])
        for label, column in zip(one.names, one.each.T, strict=True):
            speaks = next(text for start, text in SPEAKS.items() if label.startswith(start))
            yield Change(f"'{name}' follows {label}", speaks, _column(left, one.at, column), 1)


def _steps(fit: "Estimate", left: Leftover, judge: Judge) -> Iterator[Change]:
    """Outputs that jump within a record."""
    for one in left.series:
        if len(one.at) <= 2 * EDGE:
            continue
        place, t = _step(judge.residual[one.at]), _times(fit, one)
        later = np.arange(len(one.at)) >= place
        columns = [_column(left, one.at, part.astype(float)) for part in (~later, later)]
        yield Change(
            f"'{_name(fit, one.at[0])}' steps at t = {t[place]:.4g}{_of(fit, one)}",
            f"a bias stepped, or something was switched that the model does not know: cut the record there, "
            f"Experiment.window(start, {t[place]:.4g}), or look what happened",
            np.concatenate(columns, axis=1), 3,
        )  # fmt: skip


def _waves(fit: "Estimate", left: Leftover, judge: Judge) -> Iterator[Change]:
    """Outputs with a period, or that drift slowly."""
    for j in left.by_output:
        series = [one for one in left.series if one.output == j and len(one.at) > 2 * EDGE]
        if not series:
            continue
        name = fit.objective.stacked.outputs[j]
        period = _period(judge, series, _times(fit, series[0]))
        alike = [one for one in series if len(one.at) == len(series[0].at)]
        is_day = abs(period - DAY) < LIKE_A_DAY * DAY
        speaks = DAILY if is_day else "a mode, or a disturbance, of this period is missing"
        columns = [
            _column(left, one.at, wave(2 * np.pi * _times(fit, one) / period))
            for one in alike
            for wave in (np.sin, np.cos)
        ]
        yield Change(
            f"'{name}' has a period of {period:.4g} s{' (a day)' if is_day else ''}", speaks,
            np.concatenate(columns, axis=1), 2 * len(alike) + 1,
        )  # fmt: skip
        slow = [_column(left, one.at, wave) for one in series for wave in _half_waves(len(one.at)).T]
        yield Change(f"'{name}' drifts slowly", SLOW, np.concatenate(slow, axis=1), len(slow))


def _correlations(fit: "Estimate", left: Leftover, judge: Judge) -> list[Description]:
    """Outputs whose noise is of first order."""
    found = []
    for j in left.by_output:
        series = [one for one in left.series if one.output == j]
        one, two = (_correlation(judge.residual, series, lag) for lag in (1, 2))
        # The standard error of what lag two has beyond the square of lag one (Bartlett 1946).
        unsure = (1 - one**2) / np.sqrt(sum(len(part.at) for part in series))
        if abs(two - one**2) < 0.5 * abs(one) * (1 - one) + unsure:
            name = fit.objective.stacked.outputs[j]
            own = sum(float(np.sum(judge.residual[one.at] ** 2)) for one in series)
            clause = f"'{name}' has neighbours that correlate by {one:.2f}"
            found.append(Description(clause, _worth(judge, one**2 * own, 1), WHITE.format(name=name)))
    return found


def _name(fit: "Estimate", row: int | np.integer) -> str:
    return fit.objective.stacked.outputs[fit.objective.rows[2][row]]


def _column(left: Leftover, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = np.zeros((len(left.scores), 1))
    out[at, 0] = values
    return out


def _correlation(u: Float[np.ndarray, " m"], series: Sequence[Series], lag: int) -> float:
    """The correlation of residuals so many samples apart. That of noise of first order is ρ, ρ², …; that of a misfit
    under white noise hardly falls from the first to the second, and that of a smooth one falls more and more."""
    both = sum(float(u[one.at][lag:] @ u[one.at][:-lag]) for one in series)
    return both / max(sum(float(u[one.at] @ u[one.at]) for one in series), np.finfo(float).tiny)


def _times(fit: "Estimate", one: Series) -> Float[np.ndarray, " n"]:
    return fit.objective.stacked.times[one.experiment, fit.objective.rows[1][one.at]]


def _of(fit: "Estimate", one: Series) -> str:
    labels = fit.objective.stacked.labels
    return f" of {labels[one.experiment]}" if len(labels) > 1 else ""


def _step(u: Float[np.ndarray, " n"]) -> int:
    """The first place of the second of two means that explain most."""
    n, sums = len(u), np.cumsum(u)
    k = np.arange(EDGE, n - EDGE + 1)
    explained = sums[k - 1] ** 2 / k + (sums[-1] - sums[k - 1]) ** 2 / (n - k)
    return int(k[np.argmax(explained)])


def _half_waves(n: int) -> Float[np.ndarray, "n k"]:
    """A constant, and cosines of 1, 2, … half periods."""
    return np.cos(np.pi * np.outer(np.arange(n) + 0.5, np.arange(1 + DRIFTS)) / n)


def _period(judge: Judge, series: Sequence[Series], times: np.ndarray) -> float:
    """The period of the highest peak that the series with as many samples as the first one have in common."""
    alike = [one for one in series if len(one.at) == len(series[0].at)]
    power = sum(periodogram(judge.residual[None, one.at])[0] for one in alike)
    length = np.ptp(times) * len(times) / (len(times) - 1)
    return float(FINE * length / (np.argmax(power) + 1))
