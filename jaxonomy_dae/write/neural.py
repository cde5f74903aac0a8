"""Learned corrections of a model's equations."""

from collections.abc import Callable, Sequence
from typing import Literal

from ..base.errors import ModelError
from .component import Component
from .names import check_name
from .networks import as_weights, check_kind, count_outputs


class NeuralDAEBlock:
    """A learned correction on the time derivatives of target variables.

    **Arguments:**

    - `network`: an Equinox module (any callable pytree) `network(u) -> (n_targets,)`; or, with `theta`, a function
        `network(t, u, theta) -> (n_targets,)`.
    - `theta`: the weights of a plain function, any pytree of arrays (a flat vector, usually).
    - `targets`: pairs `(component, "variable")` or full names `"component.variable"`, one for each output.
    - `inputs`: the entries of `u`, in this order: pairs, names, or `"time"`. Default: the targets.
    - `name`: `system.neural[name]` holds the module, or `theta`.
    - `inject`: `"equation"` makes the target's derivative *physics + correction* inside the model's equations, so that
        hidden constraints and multipliers respond. `"row"` adds the correction to the finished right-hand side of the
        target's row instead, and the constraints do not see it. The target must then be a state, and the system must be
        compiled with `state_selection="dummy_derivatives"`.
    - `kind`: the class of which `network` must be an instance, such as `learning.AbstractPassive`, or a tuple of
        classes, as in `Component.learned`. It serves functions that build a model around a given network. A kind
        promises something about the network's own inputs and outputs.

    **Raises:**

    - `ModelError` if targets or inputs are malformed, if the network is not of the kind, or if its output does not have
        one entry for each target.
    """

    def __init__(
        self,
        network: Callable,
        theta: object = None,
        *,
        targets: Sequence[object],
        inputs: Sequence[object] | None = None,
        name: str,
        inject: Literal["equation", "row"] = "equation",
        kind: object = None,
    ):
        where = f"neural block '{name}'"
        check_name(name, "neural block")
        if not callable(network):
            raise ModelError(f"{where}: the network must be callable; got {network!r}")
        if kind is not None:
            check_kind(network, kind, where)
        if inject not in ("equation", "row"):
            raise ModelError(f"{where}: inject is 'equation' or 'row'; got {inject!r}")
        if isinstance(targets, str) or not targets:
            raise ModelError(f'{where}: targets is a non-empty list of (component, "variable"); got {targets!r}')
        self.name = name
        self.network = network
        self.theta = None if theta is None else as_weights(theta)
        self.inject = inject
        self.targets = tuple(_reference(t, where) for t in targets)
        self.inputs = self.targets if inputs is None else tuple(_reference(i, where) for i in inputs)
        found = count_outputs(network, len(self.inputs), where, self.theta)
        if found != len(self.targets):
            raise ModelError(
                f"{where}: expected one output for each of its {len(self.targets)} targets, shape "
                f"({len(self.targets)},), but the network returns shape ({found},)"
            )

    def __repr__(self):
        return f"NeuralDAEBlock({self.name!r}, inject={self.inject!r})"


def _reference(entry: object, where: str) -> tuple[Component | None, str]:
    """Reads a reference to a variable. Returns (component, local name), or (None, full name) for a string."""
    if isinstance(entry, str):
        return None, entry
    if isinstance(entry, tuple | list) and len(entry) == 2:
        component, name = entry
        if isinstance(component, Component) and isinstance(name, str):
            return component, name
    raise ModelError(f'{where}: expected (component, "variable") or "component.variable"; got {entry!r}')
