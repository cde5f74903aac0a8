"""Functional Mock-up Units: opened, driven and differentiated through FMPy."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed (extra fmi)")


class Opened:
    """An instance of an FMU, after initialization, in event mode."""

    def __init__(self, path: Path, starts: dict[str, float] | None = None, t0: float = 0.0, initialize: bool = True):
        from fmpy.fmi3 import FMU3Model

        self.description = fmpy.read_model_description(str(path))
        self.messages: list[str] = []
        self._folder = fmpy.extract(str(path))
        self.reference = {v.name: v.valueReference for v in self.description.modelVariables}
        self.model: Any = FMU3Model(
            guid=self.description.guid,
            unzipDirectory=self._folder,
            modelIdentifier=self.description.modelExchange.modelIdentifier,
            instanceName="one",
        )
        self.model.instantiate(loggingOn=True)
        self.set(starts or {})
        if initialize:
            self.model.enterInitializationMode(startTime=t0)
            self.model.exitInitializationMode()
            self.update()

    def references(self, names: Sequence[str]) -> list[int]:
        return [self.reference[name] for name in names]

    def set(self, values: dict[str, float]) -> None:
        if values:
            self.model.setFloat64(self.references(list(values)), [float(v) for v in values.values()])

    def get(self, *names: str) -> np.ndarray:
        return np.array(self.model.getFloat64(self.references(names)))

    def update(self) -> tuple:
        found = self.model.updateDiscreteStates()
        while found[0]:
            found = self.model.updateDiscreteStates()
        return found

    def forward(self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float]) -> np.ndarray:
        return np.array(
            self.model.getDirectionalDerivative(
                self.references(unknowns), self.references(knowns), list(map(float, seed)), len(unknowns)
            )
        )

    def reverse(self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float], n: int) -> np.ndarray:
        return np.array(
            self.model.getAdjointDerivative(
                self.references(unknowns), self.references(knowns), list(map(float, seed)), n
            )
        )

    def close(self) -> None:
        import shutil

        self.model.freeInstance()
        shutil.rmtree(self._folder, ignore_errors=True)


@contextlib.contextmanager
def opened(path: Path, *args: Any, **options: Any) -> Iterator[Opened]:
    fmu = Opened(path, *args, **options)
    try:
        yield fmu
    finally:
        fmu.close()


def problems(path: Path) -> list[str]:
    """What FMPy finds wrong with an FMU."""
    from fmpy.validation import validate_fmu

    return validate_fmu(str(path))


def run(path: Path, t1: float, output: Sequence[str], rtol: float = 1e-9, **options: Any) -> Any:
    """A run by FMPy's CVode, or by the FMU itself: `fmi_type="CoSimulation"`."""
    given = {"output_interval": t1 / 50, "solver": "CVode", "fmi_type": "ModelExchange"} | options
    return fmpy.simulate_fmu(str(path), stop_time=t1, relative_tolerance=rtol, output=list(output), **given)
