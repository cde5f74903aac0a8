"""What controllers that change another one's step sizes have in common."""

import diffrax

from ..aliases import Controller


class WrappedControl(diffrax.AbstractAdaptiveStepSizeController):
    """A step-size controller around another one. Solvers see the tolerances and norm of the inner controller."""

    controller: Controller

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.norm
