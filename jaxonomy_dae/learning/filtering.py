"""Errors in the equations, for `Problem(method=...)`: process noise, or what was measured fed back.

A settings object is turned into what the program is built from (`Structure`, names and places alone) and into the
coordinates that come with it (with guesses that the data suggest).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from ..base.errors import ModelError, explained, nearest, whole_number
from ..run.system.inputs import CURVED
from ..run.system.system import AcausalSystem
from .coordinates import Coordinate
from .data import Stacked
from .experiment import ESTIMATE, Unknown
from .linear_models import is_linear
from .priors import is_finite

Level: TypeAlias = float | str | Unknown  # a number, "estimate", or where its search begins

FAR = 1e6  # how far, as a factor, a level may move from its guess: beyond, it counts as none, or as a bad guess
HIDDEN = 0.1  # guessed noise of a state that was not measured, relative to measured ones, each in units of its size


@explained
@dataclasses.dataclass(frozen=True)
class Filter:
    """Process noise, for `Problem(method=...)`: the equations hold up to white noise,

        dx = f(x, u + ν, t) dt + σ dw,    y = h(x, u, t) + e,

    and the likelihood is that of the one-step prediction errors of a continuous-discrete extended Kalman filter
    (Jazwinski 1970, section 8.3; Kristensen, Madsen & Jørgensen 2004, Automatica 40:225, equations 8 to 17). For linear
    models it is exact.

    - `noise`: by names of states, σ in the state's unit per √second; by names of inputs, the intensity of white noise ν
        that is added to the input, in the input's unit times √second: a force on a mechanism, whose constraints then
        hold exactly. Each is a number, `"estimate"`, or `Unknown(guess)`. An `Unknown` is estimated, and its `spread`
        is the relative standard deviation of a prior. The name of an array stands for each of its entries.
    - `substeps`: the number of parts between two samples. The flow and its derivatives are exact at any distance. The
        integral of the noise assumes a constant Jacobian over each part.

    Starts that are `Unknown(guess, spread)` get the normal prior of a Kalman filter and are not searched. Starts
    without a spread are estimated. Estimated noise levels of measurements are coordinates, too.
    """

    noise: Mapping[str, Level]
    substeps: int = 1

    def __post_init__(self):
        if not isinstance(self.noise, Mapping) or not self.noise:
            raise ModelError(
                f"Filter: noise is a dictionary by names of states, {{'room.T': 0.05}}; got {self.noise!r}"
            )
        for name, value in self.noise.items():
            _check(f"Filter: noise of '{name}'", value, positive=True)
        object.__setattr__(self, "substeps", whole_number(self.substeps, "Filter: substeps"))


@explained
@dataclasses.dataclass(frozen=True)
class Innovations:
    """Predictions one step ahead, for `Problem(method=...)`: each sample moves the states by a constant gain K times
    the prediction error (the prediction-error form; Ljung 1999, System Identification, section 4.3),

        x ← x + K (y − ŷ),

    and the sum of squared prediction errors is minimized. The gain does not follow from noise levels as in a filter.
    But no covariance is needed, and a step costs as much as in a simulation.

    - `gain`: `"estimate"` for all differential states and outputs; or for pairs of names (state, output) a number,
        `"estimate"` or `Unknown(guess, spread)`. All other entries of K are zero.
    """

    gain: Mapping[tuple[str, str], Level] | str = ESTIMATE

    def __post_init__(self):
        if isinstance(self.gain, str) and self.gain == ESTIMATE:
            return
        by_pairs = isinstance(self.gain, Mapping) and all(isinstance(k, tuple) and len(k) == 2 for k in self.gain)
        if not by_pairs or not self.gain:
            raise ModelError(
                "Innovations: gain is 'estimate', or a dictionary by pairs (state, output), "
                f"{{('room.T', 'room.T'): 'estimate'}}; got {self.gain!r}"
            )
        assert not isinstance(self.gain, str)
        for (state, output), value in self.gain.items():
            _check(f"Innovations: gain of '{state}' by '{output}'", value, positive=False)


def _check(what: str, value: object, positive: bool) -> None:
    """A number, "estimate" or an `Unknown`."""
    if isinstance(value, str) and value == ESTIMATE:
        return
    number = value.guess if isinstance(value, Unknown) else value
    if is_finite(number) and not isinstance(number, bool) and (number > 0 or not positive):
        return
    needed = "a number > 0" if positive else "a finite number"
    raise ModelError(f"{what} is {needed}, 'estimate' or Unknown(guess); got {value!r}")


@dataclasses.dataclass(frozen=True)
class Structure:
    """The static choices from which a filter's program is built.

    - `noise`: of each intensity, the place in the state array and the factor of the variable named; or the name of an
        input, and 1.
    - `sigma`: the outputs whose noise level is a coordinate.
    - `gain`: (place in the state array, output, factor) of each entry of a constant gain.
    - `substeps`: how many parts the time between samples has.
    - `is_linear`: whether the flow is a matrix exponential.
    - `is_drawn`: whether samples are told as what they deviate by from their prediction, in standard deviations, so
        that the record is one that the model itself might have made.
    """

    noise: tuple[tuple[int | str, float], ...] = ()
    sigma: tuple[int, ...] = ()
    gain: tuple[tuple[int, int, float], ...] = ()
    substeps: int = 1
    is_linear: bool = False
    is_drawn: bool = False

    @property
    def is_filter(self) -> bool:
        """True if a covariance is propagated."""
        return bool(self.noise)


def structure_and_extras(
    method: Filter | Innovations, system: AcausalSystem, stacked: Stacked
) -> tuple[Structure, tuple[Coordinate, ...]]:
    """Returns (the static choices of the program, its coordinates beside those of the problem).

    **Raises:**

    - `ModelError` for names that are not those of differential states or outputs.
    """
    linear = is_linear(system) and not {*dict(stacked.kinds).values()} & {*CURVED}
    units = dict(zip(system.plan.flat.variables.names, system.plan.flat.variables.unit, strict=True))
    if isinstance(method, Innovations):
        gains = _gains(method, system, stacked)
        sizes = [abs(float(system.plan.nominal[p]) * f) / _size(stacked, j) for _, _, p, j, f in gains]
        pairs = zip(gains, sizes, strict=True)
        extras = [_extra(name, "", value, 0.0, size, log=False) for (name, value, *_), size in pairs]
        return Structure(gain=tuple((p, j, f) for _, _, p, j, f in gains), is_linear=linear), tuple(extras)
    noise = _noise(method, system)
    guesses = _intensities(system, stacked, [place for _, _, place, _ in noise])
    extras = []
    for name, value, place, factor in noise:
        unit = _noise_unit(place, units.get(name, ""))
        extras.append(_extra(f"noise of {name}", unit, value, guesses[place] * abs(factor), 1.0, log=True))
    unknown = stacked.estimated & stacked.observed.any(axis=1)
    estimated = tuple(np.flatnonzero(unknown.any(axis=0)).tolist())
    for j in estimated:
        name = stacked.outputs[j]
        guess = 0.5 * _increments(stacked, j)[0]
        extras.append(_extra(f"sigma of {name}", units.get(name, ""), ESTIMATE, guess, 1.0, log=True))
    places = tuple((place, factor) for _, _, place, factor in noise)
    return Structure(noise=places, sigma=estimated, substeps=method.substeps, is_linear=linear), tuple(extras)


def check_model(method: Filter | Innovations, system: AcausalSystem) -> None:
    """Raises a `ModelError` for models that cannot be followed sample by sample."""
    what, plan = type(method).__name__, system.plan
    if system.discretes:
        raise ModelError(
            f"{what}: '{system.discretes[0]}' is a discrete variable, which is not normal and which no measurement "
            "corrects: use method='single' or 'growing'"
        )
    plan.refuse_delays(f"{what} corrects states, and not the past: use method='single' or 'growing'")
    if plan.held is not None:
        raise ModelError(
            f"{what}: constraints of this model come and go with its modes, and its degrees of freedom with them: use "
            "method='single' or 'growing'"
        )
    if isinstance(method, Filter) and plan.events is not None:
        raise ModelError(
            f"Filter: relations or events of this model ({plan.events.names[0]}) would need second derivatives through "
            "events, which are not computed: leave relations that only bend alone with smooth(...), or use Innovations"
        )
    if plan.events is not None and (plan.events.state >= 0).any():
        raise ModelError(
            f"{what}: events of this model write states ({plan.events.names[0]}), and a correction may carry a state "
            "past the event: use method='single' or 'growing'"
        )


def _noise(method: Filter, system: AcausalSystem) -> list[tuple[str, Level, int | str, float]]:
    """(name, value, place, factor) of each intensity, those of arrays by their entries."""
    found: list[tuple[str, Level, int | str, float]] = []
    for name, value in method.noise.items():
        for one in system.plan.entry_names([name]):
            is_input = one in system.plan.inputs.place
            place, factor = (one, 1.0) if is_input else _state(system, one, "Filter: noise")
            double = [other for other, _, p, _ in found if p == place]
            if double:
                raise ModelError(f"Filter: noise of '{one}' is given twice, also as that of '{double[0]}'")
            found.append((one, value, place, factor))
    return found


def _gains(method: Innovations, system: AcausalSystem, stacked: Stacked) -> list[tuple[str, Level, int, int, float]]:
    """(name, value, place, output, factor) of each entry of K."""
    given = method.gain
    if isinstance(given, str):
        given = {(state, output): ESTIMATE for state in system.states for output in stacked.outputs}
    found: list[tuple[str, Level, int, int, float]] = []
    for (state, output), value in given.items():
        place, factor = _state(system, state, "Innovations: gain")
        if output not in stacked.outputs:
            raise ModelError(f"Innovations: there are no data of '{output}': " + nearest(output, stacked.outputs))
        name, j = f"gain of {state} by {output}", stacked.outputs.index(output)
        double = [other for other, _, p, k, _ in found if (p, k) == (place, j)]
        if double:
            raise ModelError(f"Innovations: the {name} is given twice, also as the {double[0]}")
        found.append((name, value, place, j, factor))
    return found


def _state(system: AcausalSystem, name: str, what: str) -> tuple[int, float]:
    """The place of a variable in the state array, and its factor."""
    plan = system.plan
    if name not in plan.variable_index:
        raise ModelError(f"{what}: '{name}' is not a variable: " + nearest(name, system.states))
    quantity, factor = plan.resolve([name])
    place = np.flatnonzero(plan.states == quantity[0])
    if not len(place):
        known = ", ".join(repr(s) for s in system.states[:8])
        raise ModelError(f"{what}: '{name}' is not a differential state of the compiled system; these are: {known}")
    return int(place[0]), float(factor[0])


def _extra(name: str, unit: str, value: Level, guess: float, size: float, *, log: bool) -> Coordinate:
    known = not isinstance(value, Unknown | str)
    spread = math.inf
    if isinstance(value, Unknown):
        guess = float(value.guess)
        spread = math.inf if value.spread is None else float(value.spread) / (1.0 if log else size)
    elif not isinstance(value, str):
        guess = float(value)
    low, high = (guess / FAR, guess * FAR) if log else (-math.inf, math.inf)
    centre = math.log(guess) if log else guess / size
    return Coordinate(
        name, unit, name, False, log, size, guess, low=low, high=high, spread=spread, fixed=known, centre=centre
    )


def _noise_unit(place: int | str, unit: str) -> str:
    if isinstance(place, str):
        return f"{unit}*s^0.5" if unit else "s^0.5"
    return f"{unit}/s^0.5" if unit else "1/s^0.5"


def _increments(stacked: Stacked, j: int) -> tuple[float, float]:
    """Two root mean squares: of the changes of an output from one sample to the next, and of these changes divided by
    the root of the time between."""
    steps, rates, often = [], [], []
    for k in _fitted(stacked):
        seen = stacked.observed[k, :, j]
        change, dt = np.diff(stacked.values[k, seen, j]), np.diff(stacked.times[k, seen])
        steps.append(change)
        rates.append(change / np.sqrt(dt))
        often.append(np.full(len(dt), stacked.weight[k]))
    step, rate, count = np.concatenate(steps), np.concatenate(rates), np.concatenate(often)
    least = 1e-3 * _size(stacked, j)
    if not len(step):
        return least, least
    found = (float(np.sqrt(np.average(a**2, weights=count))) for a in (step, rate))
    first, second = (max(value, least) for value in found)
    return first, second


def _fitted(stacked: Stacked) -> list[int]:
    """The experiments that are fitted."""
    return np.flatnonzero(~stacked.holdout & (stacked.weight > 0)).tolist()


def _size(stacked: Stacked, j: int) -> float:
    return float(np.max(np.abs(stacked.values[_fitted(stacked), :, j]), initial=0.0)) or 1.0


def _intensities(system: AcausalSystem, stacked: Stacked, places: list[int | str]) -> dict[int | str, float]:
    """Guesses of intensities: half of what a measured state changes by per √time, and for others, a part of it; of an
    input, a part of its size."""
    plan = system.plan
    found: dict[int | str, float] = {}
    nominal = np.asarray(plan.nominal, float)
    for j, name in enumerate(stacked.outputs):
        if name not in plan.variable_index:
            continue
        quantity, factor = plan.resolve([name])
        for place in np.flatnonzero(plan.states == quantity[0]).tolist():
            found[place] = 0.5 * _increments(stacked, j)[1] / abs(float(factor[0]))
    seen = np.any(stacked.observed, axis=2)
    fitted = [k for k in _fitted(stacked) if seen[k].any()]
    ends = [stacked.times[k, seen[k]][-1] - stacked.t0[k] for k in fitted]
    span, rows = max(ends, default=0.0) or 1.0, max((int(seen[k].sum()) for k in fitted), default=1)
    known = [found[p] / nominal[p] for p in found]
    typical = float(np.mean(known)) if known else HIDDEN / math.sqrt(span)
    for place in places:
        if isinstance(place, str):
            given = place in stacked.inputs
            size = float(np.max(np.abs(stacked.inputs[place][1][fitted]), initial=0.0)) if given else 0.0
            found[place] = HIDDEN * (size or 1.0) * math.sqrt(span / rows)
        elif place not in found:
            found[place] = HIDDEN * typical * float(nominal[place])
    return found
