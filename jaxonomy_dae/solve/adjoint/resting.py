"""Steps of a run that is differentiated, while some of its state rests.

The error of a step is that of the state. Where a component rests, its error is zero whatever the step; but the
derivative of the solution, which is the motion after a small push, needs steps that resolve this motion. So while any
component rests, whatever else moves, a second run is taken along in which those that rest were given such a push, and
steps are not longer than it allows.
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ...base.aliases import Args, Controller, Numeric, PyTree, Solver, State, Terms, Time
from ...base.private_names import FROM_CONTROLLER
from .closure_conversion import SolveProgram, any_member, as_traced
from .ends import AttemptedStep, End

# PUSH and MOTION are parts of a component's scale, |y| + atol/rtol: its size, and what tolerances make of zero.
# Components at rest are pushed by PUSH in the second run. A push of this size stands for an infinitesimal one; the
# error of a step, rtol of the scale, is 33·rtol of it, and this is what derivatives are resolved to
# (test_gradients_at_rest.py::test_beside_each_other).
PUSH = 0.03
MOTION = 0.01  # a component rests if its slope would move it by less over the whole run
# The first step is at most this part of the inverse rate at which slopes answer to a push: it was chosen by what moves,
# and may be longer than the whole motion of what rests (test_gradients_at_rest.py::test_the_first_step).
RESOLVED = 0.1
# The first SETTLING attempts after a push are TINY of a step: Newton's method at their ends puts the pushed state where
# algebraic equations and constraints hold.
TINY = 1e-6
SETTLING = 3
TRIES = 50  # of finding a step that the second run allows: each shortens it at least by half, fifty of them to rounding


class Pushed(eqx.Module):
    """The state of the second run.

    - `y`, `solver_state`: where it stands; `fresh`: no step has been taken since the last push.
    - `exists`: whether there is one; `given_up`: no step was short enough for it, so that it limits nothing any more.
    - `resting`: the components that were pushed and are still at rest in the first run, shape (n,).
    - `next_y`, `next_state`, `allowed`: where it stands after the step to take next, and how long the step after that
        may be.
    """

    y: Float[Array, " n"]
    solver_state: PyTree
    fresh: Bool[Array, ""]
    exists: Bool[Array, ""]
    resting: Bool[Array, " n"]
    given_up: Bool[Array, ""]
    next_y: Float[Array, " n"]
    next_state: PyTree
    allowed: Float[Array, ""]  # how long the step after the next one may be


class Resting(eqx.Module):
    """The equations, solver and controller of the second run, in which components at rest are pushed a little so that
    steps resolve their motion. `restrained` changes the end of the next step."""

    terms: Terms
    solver: Solver
    controller: Controller
    args: Args
    span: Time

    @staticmethod
    def of(terms: Terms, solver: Solver, controller: Controller, y: State, args: Args, span: Time) -> "Resting | None":
        """Prepares a second run. None where steps are prescribed or have no error estimate, for a state that is not one
        array (apart from what events keep beside it), and where equations read the past, of which there is one."""
        base = _innermost(controller)
        rtol, x = getattr(base, "rtol", None), _moving(y)
        is_array = isinstance(x, jax.Array) and x.ndim == 1 and x.size > 0
        is_adaptive = isinstance(_inner(solver), diffrax.AbstractAdaptiveSolver) and rtol is not None
        prescribed = isinstance(base, diffrax.StepTo | diffrax.ConstantStepSize)
        # Steps that the user prescribes are not to be changed, and without an error estimate a second run would limit
        # nothing.
        if prescribed or not is_array or not is_adaptive or getattr(y, "past", None) is not None:
            return None
        return Resting(terms, _small(solver, base), base, args, span)

    def begin(self, t: Time, y: State) -> Pushed:
        """The initial value of the second run's state: it does not exist yet."""
        resting, y = still((self, y))
        terms, solver, x, _ = resting._between_events(y, y)
        shapes = jax.eval_shape(lambda: solver.init(terms, t, t, x, resting.args))
        state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        no, none = jnp.array(False), jnp.zeros(x.shape, bool)
        return Pushed(
            y=x, solver_state=state, fresh=no, exists=no, resting=none, given_up=no, next_y=x, next_state=state,
            allowed=jnp.full_like(jnp.asarray(t), jnp.inf),
        )  # fmt: skip

    def first_end(self, t: Time, end: Time, y: State) -> Time:
        """The end of the first step, made earlier where a component rests. A second run begins after a step only, so
        the first step must not exceed `RESOLVED` divided by the rate at which slopes answer to a push."""
        resting, t, end, y = still((self, t, end, y))
        terms, solver, x, _ = resting._between_events(y, y)
        scale = resting._scale(x)

        def look(point, _):
            slope = solver.func(terms, t, point, resting.args)
            return x + jnp.where(resting._rests(slope, x), PUSH * scale * _pattern(x), 0.0), slope

        _, (slope, pushed) = lax.scan(look, x, length=2)  # a loop: the field is compiled once
        rests = resting._rests(slope, x)
        rate = jnp.max(jnp.abs(pushed - slope) / scale) / PUSH
        resolved = jnp.minimum(end, t + RESOLVED / jnp.where(rate > 0, rate, 1.0))
        # A push out of where the field is defined says nothing of rates; then the shortest step is taken.
        first = jnp.where(jnp.isfinite(rate), jnp.where(rate > 0, resolved, end), t)
        return jnp.where(jnp.any(rests), jnp.maximum(first, _shortened(t, end)), end)

    def restrained(self, step: AttemptedStep, pushed: Pushed) -> tuple[Array, Pushed]:
        """Returns (the end of the next step, the second run's state after `step`); begins a second run where a
        component has come to rest. `step.y1` is `step.y0` if the step was rejected."""
        resting, step, pushed = still((self, step, pushed))
        x0, x1, h = _moving(step.y0), _moving(step.y1), step.t1 - step.t0
        # The mean slope of the step is at hand: to evaluate the field would be one more copy of it in the program.
        rests = resting._rests((x1 - x0) / jnp.where(h > 0, h, 1.0), x1)
        rests = jnp.where(step.accepted, rests, pushed.resting)
        look = jnp.any(rests) & (step.accepted | pushed.exists) & ~pushed.given_up & (step.end > step.start)
        # After a step that was rejected the second run stands where the first one still is. After an accepted one it
        # has to be taken along, or begun anew.
        without = eqx.tree_at(lambda p: p.exists, pushed, pushed.exists & ~step.accepted)
        return lax.cond(
            any_member(look),
            lambda *given: resting._looked(*given),
            lambda look, rests, step, pushed, without: (step.end, without),
            look,
            rests,
            step,
            pushed,
            without,
        )

    def _looked(
        self, look: Bool[Array, ""], rests: Bool[Array, " n"], step: AttemptedStep, pushed: Pushed, without: Pushed
    ) -> tuple[Array, Pushed]:
        terms, solver, x, changed = self._between_events(step.y0, step.y1)
        on, new = step.accepted & pushed.exists, step.accepted & ~pushed.exists
        # What comes to rest later is pushed with what else has by then: solvers with a history begin anew after a push,
        # and in a large model that settles one component after the other comes to rest.
        later, still_resting = rests & ~pushed.resting, rests & pushed.resting
        again = on & jnp.any(later) & (jnp.all(rests) | (jnp.sum(later) >= jnp.sum(still_resting)))
        push = jnp.where(new, rests, later & again)
        y = jnp.where(on, pushed.next_y, jnp.where(new, x, pushed.y))
        y = y + jnp.where(push, PUSH * self._scale(x) * _pattern(x), 0.0)
        state = jax.tree.map(lambda a, b: jnp.where(on, a, b), pushed.next_state, pushed.solver_state)
        fresh = jnp.where(on, step.jump | changed | again, new | pushed.fresh)
        longest = jnp.where(on, pushed.allowed, jnp.inf)
        start, end = step.start, jnp.minimum(step.end, step.start + longest)
        order = solver.error_order(terms)
        idle = y, pushed.next_y, pushed.next_state, end, jnp.full_like(end, jnp.inf), ~look, jnp.array(0)

        def attempt(found):
            """One try of a step up to `end`; if it is too long, proposes a shorter end. The first tries after a fresh
            push are not counted as steps: they only put the state where the constraints and algebraic equations
            hold."""
            y, _, _, end, _, done, tries = found
            settles = fresh & (tries < SETTLING)
            planned, end = end, jnp.where(settles, _shortened(start, end), end)
            y1, error, _, state1, result = solver.step(terms, start, end, y, self.args, state, fresh)
            # A controller without memory: that of the first run belongs to other errors.
            _, controlled = self.controller.init(terms, start, end, y, end - start, self.args, None, order)
            keep, _, following, *_ = self.controller.adapt_step_size(
                start, end, y, y1, self.args, error, order, controlled
            )
            keep = keep & jnp.all(jnp.isfinite(y1)) & diffrax.is_okay(as_traced(result))
            shorter = jnp.where(jnp.isfinite(following), jnp.clip(following - start, 0.0, 0.5 * (end - start)), 0.0)
            # Not less than a tenth: an error that is not finite says nothing about how much shorter would do.
            shorter = jnp.maximum(shorter, 0.1 * (end - start))
            settled = settles & jnp.all(jnp.isfinite(y1))
            keep = keep & ~settles
            end = jnp.where(keep, end, jnp.where(settles, planned, start + shorter))
            after = jnp.where(settled, y1, y), y1, state1, end, following - end, keep, tries + 1
            return jax.tree.map(lambda a, b: jnp.where(done, a, b), found, after)

        found = lax.while_loop(
            lambda found: any_member(~found[5] & (found[6] < TRIES)), attempt, jax.tree.map(jnp.asarray, idle)
        )
        y, next_y, next_state, end, allowed, done, _ = found
        exists = look & done
        resting = jnp.where(new | again, rests, still_resting)
        given_up = pushed.given_up | (look & ~done)
        after = Pushed(
            y=y, solver_state=state, fresh=fresh, exists=exists, resting=resting, given_up=given_up, next_y=next_y,
            next_state=next_state, allowed=allowed,
        )  # fmt: skip
        after = jax.tree.map(lambda a, b: jnp.where(exists, a, b), after, without)
        after = eqx.tree_at(lambda p: p.given_up, after, given_up)
        return jnp.where(exists, end, step.end), after

    def _rests(self, slope: Array, x: Array) -> Bool[Array, " n"]:
        """True for components at rest, shape (n,): at this slope they would move by less than `MOTION` of their scale
        over the whole run."""
        return jnp.abs(slope) * self.span <= MOTION * self._scale(x)

    def _scale(self, x: Array) -> Array:
        rtol, atol = self._tolerances(x)
        return jnp.abs(x) + atol / jnp.maximum(rtol, jnp.finfo(x.dtype).eps)

    def _tolerances(self, x: Array) -> tuple[Array, Array]:
        return jnp.asarray(self.controller.rtol, x.dtype), jnp.asarray(self.controller.atol, x.dtype)

    def _between_events(self, y0: State, y1: State) -> tuple[Numeric, Numeric, Numeric, Numeric]:
        """Returns (terms, solver, state, whether an event changed them) after a step from y0 to y1."""
        if isinstance(y1, jax.Array):
            return self.terms, self.solver, y1, False
        return self.solver.between_events(self.terms, y0, y1)


