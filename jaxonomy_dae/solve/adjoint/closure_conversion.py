"""A solve as functions that close over no array, and the arrays they need: the closure-converted solve that the custom
rule differentiates."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, PyTree

from ...base.aliases import Args, Result, State
from ...base.private_names import MissingName, private
from .parts_of_constants import parts_of_constants


class SolveProgram(eqx.Module):
    """The functions of a solve as closure-converted ones: the arrays that they close over are passed to them."""

    step: Any  # (tprev, tnext, y, solver_state, made_jump) -> what the solver's `step` returns
    adapt: Any  # (controller, tprev, tnext, y, y1, y_error, controller_state) -> what its `adapt_step_size` returns
    # (state, buffers, active, first) -> (state, buffers, rows for the table, (the end of the step, its error)): one
    # attempted step, bookkeeping included
    body: Any
    rest: Any  # (attempted step, second run) -> (end of the next one, second run), or None: see resting.py
    first: Any  # (start, end, y) -> (end of the first step,), or None: see resting.py
    save_steps: tuple[Any, ...]  # for each part of `SaveAt`: (t, y) -> what it saves of a step, or None
    save_ts: tuple[Any, ...]  # for each part: (t, tprev, tnext, dense_info) -> what it saves at a time, or None
    every: tuple[int, ...] = eqx.field(static=True)  # for each part: it saves every so many steps, 0 for none
    jumps: bool = eqx.field(static=True)  # whether `made_jump` is ever set
    max_steps: int | None = eqx.field(static=True)
    chunk: int = eqx.field(static=True)  # attempted steps between two points where the solve can be taken up again
    points: int = eqx.field(static=True)  # how many such points are kept
    # The precision of products of matrices when the solve was called. JAX asks for derivatives when that context has
    # been left, and would trace all functions anew for another precision, and keep two of each in the program.
    precision: str | None = eqx.field(static=True)


class ClosureConverted(eqx.Module):
    """A function that closes over nothing; called with what it closed over, `(consts, *args)`.

    As `equinox.filter_closure_convert`, but arguments may lie on other devices than those it was made with: inside
    `shard_map` some do.
    """

    call: Any  # (arrays it closes over, *arrays among the arguments) -> arrays: a function of its own in the program
    inputs: PyTree = eqx.field(static=True)  # the structure of the arrays among the arguments
    outputs: PyTree = eqx.field(static=True)  # (structure of the arrays it returns, their shapes and dtypes)
    static: Any = eqx.field(static=True)  # what it returns beside arrays: (leaves, structure)

    def __call__(self, consts: PyTree, *args: Args) -> PyTree:
        leaves, structure = jax.tree.flatten(eqx.filter(args, eqx.is_array))
        if structure != self.inputs:
            raise TypeError(f"a closure-converted function was made for {self.inputs}; got {structure}")
        return self._combined(self.call(consts, *leaves))

    @property
    def out_struct(self) -> PyTree:
        """The structure of the function's result: shapes and dtypes, and values where they are static."""
        return self._combined(list(self.outputs[1]))

    def _combined(self, leaves: PyTree) -> PyTree:
        others, structure = self.static
        return eqx.combine(jax.tree.unflatten(self.outputs[0], leaves), jax.tree.unflatten(structure, others))


def closure_convert(function: Any, *args: Args) -> tuple[ClosureConverted, list[PyTree]]:
    """Returns (`function` as a `ClosureConverted`, the list of arrays that it closed over). Arguments may be arrays or
    `jax.ShapeDtypeStruct`s."""
    dynamic, static = eqx.partition(args, lambda leaf: eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct))
    leaves, structure = jax.tree.flatten(dynamic)
    found: list[PyTree] = []

    def flat(*leaves):
        out = function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))
        arrays, others = eqx.partition(out, eqx.is_array)
        out_leaves, out_structure = jax.tree.flatten(arrays)
        found[:] = out_structure, jax.tree.flatten(others)
        return out_leaves

    closed = jax.make_jaxpr(flat)(*leaves)
    out_structure, (others, others_structure) = found
    shapes = tuple(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in closed.out_avals)
    # A trace is kept as a program rather than the Python function: a derivative calls the function several times, and
    # would trace the user's code anew each time.
    evaluate = private("eval_jaxpr")
    program, constants = parts_of_constants(closed.jaxpr, list(closed.consts))

    @jax.jit
    def call(consts, *leaves):
        return evaluate(program, consts, *leaves)

    converted = ClosureConverted(call, structure, (out_structure, shapes), (tuple(others), others_structure))
    return converted, constants


