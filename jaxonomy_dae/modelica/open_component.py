"""Modelica classes as components with ports."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import sympy

from ..base.errors import ModelError, nearest
from ..write.component import Component
from ..write.environment import EqnEnv
from ..write.ports import Port
from ..write.symbols import VariableSymbol
from .flat_component import FlatComponent
from .open_class import OpenClass
from .port_domains import domain_of
from .scope import Scope
from .tree import Declaration, Expression, Reference, Truth, entry_name
from .values import Value


class OpenComponent(FlatComponent):
    """A component of a Modelica class. `component` and `Library` make the classes of such components.

    **Arguments:**

    - `ev`, `name`: as of every component.
    - `start`: values that variables must have at the initial time, by their names: numbers or expressions in
        parameters. Each is the parameter `"initial_" + name`.
    - `numbers`: names of parameters, also of arrays, that are written as their values and cannot be changed. Where the
        abscissae of a table are numbers, its look-ups at numbers need no choices.
    - `parameters`: values of Real parameters, by the names of the class: numbers, expressions in parameters of the
        parent, arrays for arrays. Those that the class gives no value are required.

    **Raises:**

    - `ModelError` for parameters that the class does not have, that it decides itself, that decide its equations
        (`component(name, …)` takes these), and for missing ones.
    """

    opened: ClassVar[OpenClass]

    def __init__(
        self, ev: EqnEnv, name: str, /, *, start: Mapping[str, Any] | None = None, numbers: Sequence[str] = (),
        **parameters: Any,
    ):  # fmt: skip
        # Not the constructor of `FlatComponent`, which would write the equations before there are ports.
        Component.__init__(self, ev, name)
        of = self.opened
        where = f"{of.name} '{name}'"
        given = _given(of, parameters, where)
        missing = [n for n in of.required if n not in given]
        if missing:
            least = ", ".join(f"{n}=…" if n.isidentifier() else f'**{{"{n}": …}}' for n in missing)
            raise ModelError(
                f"{where}: the class gives no value to {_listed(missing)}: {type(self).__name__}(…, {least})"
            )
        for port in of.ports:
            self.ports[port.name] = Port(self, port.name, domain_of(port))
        self._of_ports = {f"{p.name}.{v}" for p in self.ports.values() for v, _ in p.domain.variables}
        for a, b in of.branches:
            self.declare_branch(self.ports[a], self.ports[b])
        for a in of.roots:
            self.declare_root(self.ports[a])
        flat = of.flat
        declared = {d.name: d for d in flat.model.declarations}
        for variable, value in (start or {}).items():
            if variable not in declared or declared[variable].prefixes & {"parameter", "constant"}:
                raise ModelError(f"{where}: start: there is no variable '{variable}': {nearest(variable, declared)}")
            symbol = self.parameter(f"initial_{variable}", value)
            given[symbol.name] = symbol
            declared[variable] = _with_start(declared[variable], Reference((symbol.name,)))
        model = flat.model._replace(declarations=tuple(declared.values()))
        types = {d.name: d.type for d in declared.values()}
        discrete = [n for n in of.outputs if types[n] != "Real"]
        flat = type(flat)(model, flat.classes)
        signals = {n for n in of.inputs if types[n] != "Real"}
        scope = Scope(flat, self, _numbers(of, numbers, where), given, signals)
        # Starts refer to parameters that the text does not declare.
        scope.known |= {n: v for n, v in given.items() if n not in declared}
        self._write(flat, scope, discrete)
        self._show_ports()

    def variable(self, name: str, **declared: Any) -> VariableSymbol:
        """Declares a variable of the class; those of connectors belong to ports."""
        if name in self._of_ports:
            return self._declare(name, "port", **declared)
        return super().variable(name, **declared)

    def _show_ports(self) -> None:
        """Ports as attributes: also where a component has a method of that name; arrays of connectors as tuples. Those
        of fluids are called `ports`, as the mapping of all ports, which stays."""
        nested: dict[str, Any] = {}
        for name, port in self.ports.items():
            nested.setdefault(name.partition("[")[0].partition(".")[0], []).append(port)
        for top, ports in nested.items():
            if top not in self.__dict__:
                object.__setattr__(self, top, ports[0] if ports[0].name == top else tuple(ports))


def _with_start(d: Declaration, start: Expression) -> Declaration:
    return d._replace(modifiers={**d.modifiers, "start": start, "fixed": Truth(True)})


def _given(of: OpenClass, parameters: Mapping[str, Any], where: str) -> dict[str, Value]:
    """The values of parameters, those of arrays by their entries."""
    arrays: dict[str, list[str]] = {}
    for n in of.tunable:
        arrays.setdefault(n.partition("[")[0] if n.endswith("]") else n, []).append(n)
    out: dict[str, Value] = {}
    for name, value in parameters.items():
        if name in of.tunable:
            out[name] = value if isinstance(value, sympy.Expr) else _number(value, name, where)
        elif name in arrays:
            out |= _entries(name, value, arrays[name], where)
        elif name in of.fixed or any(n.startswith(f"{name}[") for n in of.fixed):
            raise ModelError(
                f"{where}: '{name}' decides the equations of the class or is final; give it when the class is opened: "
                f'component("{of.name}", …, {name}={value!r})'
            )
        else:
            known = [*arrays, *of.fixed]
            raise ModelError(f"{where}: the class has no parameter '{name}': {nearest(name, known)}")
    return out


def _numbers(of: OpenClass, names: Sequence[str], where: str) -> set[str]:
    """The parameters that are written as numbers, those of arrays by their entries."""
    found = {name: [n for n in of.tunable if n == name or n.startswith(f"{name}[")] for name in names}
    for name, entries in found.items():
        if not entries:
            raise ModelError(f"{where}: numbers: the class has no parameter '{name}': {nearest(name, of.tunable)}")
    return {n for entries in found.values() for n in entries}


def _number(value: Any, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ModelError(f"{where}: the parameter '{name}' is a number or an expression in parameters; got {value!r}")
    return float(value)


def _entries(name: str, value: Any, names: Sequence[str], where: str) -> dict[str, Value]:
    array = np.array(value, object)
    found = {
        entry_name(name, [k + 1 for k in place]): v if isinstance(v, sympy.Expr) else _number(v, name, where)
        for place, v in np.ndenumerate(array)
    }
    if set(found) != set(names):
        raise ModelError(
            f"{where}: the parameter '{name}' has the entries {_listed(names)}; got the shape {array.shape}"
        )
    return found


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{n}'" for n in names)
