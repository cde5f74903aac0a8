"""One accepted step backwards: from cotangents after it to cotangents before it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ...base.aliases import PyTree, State
from ...base.private_names import private
from .appended import NOTED, appended_transposed
from .closure_conversion import SolveProgram, any_member, inexact, read, unless_waiting
from .step_times import StepTimes


class ReverseStep:
    """Takes the derivative of one accepted step after another, backwards. Its carry holds the cotangents gathered so
    far and the position in the saved rows."""

    def __init__(self, cotangents: PyTree, perturbed: PyTree, numbers: PyTree, program: SolveProgram, times: StepTimes):
        self.numbers, self.program, self.times = numbers, program, times
        self.state_cotangent, self.saved, self.table = cotangents
        self.timed = times.count > 0

        def taken(flags, consts):
            wanted = [flag and eqx.is_inexact_array(c) for flag, c in zip(flags, consts, strict=True)]
            return eqx.partition(consts, wanted)

        self.consts = {
            "step": taken(perturbed["step"], numbers["step"]),
            "save_steps": [taken(f, c) for f, c in zip(perturbed["save_steps"], numbers["save_steps"], strict=True)],
            "save_ts": [taken(f, c) for f, c in zip(perturbed["save_ts"], numbers["save_ts"], strict=True)],
        }
        self.ts_wanted = perturbed["ts"]
        # The parts of `SaveAt` whose saved rows have a cotangent: functions that save what nobody reads are left out of
        # the program.
        live = [i for i, saved in enumerate(self.saved) if jax.tree.leaves(saved)]
        self.save_steps = [i for i in live if program.every[i]]
        self.save_ts = [i for i in live if program.save_ts[i] is not None]
        self.saved = [_full(ct, like) for ct, like in zip(self.saved, numbers["buffers"], strict=True)]
        self.appends = bool(jax.tree.leaves(self.table))
        self.table = _full(self.table, numbers["table"]) if self.appends else self.table

    def start(self, state: State, moves: PyTree) -> dict[str, PyTree]:
        """The carry of the reverse loop at the end of the solve."""
        given = self.state_cotangent
        seeds = jnp.zeros((self.times.count,), state.tprev.dtype)
        if self.timed:
            for ct, move in ((given.tprev, moves[0]), (given.tnext, moves[1])):
                seeds = seeds if ct is None else seeds + ct * move
        saves = state_saves(state)
        return dict(
            y=_full(given.y, state.y),
            solver_state=_full(given.solver_state, inexact(state.solver_state)),
            step=_zeros(self.consts["step"][0]),
            save_steps=[_zeros(c) for c, _ in self.consts["save_steps"]],
            save_ts=[_zeros(c) for c, _ in self.consts["save_ts"]],
            ts=[jnp.zeros_like(t) if w else None for t, w in zip(self.numbers["ts"], self.ts_wanted, strict=True)],
            seeds=seeds,
            accepted=state.num_accepted_steps,
            row=[save.save_index for save in saves],
            index=[save.saveat_ts_index for save in saves],
            after=(state.tprev, moves[0] if self.timed else ()),
        )

    def step(self, carry: dict[str, PyTree], row: dict[str, PyTree], kept: PyTree) -> dict[str, PyTree]:
        """Pulls the carry back over one row of the record; `kept` is true for members of a batch that accepted this
        step."""
        before = dict(carry)
        moving, still = eqx.partition(row["solver_state"], eqx.is_inexact_array)
        ends = (row["tprev"], row["tnext"])
        dense_wanted = bool(self.save_ts)
        rest = []

        def forward(y, solver_state, ends, consts):
            jump = row["made_jump"] if self.program.jumps else False
            consts = eqx.combine(consts, self.consts["step"][1])
            state = eqx.combine(solver_state, still)
            y1, _, dense, state1, _ = self.program.step(consts, *ends, y, state, jump)
            dense, fixed = eqx.partition(dense, eqx.is_inexact_array)
            rest.append(fixed)
            noted = inexact(dense[NOTED]) if self.appends else ()
            return y1, inexact(state1), dense if dense_wanted else (), noted

        consts = self.consts["step"][0]
        # Where no time is differentiated, the ends of the step are constants, and their cotangents are not compiled.
        if self.timed:
            (y1, _, dense, noted), pull = jax.vjp(forward, row["y"], moving, ends, consts)
        else:
            (y1, _, dense, noted), pull = jax.vjp(lambda y, s, c: forward(y, s, ends, c), row["y"], moving, consts)
        for i in self.save_steps:
            carry = self._saved_step(carry, i, kept, y1)
        dense_ct, ends_ct = _zeros(dense), _zeros(ends)
        for i in self.save_ts:
            carry, dense_ct, ends_ct = self._saved_times(carry, i, row, kept, dense, rest[0], dense_ct, ends_ct)
        noted_ct = appended_transposed(self.table, noted, row["y"], y1) if self.appends else ()
        out = pull((carry["y"], carry["solver_state"], dense_ct, noted_ct))
        carry = carry | dict(
            y=out[0],
            solver_state=out[1],
            step=jax.tree.map(jnp.add, carry["step"], out[-1]),
            accepted=carry["accepted"] - 1,
            after=(row["tprev"], row["moves"][0] if self.timed else ()),
        )
        if self.timed:
            total = jax.tree.map(jnp.add, ends_ct, out[2])
            carry["seeds"] = carry["seeds"] + sum(c * move for c, move in zip(total, row["moves"], strict=True))
        return unless_waiting(kept, carry, before)

    def _saved_step(self, carry, i, kept, y1):
        """Pulls back the cotangents of the values saved at the end of the step."""
        # Which steps were saved follows from their count, so that no row has to record it.
        here = kept & (carry["accepted"] % self.program.every[i] == 0)
        at = carry["row"][i] - 1
        t, move = carry["after"]
        consts, fixed = self.consts["save_steps"][i]
        t_ct, ct = read(self.saved[i], jnp.maximum(at, 0))

        def saved(t, y, consts):
            return inexact(self.program.save_steps[i](eqx.combine(consts, fixed), t, y))

        _, pull = jax.vjp(saved, t, y1, consts)
        by_t, by_y, by_consts = _where(here, pull(ct))
        carry = carry | dict(y=jax.tree.map(jnp.add, carry["y"], by_y))
        carry["save_steps"] = _added(carry["save_steps"], i, by_consts)
        carry["row"] = _replaced(carry["row"], i, carry["row"][i] - here.astype(carry["row"][i].dtype))
        if self.timed:
            carry["seeds"] = carry["seeds"] + (by_t + jnp.where(here, t_ct, 0)) * move
        return carry

    def _saved_times(self, carry, i, row, kept, dense, fixed, dense_ct, ends_ct):
        """Pulls back the cotangents of all values saved at times within the step, the last one first."""
        ts, (consts, others) = self.numbers["ts"][i], self.consts["save_ts"][i]

        def inside(index):
            return kept & (index > 0) & (ts[jnp.maximum(index - 1, 0)] > row["last"])

        def one(loop):
            index, at, dense_ct, ends_ct, consts_ct, ts_ct = loop
            here = inside(index)
            t = ts[jnp.maximum(index - 1, 0)]
            t_ct, ct = read(self.saved[i], jnp.maximum(at - 1, 0))

            def saved(t, ends, dense, consts):
                consts = eqx.combine(consts, others)
                return inexact(self.program.save_ts[i](consts, t, *ends, eqx.combine(dense, fixed)))

            _, pull = jax.vjp(saved, t, (row["tprev"], row["tnext"]), dense, consts)
            by_t, *by = pull(ct)
            new = jax.tree.map(jnp.add, (dense_ct, ends_ct, consts_ct), (by[1], by[0], by[2]))
            # The time is saved beside the value: its own cotangent adds to that of the value by the time.
            if ts_ct is not None:
                new_ts = ts_ct.at[index - 1].add(unless_waiting(here, by_t + t_ct, jnp.zeros_like(by_t)))
            else:
                new_ts = None
            old = index, at, dense_ct, ends_ct, consts_ct
            index, at, *new = unless_waiting(here, (index - 1, at - 1, *new), old)
            return index, at, *new, new_ts

        # From the last saved time of the step to the first: the index into the times goes down with the rows.
        start = (carry["index"][i], carry["row"][i], dense_ct, ends_ct, carry["save_ts"][i], carry["ts"][i])
        loop = lax.while_loop(lambda loop: any_member(inside(loop[0])), one, start)
        index, at, dense_ct, ends_ct, consts_ct, ts_ct = loop
        carry = carry | dict(
            index=_replaced(carry["index"], i, index),
            row=_replaced(carry["row"], i, at),
            save_ts=_replaced(carry["save_ts"], i, consts_ct),
            ts=_replaced(carry["ts"], i, ts_ct),
        )
        return carry, dense_ct, ends_ct

    def finish(self, carry: dict[str, PyTree]) -> dict[str, PyTree]:
        """The cotangents of `numbers`, from the carry at the start of the solve."""
        out = jax.tree.map(lambda _: None, inexact(self.numbers))
        (tprev, tnext, controller_state), (t1, controller) = self.times.split(carry["seeds"])
        state = dataclasses.replace(
            out["state"],
            y=carry["y"],
            solver_state=carry["solver_state"],
            tprev=tprev,
            tnext=tnext,
            controller_state=(controller_state, None),
        )
        # Rows saved or appended in the loop were constant before it; the others are passed through.
        return out | dict(
            state=state, buffers=tuple(self.saved), table=self.table, t1=t1, controller=controller,
            ts=tuple(carry["ts"]), step=carry["step"],
            save_steps=tuple(carry["save_steps"]), save_ts=tuple(carry["save_ts"]),
        )  # fmt: skip


def state_saves(state: State) -> list[PyTree]:
    """The `SaveState`s in Diffrax's state, one for each part of `SaveAt`."""
    kind = private("SaveState")

    def is_save(node):
        return isinstance(node, kind)

    return [node for node in jax.tree.leaves(state.save_state, is_leaf=is_save) if is_save(node)]


def _full(cotangent, like):
    """The cotangent with zeros in place of None, in the shapes of `like`."""

    def one(c, v):
        return jnp.zeros(v.shape, v.dtype) if c is None and v is not None else c

    return jax.tree.map(one, cotangent, inexact(like), is_leaf=lambda leaf: leaf is None)


def _zeros(tree):
    return jax.tree.map(jnp.zeros_like, tree)


def _where(flag, tree):
    return jax.tree.map(lambda leaf: jnp.where(flag, leaf, 0), tree)


def _replaced(items, i, item):
    return [item if j == i else other for j, other in enumerate(items)]


def _added(items, i, change):
    return _replaced(items, i, jax.tree.map(jnp.add, items[i], change))
