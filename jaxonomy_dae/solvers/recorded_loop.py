"""The loop over the steps of a solve that records them, and its derivative by going back over the record."""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax

from .hoisted import Program, any_member, apart, going, read, rows, unless_waiting, written
from .reverse_step import ReverseStep
from .step_times import StepTimes


@eqx.filter_custom_vjp
def solve(numbers: dict[str, Any], program: Program) -> tuple[Any, Any]:
    """Steps until the end: the final `(state, buffers)`.

    `numbers` holds every array that the solve depends on: `state` and `buffers` to start from, `t1`, the `controller`'s
    own, the times `ts` of each part of `SaveAt`, and by the names of `program`'s functions what these close over.
    """

    def advance(carry):
        state, buffers = carry
        active = going(state, numbers, program)
        new, buffers = program.body(numbers["body"], state, buffers, active, jnp.array(True))
        return unless_waiting(active, new, state), buffers

    start = numbers["state"], numbers["buffers"]
    return lax.while_loop(lambda carry: any_member(going(carry[0], numbers, program)), advance, start)


class _Recorder:
    """Attempts steps, and keeps what those since the last multiple of `chunk` started from, as far as accepted.

    A carry is `(state, end of the last accepted step, derivatives of the times)`. Rows count the same for all members
    of a batch, and each says which members accepted it; a row that none did is written over.
    """

    def __init__(self, numbers: dict[str, Any], program: Program, times: StepTimes):
        self.numbers, self.program, self.times = numbers, program, times

    def start(self):
        state = self.numbers["state"]
        return state, jnp.full_like(state.tprev, -jnp.inf), self.times.start()

    def going(self, carry):
        return any_member(going(carry[0], self.numbers, self.program))

    def empty(self):
        return rows(self._row(self.start(), jnp.array(False)), self.program.chunk)

    def _row(self, carry, accepted):
        state, last, moves = carry
        row = dict(y=state.y, solver_state=state.solver_state, tprev=state.tprev, tnext=state.tnext)
        jump = state.made_jump if self.program.jumps else None
        return row | dict(made_jump=jump, last=last, moves=moves[:2], accepted=accepted)

    def run(self, carry, buffers, count, first):
        """At most `count` attempted steps: (carry, buffers, record, rows filled)."""

        def body(state, buffers, active, first):
            return self.program.body(self.numbers["body"], state, buffers, active, first)

        def advance(loop):
            carry, buffers, k, record, filled = loop
            state, last, moves = carry
            active = going(state, self.numbers, self.program)
            new, buffers = apart(k < count, lambda c: body(*c, active, first), (state, buffers))
            accepted = active & (new.num_accepted_steps > state.num_accepted_steps)
            filled = jnp.where(k % self.program.chunk == 0, 0, filled)
            record = written(record, filled, self._row(carry, accepted))
            after = new, jnp.where(accepted, state.tnext, last), self.times.after(state, moves)
            carry = unless_waiting(active, after, carry)
            return carry, buffers, k + 1, record, filled + any_member(accepted).astype(filled.dtype)

        zero = jnp.array(0, jnp.int32)
        loop = (carry, buffers, zero, self.empty(), zero)
        loop = lax.while_loop(lambda loop: (loop[2] < count) & self.going(loop[0]), advance, loop)
        carry, buffers, _, record, filled = loop
        return carry, buffers, record, filled


@solve.def_fwd
def _(perturbed, numbers, program):
    recorder = _Recorder(numbers, program, StepTimes(perturbed, numbers, program))
    points = program.points

    def advance(loop):
        carry, buffers, chunks, stride, kept, _, _ = loop

        def thin():
            return jax.tree.map(lambda a: a.at[: points // 2].set(a[:points:2]), kept), 2 * stride

        kept, stride = lax.cond(chunks == points * stride, thin, lambda: (kept, stride))
        row = jnp.where(chunks % stride == 0, chunks // stride, points)  # the last row is for what is not kept
        kept = written(kept, row, carry)
        carry, buffers, record, filled = recorder.run(carry, buffers, program.chunk, jnp.array(True))
        return carry, buffers, chunks + 1, stride, kept, record, filled

    start = recorder.start()
    one, zero = jnp.array(1, jnp.int32), jnp.array(0, jnp.int32)
    loop = (start, numbers["buffers"], zero, one, rows(start, points + 1), recorder.empty(), zero)
    loop = lax.while_loop(lambda loop: recorder.going(loop[0]), advance, loop)
    (state, _, moves), buffers, chunks, stride, kept, record, filled = loop
    return (state, buffers), (state, moves, chunks, stride, kept, record, filled)


@solve.def_bwd
def _(residuals, cotangents, perturbed, numbers, program):
    state, moves, chunks, stride, kept, record, filled = residuals
    times = StepTimes(perturbed, numbers, program)
    recorder = _Recorder(numbers, program, times)
    reverse = ReverseStep(cotangents, perturbed, numbers, program, times)
    chunks, stride, filled = (eqxi.unvmap_max(v) for v in (chunks, stride, filled))
    blank = jax.tree.map(jnp.zeros_like, numbers["buffers"])  # saved nowhere: dead code

    def again(q):
        point = q // stride
        count = (q - point * stride + 1) * program.chunk
        _, _, record, filled = recorder.run(read(kept, point), blank, count, jnp.array(False))
        return record, filled

    def advance(loop):
        q, record, filled, carry = loop

        def one(inner):
            k, carry = inner
            return k - 1, apart(k > 0, reverse.step, carry, read(record, k - 1))

        _, carry = lax.while_loop(lambda inner: inner[0] > 0, one, (filled, carry))
        record, filled = lax.cond(q > 0, again, lambda _: (record, filled), q - 1)
        return q - 1, record, filled, carry

    loop = (chunks - 1, record, filled, reverse.start(state, moves))
    *_, carry = lax.while_loop(lambda loop: loop[0] >= 0, advance, loop)
    return reverse.finish(carry)
