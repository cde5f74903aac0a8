"""What controllers that change another one's step sizes have in common."""

import dataclasses

import diffrax

from ..aliases import Controller, Time


class WrappedControl(diffrax.AbstractAdaptiveStepSizeController):
    """A step-size controller around another one. Solvers see the tolerances and norm of the inner controller.

    A subclass says by `first_end` and `next_end` where steps end that the inner controller would take from `start` to
    `end`. One that needs the state for it has `init` and `adapt_step_size` of its own.
    """

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

    def wrap(self, direction):
        return dataclasses.replace(self, controller=self.controller.wrap(direction))

    def first_end(self, start: Time, end: Time) -> Time:
        """The end of the first step."""
        return end

    def next_end(self, start: Time, end: Time) -> Time:
        """The end of the step to take next."""
        return end

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step, and the state of the controller."""
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return self.first_end(t0, end), state

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, controller_state):
        """Lets the inner controller accept or reject the step, and changes the end of the next one."""
        keep, start, end, jump, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1, args, y_error, error_order, controller_state
        )
        return keep, start, self.next_end(start, end), jump, state, result
