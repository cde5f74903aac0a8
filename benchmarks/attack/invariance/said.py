"""What the package says of a model, and whether two sayings are alike."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalSystem, simulate
from jaxonomy_dae.errors import InitializationError, ModelError, SimulationError, SteadyStateError

from ..judge import TooLong
from ..outcome import Outcome
from .sketch import Sketch, diagram_of

REFUSALS = (ModelError, InitializationError, SimulationError, SteadyStateError, eqx.EquinoxRuntimeError)
POINT = 1e-9  # of a variable's size: what a point may differ by
FAINT = 1e-3  # of the largest value that is compared with it: a variable's size, at least
TOLERANCES: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-11}  # of runs; what they may differ by:
ALONG = 2e-6  # of a variable's size


@dataclasses.dataclass(frozen=True)
class Said:
    """Numbers by name; or why there are none: the class of an error of the package, and its text."""

    values: Mapping[str, np.ndarray]
    refusal: str = ""
    text: str = ""


def said(values: Callable[[], Mapping[str, Any]]) -> Said:
    """What comes out, or the refusal. Errors that are not the package's pass through."""
    try:
        return Said({name: np.asarray(value) for name, value in values().items()})
    except REFUSALS as error:
        kind = "run time" if isinstance(error, eqx.EquinoxRuntimeError) else type(error).__name__
        return Said({}, kind, f"{kind}: {error}")


def compiled(sketch: Sketch) -> AcausalSystem:
    """The system of a sketch."""
    return AcausalCompiler(*diagram_of(sketch))()


def at_start(system: AcausalSystem, names: Mapping[str, str], initial: Mapping[str, float] | None = None, t0=0.0):
    """All variables at the start, and derivatives of the states, by symbols' names. `names`: full ones by those."""
    x = system.initialize(t0, initial=initial)
    full = list(names.values())

    def both(system, x):
        return system.observe(full, t0, x), system.vector_field(t0, x)

    values, rates = jax.jit(both)(system, x)
    out = dict(zip(names, np.asarray(values), strict=True))
    back = {f: n for n, f in names.items()}
    for state, slope in zip(system.states, np.asarray(rates), strict=False):
        sign, bare = (-1.0, state[1:]) if state.startswith("-") else (1.0, state)
        if bare in back:
            out[f"{back[bare]}'"] = sign * slope
    return out


def along(
    system: AcausalSystem,
    names: Mapping[str, str],
    ts: np.ndarray,
    end: float,
    inputs: Mapping[str, Any],
    **options: Any,
) -> dict[str, np.ndarray]:
    """All variables at the times `ts` of a run."""
    solution = simulate(system, end, ts=ts, inputs=inputs, **TOLERANCES | options)
    return {name: np.asarray(solution[full]) for name, full in names.items()}


def unknowns_of(sketch: Sketch) -> dict[str, str]:
    """Full names of all unknowns."""
    full = sketch.names()
    return {name: full[name] for name in sketch.variables()}


def variables_of(sketch: Sketch) -> dict[str, str]:
    """Full names of all unknowns and discrete variables."""
    full = sketch.names()
    return {d.name: full[d.name] for d in sketch.declared("variable", "discrete")}


def inputs_of(sketch: Sketch) -> dict[str, Any]:
    """What `simulate` is given."""
    full = sketch.names()
    return {full[name]: value for name, value in sketch.inputs.items()}


def times(rng: np.random.Generator, end: float, count: int = 6) -> np.ndarray:
    """Times inside a run at which nothing is likely to happen; the last is its end."""
    ts = np.sort(rng.uniform(0.03, 0.97, count)) * end
    ts[-1] = end
    return ts


def difference(
    one: Said,
    other: Said,
    allowed: float,
    scales: Mapping[str, float] | None = None,
    sizes: Mapping[str, float] | None = None,
) -> tuple[float, str]:
    """What two sayings differ by, in units of what is allowed, and where.

    **Arguments:**

    - `scales`: values of `other` times these are values of `one`, by name; 1 where there is none.
    - `sizes`: typical sizes by name, of `one`: differences that are small beside them do not count.
    """
    scales, sizes = scales or {}, sizes or {}
    if bool(one.refusal) != bool(other.refusal):
        return np.inf, f"one: {one.text or 'accepted'}; other: {other.text or 'accepted'}"
    if one.refusal:
        return (0.0 if one.refusal == other.refusal else np.inf), f"one: {one.text}; other: {other.text}"
    worst, where = 0.0, ""
    for name, values in one.values.items():
        if name not in other.values:
            continue
        others = other.values[name] * scales.get(name, 1.0)
        bare = name.rstrip("'")
        size = max(sizes.get(bare, 1.0) * FAINT, float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values))))
        if values.shape != others.shape:
            return np.inf, f"{name}: shapes {values.shape} and {others.shape}"
        same = (values == others) | (np.isnan(values) & np.isnan(others))
        with np.errstate(invalid="ignore"):
            off = np.where(same, 0.0, np.abs(values - others) / (allowed * size))
        off = np.where(np.isnan(off), np.inf, off)
        at = int(np.argmax(off)) if off.size else 0
        if off.size and off.flat[at] > worst:
            worst = float(off.flat[at])
            where = f"{name}[{at}]: {values.flat[at]!r} and {others.flat[at]!r}"
    return worst, where


class Pairs:
    """The outcomes of pairs, one after the other, with the processor time since the one before."""

    def __init__(self, letter: str, note: str):
        self.letter, self.note, self.outcomes = letter, note, []
        self._since = time.process_time()

    def add(self, what: str, off: float, where: str, refused: bool = False) -> None:
        now = time.process_time()
        kind = "wrong" if not off <= 1.0 else "refused" if refused else "right"
        self.outcomes.append(Outcome(kind, off, f"{what}: {where}", now - self._since, self.letter))
        self._since = now

    def compare(self, what: str, one: Said, other: Said, allowed: float, **how: Any) -> None:
        """Adds a pair of sayings."""
        off, where = difference(one, other, allowed, **how)
        self.add(what, off, where, bool(one.refusal and other.refusal))

    def crashed(self, what: str, error: BaseException) -> None:
        """Adds a pair of which one ended in an error that is not the package's."""
        self.outcomes.append(Outcome("crashed", np.inf, f"{what}: {type(error).__name__}: {error}", 0.0, self.letter))

    def attempt(self, what: str, pair: Callable[[], None]) -> None:
        """Calls what adds a pair."""
        try:
            pair()
        except TooLong:
            raise
        except Exception as error:
            self.crashed(what, error)
