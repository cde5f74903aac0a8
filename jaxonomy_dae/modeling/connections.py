"""What `connect` is given: ports of one domain, or one variable and the inputs it drives."""

from collections.abc import Sequence
from typing import Any

from ..errors import ModelError, nearest
from .construction import Construction
from .ports import Port
from .symbols import VariableSymbol

Connection = tuple[Port, ...]
Signal = tuple[VariableSymbol, ...]


def resolve_ends(ends: Sequence[Any], where: str) -> tuple[Connection, Signal]:
    """Reads the arguments of a `connect` call: ports, or symbols of variables, one of the two returned empty; a pair
    (component, name) stands for either."""
    found: list[Any] = []
    rest = list(ends)
    while rest:
        end = rest.pop(0)
        if isinstance(type(end), Construction):
            if not rest or not isinstance(rest[0], str):
                raise ModelError(f"{where}: connect(component, \"port\", …) needs a port name after '{end.path}'")
            name = rest.pop(0)
            if name not in end.ports and name not in end.variables:
                what, known = ("port", end.ports) if end.ports else ("variable", end.variables)
                raise ModelError(f"component '{end.path}' has no {what} '{name}': " + nearest(name, known))
            end = end.ports[name] if name in end.ports else end[name]
        if not isinstance(end, Port | VariableSymbol) or (isinstance(end, VariableSymbol) and end.order):
            raise ModelError(
                f"{where}: connect takes ports, symbols of variables, or a component and a name; got {end!r}"
            )
        found.append(end)
    kinds = {isinstance(end, Port) for end in found}
    if len(kinds) > 1:
        raise ModelError(f"{where}: connect joins ports, or a variable and inputs; got both: {_listed(found)}")
    if len(found) < 2:
        what = "ports" if kinds != {False} else "ends"
        got = f"{_listed(found)} only" if found else "none"
        raise ModelError(f"{where}: connect needs at least two {what}; got {got}")
    if kinds == {False}:
        return (), tuple(found)
    _check_ports(found, where)
    return tuple(found), ()


def _check_ports(ports: Sequence[Port], where: str) -> None:
    seen: set[int] = set()
    for port in ports:
        if port.domain != ports[0].domain:
            raise ModelError(
                f"{where}: cannot connect {port!r} to {ports[0]!r}: a connection joins ports of one domain"
            )
        if id(port) in seen:
            raise ModelError(
                f"{where}: '{port.component.path}.{port.name}' is connected to itself: name each port once"
            )
        seen.add(id(port))


def _listed(ends: Sequence[Any]) -> str:
    return ", ".join(f"'{e.component.path}.{e.name}'" if isinstance(e, Port) else f"'{e}'" for e in ends)
