"""A controller whose steps end where a list of ends says: events and ticks, waves, the first step, what rests.

Any Diffrax controller chooses steps by their errors. Each end of the list then shortens or rejects them, in order. So
all solvers and adjoints see one controller, whatever limits its steps.
"""

import dataclasses
from typing import Any, Self

import diffrax
import equinox as eqx

from ...base.aliases import Args, Controller, Numeric, Result, State, Terms, Time


class AttemptedStep(eqx.Module):
    """An attempted step.

    - `t0`, `y0`, `t1`, `y1`: its ends.
    - `accepted`, `jump`: whether it is accepted, and whether the field jumps at its end.
    - `start`, `end`: the step to take next.
    - `result`: a code that ends the run; `states`: of the controller by errors, before and after the step.
    """

    t0: Time
    t1: Time
    y0: State
    y1: State
    accepted: Numeric
    jump: Numeric
    start: Time
    end: Time
    result: Result = None
    states: Any = None

    def but(self, **changes: Any) -> Self:
        """A copy with other values."""
        return dataclasses.replace(self, **changes)


class End(eqx.Module):
    """A reason for which steps end where their errors alone would not end them."""

    def wrap(self, direction: Time) -> Self:
        """The same for a run in the direction of time 1 or −1, in the time in which it goes forwards."""
        return self

    def asked(self, dt0: Time) -> Time:
        """The length of the first step that the controller by errors is asked for; None if it chooses."""
        return dt0

    def inside(self, terms: Terms, y: State) -> tuple[Terms, State]:
        """The terms and the state that the controller by errors sees."""
        return terms, y

    def first(self, t: Time, end: Time, y: State, args: Args, span: Time) -> tuple[Time, Any]:
        """The end of the first step, which would go from `t` to `end`, and the state of this end. The run is `span`
        long."""
        return self.moved(t, end), ()

    def next(self, step: AttemptedStep, args: Args, state: Any) -> tuple[AttemptedStep, Any]:
        """The step as this end leaves it, and the state of this end."""
        return step.but(end=self.moved(step.start, step.end)), state

    def moved(self, start: Time, end: Time) -> Time:
        """The end of any step that would go from `start` to `end`, where nothing else counts."""
        return end


class Ending(diffrax.AbstractAdaptiveStepSizeController):
    """A step-size controller by errors with ends. Solvers see its tolerances and norm."""

    controller: Controller
    ends: tuple[End, ...]

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
        return Ending(self.controller.wrap(direction), tuple(end.wrap(direction) for end in self.ends))  # pyright: ignore[reportCallIssue]

    def _inside(self, terms, y):
        # From the outermost end inwards: each sees what the ones around it have left of the state.
        for end in reversed(self.ends):
            terms, y = end.inside(terms, y)
        return terms, y

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step, and the state of the controller."""
        for end in self.ends:
            dt0 = end.asked(dt0)
        inner_terms, x0 = self._inside(terms, y0)
        last, state = self.controller.init(inner_terms, t0, t1, x0, dt0, args, func, error_order)
        return self.begun(t0, last, state, y0, args, t1 - t0)

    def begun(self, t: Time, last: Time, state: Any, y: State, args: Args, span: Time) -> tuple[Time, Any]:
        """The end of the first step, and the state of the controller, given those of the controller by errors."""
        states = []
        for end in self.ends:
            last, own = end.first(t, last, y, args, span)
            states.append(own)
        return last, (state, tuple(states))

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, controller_state):
        """Accepts or rejects the step and proposes the next one; see `diffrax.AbstractStepSizeController`."""
        # The controller by errors goes first: it alone knows the error, and ends only shorten or reject what it
        # proposes.
        before, states = controller_state
        x0, x1 = self._inside(None, y0)[1], self._inside(None, y1)[1]
        keep, start, last, jump, after, result = self.controller.adapt_step_size(
            t0, t1, x0, x1, args, y_error, error_order, before
        )
        step = AttemptedStep(
            t0=t0, t1=t1, y0=y0, y1=y1, accepted=keep, jump=jump, start=start, end=last, result=result,
            states=(before, after),
        )  # fmt: skip
        new = []
        for end, state in zip(self.ends, states, strict=True):
            step, state = end.next(step, args, state)
            new.append(state)
        return step.accepted, step.start, step.end, step.jump, (step.states[1], tuple(new)), step.result


def ending(controller: Controller, *ends: End) -> Controller:
    """The controller with more ends, after those that it has. One that clips steps stays outermost."""
    # It tells by the start of the next step whether a jump lies behind, so it must see which steps the ends reject.
    if isinstance(controller, diffrax.ClipStepSizeController):
        return eqx.tree_at(lambda c: c.controller, controller, ending(controller.controller, *ends))
    if isinstance(controller, Ending):
        return dataclasses.replace(controller, ends=(*controller.ends, *ends))
    return Ending(controller, ends)  # pyright: ignore[reportCallIssue]
