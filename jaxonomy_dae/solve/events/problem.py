"""What a model with events gives to the solver that watches over it."""

import abc
import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ...base.aliases import Args, State, Terms, Time
from ...base.private_names import rewrapped, unwrapped
from ..adjoint.appended import AbstractAppending
from .facts import EventFacts
from .first_order import constant_once
from .iteration import Iteration
from .log import EventRows


class AbstractHybridProblem(eqx.Module):
    """Equations whose discrete values `q` stay constant between events.

    Each event of a condition has a guard, which falls through zero where the condition becomes true.
    """

    facts: eqx.AbstractVar[EventFacts]
    resolution: eqx.AbstractVar[Time]  # a time that is nothing beside the run, but more than rounding

    @abc.abstractmethod
    def term(self, q: Float[Array, " q"]) -> diffrax.AbstractTerm:
        """The term of the equations that hold with the discrete values q."""

    @abc.abstractmethod
    def prepared(self, solver: diffrax.AbstractSolver, q: Float[Array, " q"]) -> diffrax.AbstractSolver:
        """The solver, prepared for the equations that hold with the discrete values q."""

    @abc.abstractmethod
    def field(self, t: Time, x: Float[Array, " n"], q: Float[Array, " q"], args: Args) -> Float[Array, " n"]:
        """dx/dt."""

    @abc.abstractmethod
    def guards(self, t: Time, x: Float[Array, " n"], q: Float[Array, " q"], args: Args) -> Float[Array, " guards"]:
        """The guards' values."""

    @abc.abstractmethod
    def written(
        self,
        t: Time,
        x: Float[Array, " n"],
        read: Float[Array, " n"],
        q: Float[Array, " q"],
        previous: Float[Array, " q"],
        events: Bool[Array, " events"],
        args: Args,
    ) -> tuple[Float[Array, " n"], Float[Array, " q"]]:
        """(x, q) after an event, or after several `strikes`, consistent. What they write is computed from the states
        `read`, and with `previous`, the discrete values, before all events that happen as one."""

    @abc.abstractmethod
    def settled(
        self, t: Time, x: Float[Array, " n"], q: Float[Array, " q"], events: Bool[Array, " events"], args: Args
    ) -> Float[Array, " q"]:
        """q after several events that assign discrete values. Each reads the values from before all of them."""

    @abc.abstractmethod
    def clocks(self) -> tuple[Float[Array, " clocks"], Float[Array, " clocks"]]:
        """Periods and offsets of the sampled events; the period is infinite for one that happens once."""

    def at_instant(self, args: Args) -> "tuple[AbstractHybridProblem, Args, bool]":
        """Returns (the problem and what its equations read at an instant and from then on, whether that may differ from
        what they read just before)."""
        return self, args, False

    # Of what is delayed, where `facts.delays` are there:

    def remembering(self, past: Any, ticks: Float[Array, " delays"] | None = None) -> "AbstractHybridProblem":
        """The problem whose equations read this past (`past.Remembered`); `ticks`: when the breaks come out of the
        delays that do so now."""
        raise NotImplementedError

    def sources(
        self, t: Time, x: State, q: Array, args: Args
    ) -> tuple[Float[Array, " delays"], Float[Array, " delays"]]:
        """Returns (what is delayed, the times at which the past is read)."""
        raise NotImplementedError

    def longest(self) -> Float[Array, " delays"]:
        """The longest delays."""
        raise NotImplementedError

    def allowed(self, size: Float[Array, " delays"]) -> Float[Array, " delays"]:
        """The error that is allowed in a record of what is delayed, given how large that is."""
        raise NotImplementedError

    def with_past_read(self, t: Time, x: State, q: Array, args: Args) -> Float[Array, " q"]:
        """The discrete values with what equations read of the past, so that it is not needed any more."""
        return q

    def due(self, ticks: Float[Array, " clocks"]) -> Float[Array, " clocks"]:
        """The time of the next tick of each clock, given the number of ticks so far."""
        period, offset = self.clocks()
        ticks = lax.stop_gradient(ticks)
        # An event that happens once has an infinite period, and zero times infinity is not a number.
        return offset + jnp.where(ticks == 0, 0.0, ticks * period)

    def slope(self, t: Time, x: State, q: Array, args: Args) -> Float[Array, " n"]:
        """dx/dt, constant under a first derivative."""
        frozen, *point = constant_once((self, t, x, q, args))
        return frozen.field(*point)

    def rates(
        self, t: Time, x: State, q: Array, args: Args, slope: Array
    ) -> tuple[Float[Array, " guards"], Float[Array, " guards"]]:
        """Returns (the guards' values, their rates of change along `slope`), both constant under a first derivative."""
        # A rate is the slope of the guard where the event happens. It divides the guard in δ, whose derivative is exact
        # with a constant rate.
        frozen, t, x, q, args = constant_once((self, t, x, q, args))
        return jax.jvp(lambda t, x: frozen.guards(t, x, q, args), (t, x), (jnp.ones_like(t), slope))


