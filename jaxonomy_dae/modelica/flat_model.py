"""A flat Modelica model: one class with the functions and types that it needs."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from ..errors import ModelError
from .read_base import read_base
from .tree import Class, Number, Reference

PREFERRED = ("StateSelect.prefer", "StateSelect.always")


@dataclasses.dataclass(frozen=True)
class FlatModel:
    """A flat Modelica model.

    - `model`: its declarations and equations.
    - `classes`: functions, records and enumerations by name.
    """

    model: Class
    classes: Mapping[str, Class]

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def experiment(self) -> dict[str, float]:
        """The settings of the text's own experiment as numbers: `StartTime`, `StopTime`, `Interval`, `Tolerance`."""
        found = self.model.annotation.get("experiment", {})
        return {k: float(v.value) for k, v in found.items() if isinstance(v, Number)}

    @property
    def preferred_states(self) -> tuple[str, ...]:
        """The variables whose `stateSelect` prefers them as states."""
        chosen = ((d.name, d.modifiers.get("stateSelect")) for d in self.model.declarations)
        return tuple(name for name, e in chosen if isinstance(e, Reference) and e.path in PREFERRED)


def load(source: str | Path) -> FlatModel:
    """Reads a model in Base Modelica.

    **Arguments:**

    - `source`: the path of a file, or the text itself.

    **Raises:**

    - `ModelError` for what is not Base Modelica, with line and column, and for a text that does not hold exactly one
        model.
    """
    is_text = isinstance(source, str) and ("\n" in source or not source.endswith((".bmo", ".mo")))
    outermost = read_base(str(source) if is_text else Path(source).read_text(encoding="utf-8"))
    if outermost.kind in ("model", "class", "block"):
        return FlatModel(outermost, {})
    models = [c for c in outermost.classes if c.kind == "model"]
    if len(models) != 1:
        raise ModelError(f"a flat text holds one model; '{outermost.name}' holds {len(models)}")
    return FlatModel(models[0], {c.name: c for c in outermost.classes if c is not models[0]})
