"""Reverse-mode differentiation of a solve from a record of its steps."""

import contextlib
import contextvars
import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ...base.aliases import PyTree, Solver, Terms
from ...base.errors import ModelError
from ...base.private_names import has_stored_adjoint, private
from ...host.members import batch_size
from ...host.staging import is_forwards, is_reversed_outside
from .appended import NOTED, AbstractAppending, apart, together
from .closure_conversion import SolveProgram, as_traced, by_itself_or_batched, closure_convert, unless_waiting
from .ends import AttemptedStep, Ending
from .recorded_loop import solve
from .resting import HeldBack, Resting
from .reverse_step import state_saves

LARGEST_RECORD = 2**25  # bytes; a solve whose record would be larger is left to `RecursiveCheckpointAdjoint`
# Bytes of a record that may have more rows than it must, up to 256, those of all members of a batch taken together:
# with 256 rows, states of up to 4 kB. Most solves then fit into the record, and no step is taken twice.
ROOMY_RECORD = 2**20
# The fewest rows. In a batch memory is what gradients cost: a thousand bouncing balls take 101 kB each and 52 ms with
# 256 rows, 25 kB and 19 ms with 64, 14 kB and 17 ms with 32.
ROWS, ROWS_IN_BATCH = 64, 32
# The largest states whose stages are a loop where a run is made by itself. What is computed on arrays takes a tenth
# longer to compile written out (0.2 s), and runs in 0.74 to 0.86 of the time: ladders of 40 to 4,000 cells.
LOOPED = 32

_forward: contextvars.ContextVar[bool] = contextvars.ContextVar("forward_mode", default=False)