def by_itself_or_batched(
    one: ClosureConverted, of_one: list[PyTree], many: ClosureConverted, of_many: list[PyTree]
) -> tuple[ClosureConverted, Any]:
    """A function in two forms that return the same, with the arrays that each closes over: `one` where it is called by
    itself, `many` in a batch and where it is differentiated."""

    @jax.custom_jvp
    def call(consts, *leaves):
        return alone(consts, *leaves)

    @call.defjvp
    def _(primals, tangents):
        (_, consts), *leaves = primals
        (_, moving), *tangents = tangents
        return jax.jvp(many.call, (consts, *leaves), (moving, *tangents))

    @jax.custom_batching.custom_vmap
    def alone(consts, *leaves):
        return one.call(consts[0], *leaves)

    @alone.def_vmap
    def _(axis_size, in_batched, consts, *leaves):
        del axis_size
        # Where one argument of a batch is batched, so is the whole result: which outputs stay alike would have to be
        # traced to be known.
        axes = jax.tree.map(lambda batched: 0 if batched else None, (in_batched[0][1], *in_batched[1:]))
        out = jax.vmap(many.call, in_axes=axes)(consts[1], *leaves)
        return out, jax.tree.map(lambda _: True, out)

    both = ClosureConverted(jax.jit(call), many.inputs, many.outputs, many.static)
    return both, (of_one, of_many)


@jax.custom_jvp
def unless_waiting(active: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """Returns `new`; but `old` for a member of a batch that is no longer active and waits for the slowest one."""
    return _unless_waiting(active, new, old)


@unless_waiting.defjvp
def _(primals, tangents):
    # By hand, for JAX cannot batch the derivative of a `custom_vmap` function.
    active, (new, structure) = primals[0], jax.tree.flatten(tangents[1])
    old = jax.tree.leaves(tangents[2])
    moving = [k for k, leaf in enumerate(new) if leaf.dtype != jax.dtypes.float0]
    chosen = unless_waiting(active, [new[k] for k in moving], [old[k] for k in moving])
    for k, leaf in zip(moving, chosen, strict=True):
        new[k] = leaf
    return unless_waiting(*primals), jax.tree.unflatten(structure, new)


@jax.custom_batching.custom_vmap
def _unless_waiting(active, new, old):
    del active, old
    return new


@_unless_waiting.def_vmap
def _(size, batched, active, new, old):
    def spread(leaf, is_batched):
        return leaf if is_batched else jnp.broadcast_to(leaf, (size, *jnp.shape(leaf)))

    def choose(a, b):
        return jnp.where(active.reshape(active.shape + (1,) * (a.ndim - active.ndim)), a, b)

    new, old = jax.tree.map(spread, new, batched[1]), jax.tree.map(spread, old, batched[2])
    out = jax.tree.map(choose, new, old) if batched[0] else _unless_waiting(active, new, old)
    return out, jax.tree.map(lambda _: True, out)


def going(state: State, numbers: dict[str, PyTree], program: SolveProgram) -> Bool[Array, ""]:
    """True while a solve has steps left to take."""
    on = (state.tprev < numbers["t1"]) & diffrax.is_successful(state.result)
    return on if program.max_steps is None else on & (state.num_steps < program.max_steps)


def as_traced(result: Result) -> Result:
    """A result code that Python knows, as a value of the program. Two that Python knows are compared by programs of
    their own, which JAX compiles on the way."""
    return jax.tree.map(lambda code: jnp.full(jnp.shape(code), code, jnp.result_type(code)), result)


def any_member(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """True if a flag is set for any member of a batch. The result is not batched, so that `lax.cond` does not become a
    select that computes both branches."""
    try:
        return private("unvmap_any")(flag)
    except MissingName:
        return flag  # as good, but in a batch both branches are computed


def inexact(tree: PyTree) -> PyTree:
    """The tree's floating-point and complex arrays; None in place of other leaves."""
    return eqx.filter(tree, eqx.is_inexact_array)


def rows(tree: PyTree, count: int) -> PyTree:
    """A table of zeros with `count` rows, each of which has the structure and shapes of `tree`."""
    return jax.tree.map(lambda leaf: jnp.zeros((count, *jnp.shape(leaf)), jnp.result_type(leaf)), tree)


def written(table: PyTree, index: Int[Array, ""], row: PyTree) -> PyTree:
    """The table with row number `index` replaced."""
    return jax.tree.map(lambda a, b: lax.dynamic_update_index_in_dim(a, b, index, 0), table, row)


def read(table: PyTree, index: Int[Array, ""]) -> PyTree:
    """Row number `index` of the table."""
    return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, index, 0, keepdims=False), table)


def apart(true: Bool[Array, ""], function: Any, carry: PyTree, *args: PyTree) -> PyTree:
    """Returns `function(carry, *args)`, which has the structure of `carry`, compiled as a computation of its own.

    XLA on CPU runs a computation in plain order if none of its arrays is larger than 512 bytes, and as a graph of tasks
    otherwise, which costs small operations several times over. So small computations are kept apart from large tables.
    `true` must be traced, not constant, or XLA folds the branch away.
    """
    return lax.cond(true, function, lambda carry, *args: carry, carry, *args)
