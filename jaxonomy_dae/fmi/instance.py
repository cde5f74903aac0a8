"""One instance of a foreign FMU, driven in the order that the standard prescribes, for FMI 2.0 and 3.0."""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .described import Described

DISCARD = 2  # the status of a point at which the equations have no solution
AT_ONCE = 64.0  # spacings of floating-point numbers: a time event that is so near is now


class Update(NamedTuple):
    """What an event left: whether the run ends, whether states have changed, and the time of the next event, if one is
    known."""

    ended: bool
    changed: bool
    due: float | None


class Instance:
    """An instance between events, or before its first start."""

    def __init__(self, described: Described, parameters: Sequence[str], outputs: Sequence[str]):
        self.described, self.model = described, described.new_instance()
        references = described.reference
        self._parameters = list(map(references, parameters))
        self._inputs = list(map(references, described.inputs))
        self._states = list(map(references, described.states))
        self._read = [*described.slopes, *outputs]
        self._of_type: dict[str, list[int]] = {}
        for k, name in enumerate(self._read):
            self._of_type.setdefault(described.type_of(name), []).append(k)
        self._used = False
        self.update = Update(False, False, None)
        self.after = np.zeros(0)  # the states after the last event
        self.n_indicators = 0

    # --- modes ------------------------------------------------------------------------------------------------------

    def start(self, parameters: Sequence[float], t: float, u: Sequence[float] | np.ndarray) -> None:
        """Starts anew at t. Parameters are set before the start, as fixed ones must be, and inputs during it: the
        states at the start may depend on them."""
        if self._used:
            self.model.reset()
        self._used = True
        if self.described.version == 2:
            self.model.setupExperiment(startTime=t)
        if len(parameters):
            self._set_reals(self._parameters, parameters)
        if self.described.version == 2:
            self.model.enterInitializationMode()
        else:
            self.model.enterInitializationMode(startTime=t)
        if len(u):
            self._set_reals(self._inputs, u)
        self.model.exitInitializationMode()
        if not self.n_indicators:
            self.n_indicators = self._count_indicators()
        self._settle()

    def _settle(self) -> None:
        """Iterates what happens at this instant, and goes on in continuous time."""
        ended = changed = False
        while True:
            step = self.model.updateDiscreteStates if self.described.version == 3 else self.model.newDiscreteStates
            again, ends, _, moved, has_next, due = step()
            ended, changed = ended or bool(ends), changed or bool(moved)
            if not again or ended:
                break
        self.model.enterContinuousTimeMode()
        self.update = Update(ended, changed, float(due) if has_next else None)
        self.after = self.states()

    def place(self, t: float, x: np.ndarray, u: np.ndarray) -> None:
        """Moves to a point in continuous time."""
        self.model.setTime(float(t))
        if len(x):
            x = np.ascontiguousarray(x, float)
            self.model.setContinuousStates(_pointer(x), len(x))
        if len(u):
            self._set_reals(self._inputs, u)

    def happen(self) -> None:
        """What happens at the present point."""
        self.model.enterEventMode()
        self._settle()

    def is_due(self, t: float) -> bool:
        """True if a time event is due at t, up to rounding."""
        due = self.update.due
        return due is not None and t >= due - AT_ONCE * np.finfo(float).eps * max(abs(t), abs(due))

    # --- values -----------------------------------------------------------------------------------------------------

    def states(self) -> np.ndarray:
        """The states, shape (states,)."""
        return self._filled(self.model.getContinuousStates, len(self._states))

    def values(self) -> np.ndarray:
        """The states' derivatives and the outputs, shape (states + outputs,); not-a-number where the equations have no
        solution."""
        out = np.zeros(len(self._read))
        for kind, places in self._of_type.items():
            references = [self.described.reference(self._read[k]) for k in places]
            whole = "Integer" if self.described.version == 2 else "Int64"
            suffix = whole if kind == "Enumeration" else kind
            try:
                out[places] = getattr(self.model, f"get{suffix}")(references)
            except Exception as error:
                if getattr(error, "status", None) != DISCARD:
                    raise
                out[places] = np.nan
        return out

    def indicators(self) -> np.ndarray:
        """The event indicators, shape (indicators,)."""
        return self._filled(self.model.getEventIndicators, self.n_indicators)

    def directional(self, names: Sequence[str], known: str) -> list[float]:
        """The derivatives of variables by one."""
        references = [self.described.reference(n) for n in names]
        return self.model.getDirectionalDerivative(references, [self.described.reference(known)], [1.0])

    def _filled(self, get: Callable[[Any, int], Any], n: int) -> np.ndarray:
        out = np.zeros(n)
        if not n:
            return out
        try:
            get(_pointer(out), n)
        except Exception as error:
            if getattr(error, "status", None) != DISCARD:
                raise
            out[:] = np.nan
        return out

    def _set_reals(self, references: Sequence[int], values: Sequence[float] | np.ndarray) -> None:
        given = [float(v) for v in values]
        (self.model.setFloat64 if self.described.version == 3 else self.model.setReal)(references, given)

    def _count_indicators(self) -> int:
        if self.described.version == 2 or not self.described.has_indicators:
            return self.described.n_indicators_said
        count = ctypes.c_size_t()
        self.model.fmi3GetNumberOfEventIndicators(self.model.component, ctypes.byref(count))
        return count.value

    # --- the state of the whole FMU ---------------------------------------------------------------------------------

    def save(self) -> tuple[Any, ...]:
        """The whole state, discrete variables included."""
        return self.model.getFMUState(), self.update, self.after

    def restore(self, saved: tuple[Any, ...]) -> None:
        state, self.update, self.after = saved
        self.model.setFMUState(state)

    def forget(self, saved: tuple[Any, ...]) -> None:
        self.model.freeFMUState(saved[0])


def _pointer(x: np.ndarray) -> Any:
    return x.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
