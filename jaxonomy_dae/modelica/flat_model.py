"""A flat Modelica model: one class with the functions and types that it needs."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import ModelError
from .learned_law import Law, law_of
from .read_expressions import INSIDE, written
from .tree import Array, Call, Class, Declaration, Number, Reference

PREFERRED = ("StateSelect.prefer", "StateSelect.always")


@dataclasses.dataclass(frozen=True)
class FlatModel:
    """A flat Modelica model.

    - `model`: its declarations and equations.
    - `classes`: functions, records and enumerations by name.
    - `laws`: other laws for some variables, as `replace` and `add_term` note them, by name.
    """

    model: Class
    classes: Mapping[str, Class]
    laws: Mapping[str, Law] = dataclasses.field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def experiment(self) -> dict[str, float]:
        """The settings of the text's own experiment as numbers: `StartTime`, `StopTime`, `Interval`, `Tolerance`."""
        found = self.model.annotation.get("experiment", {})
        return {k: float(v.value) for k, v in found.items() if isinstance(v, Number)}

    def replace(self, name: str, law: Any, inputs: Sequence[str] = ()) -> "FlatModel":
        """The model with another law in the place of an equation.

        **Arguments:**

        - `name`: the variable that the equation gives, as `"damper.f"` for `damper.f = d*damper.v_rel`, or
            `"der(v)"`; or a part with one law, as `"damper"`.
        - `law`: a network, `law(u) -> (1,)`, that is trained under the name `name.law`; or a function
            `law(m, written)` of the component and of the expression of the text, that returns another expression.
        - `inputs`: the variables that a network reads; those of the replaced expression if left out.
        """
        return self._with_law(name, law_of(name, law, inputs, False))

    def add_term(self, name: str, law: Any, inputs: Sequence[str] = ()) -> "FlatModel":
        """The model with a term beside what an equation says: `damper.f = d*damper.v_rel + law`. The arguments are
        those of `replace`."""
        return self._with_law(name, law_of(name, law, inputs, True))

    def _with_law(self, name: str, law: Law) -> "FlatModel":
        if name in self.laws:
            raise ModelError(f"the law of '{name}' has been changed already")
        return dataclasses.replace(self, laws={**self.laws, name: law})

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
    models = [c for c in outermost.classes.values() if c.kind == "model"]
    if len(models) != 1:
        raise ModelError(f"a flat text holds one model; '{outermost.name}' holds {len(models)}")
    classes = {name: c for name, c in outermost.classes.items() if c is not models[0]}
    model = models[0]._replace(declarations=outermost.declarations + models[0].declarations)  # constants of the package
    model = _with_numbers(model, literal_numbers(classes))
    return FlatModel(_with_types(model, classes), {name: _with_types(c, classes) for name, c in classes.items()})


def _with_types(c: Class, classes: Mapping[str, Class]) -> Class:
    return c._replace(declarations=tuple(_with_type(d, classes) for d in c.declarations)) if c.declarations else c


def _with_type(d: Declaration, classes: Mapping[str, Class]) -> Declaration:
    """A declaration with the modifiers and the dimensions of its type, where it has none of its own."""
    of = classes.get(d.type)
    alias = None if of is None or of.kind != "type" else of.alias or _base(of)
    if alias is None:
        return d
    alias = _with_type(alias, classes)
    # An array in the modifiers of a type is one of an entry of d.
    shared = {
        k: Call("fill", (v, *d.dimensions), ()) if d.dimensions and isinstance(v, Array) else v
        for k, v in alias.modifiers.items()
    }
    return d._replace(modifiers=shared | d.modifiers, dimensions=d.dimensions + alias.dimensions)


def _base(of: Class) -> Declaration | None:
    """The type that a type extends, with its modifiers."""
    return next((Declaration(frozenset(), b, of.name, (), more, None, "", 0) for b, more in of.bases), None)


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
