"""Which kind of network a component's physics allows."""

from typing import Any

from ..errors import ModelError


def check_kind(network: Any, kind: Any, where: str) -> None:
    """Refuses a network that is not of a kind: a class, or a tuple of classes.

    **Raises:**

    - `ModelError` if it is not, naming the component, what was found, and what the kind promises.
    """
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not kinds or not all(isinstance(k, type) for k in kinds):
        raise ModelError(f"{where}: kind is a class such as learning.AbstractPassive, or a tuple of them; got {kind!r}")
    if isinstance(network, kinds):
        return
    names = " or ".join(k.__name__ for k in kinds)
    promise = " ".join((kinds[0].__doc__ or "").split("\n\n")[0].split())
    found = network.__name__ if isinstance(network, type) else type(network).__name__
    raise ModelError(
        f"{where}: only a law of kind {names} may stand here; got {found}, which promises nothing of it."
        + (f" {kinds[0].__name__}: {promise}" if promise else "")
    )