def held_back(
    state: State,
    new: PyTree,
    accepted: Bool[Array, ""],
    pushed: PyTree,
    numbers: dict[str, PyTree],
    program: SolveProgram,
) -> tuple[Any, Bool[Array, ""], Any]:
    """Returns (Diffrax's state `new` with its next step shortened where components rest, whether it was shortened, the
    second run's state)."""
    if program.rest is None:
        return new, jnp.array(False), pushed
    jump = new.made_jump if program.jumps else False  # some versions of JAX make an array of a constant
    step = AttemptedStep(
        t0=state.tprev, t1=state.tnext, y0=state.y, y1=new.y, accepted=accepted, jump=jump, start=new.tprev,
        end=new.tnext,
    )  # fmt: skip
    end, pushed = program.rest(numbers["rest"], step, pushed)
    return dataclasses.replace(new, tnext=end), end < new.tnext, pushed


class HeldBack(End):
    """Steps resolve derivatives of components at rest, for all adjoints but the record of `StoredAdjoint`, which sees
    to it by itself. The state of this end is (the length of the run, the second run's state)."""

    terms: Terms
    solver: Solver
    controller: Controller

    def _resting(self, y: State, args: Args, span: Time) -> Resting:
        found = Resting.of(self.terms, self.solver, self.controller, y, args, span)
        assert found is not None
        return found

    def first(self, t, end, y, args, span):
        resting = self._resting(y, args, span)
        return _no_later(t, end, resting.first_end(t, end, y)), (span, resting.begin(t, y))

    def next(self, step, args, state):
        span, pushed = state
        after = jax.tree.map(lambda a, b: jnp.where(step.accepted, b, a), step.y0, step.y1)
        tried = step.but(y1=after, result=None, states=None)
        allowed, pushed = self._resting(step.y0, args, span).restrained(tried, pushed)
        return step.but(end=_no_later(step.start, step.end, allowed)), (span, pushed)


