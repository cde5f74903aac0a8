"""The loop over the steps of a solve that records them, and its derivative by going back over the record."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ...base.aliases import PyTree
from ...base.private_names import private
from ...host.whole_records import SET, flag, is_known_to_be_whole
from .appended import appended
from .closure_conversion import SolveProgram, any_member, apart, going, read, rows, unless_waiting, written
from .packing import Packing
from .resting import held_back
from .reverse_step import ReverseStep
from .step_times import StepTimes


@eqx.filter_custom_vjp
def solve(numbers: dict[str, PyTree], program: SolveProgram) -> tuple[PyTree, PyTree, PyTree]:
    """Takes steps until the end and returns the final `(state, buffers, table)`.

    `numbers` holds every array that the solve depends on: `state`, `buffers` and `table` to start from, `t1`, the
    `controller`'s own, the times `ts` of each part of `SaveAt`, and by the names of `program`'s functions what these
    close over.
    """

    def advance(carry):
        state, buffers, table = carry
        active = going(state, numbers, program)
        # This loop is the whole solve where nothing is differentiated: it records nothing, and holds no step back.
        new, buffers, noted, _ = program.body(numbers["body"], state, buffers, active, jnp.array(True))
        # A step that is rejected appends nothing: it leaves the state as it was.
        return unless_waiting(active, new, state), buffers, appended(table, noted, state.y, new.y)

    start = numbers["state"], numbers["buffers"], numbers["table"]
    return lax.while_loop(lambda carry: any_member(going(carry[0], numbers, program)), advance, start)


class _Recorder:
    """Attempts steps and records what each accepted one started from, since the last multiple of `chunk`.

    Loops carry `(row, rest)`, both packed: what a row of the record holds, and the rest of Diffrax's state. Rows count
    the same for all members of a batch, and each says which members accepted it; a row that none did is written over.
    """

    def __init__(self, numbers: dict[str, PyTree], program: SolveProgram, times: StepTimes):
        self.numbers, self.program, self.times = numbers, program, times
        self.row, self.rest = (Packing(part) for part in self._given(numbers["state"], times.start()))

    def _given(self, state, moves):
        return self._taken_apart(state, jnp.full_like(state.tprev, -jnp.inf), moves, self.numbers["pushed"])

    def start(self):
        """The carry at the start, packed."""
        state, moves = self.numbers["state"], self.times.start()
        if self.program.first is not None:  # it may be shorter for what rests; its end then moves with its start
            (first,) = self.program.first(self.numbers["first"], state.tprev, state.tnext, state.y)
            held = first < state.tnext
            state = dataclasses.replace(state, tnext=jnp.where(held, first, state.tnext))
            if self.times.count:
                moves = moves[0], jnp.where(held, moves[0], moves[1]), *moves[2:]
        return self.pack(self._given(state, moves))

    def _taken_apart(self, state, last, moves, pushed):
        names = ("y", "solver_state", "tprev", "tnext") + (("made_jump",) if self.program.jumps else ())
        # A row holds what a step depends on and nothing else: the larger it is, the fewer rows a record has.
        row = {name: getattr(state, name) for name in names} | dict(last=last, moves=moves[:2])
        return row, (dataclasses.replace(state, **dict.fromkeys(names)), moves[2:], pushed)

    def pack(self, carry):
        return self.row.pack(carry[0]), self.rest.pack(carry[1])

    def unpack(self, packed):
        """Returns (state, end of the last accepted step, derivatives of the times, second run of `resting`)."""
        row, (state, moves, pushed) = self.row.unpack(packed[0]), self.rest.unpack(packed[1])
        last, first_moves = row.pop("last"), row.pop("moves")
        return dataclasses.replace(state, **row), last, (*first_moves, *moves), pushed

    def going(self, packed):
        return any_member(going(self.unpack(packed)[0], self.numbers, self.program))

    def empty(self, start):
        return rows((start[0], jnp.array(False)), self.program.chunk)

    def run(self, packed, buffers, table, record, filled, count, first):
        """Attempts at most `count` steps. Returns (carry, buffers, table, record, rows filled). The rows of
        `record` are overwritten; `filled` of them were in use. Where the table is None, nothing is appended."""
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), self.program.body.out_struct[2])

        def attempt(loop):
            packed, buffers, *_ = loop
            carry = self.unpack(packed)
            state, last, moves, pushed = carry
            active = going(state, self.numbers, self.program)
            new, buffers, noted, taken = self.program.body(self.numbers["body"], state, buffers, active, first)
            accepted = active & (new.num_accepted_steps > state.num_accepted_steps)
            new, held, pushed = held_back(state, new, accepted, pushed, self.numbers, self.program)
            after = new, jnp.where(accepted, state.tnext, last), self.times.after(state, moves, taken, held), pushed
            # Members of a batch that have finished keep what they have, while the others go on.
            after = unless_waiting(active, after, carry)
            return self.pack(self._taken_apart(*after)), buffers, noted, accepted

        def advance(loop):
            packed, buffers, table, k, record, filled = loop
            before = packed[0]
            packed, buffers, noted, accepted = apart(k < count, attempt, (packed, buffers, none, jnp.array(False)))
            if table is not None:
                table = appended(table, noted, self.row.unpack(before)["y"], self.row.unpack(packed[0])["y"])
            # A new chunk is recorded over the last one: only the rows of one chunk are held at a time.
            filled = jnp.where(k % self.program.chunk == 0, 0, filled)
            record = written(record, filled, (before, accepted))
            return packed, buffers, table, k + 1, record, filled + any_member(accepted).astype(filled.dtype)

        loop = (packed, buffers, table, jnp.array(0, jnp.int32), record, filled)
        loop = lax.while_loop(lambda loop: (loop[3] < count) & self.going(loop[0]), advance, loop)
        packed, buffers, table, _, record, filled = loop
        return packed, buffers, table, record, filled


@solve.def_fwd
def _(perturbed, numbers, program):
    recorder = _Recorder(numbers, program, StepTimes(perturbed, numbers, program))
    points = program.points

    def advance(loop):
        carry, buffers, table, chunks, stride, kept, record, filled = loop

        # When all points are in use, every other one is given up and the stride doubles: their number stays bounded
        # however long the solve is. A loop of one or no turn, since XLA copies what a `cond` passes through.
        def thinned(both):
            return jax.tree.map(lambda a: a.at[: points // 2].set(a[:points:2]), both[0]), 2 * both[1]

        kept, stride = lax.while_loop(lambda both: chunks == points * both[1], thinned, (kept, stride))
        row = jnp.where(chunks % stride == 0, chunks // stride, points)  # the last row is for what is not kept
        kept = written(kept, row, carry)
        carry, buffers, table, record, filled = recorder.run(
            carry, buffers, table, record, filled, program.chunk, jnp.array(True)
        )
        return carry, buffers, table, chunks + 1, stride, kept, record, filled

    start = recorder.start()
    one, zero = jnp.array(1, jnp.int32), jnp.array(0, jnp.int32)
    saved = numbers["buffers"], numbers["table"]
    loop = (start, *saved, zero, one, rows(start, points + 1), recorder.empty(start), zero)
    loop = lax.while_loop(lambda loop: recorder.going(loop[0]), advance, loop)
    carry, buffers, table, chunks, stride, kept, record, filled = loop
    state, _, moves, _ = recorder.unpack(carry)
    # Outside of jit the pullback is compiled when the values are known. Told by this flag that nothing has to be run
    # again, it leaves half of the program out (`host/whole_records.py`).
    return (state, buffers, table), (state, moves, chunks, stride, kept, record, filled, flag(chunks <= 1))


@solve.def_bwd
def _(residuals, cotangents, perturbed, numbers, program):
    # JAX calls this rule outside of the context in which the solve was called.
    with jax.default_matmul_precision(program.precision):
        return _backwards(residuals, cotangents, perturbed, numbers, program)


def _backwards(residuals, cotangents, perturbed, numbers, program):
    residuals, numbers = jax.tree.map(jnp.asarray, (residuals, numbers))  # JAX hands constants over as its literals
    state, moves, chunks, stride, kept, record, filled, is_whole = residuals
    times = StepTimes(perturbed, numbers, program)
    recorder = _Recorder(numbers, program, times)
    reverse = ReverseStep(cotangents, perturbed, numbers, program, times)
    # In a batch, all members go back over as many rows as the longest solve has.
    chunks, stride, filled = (private("unvmap_max")(v) for v in (chunks, stride, filled))
    blank = jax.tree.map(jnp.zeros_like, numbers["buffers"])  # saved nowhere: dead code
    start = reverse.start(state, moves)
    packing = Packing(start)

    def backwards(packed, row):
        row, accepted = row
        return packing.pack(reverse.step(packing.unpack(packed), recorder.row.unpack(row), accepted))

    def over(record, filled, packed):
        def one(inner):
            k, packed = inner
            return k - 1, apart(k > 0, backwards, packed, read(record, k - 1))

        return lax.while_loop(lambda inner: inner[0] > 0, one, (filled, packed))[1]

    def advance(loop):
        q, record, filled, packed = loop
        # The record holds the last chunk. Each one before is taken once more, from the nearest point kept. A count of
        # zero steps, instead of a `cond`, and before the rows are read: XLA would copy the record otherwise.
        point = q // stride
        count = jnp.where(q == chunks - 1, 0, (q - point * stride + 1) * program.chunk)
        again = recorder.run(read(kept, point), blank, None, record, filled, count, jnp.array(False))
        *_, record, filled = again
        return q - 1, record, filled, over(record, filled, packed)

    packed = packing.pack(start)
    if is_known_to_be_whole(is_whole):
        wrong = jnp.any(is_whole != SET)  # whoever said so was mistaken
        packed = over(record, filled, jax.tree.map(lambda leaf: _refused(wrong, leaf), packed))
    else:
        loop = (chunks - 1, record, filled, packed)
        *_, packed = lax.while_loop(lambda loop: loop[0] >= 0, advance, loop)
    return reverse.finish(packing.unpack(packed))


def _refused(wrong, leaf):
    """The leaf; numbers that are none where something is `wrong`."""
    return jnp.where(wrong, jnp.nan, leaf) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf
