"""Which adjoint a simulation takes that was not given one."""

import contextlib
import contextvars
from collections.abc import Iterator

import diffrax

from ..private_names import has_stored_adjoint
from .stored_adjoint import StoredAdjoint

_forward: contextvars.ContextVar[bool] = contextvars.ContextVar("forward_mode", default=False)


@contextlib.contextmanager
def forward_mode() -> Iterator[None]:
    """A context in which functions are traced for forward-mode differentiation: the default adjoint is
    `diffrax.ForwardMode`."""
    token = _forward.set(True)
    try:
        yield
    finally:
        _forward.reset(token)


def default_adjoint(forwards: bool) -> diffrax.AbstractAdjoint:
    """The adjoint where the user gives none. `forwards` is true if forward mode alone differentiates the arguments."""
    if forwards or _forward.get():
        return diffrax.ForwardMode()
    return StoredAdjoint() if has_stored_adjoint() else diffrax.RecursiveCheckpointAdjoint()
