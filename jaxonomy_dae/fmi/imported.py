"""An FMU as a component: its equations are calls of its binary, through FMPy."""

import re
import shutil
import threading
import weakref
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import sympy
from jax import Array

from ..base.errors import ModelError, nearest
from ..base.optional import optional_module
from ..write.component import Component
from ..write.environment import EqnEnv
from ..write.symbols import der
from .compilers import this_platform

STEP = 6e-6  # of central differences, in units of a variable's size: the cube root of the spacing of numbers


class FmuComponent(Component):
    """A Functional Mock-up Unit for Model Exchange, FMI 3.0, without events, as a component.

    Its states, outputs, inputs and parameters are this component's; names that are no identifiers have underscores in
    place of other letters (`names`). The field and the outputs are calls of the binary. Derivatives by states, inputs
    and time are the FMU's own directional derivatives where it has them, and central differences otherwise:
    `derivatives` says which. Those by parameters are central differences: an FMU may refuse others while it runs. So
    forward and reverse mode work; second derivatives are refused. Calls go to the host one after another, in batches,
    too.

    **Arguments:**

    - `path`: the file.
    - `outputs`: the names of outputs to read; None: all of them.
    - `parameters`: the names of the FMU's parameters that are parameters here; None: all scalar ones. Others keep the
        values that they start with.

    **Raises:**

    - `ModelError` for a file that does not exist, another version of FMI or platform, an FMU with events or without
        Model Exchange, and an unknown name.
    - `MissingPackage` without FMPy, which names the extra.
    """

    names: dict[str, str]
    derivatives: str

    def __init__(
        self, ev: EqnEnv, name: str, path: Any, *, outputs: Sequence[str] | None = None,
        parameters: Sequence[str] | None = None,
    ):  # fmt: skip
        super().__init__(ev, name)
        unit = _Unit(Path(path), f"{name}: ")
        outputs = unit.outputs if outputs is None else list(outputs)
        parameters = unit.parameters if parameters is None else list(parameters)
        for wanted, known, what in ((outputs, unit.outputs, "output"), (parameters, unit.parameters, "parameter")):
            for one in wanted:
                if one not in known:
                    raise ModelError(f"{name}: '{one}' is not a scalar {what} of the FMU: " + nearest(one, known))
        calls = _Calls(unit, outputs, parameters)
        self.derivatives = unit.derivatives
        self.names = {}

        def own(of_fmu: str) -> str:
            short = re.sub(r"\W+", "_", of_fmu).strip("_")
            short = f"_{short}" if short[:1].isdigit() else short
            if short in self.names.values():
                raise ModelError(f"{name}: two variables of the FMU would have the name '{short}'")
            self.names[of_fmu] = short
            return short

        values = calls.parameter_values
        p = [
            self.parameter(own(n), float(v), unit=unit.unit(n), bounds=unit.bounds(n))
            for n, v in zip(parameters, values, strict=True)
        ]
        begins = calls.starts_of(values)
        x = [
            self.variable(own(n), unit=unit.unit(n), nominal=unit.nominal(n), start=float(v), fixed=not parameters)
            for n, v in zip(unit.states, begins, strict=True)
        ]
        u = [self.input(own(n), default=unit.start(n)) for n in unit.inputs]
        # Functions read variables; these have the values of parameters.
        held = [self.variable(f"{self.names[n]}_value") for n in parameters]
        self.add_equations(*(sympy.Eq(v, s, evaluate=False) for v, s in zip(held, p, strict=True)))
        shown = [n for n in outputs if n not in unit.states]
        found = self.function("fmu", calls.function, inputs=[ev.t, *x, *u, *held])
        self.add_equations(*(sympy.Eq(der(v), f, evaluate=False) for v, f in zip(x, found, strict=False)))
        for one, value in zip(shown, found[len(x) :], strict=True):
            self.output(own(one), value, unit=unit.unit(one))
        if parameters and x:
            starts = self.function("starts", calls.start, inputs=held)
            self.initially(*(sympy.Eq(v, s, evaluate=False) for v, s in zip(x, starts, strict=True)))


