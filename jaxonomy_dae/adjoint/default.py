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
    """Inside, what is traced will be differentiated forwards, so the default adjoint is `diffrax.ForwardMode`."""
    token = _forward.set(True)
    try:
        yield
    finally:
        _forward.reset(token)


def default_adjoint(forwards: bool) -> diffrax.AbstractAdjoint:
    """The adjoint to be taken where none is given; `forwards`: whether forward mode alone is at work."""
    if forwards or _forward.get():
        return diffrax.ForwardMode()
    return StoredAdjoint() if has_stored_adjoint() else diffrax.RecursiveCheckpointAdjoint()
