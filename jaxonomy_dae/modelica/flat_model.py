"""A flat Modelica model: one class with the functions and types that it needs."""

import dataclasses
from collections.abc import Mapping

from ..errors import ModelError
from .read_base import INSIDE, written
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


def flat_of(outermost: Class) -> FlatModel:
    """The flat model that a package of Base Modelica holds.

    **Raises:**

    - `ModelError` for a package that does not hold exactly one model.
    """
    if outermost.kind in ("model", "class", "block"):
        return FlatModel(outermost, {})
    models = [c for c in outermost.classes if c.kind == "model"]
    if len(models) != 1:
        raise ModelError(f"a flat text holds one model; '{outermost.name}' holds {len(models)}")
    classes = {c.name: c for c in outermost.classes if c is not models[0]}
    return FlatModel(_with_numbers(models[0], literal_numbers(classes)), classes)


def literal_numbers(classes: Mapping[str, Class]) -> dict[str, int]:
    """The numbers of all literals of enumerations, by name."""
    return {f"{c.name}.{literal}": k for c in classes.values() for k, literal in enumerate(c.literals, start=1)}


def _with_numbers(model: Class, literals: Mapping[str, int]) -> Class:
    """The model with numbers for literals in the names of entries, such as 'delay[\'Logic\'.\'one\']'."""
    declarations = []
    for d in model.declarations:
        if INSIDE in d.name:
            name = written(d.name)
            inside = [
                ",".join(str(literals[e.path]) if isinstance(e, Reference) else str(getattr(e, "value", "")) for e in s)
                for s in name.subscripts
            ]
            d = d._replace(
                name=".".join(f"{p}[{n}]" if n else p for p, n in zip(name.parts, inside, strict=True))
            )  # fmt: skip
        declarations.append(d)
    return model._replace(declarations=tuple(declarations))
