"""What `connect` is given: ports of one domain, or one variable and the inputs it drives."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError, nearest
from .arrays import ComponentArray, PortArray
from .construction import Construction
from .ports import Port
from .symbols import VariableSymbol

Signal = tuple[VariableSymbol, ...]


@dataclasses.dataclass(frozen=True)
class Connection:
    """Ports that meet at one node; or arrays of one shape of which the first meet, the second, and so on."""

    ends: tuple[Port | PortArray, ...]
    by_element: bool = False


def resolve_ends(ends: Sequence[Any], where: str) -> tuple[Connection | None, list[Signal]]:
    """Reads the arguments of a `connect` call: ports, or symbols of variables, one of the two returned empty; a pair
    (component, name) stands for either."""
    found: list[Any] = []
    rest = list(ends)
    while rest:
        end = rest.pop(0)
        # By its metaclass: `component` imports this module, which so cannot import `Component`.
        if isinstance(type(end), Construction) or isinstance(end, ComponentArray):
            if not rest or not isinstance(rest[0], str):
                raise ModelError(f"{where}: connect(component, \"port\", …) needs a port name after '{end.path}'")
            name = rest.pop(0)
            inner = end.inner if isinstance(end, ComponentArray) else end
            if name not in inner.ports and name not in inner.variables:
                what, known = ("port", inner.ports) if inner.ports else ("variable", inner.variables)
                raise ModelError(f"component '{end.path}' has no {what} '{name}': " + nearest(name, known))
            if name not in inner.ports:
                end = end[name]
            else:  # its name may be that of a method
                end = inner.ports[name] if end is inner else getattr(end, name)
        if type(end) is not Port and not _is_port(end) and not _is_signal(end):
            owner: Any = getattr(end, "__self__", None)  # a method, as `r.port`, where a port was meant
            if isinstance(type(owner), Construction):
                raise ModelError(
                    f"{where}: '{owner.path}.{end.__name__}' is a method, not a port: " + nearest("", owner.ports)
                )
            raise ModelError(
                f"{where}: connect takes ports, symbols of variables, or a component and a name; got {end!r}"
            )
        found.append(end)
    if len(found) > 1 and all(type(end) is Port for end in found):  # as nearly always, in models with many
        _check_single_ports(found, where)
        return Connection(tuple(found)), []
    kinds = {_is_port(end) for end in found}
    if len(kinds) > 1:
        raise ModelError(f"{where}: connect joins ports, or a variable and inputs; got both: {_listed(found)}")
    if len(found) < 2:
        what = "ports" if kinds != {False} else "ends"
        got = f"{_listed(found)} only" if found else "none"
        raise ModelError(f"{where}: connect needs at least two {what}; got {got}")
    shapes = [_shape(end) for end in found]
    arrays = {shape for shape in shapes if shape}
    by_element = () not in shapes
    if by_element and len(arrays) > 1 or not by_element and sum(map(bool, shapes)) > 1:
        what = "arrays of one shape join element by element, an array and one port at one node"
        raise ModelError(f"{where}: {what}; got {_listed(found)} of shapes {', '.join(map(str, shapes))}")
    if kinds == {False}:
        if by_element:
            return None, list(zip(*(end.ravel() for end in found), strict=True))
        return None, [tuple(s for end in found for s in (end.ravel() if isinstance(end, np.ndarray) else [end]))]
    _check_ports(found, by_element, where)
    return Connection(tuple(found), by_element), []


def _is_port(end: object) -> bool:
    return isinstance(end, Port | PortArray)


def _is_signal(end: object) -> bool:
    symbols = end.ravel() if isinstance(end, np.ndarray) else [end]
    return all(isinstance(s, VariableSymbol) and not s.order for s in symbols)


def _shape(end: object) -> tuple[int, ...]:
    return end.chosen.numbers.shape if isinstance(end, PortArray) else getattr(end, "shape", ())


def _check_single_ports(ports: Sequence[Port], where: str) -> None:
    domain, seen = ports[0].domain, set()
    for port in ports:
        if port.domain is not domain and port.domain != domain:
            raise ModelError(_TWO_DOMAINS.format(where, _in_domain(port), _in_domain(ports[0])))
        if id(port) in seen:
            raise ModelError(_ITSELF.format(where, port.component.path, port.name))
        seen.add(id(port))


_TWO_DOMAINS = "{}: cannot connect {} to {}: ports must have the same domain"
_ITSELF = "{}: '{}.{}' is connected to itself: name each port once"


def _check_ports(ends: Sequence[Port | PortArray], by_element: bool, where: str) -> None:
    seen: dict[int, list[np.ndarray]] = {}
    first = ends[0].port if isinstance(ends[0], PortArray) else ends[0]
    for end in ends:
        port = end.port if isinstance(end, PortArray) else end
        if port.domain != first.domain:
            raise ModelError(_TWO_DOMAINS.format(where, _in_domain(end), _in_domain(ends[0])))
        numbers = end.chosen.numbers if isinstance(end, PortArray) else np.zeros((), np.int64)
        others = seen.setdefault(id(port), [])
        twice = any((numbers == other).any() for other in others)
        if not by_element:
            twice |= len(np.unique(numbers)) < numbers.size
        if twice:
            raise ModelError(_ITSELF.format(where, port.component.path, port.name))
        others.append(numbers)


def _in_domain(end: Port | PortArray) -> str:
    return f"{_named(end)} ({(end.port if isinstance(end, PortArray) else end).domain.name})"


def _listed(ends: Sequence[Any]) -> str:
    return ", ".join(_named(end) for end in ends)


def _named(end: object) -> str:
    if isinstance(end, Port):
        return f"'{end.component.path}.{end.name}'"
    if isinstance(end, PortArray):
        return f"'{end.described}'"
    return f"'{end}'"
