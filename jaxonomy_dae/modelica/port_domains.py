"""Connector classes as domains: those of this package where the quantities are the same."""

from collections.abc import Mapping, Sequence

import numpy as np
import sympy

from ..write.ports import Domain, Electrical, Hydraulic, Overdetermined, Rotational, Thermal, Translational
from .open_class import OpenPort, is_frame


def domain_of(port: OpenPort) -> Domain:
    """The domain of a connector. Connectors of the same potentials and flows have the same domain, whatever their class
    is called."""
    if port.streams or port.orientation:
        return _named(port)
    for domain in (Electrical, Translational, Rotational, Thermal, Hydraulic):
        pairs = zip((*domain.across, *domain.through), (*port.potentials, *port.flows), strict=False)
        # A connector without units counts by its names.
        if len(port.potentials) == len(domain.across) and all(
            ours == theirs and _unit(there) in ("", here) for (ours, here), (theirs, there) in pairs
        ):
            return domain
    return _named(port)


def _named(port: OpenPort) -> Domain:
    """A domain that is called by its quantities."""
    sides = [side for side in (port.potentials, port.flows, port.streams) if side]
    names = "; ".join(", ".join(name for name, _ in side) for side in sides)
    across, through, streams = (
        tuple((name, _unit(unit)) for name, unit in side) for side in (port.potentials, port.flows, port.streams)
    )
    if port.orientation:
        if is_frame(port.orientation):
            return Domain("frame", across, through, streams, Overdetermined(port.orientation, _turned))
        return Domain(f"({names})", across, through, streams, Overdetermined(port.orientation, _nothing))
    return Domain(f"({names})", across, through, streams)


def _nothing(a: Mapping[str, sympy.Symbol], b: Mapping[str, sympy.Symbol]) -> Sequence[sympy.Expr]:
    """What a loop demands of quasi-static references: their angles are equal by what turns them."""
    return []


def _turned(a: Mapping[str, sympy.Symbol], b: Mapping[str, sympy.Symbol]) -> Sequence[sympy.Expr]:
    """Three angles that are zero where two frames are turned equally: those by which the library's
    `Frames.Orientation.equalityConstraint` compares them."""
    first, second = (np.array([[of[f"R.T[{i},{j}]"] for j in (1, 2, 3)] for i in (1, 2, 3)]) for of in (a, b))
    third = np.cross(first[0], first[1])
    return [
        sympy.atan2(third @ second[1], first[0] @ second[0]),
        sympy.atan2(-third @ second[0], first[1] @ second[1]),
        sympy.atan2(first[1] @ second[0], first[2] @ second[2]),
    ]


def _unit(unit: str) -> str:
    """A unit of Modelica as this package writes it."""
    return unit.replace(".", "*")