def _pattern(x: Array) -> Array:
    """The relative size (0.5 to 1.5) and sign of the push to each component, shape (n,). It is irregular, so that the
    motion it excites is neither symmetric nor a new state of rest."""
    # A hash, since XLA computes this anew wherever it is read: sines took 76 µs a step of 4,000 states, this takes 2.
    k = (jnp.arange(x.size, dtype=jnp.uint32) + 1) * jnp.uint32(0x9E3779B1)
    k = (k ^ (k >> 15)) * jnp.uint32(0x85EBCA77)
    part = (k ^ (k >> 13)).astype(x.dtype) / 2.0**31 - 1.0  # −1 to 1
    return part + jnp.where(part < 0, -0.5, 0.5)


def _no_later(start: Time, end: Time, allowed: Time) -> Time:
    """The end of a step, no later than `allowed`. An end taken from `allowed` moves with `start` under differentiation:
    the length of the step is constant."""
    return jnp.where(allowed < end, start + still(allowed - start), end)


def _shortened(start: Time, end: Time) -> Time:
    """The end of a step so short that it changes nothing, but long enough to advance time."""
    shortest = 16 * jnp.finfo(start.dtype).eps * jnp.abs(start)
    return jnp.minimum(end, start + jnp.maximum(TINY * (end - start), shortest))


def still(tree: PyTree) -> Any:
    """The tree with all arrays constant under differentiation."""
    return jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def _moving(y: State) -> Numeric:
    """The array that is integrated: y itself, or `y.x` of a state with events."""
    return y if isinstance(y, jax.Array) else getattr(y, "x", y)


def _inner(solver: Solver) -> Solver:
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    return solver


def _small(solver: Solver, controller: Controller) -> Numeric:
    """A copy of the solver that compiles quickly: stages in a loop where supported, and Newton tolerances taken from
    the controller (as `diffeqsolve` does)."""
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        return dataclasses.replace(solver, solver=_small(solver.solver, controller))
    if hasattr(solver, "looped"):
        solver = dataclasses.replace(solver, looped=True)
    finder = getattr(solver, "root_finder", None)
    if finder is not None:
        open_ = [n for n in ("rtol", "atol", "norm") if getattr(finder, n, None) is FROM_CONTROLLER]
        values = {name: getattr(controller, name) for name in open_}
        solver = dataclasses.replace(solver, root_finder=dataclasses.replace(finder, **values))
    return solver


def _innermost(controller: Controller) -> Controller:
    while hasattr(controller, "controller"):
        controller = controller.controller
    return controller
