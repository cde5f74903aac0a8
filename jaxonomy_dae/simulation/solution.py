"""Solutions: every variable by name."""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..system.system import AcausalSystem


class Solution(eqx.Module):
    """What `simulate` returns; `solution["pend.x"]` has shape `(n,)`, one value for each saved time.

    - `ts`: the saved times, shape `(n,)`.
    - `states`: the state array at these times, shape `(n, len(system.states) + len(system.carried))`, on the hidden
        constraints.
    - `system`, `inputs`: what was simulated.
    - `counts`: steps taken, accepted, rejected, and Jacobians of implicit solvers; `stats` adds the solver's name and
        why it was chosen.
    - `result`: Diffrax's result code. Where the integration stopped early, later rows are infinite.

    A solution that `equinox.filter_vmap` returns is a batch: shapes get its axis in front.
    """

    ts: Float[Array, " n"]
    states: Float[Array, "n x"]
    system: AcausalSystem
    inputs: dict[str, Any]
    counts: dict[str, Any]
    result: Any
    solver: str = eqx.field(static=True, default="")
    reason: str = eqx.field(static=True, default="")

    def __getitem__(self, name: str) -> Any:
        """The values of a variable; `"time"` and `"der(...)"` of what the model differentiates are accepted.

        **Raises:**

        - `ModelError` for an unknown name.
        """
        if name == "time":
            return self.ts
        if self.states.ndim > 2:
            return _each(self, lambda one: one[name])
        plan = self.system.plan
        quantity, sign = plan.resolve([name])
        if quantity[0] < 0:  # identically zero
            return jnp.zeros(self.ts.shape, self.states.dtype)
        place = np.flatnonzero(np.concatenate([plan.states, plan.carried]) == quantity[0])
        if len(place):
            column = self.states[:, int(place[0])]
            return column if sign[0] > 0 else -column
        leaves = jax.tree.leaves((self.system, self.ts, self.states, self.inputs))
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return _observe(self.system, self.ts, self.states, self.inputs, quantity, sign)
        return _observe_all(self.system, self.ts, self.states, self.inputs, quantity[0], sign[0])

    @property
    def stats(self) -> dict[str, Any]:
        """What the integration took: numbers of steps, the solver and the reason for it."""
        return {**self.counts, "solver": self.solver, "reason": self.reason}

    def __contains__(self, name: str) -> bool:
        return name == "time" or name in self.system.plan.variable_index

    def __iter__(self) -> Iterator[str]:
        return iter(self.system.variables)

    def constraint_residual(self) -> Float[Array, "*batch n m"]:
        """The residuals of all hidden constraints at the saved times, shape `(n, constraints)`."""
        if self.states.ndim > 2:
            return _each(self, Solution.constraint_residual)
        return _constraint_residual(self.system, self.ts, self.states, self.inputs)

    def to_dict(self) -> dict[str, Any]:
        """All variables, and `"time"`, by name."""
        return {"time": self.ts} | {name: self[name] for name in self.system.variables}

    def plot(self, *names: str, ax: Any = None) -> Any:
        """Draws variables over time with Matplotlib (extra `plot`); returns the axes."""
        from ..plotting import plot_solution

        return plot_solution(self, *names, ax=ax)

    def __repr__(self):
        return f"Solution({self.ts.shape[-1]} times, {len(self.system.variables)} variables)"


def _each(batch: Solution, read: Callable[[Solution], Any]) -> Any:
    """Reads every solution of a batch."""
    return eqx.filter_vmap(read)(batch)


def _observe(system: AcausalSystem, ts, states, inputs, quantity: np.ndarray, sign: np.ndarray):
    def one(t, x):
        return system._point(t, inputs).quantities(x, quantity, sign)[0]

    return jax.vmap(one)(ts, states)


@eqx.filter_jit
def _all(system: AcausalSystem, ts, states, inputs, quantity, sign):
    """One quantity, chosen while running: compiled once for all names."""
    plan = system.plan
    every = np.arange(plan.extended.quantities.n)
    ones = np.ones_like(every)

    def one(t, x):
        return system._point(t, inputs).quantities(x, every, ones)[quantity]

    return jnp.where(quantity < 0, 0.0, sign * jax.vmap(one)(ts, states))


def _observe_all(system: AcausalSystem, ts, states, inputs, quantity, sign):
    dtype = states.dtype
    return _all(system, ts, states, inputs, jnp.asarray(quantity), jnp.asarray(sign, dtype))


@eqx.filter_jit
def _constraint_residual(system: AcausalSystem, ts, states, inputs):
    return jax.vmap(lambda t, x: system.constraint_residual(t, x, inputs))(ts, states)
