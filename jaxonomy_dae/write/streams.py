"""What a flow carries through a port: `in_stream` and `actual_stream`."""

import sympy

from ..base.errors import ModelError
from .automatic_events import smooth
from .ports import Port, inflow


def in_stream(port: Port, name: str) -> sympy.Symbol:
    """What the stream `name` would bring into the component, whatever the direction of the flow: the mixture of what
    leaves the other ports of the junction, weighted by their flows.

    ```python
    self.add_equations(Eq(C * der(T), a.m_flow * c * (actual_stream(a, "T") - T)), Eq(a.T, T))
    ```

    **Raises:**

    - `ModelError` if the port has no such stream.
    """
    _check(port, name)
    return port.component.symbol(f"{port.name}.{inflow(name)}")


def actual_stream(port: Port, name: str) -> sympy.Expr:
    """What the flow carries through the port: `in_stream` where it enters the component, and what the component says
    where it leaves. It jumps where the flow turns; its product with the flow does not, so that no event is needed.

    **Raises:**

    - `ModelError` if the port has no such stream.
    """
    enters = in_stream(port, name)
    flow, leaves = (getattr(port, n) for n in (port.domain.through[0][0], name))
    return smooth(sympy.Piecewise((enters, flow > 0), (leaves, True)))


def _check(port: Port, name: str) -> None:
    known = [n for n, _ in port.domain.streams]
    if name not in known:
        what = f"the streams {', '.join(known)}" if known else "no streams"
        raise ModelError(f"{port!r} has no stream '{name}': a {port.domain.name} port has {what}")
