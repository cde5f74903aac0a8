"""What the description of a foreign FMU says: its variables by name, and what its binary can do."""

import shutil
import weakref
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..base.errors import ModelError
from ..base.optional import optional_module
from .compilers import FOLDERS_OF_FMI_2, this_platform

REALS, TRUTHS = ("Float64", "Real"), ("Boolean",)
WHOLE = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Integer", "Enumeration")


def _version(path: Path, where: str) -> str:
    """The version of FMI that a file says it is of, read before FMPy reads it by the rules of that version."""
    try:
        with zipfile.ZipFile(path) as file:
            return ElementTree.fromstring(file.read("modelDescription.xml")).get("fmiVersion", "none")
    except (zipfile.BadZipFile, KeyError, ElementTree.ParseError) as error:
        raise ModelError(f"{where}'{path.name}' is no FMU: its modelDescription.xml cannot be read") from error


class Described:
    """An FMU's file, unpacked. `states`, `slopes`, `inputs`, `outputs` and `parameters` are names of scalars.

    **Raises:**

    - `ModelError` for a file that does not exist, another version of FMI or another platform, an FMU without Model
        Exchange, and one whose states are arrays.
    - `MissingPackage` without FMPy.
    """

    def __init__(self, path: Path, where: str):
        fmpy = optional_module("fmpy", "fmi", "FMUs run through FMPy")
        if not path.is_file():
            raise ModelError(f"{where}there is no file '{path}'")
        self.where, self.path = where, path
        version = _version(path, where)
        if version not in ("2.0", "3.0"):
            raise ModelError(f"{where}'{path.name}' is of FMI {version}: export it for FMI 3.0 or 2.0")
        self.text = description = fmpy.read_model_description(str(path))
        self.version = int(float(description.fmiVersion))
        if description.modelExchange is None:
            raise ModelError(f"{where}'{path.name}' has no Model Exchange: export it with it")
        with zipfile.ZipFile(path) as file:
            folders = {n.split("/")[1] for n in file.namelist() if n.startswith("binaries/") and n.count("/") > 1}
            # FMPy leaves attributes of FMI 3 out.
            exchange = ElementTree.fromstring(file.read("modelDescription.xml")).find("ModelExchange")
        own = this_platform() if self.version == 3 else FOLDERS_OF_FMI_2.get(this_platform(), this_platform())
        if own not in folders:
            raise ModelError(
                f"{where}'{path.name}' has no binary for {own}, only for {sorted(folders) or 'none'}: make one of its "
                "sources"
            )
        said = {} if exchange is None else {k.lower(): v in ("true", "1") for k, v in exchange.attrib.items()}
        # The names differ between versions by a letter.
        self.directional = any(said.get(f"providesdirectionalderivative{s}", False) for s in ("", "s"))
        self.saves_states = said.get("cangetandsetfmustate", False)
        self.only_once = said.get("canbeinstantiatedonlyonceperprocess", False)
        self._variables = {v.name: v for v in description.modelVariables}
        of_states = [d.variable for d in description.derivatives]
        array = next((v for v in of_states if v.dimensions), None)
        if array is not None:
            raise ModelError(
                f"{where}the state '{array.derivative.name}' of '{path.name}' is an array: only scalars are"
            )
        self.slopes = [v.name for v in of_states]
        self.states = [v.derivative.name for v in of_states]
        scalars = [v for v in description.modelVariables if not v.dimensions]
        reals = [v for v in scalars if v.type in REALS]
        # Discrete inputs may be set at events only: they keep the values that they start with.
        moving = [v for v in reals if v.variability in (None, "continuous")]
        self.inputs = [v.name for v in moving if v.causality == "input"]
        self.outputs = [v.name for v in scalars if v.causality == "output" and v.type in (*REALS, *TRUTHS, *WHOLE)]
        self.parameters = [v.name for v in reals if v.causality == "parameter"]
        self.time = next((v.name for v in description.modelVariables if v.causality == "independent"), "")
        unknowns = (*description.derivatives, *description.outputs)
        # The standard lets importers differentiate by time where it is listed.
        self.by_time = self.version == 3 and any(
            v.name == self.time for u in unknowns for v in getattr(u, "dependencies", None) or ()
        )
        # A number in FMI 2.0; a list of variables in FMI 3.0, which may be arrays: the binary counts them.
        indicators = getattr(description, "eventIndicators", None)
        self.has_indicators = bool(indicators or description.numberOfEventIndicators)
        self.n_indicators_said = int(description.numberOfEventIndicators or 0)
        self.folder = fmpy.extract(str(path))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def reference(self, name: str) -> int:
        return self._variables[name].valueReference

    def type_of(self, name: str) -> str:
        return self._variables[name].type

    def is_continuous(self, name: str) -> bool:
        """True for a variable that has derivatives between events."""
        v = self._variables[name]
        return v.type in REALS and v.variability in (None, "continuous")

    def start(self, name: str) -> float:
        return float(self._variables[name].start or 0.0)

    def unit(self, name: str) -> str:
        return self._variables[name].unit or ""

    def nominal(self, name: str) -> float | None:
        found = self._variables[name].nominal
        return None if found is None else float(found)

    def sizes(self, names: Sequence[str]) -> np.ndarray:
        """Typical sizes."""
        return np.array([self.nominal(name) or 1.0 for name in names])

    def bounds(self, name: str) -> tuple[float, float]:
        v = self._variables[name]
        return float(-np.inf if v.min is None else v.min), float(np.inf if v.max is None else v.max)

    def new_instance(self) -> Any:
        """A new instance, as FMPy wraps it."""
        kind = "FMU3Model" if self.version == 3 else "FMU2Model"
        module = __import__(f"fmpy.fmi{self.version}", fromlist=[kind])
        model = getattr(module, kind)(
            guid=self.text.guid, unzipDirectory=self.folder, instanceName="component",
            modelIdentifier=self.text.modelExchange.modelIdentifier,
        )  # fmt: skip
        model.instantiate()
        return model
