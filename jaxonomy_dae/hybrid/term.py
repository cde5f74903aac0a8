"""The term of a problem with events, as Diffrax sees it."""

from typing import Any

import diffrax

from ..aliases import Args, State, Terms, Time
from ..private_names import rewrapped, unwrapped
from .problem import AbstractHybridProblem, HybridState


class HybridTerm(diffrax.AbstractTerm):
    """The term of a problem with events. It takes no steps itself: `bound` gives the term for the discrete values at
    hand."""

    problem: AbstractHybridProblem

    def vf(self, t: Time, y: HybridState, args: Args) -> State:
        return self.problem.field(t, y.x, y.q, args)

    def contr(self, t0: Time, t1: Time, **kwargs: Any) -> Any:
        return t1 - t0

    def prod(self, vf: State, control: Time) -> State:
        raise NotImplementedError("a solver for events takes steps by the term of the discrete values at hand")


def problem_of(terms: Terms) -> AbstractHybridProblem:
    """The problem inside the terms that Diffrax hands to a solver or a controller, which may be wrapped in a direction
    of time."""
    return unwrapped(terms)[0].problem


def bound(terms: Terms, q: Any) -> Any:
    """The terms of the equations that hold with the discrete values q."""
    return rewrapped(terms, problem_of(terms).term(q))
