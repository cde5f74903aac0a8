"""What residuals that are no noise look like, in one clause, and what that speaks for.

Simple descriptions compete: a signal that residuals follow, a step, a period, a drift, correlated neighbours. Each
explains a part R² of the sum of squares. The one is said whose likelihood ratio −n ln(1 − R²), less ln n for each
number that it takes (Schwarz 1978), is greatest.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from .leftover import FINE, Leftover, Series, periodogram

if TYPE_CHECKING:
    from .estimate import Estimate

EDGE = 4  # samples on each side of a step
DRIFTS = 2  # half waves of a drift, beside a constant
DAY = 86400.0  # s
LIKE_A_DAY = 0.05  # relative: by how much a period may miss a day in a record of some days

WHITE = (
    "noise is correlated: intervals are too narrow. Estimate its correlation, sigma={{'{name}': Noise(rho='estimate')}}"
)
SLOW = (
    "something slow acts that was not measured: let the equations err, method=learning.Filter(noise), or make it a "
    "parameter of each record"
)
# What a signal speaks for, by the beginning of its name.
SPEAKS = {
    "a constant": "a bias of the sensor, or a constant input, is missing",
    "the prediction": "a gain is wrong",
    "the rate of change": "the sensor or an input is late",
    "the direction of its rate": "dry friction or backlash is missing",
    "the sign of the prediction": "dry friction is missing",
    "the rate times its size": "a drag that grows with the square of the speed is missing",
    "the input": "this input acts otherwise than the model says: its gain, its delay, or what it passes through",
    "time": SLOW,
    "the square of time": SLOW,
    "a drift": "a gain drifts, or damping and friction differ from the model's",
    "": "a law is not linear where the model's is, or its form is another",
}


class Description(NamedTuple):
    """A clause about an output's residuals; −n ln(1 − R²) less the price of its numbers; and what it speaks for."""

    clause: str
    worth: float
    speaks: str


def described(fit: "Estimate", left: Leftover) -> Description:
    """The best description of the residuals of the output that it describes best."""
    found = []
    for j in left.by_output:
        found.extend(_descriptions(fit, left, j))
    return max(found, key=lambda one: one.worth)


def _descriptions(fit: "Estimate", left: Leftover, output: int) -> list[Description]:
    series = [one for one in left.series if one.output == output]
    name, at = fit.objective.stacked.outputs[output], left.by_output[output]
    u = np.where(left.outliers, 0.0, left.scores)
    n, whole = len(at), float(np.sum(u[at] ** 2))
    found = []

    def add(clause: str, explained: float, numbers: float, speaks: str) -> None:
        share = min(explained / whole, 1 - 1e-12) if whole > 0 else 0.0
        found.append(Description(f"'{name}' {clause}", -n * np.log1p(-share) - numbers * np.log(n), speaks))

    own = next(one for one in left.signals if one.at[0] in at)
    for label, column in zip(own.names, own.each.T, strict=True):
        speaks = next(text for start, text in SPEAKS.items() if label.startswith(start))
        add(f"follows {label}", float(u[own.at] @ column) ** 2, 1, speaks)
    one, two = (_correlation(u, series, lag) for lag in (1, 2))
    if abs(two - one**2) < 0.5 * abs(one) * (1 - one):
        text = WHITE.format(name=name)
        add(f"has neighbours that correlate by {one:.2f}", one**2 * whole, 1, text)
    times = [_times(fit, one) for one in series]
    for one, t in zip(series, times, strict=True):
        if len(t) <= 2 * EDGE:
            continue
        explained, place = _step(u[one.at])
        add(
            f"steps at t = {t[place]:.4g}{_of(fit, one)}", explained, 3,
            f"a bias stepped, or something was switched that the model does not know: cut the record there, "
            f"Experiment.window(start, {t[place]:.4g}), or look what happened",
        )  # fmt: skip
    if len(times[0]) > 2 * EDGE:
        found.append(_period(u, series, times, name, n, whole))
        waves = sum(float(np.sum((_half_waves(len(one.at)).T @ u[one.at]) ** 2)) for one in series)
        add("drifts slowly", waves, (1 + DRIFTS) * len(series), SLOW)
    return found


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


def _step(u: Float[np.ndarray, " n"]) -> tuple[float, int]:
    """(the sum of squares that two means explain beyond none, at best; the first place of the second)."""
    n, sums = len(u), np.cumsum(u)
    k = np.arange(EDGE, n - EDGE + 1)
    explained = sums[k - 1] ** 2 / k + (sums[-1] - sums[k - 1]) ** 2 / (n - k)
    best = int(np.argmax(explained))
    return float(explained[best]), int(k[best])


def _half_waves(n: int) -> Float[np.ndarray, "n k"]:
    """A constant, and cosines of 1, 2, … half periods, of length one."""
    waves = np.cos(np.pi * np.outer(np.arange(n) + 0.5, np.arange(1 + DRIFTS)) / n)
    return waves / np.linalg.norm(waves, axis=0)


def _period(
    u: np.ndarray, series: Sequence[Series], times: Sequence[np.ndarray], name: str, n: int, whole: float
) -> Description:
    """The highest peak that the series with as many samples as the first have in common."""
    alike = [k for k, one in enumerate(series) if len(one.at) == len(series[0].at)]
    power = sum(periodogram(u[None, series[k].at])[0] for k in alike)
    place = int(np.argmax(power))
    length = np.ptp(times[0]) * len(times[0]) / (len(times[0]) - 1)
    period = FINE * length / (place + 1)
    is_day = abs(period - DAY) < LIKE_A_DAY * DAY
    share = min(2 * float(np.max(power)) / whole, 1 - 1e-12)
    speaks = (
        "what comes and goes with the day (sun, people, tariffs) is missing: give it as an input"
        if is_day
        else "a mode, or a disturbance, of this period is missing"
    )
    clause = f"'{name}' has a period of {period:.4g} s{' (a day)' if is_day else ''}"
    return Description(clause, -n * np.log1p(-share) - (2 * len(alike) + 1) * np.log(n), speaks)