class StoredAdjoint(diffrax.AbstractAdjoint):
    """Differentiates the numerical solution itself, step by step backwards, from a record of the accepted steps.

    Gradients are those of `diffrax.RecursiveCheckpointAdjoint`, to rounding, at a small multiple of the cost of the
    solve. During the solve, the start of each step is recorded in a table of 64 to 256 rows, in a large batch of fewer
    rows, at least 32. If a solve takes more steps than rows, it is repeated in pieces from stored points (checkpointing
    with two levels, Griewank & Walther 2008, Evaluating Derivatives, chapter 12). Memory hardly grows with `max_steps`,
    and without differentiation nothing is recorded. Tables to which steps append rows, such as the log of events, are
    stored once and are not part of the record.

    If a component of the state rests, its error is zero, and steps could grow without limit. They would not resolve the
    derivative, which is the motion after a small push. Therefore a differentiated run integrates a second, pushed
    solution while any component rests, and the error of that solution limits the steps, too.

    Rejected steps do not enter the derivative, so values in them need not be finite. Step sizes count as constant,
    except where they follow from given times: derivatives with respect to `t0`, `t1`, `dt0`, `SaveAt(ts=...)` and the
    times of `diffrax.ClipStepSizeController` and `diffrax.StepTo` are complete.

    `diffrax.RecursiveCheckpointAdjoint` takes over for solves with events, dense output or Brownian motion, and for
    records above 32 MB. It also does, with a `RuntimeWarning`, if the versions of Diffrax, Equinox or JAX lack a
    private name that is needed. Forward mode alone is refused: use `diffrax.ForwardMode()`.

    Second derivatives are forward mode over reverse mode: `jax.hessian`, or `jax.jvp` of `jax.grad`. They need steps
    that forward mode can differentiate, such as those of this package's solvers. Diffrax's Runge–Kutta methods loop
    over their stages and need an option for it: `diffrax.Dopri5(scan_kind="bounded")`.

    **Arguments:**

    - `members`: the size of the batch, for `jax.vmap(jax.jit(f))`, where the solve cannot see `jax.vmap`.
    - `known`: whether all values are known, so that nothing will be differentiated.
    """

    members: int = eqx.field(static=True, default=1)
    known: bool = eqx.field(static=True, default=False)

    def loop(self, **given: PyTree) -> PyTree:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The loop over the steps, called by `diffrax.diffeqsolve`."""
        if not has_stored_adjoint():
            return self._by_checkpoints(**given)
        terms, solver, saveat, max_steps = (given[name] for name in ("terms", "solver", "saveat", "max_steps"))
        init_state, progress_meter = given["init_state"], given["progress_meter"]
        # The table that steps append to counts neither in the size of a row nor in what is kept.
        y, empty = apart(init_state.y)
        init_state = dataclasses.replace(init_state, y=y)
        size = sum(
            leaf.size * leaf.dtype.itemsize
            for leaf in jax.tree.leaves(_arrays((init_state.y, init_state.solver_state)))
        )
        # A gradient outside of jit knows how large its batch is; inside, the tracers of `vmap` say it.
        members = max(self.members, batch_size((terms, given["args"], y, init_state.tprev)))
        # Events cost more than stages, so a run by itself that has events does not gain by stages that are written out:
        # with them the gradient of a bouncing ball takes 0.26 ms in place of 0.27, and a fifth longer to be traced.
        if members == 1 and isinstance(y, AbstractAppending):
            given["solver"] = solver = _in_a_loop(solver) or solver
        chunk, points = _table(max_steps, size, members)
        too_large = size * (chunk + points) > LARGEST_RECORD
        if given["event"] is not None or saveat.dense or _is_random(terms) or too_large:
            return self._by_checkpoints(
                **given | dict(init_state=dataclasses.replace(init_state, y=together(y, empty)))
            )
        # Diffrax' inner loop does not take these.
        for name in ("throw", "passed_solver_state", "passed_controller_state"):
            del given[name]

        # Diffrax's own loop, with functions in place of solver and controller that close over nothing.
        init_state = dataclasses.replace(
            init_state,
            **{
                name: _arrays(getattr(init_state, name))
                for name in ("y", "tprev", "tnext", "solver_state", "controller_state")
            },
        )
        functions, numbers = _functions(**{**given, "init_state": init_state})
        state = dataclasses.replace(
            init_state,
            made_jump=jnp.asarray(init_state.made_jump) if functions["jumps"] else False,
            result=as_traced(init_state.result),
            # Diffrax's loop hands controllers and meters their states and nothing else, so that flags for them travel
            # in these.
            controller_state=(init_state.controller_state, jnp.array(True)),
            progress_meter_state=(init_state.progress_meter_state, jnp.array(True)),
        )

        quick = _quickly(**{**given, "init_state": init_state}, made_jump=functions["jumps"]) if members == 1 else None
        forward, consts = functions["step"], numbers["step"]
        if quick is not None:
            forward, consts = by_itself_or_batched(*quick, forward, consts)
        stepper = _Solver(forward, consts, solver, terms)

        final_state, stats = private("loop")(
            **given
            | dict(
                solver=stepper,
                stepsize_controller=_Controller(functions["adapt"], numbers["adapt"], numbers["controller"]),
                progress_meter=_Meter(progress_meter),
                init_state=state,
            ),
            inner_while_loop=_inner_loop,
            outer_while_loop=_outer_loop(stepper, functions, numbers, empty, chunk, points),
        )
        final_state = dataclasses.replace(
            final_state,
            controller_state=final_state.controller_state[0],
            progress_meter_state=final_state.progress_meter_state[0],
        )
        return final_state, stats

    def _by_checkpoints(self, **given: Any) -> Any:
        """The loop as `diffrax.RecursiveCheckpointAdjoint` differentiates it, steps held back where components rest."""
        terms, solver, controller, args = (given[name] for name in ("terms", "solver", "stepsize_controller", "args"))
        state = given["init_state"]
        span = given["t1"] - state.tprev
        if not (self.known or _is_random(terms)) and Resting.of(terms, solver, controller, state.y, args, span):
            held = Ending(controller, (HeldBack(terms, solver, controller),))  # pyright: ignore[reportCallIssue]
            end, controlled = held.begun(state.tprev, state.tnext, state.controller_state, state.y, args, span)
            state = dataclasses.replace(state, tnext=end, controller_state=_arrays(controlled))
            given = given | dict(stepsize_controller=held, init_state=state)
        return diffrax.RecursiveCheckpointAdjoint().loop(**given)


def _is_random(terms: Terms) -> bool:
    """True if Brownian motion drives the solve."""

    def is_brownian(node: object) -> bool:
        return isinstance(node, diffrax.AbstractBrownianPath)

    return any(map(is_brownian, jax.tree.leaves(terms, is_leaf=is_brownian)))


def _table(max_steps: int | None, size: int, members: int) -> tuple[int, int]:
    """Returns (rows of the record, points kept) for states of `size` bytes. With steps for eight times their product,
    pieces are run again 4.5 times. Small states have more rows, so that most solves need no second run."""
    least = ROWS if members == 1 else ROWS_IN_BATCH
    chunk = min(max(ROOMY_RECORD // max(size * members, 1), least), 256)
    if max_steps is not None and members == 1:
        # With half as many points as rows, `max_steps` are at most eight times their product.
        chunk = max(chunk, math.isqrt(max_steps // 4))
    # An even number of points, since every other one is given up when all are in use.
    return chunk, chunk // 2 // 2 * 2


def _inner_loop(cond_fun, body_fun, start, *, max_steps, buffers, checkpoints):
    """The loop that saves at times within a step, not differentiated by itself."""
    # Its derivative is written by hand (`reverse_step`). A loop that Diffrax would differentiate keeps checkpoints.
    del checkpoints
    return private("while_loop")(cond_fun, body_fun, start, max_steps=max_steps, buffers=buffers, kind="lax")


def _outer_loop(
    stepper: "_Solver", functions: dict[str, Any], numbers: dict[str, Any], empty: PyTree, chunk: int, points: int
) -> Callable[..., Any]:
    """The loop over the steps: `solve`, given the body of Diffrax' loop as a function that closes over nothing."""

    def outer(cond_fun, body_fun, start, *, max_steps, buffers):
        del cond_fun, buffers
        start = _arrays(start)
        buffers = tuple((save.ts, save.ys) for save in state_saves(start))

        def body(state, buffers, active, first):
            state = dataclasses.replace(
                state,
                controller_state=(state.controller_state[0], active),
                progress_meter_state=(state.progress_meter_state[0], first),
            )
            out = _arrays(body_fun(_with_buffers(state, buffers)))
            saved = tuple((save.ts, save.ys) for save in state_saves(out))
            return _without_buffers(out), saved, stepper.noted, stepper.taken

        # Buffers of saved values stay out of the state: they would be part of every row and of every point kept.
        start = _without_buffers(start)
        flag = jnp.array(True)
        converted, consts = closure_convert(body, start, buffers, flag, flag)
        program = SolveProgram(
            **functions, body=converted, max_steps=max_steps, chunk=chunk, points=points,
            precision=jax.config.jax_default_matmul_precision,  # pyright: ignore[reportAttributeAccessIssue]
        )  # fmt: skip
        given = dict(state=start, buffers=buffers, table=_arrays(empty), body=consts)
        final, buffers, table = solve(numbers | given, program)
        final = _with_buffers(final, buffers)
        return dataclasses.replace(final, y=together(final.y, table))

    return outer


