"""What `connect` is given."""

from collections.abc import Sequence
from typing import Any

from ..errors import ModelError, nearest
from .construction import Construction
from .ports import Port


def resolve_ports(ends: Sequence[Any], where: str) -> tuple[Port, ...]:
    """Reads the arguments of a `connect` call: ports, or pairs (component, port name), of one domain."""
    ports: list[Port] = []
    rest = list(ends)
    while rest:
        end = rest.pop(0)
        if isinstance(type(end), Construction):
            if not rest or not isinstance(rest[0], str):
                raise ModelError(f"{where}: connect(component, \"port\", …) needs a port name after '{end.path}'")
            name = rest.pop(0)
            if name not in end.ports:
                raise ModelError(f"component '{end.path}' has no port '{name}': " + nearest(name, end.ports))
            end = end.ports[name]
        if not isinstance(end, Port):
            raise ModelError(f"{where}: connect takes ports, or a component and a port name; got {end!r}")
        ports.append(end)
    if len(ports) < 2:
        got = f"'{ports[0].component.path}.{ports[0].name}' only" if ports else "none"
        raise ModelError(f"{where}: connect needs at least two ports; got {got}")
    for port in ports[1:]:
        if port.domain != ports[0].domain:
            raise ModelError(
                f"{where}: cannot connect {port!r} to {ports[0]!r}: a connection joins ports of one domain"
            )
    seen: set[int] = set()
    for port in ports:
        if id(port) in seen:
            raise ModelError(
                f"{where}: '{port.component.path}.{port.name}' is connected to itself: name each port once"
            )
        seen.add(id(port))
    return tuple(ports)