class _Unit:
    """A file of an FMU, its description, and one instance."""

    def __init__(self, path: Path, where: str):
        fmpy = optional_module("fmpy", "fmi", "FMUs run through FMPy")
        if not path.is_file():
            raise ModelError(f"{where}there is no file '{path}'")
        description = fmpy.read_model_description(str(path))
        if description.fmiVersion != "3.0":
            raise ModelError(f"{where}'{path.name}' is of FMI {description.fmiVersion}: export it for FMI 3.0")
        if description.modelExchange is None:
            raise ModelError(f"{where}'{path.name}' has no Model Exchange: export it with it")
        if description.eventIndicators:
            raise ModelError(
                f"{where}'{path.name}' has {len(description.eventIndicators)} event indicators, and events of an FMU "
                "are not run: write the part with events as a component of its own"
            )
        with zipfile.ZipFile(path) as file:
            platforms = {n.split("/")[1] for n in file.namelist() if n.startswith("binaries/") and n.count("/") > 1}
            # FMPy leaves this attribute of FMI 3 out.
            exchange = ElementTree.fromstring(file.read("modelDescription.xml")).find("ModelExchange")
        if this_platform() not in platforms:
            raise ModelError(
                f"{where}'{path.name}' has no binary for {this_platform()}, only for {sorted(platforms) or 'none'}: "
                "make one of its sources"
            )
        self._variables = {v.name: v for v in description.modelVariables}
        self.states = [d.variable.derivative.name for d in description.derivatives]
        self.slopes = [d.variable.name for d in description.derivatives]
        scalars = [v for v in description.modelVariables if not v.dimensions and v.type == "Float64"]
        self.inputs = [v.name for v in scalars if v.causality == "input"]
        self.outputs = [v.name for v in scalars if v.causality == "output"]
        self.parameters = [v.name for v in scalars if v.causality == "parameter"]
        self.time = next(v.name for v in description.modelVariables if v.causality == "independent")
        self.directional = exchange is not None and exchange.get("providesDirectionalDerivatives") in ("true", "1")
        self.derivatives = "directional derivatives" if self.directional else "central differences"
        folder = fmpy.extract(str(path))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        from fmpy.fmi3 import FMU3Model

        self.model: Any = FMU3Model(
            guid=description.guid, unzipDirectory=folder, instanceName="component",
            modelIdentifier=description.modelExchange.modelIdentifier,
        )  # fmt: skip
        self.model.instantiate()
        self.lock = threading.Lock()

    def references(self, names: Sequence[str]) -> list[int]:
        return [self._variables[n].valueReference for n in names]

    def start(self, name: str) -> float:
        return float(self._variables[name].start or 0.0)

    def unit(self, name: str) -> str:
        return self._variables[name].unit or ""

    def nominal(self, name: str) -> float | None:
        found = self._variables[name].nominal
        return None if found is None else float(found)

    def bounds(self, name: str) -> tuple[float, float]:
        v = self._variables[name]
        return float(-np.inf if v.min is None else v.min), float(np.inf if v.max is None else v.max)