def _functions(
    *, args, terms, solver, stepsize_controller, saveat, t1, init_state, **_
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns (the functions of `SolveProgram` except its body, the arrays they close over)."""
    s = init_state
    # The controller's own times may be differentiated, so they are arguments and not closed over.
    controller, others = eqx.partition(stepsize_controller, eqx.is_inexact_array)
    order = solver.error_order(terms)

    def take_step(tprev, tnext, y, solver_state, made_jump):
        y1, y_error, dense, state, result = solver.step(terms, tprev, tnext, y, args, solver_state, made_jump)
        return y1, y_error, dense, _arrays(state), result

    def adapt(controller, tprev, tnext, y, y1, y_error, state):
        both = eqx.combine(controller, others)
        return both.adapt_step_size(tprev, tnext, y, y1, args, y_error, order, state)

    def convert_both(made_jump):
        step = closure_convert(take_step, s.tprev, s.tnext, s.y, s.solver_state, made_jump)
        y1, y_error, *_ = step[0].out_struct
        return step, closure_convert(adapt, controller, s.tprev, s.tnext, s.y, y1, y_error, s.controller_state)

    made_jump = s.made_jump
    step, adapted = convert_both(made_jump)
    # A controller that may report jumps makes `made_jump` an array: both functions are converted for that.
    if made_jump is False and adapted[0].out_struct[3] is not False:
        made_jump = jnp.array(False)
        step, adapted = convert_both(made_jump)
    y1, _, dense, *_ = step[0].out_struct
    parts = jax.tree.leaves(saveat.subs, is_leaf=lambda node: isinstance(node, diffrax.SubSaveAt))
    none = None, []

    def save_ts(part):
        def saved(t, tprev, tnext, dense):
            return part.fn(t, solver.interpolation_cls(t0=tprev, t1=tnext, **dense).evaluate(t), args)

        return none if part.ts is None else closure_convert(saved, s.tprev, s.tprev, s.tnext, dense)

    def save_step(part):
        return closure_convert(lambda t, y: part.fn(t, y, args), s.tprev, y1) if part.steps else none

    at_ts, at_steps = [save_ts(part) for part in parts], [save_step(part) for part in parts]
    rest, first, pushed = none, none, ()
    resting = Resting.of(terms, solver, stepsize_controller, s.y, args, t1 - s.tprev)
    if resting is not None:
        pushed = resting.begin(s.tprev, s.y)
        first = closure_convert(lambda *given: (resting.first_end(*given),), s.tprev, s.tnext, s.y)
        tried = AttemptedStep(
            t0=s.tprev, t1=s.tnext, y0=s.y, y1=s.y, accepted=jnp.array(False), jump=made_jump, start=s.tprev,
            end=s.tnext,
        )  # fmt: skip
        rest = closure_convert(lambda *given: resting.restrained(*given), tried, pushed)
    functions = dict(
        rest=rest[0], first=first[0], step=step[0], adapt=adapted[0], jumps=made_jump is not False,
        every=tuple(int(part.steps) for part in parts),
        save_ts=tuple(f for f, _ in at_ts), save_steps=tuple(f for f, _ in at_steps),
    )  # fmt: skip
    numbers = dict(
        rest=rest[1], first=first[1], pushed=pushed, step=step[1], adapt=adapted[1],
        controller=controller, t1=jnp.asarray(t1),
        ts=tuple(part.ts for part in parts),
        save_ts=tuple(c for _, c in at_ts), save_steps=tuple(c for _, c in at_steps),
    )  # fmt: skip
    return functions, numbers


def _quickly(*, args, terms, solver, init_state, made_jump, **_) -> tuple[PyTree, list[PyTree]] | None:
    """The step with its stages in a loop, if the solver has both forms: by itself, outside of batches, it takes the
    same time and compiles in a part of it. What is differentiated is the other form. States of arrays have it alone."""
    looped = _in_a_loop(solver)
    if looped is None or any(leaf.size > LOOPED for leaf in jax.tree.leaves(init_state.y)):
        return None
    s = init_state

    def take_step(tprev, tnext, y, solver_state, made_jump):
        y1, y_error, dense, state, result = looped.step(terms, tprev, tnext, y, args, solver_state, made_jump)
        return y1, y_error, dense, _arrays(state), result

    jump = jnp.array(False) if made_jump else False
    return closure_convert(take_step, s.tprev, s.tnext, s.y, s.solver_state, jump)


def _in_a_loop(solver: Solver) -> Solver:
    """The solver with its stages in a loop; None if it has but one form, or the user has chosen."""
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        inner = _in_a_loop(solver.solver)
        return None if inner is None else dataclasses.replace(solver, solver=inner)
    return dataclasses.replace(solver, looped=True) if getattr(solver, "looped", False) is None else None


class _Solver:
    """The part of a solver's interface that Diffrax's loop calls. `noted` are the rows that the last step appends to
    the table of the state, `taken` its end and error."""

    # Diffrax's loop returns its own state and no more: what a step appends, and its error, leave the trace by
    # attributes.
    noted: PyTree = None
    taken: PyTree = None

    def __init__(self, step, consts, solver, terms):
        self.function, self.consts, self.interpolation_cls = step, consts, solver.interpolation_cls
        self.order = solver.error_order(terms)

    def error_order(self, terms):
        return self.order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, y_error, dense, *rest = self.function(self.consts, t0, t1, y0, solver_state, made_jump)
        self.noted, self.taken = dense.get(NOTED), (y1, y_error)
        return y1, y_error, dense, *rest


class _Controller:
    """The part of a controller's interface that Diffrax's loop calls. No step is accepted for a member of a batch that
    waits."""

    def __init__(self, adapt, consts, controller):
        self.function, self.consts, self.controller = adapt, consts, controller

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, order, state):
        state, active = state
        keep, *rest, state, result = self.function(self.consts, self.controller, t0, t1, y0, y1, y_error, state)
        return unless_waiting(active, jnp.asarray(keep), jnp.array(False)), *rest, (state, active), result


class _Meter:
    """A progress meter that does not run when pieces are run again."""

    def __init__(self, meter):
        self.meter = meter

    def step(self, state, progress):
        state, first = state
        if not isinstance(self.meter, diffrax.NoProgressMeter):
            state = lax.cond(first, lambda: self.meter.step(state, progress), lambda: state)
        return state, first


def _arrays(tree):
    def one(leaf):
        leaf = jnp.asarray(leaf)
        return lax.convert_element_type(leaf, leaf.dtype)  # no weak types: those would change in the loop

    return jax.tree.map(one, tree)


def _without_buffers(state):
    return _with_buffers(state, tuple((None, None) for _ in state_saves(state)))


def _with_buffers(state, buffers):
    if not buffers:
        return state
    return eqx.tree_at(
        lambda s: [leaf for save in state_saves(s) for leaf in (save.ts, save.ys)],
        state,
        [leaf for pair in buffers for leaf in pair],
        is_leaf=lambda leaf: leaf is None,
    )


@contextlib.contextmanager
def forward_mode() -> Iterator[None]:
    """A context in which functions are traced for forward-mode differentiation: the default adjoint is
    `diffrax.ForwardMode`."""
    token = _forward.set(True)
    try:
        yield
    finally:
        _forward.reset(token)


def default_adjoint(given: PyTree, members: int = 1, known: bool = False) -> diffrax.AbstractAdjoint:
    """The adjoint of a run of the arguments `given` where the user names none. `members` is the size of the batch that
    they are; `known`, that all of them have values.

    **Raises:**

    - `ModelError` for reverse mode around another differentiation: a record of steps goes back over a run, and nothing
        goes back over that.
    """
    if is_reversed_outside(given):
        raise ModelError(
            "a run is differentiated in reverse mode around another differentiation, as by jax.grad(jax.grad(f)): "
            "put the forward mode outside, as jax.hessian(f) and jax.jacfwd(jax.grad(f)) do"
        )
    if is_forwards(given) or _forward.get():
        return diffrax.ForwardMode()
    return StoredAdjoint(members, known) if has_stored_adjoint() else diffrax.RecursiveCheckpointAdjoint()
