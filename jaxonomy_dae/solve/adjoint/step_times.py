"""How the ends of steps move with the times that a solve was given."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ...base.aliases import State, Time
from ...base.private_names import clip_floor, private
from .closure_conversion import SolveProgram, inexact


class StepTimes:
    """Derivatives of tprev and tnext, taken along in the forward direction.

    A step-size controller multiplies the last step by a factor, and factors count as constants, so the ends of steps
    depend on no state. What is left is a few numbers, here called seeds: the start, the first step, the end, and the
    controller's own times, as far as they are differentiated. Mostly there are none.
    """

    def __init__(self, perturbed: dict[str, PyTree], numbers: dict[str, PyTree], program: SolveProgram):
        self.numbers, self.program = numbers, program
        clock = _clock(numbers)
        self.leaves, self.structure = jax.tree.flatten(inexact(clock))
        pairs = zip(jax.tree.leaves(_clock(perturbed)), jax.tree.leaves(clock), strict=True)
        self.wanted = [flag for flag, leaf in pairs if eqx.is_inexact_array(leaf)]
        self.count = sum(leaf.size for flag, leaf in zip(self.wanted, self.leaves, strict=True) if flag)

    def seeds(self) -> PyTree[Float[Array, "seeds ..."]]:
        """Derivatives of ((tprev, tnext, controller's state), (t1, controller)) at the start, shapes (seeds, ...)."""
        out, row = [], 0
        for wanted, leaf in zip(self.wanted, self.leaves, strict=True):
            hot = jnp.zeros((self.count, leaf.size), leaf.dtype)
            if wanted:
                hot = hot.at[row : row + leaf.size].set(jnp.eye(leaf.size, dtype=leaf.dtype))
                row += leaf.size
            out.append(hot.reshape(self.count, *leaf.shape))
        return jax.tree.unflatten(self.structure, out)

    def split(self, total: Float[Array, " seeds"]) -> PyTree:
        """The cotangents of the seeds in the structure of `_clock`; None for leaves that are not differentiated."""
        out, row = [], 0
        for wanted, leaf in zip(self.wanted, self.leaves, strict=True):
            out.append(total[row : row + leaf.size].reshape(leaf.shape).astype(leaf.dtype) if wanted else None)
            row += leaf.size if wanted else 0
        return jax.tree.unflatten(self.structure, out)

    def start(self) -> PyTree[Float[Array, "seeds ..."]]:
        """The derivatives of (tprev, tnext, controller's state) at the start."""
        return self.seeds()[0] if self.count else ()

    def after(
        self,
        state: State,
        moves: PyTree[Float[Array, "seeds ..."]],
        taken: tuple[PyTree, PyTree],
        held: Bool[Array, ""],
    ) -> PyTree[Float[Array, "seeds ..."]]:
        """The tangents `moves` of (start, end, controller state), advanced over the step that `state` attempts; `taken`
        are the state at its end and the error. Where `held`, a flag, is set, the end of the next step moves with its
        start: it keeps its length."""
        if not self.count:
            return ()
        program, numbers = self.program, self.numbers
        y1, error = taken
        # As Diffrax does: an error that is not a number rejects the step.
        error = jax.tree.map(lambda e: jnp.where(jnp.isnan(e), jnp.inf, e), error)
        fixed = eqx.filter(state.controller_state[0], eqx.is_inexact_array, inverse=True)
        floor = clip_floor(numbers["t1"])

        def clock(moving, given):
            tprev, tnext, controlled = moving
            t1, controller = given
            keep, tprev, tnext, _, after, _ = program.adapt(
                numbers["adapt"], controller, tprev, tnext, state.y, y1, error, eqx.combine(controlled, fixed)
            )
            # As Diffrax' loop does after the controller.
            tprev = jnp.minimum(tprev, t1)
            return tprev, private("clip_to_end")(tprev, tnext, t1, floor, keep), inexact(after)

        at = inexact(_clock(numbers | {"state": state}))
        given = self.seeds()[1]
        tprev, tnext, controlled = jax.vmap(lambda a, b: jax.jvp(clock, at, (a, b))[1])(moves, given)
        return tprev, jnp.where(held, tprev, tnext), controlled


def _clock(tree: dict[str, PyTree]) -> Time:
    """The quantities on which the ends of steps depend: (start, end, controller state), and (t1, controller)."""
    state = tree["state"]
    moving = state.tprev, state.tnext, state.controller_state[0]
    return moving, (tree["t1"], tree["controller"])