class _Calls:
    """The functions of an FMU that equations call: arrays in, arrays out, one after another."""

    def __init__(self, unit: _Unit, outputs: Sequence[str], parameters: Sequence[str]):
        self.unit = unit
        self._parameters = unit.references(parameters)
        self._unknowns = unit.references([*unit.slopes, *(n for n in outputs if n not in unit.states)])
        self._given = unit.references([unit.time, *unit.states, *unit.inputs])
        self._inputs = unit.references(unit.inputs)
        self._set: tuple[float, ...] | None = None
        self.parameter_values = [unit.start(n) for n in parameters]
        n = len(unit.states)
        sizes = [unit.nominal(name) or 1.0 for name in (*unit.states, *unit.inputs, *parameters)]
        self._sizes = np.array([1.0, *sizes])
        self.function = _differentiable(self._values, self._jacobian, len(self._unknowns))
        self.start = _differentiable(self._starts, self._jacobian_of_starts, n)

    def _prepared(self, parameters: np.ndarray) -> Any:
        """The instance with these parameters, in continuous-time mode; they are set before the start, as fixed ones
        must be."""
        model, wanted = self.unit.model, tuple(map(float, parameters))
        if self._set != wanted:
            self._set = None
            model.reset()
            if wanted:
                model.setFloat64(self._parameters, list(wanted))
            model.enterInitializationMode()
            model.exitInitializationMode()
            while model.updateDiscreteStates()[0]:
                pass
            model.enterContinuousTimeMode()
            self._set = wanted
        return model

    def starts_of(self, parameters: Sequence[float]) -> np.ndarray:
        """The states with which the FMU starts."""
        return self._starts(np.asarray(parameters, float))

    def _starts(self, given: np.ndarray) -> np.ndarray:
        with self.unit.lock:
            self._set = None  # other calls have moved the states
            model = self._prepared(given)
            return np.array(model.getFloat64(self.unit.references(self.unit.states)), float)

    def _placed(self, given: np.ndarray) -> Any:
        n, m = len(self.unit.states), len(self._inputs)
        t, x, u = given[0], np.ascontiguousarray(given[1 : 1 + n]), given[1 + n : 1 + n + m]
        model = self._prepared(given[1 + n + m :])
        model.setTime(float(t))
        if n:
            model.setContinuousStates(_pointer(x), n)
        if m:
            model.setFloat64(self._inputs, u.tolist())
        return model

    def _values(self, given: np.ndarray) -> np.ndarray:
        with self.unit.lock:
            return np.array(self._placed(given).getFloat64(self._unknowns), float)

    def _jacobian(self, given: np.ndarray) -> np.ndarray:
        """∂(slopes and outputs)/∂(time, states, inputs, parameters), shape (unknowns, given)."""
        columns = range(len(self._given))
        if not self.unit.directional:
            return self._differences(self._values, given)
        found = self._differences(self._values, given, range(len(self._given), len(given)))
        with self.unit.lock:
            model = self._placed(given)
            for k in columns:
                found[:, k] = model.getDirectionalDerivative(self._unknowns, [self._given[k]], [1.0], len(found))
        return found

    def _jacobian_of_starts(self, given: np.ndarray) -> np.ndarray:
        return self._differences(self._starts, given, offset=len(self._given))

    def _differences(
        self, function: Callable[[np.ndarray], np.ndarray], given: np.ndarray, columns: Sequence[int] | None = None,
        offset: int = 0,
    ) -> np.ndarray:  # fmt: skip
        """Central differences by some of what is given, zeros by the rest."""
        out = np.zeros((len(function(given)), len(given)))
        for k in range(len(given)) if columns is None else columns:
            h = STEP * max(abs(given[k]), self._sizes[offset + k])
            above, below = given.copy(), given.copy()
            above[k] += h
            below[k] -= h
            out[:, k] = (function(above) - function(below)) / (above[k] - below[k])
        return out


def _pointer(x: np.ndarray) -> Any:
    import ctypes

    return x.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def _differentiable(
    values: Callable[[np.ndarray], np.ndarray], jacobian: Callable[[np.ndarray], np.ndarray], m: int
) -> Callable[..., Array]:
    """A function of scalars that calls the host. Its derivative is a product by a matrix, which reverse mode
    transposes."""

    def call(host: Callable[[np.ndarray], np.ndarray], given: Array, shape: tuple[int, ...]) -> Array:
        out = jax.ShapeDtypeStruct(shape, given.dtype)
        return jax.pure_callback(
            lambda g: host(np.asarray(g, float)).astype(given.dtype), out, given, vmap_method="sequential"
        )

    @jax.custom_jvp
    def matrix(given: Array) -> Array:
        return call(jacobian, given, (m, given.shape[0]))

    @matrix.defjvp
    def refused(primals: Any, tangents: Any) -> Any:
        raise ModelError("an FMU has first derivatives only, and this needs second ones")

    @jax.custom_jvp
    def function(given: Array) -> Array:
        return call(values, given, (m,))

    @function.defjvp
    def along(primals: Any, tangents: Any) -> Any:
        (given,), (moves,) = primals, tangents
        return function(given), matrix(given) @ moves

    def of_scalars(*scalars: Array) -> Array:
        found = function(jnp.stack([jnp.asarray(s) for s in scalars]))
        return found if m != 1 else found[0]

    return of_scalars
