"""Newton's method with steps that are shortened where they do not help, in NumPy and in JAX.

A look at a trial point says whether the point is better than the last one that was accepted, whether the equations hold
there, and which Newton step leads on. Nonlinear blocks, consistent points of index 1, starts of large sparse models,
starts block by block and the points that passes of the compiler need are looks of this one search.

Two iterations stay apart. The ladder of initialization (`run/start/ladder.py`) changes between methods that share
one factorization. The iteration of an implicit step (`solve/methods/newton.py`) keeps the factors of earlier steps, and
gives up as soon as it contracts slowly, since a shorter time step costs less than a damped search.

A search is not differentiated. Two more steps carry first and second derivatives (`twice`).
"""

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from .arrays import Verdict, namespace, where

_X = TypeVar("_X")  # a point: an array, or a list of arrays of one shape
_M = TypeVar("_M")  # a pytree
_S = TypeVar("_S")


class Tried(NamedTuple, Generic[_X, _M]):
    """What a look at a trial point finds. Verdicts are of one problem, or of each of a batch.

    - `falls`: whether the trial point is better than the last accepted one; `holds`: whether the equations hold there.
    - `step`: the Newton step from the trial point.
    - `memory`: what the next look compares with, if this point is accepted.
    """

    falls: Verdict
    holds: Verdict
    step: _X
    memory: _M


class Point(NamedTuple, Generic[_X, _M]):
    """The last accepted point, whether the equations hold there, what was remembered of it, and the number of looks."""

    x: _X
    holds: Verdict
    memory: _M
    count: Any


def newton(
    look: Callable[[_X, Any, _M], Tried[_X, _M]],
    start: _X,
    memory: _M,
    most: int,
    shortest: float = 0.0,
    batch: tuple[int, ...] = (),
) -> Point[_X, _M]:
    """Newton's method from `start`, until the equations hold.

    **Arguments:**

    - `look`: given the trial point, the part of the Newton step that led to it, and what is remembered of the last
        accepted point. The start is accepted, whatever is found there.
    - `memory`: of the shapes and dtypes that a look returns. The first look gets it.
    - `most`: looks; `shortest`: the part of a Newton step that is still tried.
    - `batch`: the shape of verdicts.
    """
    leaf = jax.tree.leaves(start)[0]
    xp = namespace(leaf)

    def going(state: Any) -> Any:
        *_, part, holds, _, count = state
        left = ~holds & (part >= shortest) if shortest else ~holds
        return xp.any(left) & (count < most)

    def body(state: Any) -> Any:
        trial, x, step, part, _, memory, count = state
        tried = look(trial, part, memory)
        accepted = tried.falls | tried.holds | (count == 0)
        x, step, memory = chosen(accepted, (trial, tried.step, tried.memory), (x, step, memory))
        # The part is doubled, not set to one, after a step that helped: where steps had to be short, the next whole one
        # would be rejected as many times again.
        part = where(accepted, xp.minimum(2 * part, 1), part / 2)
        if shortest:  # a step that is not finite has no part that helps
            part = where(_finite(step, part), part, 0 * part)
        # Members of a batch whose equations hold stay where they are while others go on.
        trial = jax.tree.map(lambda a, d: where(tried.holds, a, a + part * d), x, step)
        return trial, x, step, part, tried.holds, memory, count + 1

    one = xp.ones(batch, leaf.dtype)
    state = start, start, jax.tree.map(xp.zeros_like, start), one, one < 0, memory, xp.asarray(0, np.int32)
    _, x, _, _, holds, memory, count = _repeated(going, body, state)
    return Point(x, holds, memory, count)


def twice(step: Callable[[_X], tuple[_X, _S]], x: _X) -> tuple[_X, _S]:
    """x after two steps with constant matrices, in a loop, so that they are compiled once, and what the first one found
    on the way. At a root, by the implicit function theorem, the first step carries first derivatives, which are exact,
    and the second one second derivatives.

    What is found is carried on: JAX cannot transpose a scan if none of what it collects is read (jax 0.10.2).
    """
    none = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(step, x)[1])

    def once(carry: tuple[_X, _S], first: Any) -> tuple[tuple[_X, _S], None]:
        x, seen = carry
        x, new = step(x)
        return (x, chosen(first, new, seen)), None

    return jax.lax.scan(once, (x, none), np.array([True, False]))[0]


def chosen(condition: Any, a: _S, b: _S) -> _S:
    """The pytree a where the condition holds, b elsewhere."""
    return jax.tree.map(lambda a, b: where(condition, a, b), a, b)


def _repeated(going: Callable[[_S], Any], body: Callable[[_S], _S], state: _S) -> _S:
    """`jax.lax.while_loop`, or a loop of Python over arrays of NumPy."""
    if namespace(jax.tree.leaves(state)[0]) is jnp:
        return jax.lax.while_loop(going, body, state)
    while going(state):
        state = body(state)
    return state


def _finite(step: Any, like: Any) -> Any:
    """True where a step is finite, for each of a batch of the shape of `like`."""
    xp, verdict = namespace(like), True
    for leaf in jax.tree.leaves(step):
        verdict = verdict & xp.all(xp.isfinite(leaf), axis=tuple(range(np.ndim(like), np.ndim(leaf))))
    return verdict
