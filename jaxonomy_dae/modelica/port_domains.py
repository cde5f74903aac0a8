"""Connector classes as domains: those of this package where the quantities are the same."""

from ..write.ports import Domain, Electrical, Hydraulic, Rotational, Thermal, Translational
from .open_class import OpenPort


def domain_of(port: OpenPort) -> Domain:
    """The domain of a connector. Connectors of the same potentials and flows have the same domain, whatever their class
    is called."""
    for domain in (Electrical, Translational, Rotational, Thermal, Hydraulic):
        pairs = zip((*domain.across, *domain.through), (*port.potentials, *port.flows), strict=False)
        if len(port.potentials) == len(domain.across) and all(
            ours == theirs and _unit(there) in ("", here) for (ours, here), (theirs, there) in pairs
        ):
            return domain
    names = (", ".join(name for name, _ in side) for side in (port.potentials, port.flows))
    units = (tuple((name, _unit(unit)) for name, unit in side) for side in (port.potentials, port.flows))
    return Domain("({}; {})".format(*names), *units)


def _unit(unit: str) -> str:
    """A unit of Modelica as this package writes it."""
    return unit.replace(".", "*")