class HybridState(AbstractAppending):
    """The state that is integrated: the continuous state `x`, the discrete values `q`, and the bookkeeping of events.
    The latter is packed into few arrays: XLA compiles the passing on of the state from step to step for each array.

    - `armed`: on which side of zero the guards are: `side.ABOVE`, `side.RESTS` or `side.BELOW`; `size`: how large they
        have been so far.
    - `ticks`, `due`: how often each clock has ticked, and when it does next.
    - `span`: how long the steps have been of late; `request`: where the step that was tried should have ended, or
        infinity.
    - `ended`: 1.0 once an event has ended the run; `stuck`: the number of one that happens again and again at one
        instant, below −1 for two that contradict each other (`rivals.pair_of`), else −1; `turns`: how often guards have
        fallen without time going on.
    - `count`: how many events there were; `table`: the first ones, or None where `StoredAdjoint` keeps them elsewhere.
    - `iteration`: how far repeated events are at this instant; None without such.
    - `past`: the record of what is delayed (`past.Past`); None without such.
    """

    x: Float[Array, " n"]
    q: Float[Array, " q"]
    of_guards: Float[Array, "2 guards"]
    of_clocks: Float[Array, "2 clocks"]
    of_run: Float[Array, "6"]
    table: EventRows | None
    iteration: Iteration | None = None
    past: Any = None

    @classmethod
    def of(
        cls, x: State, q: Array, table: EventRows | None, iteration: Iteration | None = None, **parts: Array
    ) -> "HybridState":
        """A state of all its parts."""
        packed = {field: jnp.stack([parts[name] for name in names]) for field, names in _PARTS.items()}
        return cls(x=x, q=q, table=table, iteration=iteration, **packed)

    def but(self, **changes: Any) -> "HybridState":
        """A copy with the named parts replaced."""
        whole = {name: changes.pop(name) for name in ("x", "q", "iteration", "past") if name in changes}
        for field, names in _PARTS.items():
            if not changes.keys().isdisjoint(names):
                parts = zip(names, getattr(self, field), strict=True)
                whole[field] = jnp.stack([changes.pop(name, old) for name, old in parts])
        assert not changes
        return dataclasses.replace(self, **whole)

    armed = property(lambda self: self.of_guards[..., 0, :])
    size = property(lambda self: self.of_guards[..., 1, :])
    ticks = property(lambda self: self.of_clocks[..., 0, :])
    due = property(lambda self: self.of_clocks[..., 1, :])
    span = property(lambda self: self.of_run[..., 0])
    request = property(lambda self: self.of_run[..., 1])
    ended = property(lambda self: self.of_run[..., 2])
    stuck = property(lambda self: self.of_run[..., 3])
    turns = property(lambda self: self.of_run[..., 4])
    count = property(lambda self: self.of_run[..., 5])


_PARTS = {
    "of_guards": ("armed", "size"),
    "of_clocks": ("ticks", "due"),
    "of_run": ("span", "request", "ended", "stuck", "turns", "count"),
}


def one_hot(index: Array, n: int) -> Bool[Array, " n"]:
    return jnp.arange(n) == index


class HybridTerm(diffrax.AbstractTerm):
    """The term of a problem with events. It takes no steps itself: `bound` gives the term for the discrete values at
    hand."""

    problem: AbstractHybridProblem

    def vf(self, t: Time, y: HybridState, args: Args) -> State:
        return self.problem.field(t, y.x, y.q, args)

    def contr(self, t0: Time, t1: Time, **kwargs: object) -> object:
        return t1 - t0

    def prod(self, vf: State, control: Time) -> State:
        raise NotImplementedError("a solver for events takes steps by the term of the discrete values at hand")


def problem_of(terms: Terms) -> AbstractHybridProblem:
    """The problem inside the terms that Diffrax hands to a solver or a controller, which may be wrapped in a direction
    of time."""
    return unwrapped(terms)[0].problem


def problem_after(terms: Terms, y: HybridState) -> AbstractHybridProblem:
    """The problem inside the terms, with the past of a state."""
    problem = problem_of(terms)
    return problem if y.past is None else problem.remembering(y.past.onwards(problem.resolution))


def bound(terms: Terms, y: HybridState) -> Any:
    """The terms of the equations that hold with the discrete values and the past of a state."""
    return rewrapped(terms, problem_after(terms, y).term(y.q))
