"""Where a path ends that begins at x and follows dx/ds = d(x) from s = 0 to s = 1: what an impulse does.

Each piece of the path is one step of the modified midpoint rule with 2, 4, 6, … substeps, extrapolated to substeps of
no length (Gragg 1965; Bulirsch & Stoer 1966; Hairer, Nørsett & Wanner 1993, section II.9). Most impulses act along one
direction, which two looks show.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import Numeric, PyTree, Time
from ..adjoint.closure_conversion import any_member

SUBSTEPS = (2, 4, 6, 8, 12, 16)  # of each column of the extrapolation: the last one is of order twelve
TOGETHER = 8  # substeps that are skipped as one where a piece has ended
FIRST = 1 / 8  # of the path: the first piece, where the whole is not straight
ATTEMPTS = 40  # pieces that are tried: each is half or twice as long as the one before


def _weights() -> np.ndarray:
    """For each column, the weights of it and those before it in the value for substeps of no length: an even polynomial
    in the substep, at zero."""
    # By the squares of the numbers of substeps: errors of the midpoint rule have even powers alone, so that each column
    # raises the order by two.
    n = np.array(SUBSTEPS, float) ** 2
    out = np.zeros((len(n), len(n)))
    for k in range(len(n)):
        for j in range(k + 1):
            others = [n[i] for i in range(k + 1) if i != j]
            out[k, j] = np.prod([n[j] / (n[j] - other) for other in others])
    return out


_COLUMN = np.repeat(np.arange(len(SUBSTEPS)), SUBSTEPS)
_SUBSTEP = np.concatenate([np.arange(n) for n in SUBSTEPS])
_WEIGHTS = _weights()


class _Path(NamedTuple):
    """The path so far: x, the last guess, s, the length of the next piece, whether that is the whole path, whether it
    goes on, and whether d was finite everywhere."""

    x: Array
    guess: PyTree
    s: Time
    length: Time
    whole: Array
    going: Array
    finite: Array


class _Piece(NamedTuple):
    """A piece in the making: the last two places, the columns, the value by those so far, the last guess, whether the
    last columns agree, whether another one is to be computed, and whether d was finite."""

    before: Array
    here: Array
    columns: Array
    value: Array
    guess: PyTree
    agree: Array
    going: Array
    finite: Array


class _At(NamedTuple):
    """A substep: its column, its number there, its part of the piece, the columns' weights, whether it ends one."""

    column: Numeric
    substep: Numeric
    part: Numeric
    weights: Numeric
    ends: Numeric


def path_end(
    direction: Callable[[Array, PyTree], tuple[Array, PyTree]],
    x: Array,
    guess: PyTree,
    allowed: Callable[[Array], Array],
    moves: Array,
) -> tuple[Array, PyTree, Array]:
    """Returns (the end of the path, the last guess, whether it is found).

    A path on which a trial piece leaves where d is finite is not found: its derivatives would not be numbers.

    **Arguments:**

    - `direction`: d(x) and the next guess, given x and what was found at the place before.
    - `allowed`: how far off each entry of the end may be, given the change along the path.
    - `moves`: whether there is a path at all; else x is the end, and nothing is evaluated.
    """
    dtype, origin = x.dtype, x

    def substep(path: _Path, piece: _Piece, at: _At) -> _Piece:
        d, guess = direction(piece.here, piece.guess)
        h = at.part.astype(dtype) * path.length
        ahead = jnp.where(at.substep == 0, path.x + h * d, piece.before + 2 * h * d)
        # The rule of Euler stands before the first column: they agree where d is constant.
        first = (at.column == 0) & (at.substep == 0)
        last = jnp.where(first, path.x + path.length * d, piece.value)
        columns = jnp.where(at.ends, piece.columns.at[at.column].set(ahead), piece.columns)
        value = at.weights.astype(dtype) @ columns
        agree = at.ends & jnp.all(jnp.abs(value - last) <= allowed(value - origin))
        return _Piece(
            before=jnp.where(at.ends, path.x, piece.here),
            here=jnp.where(at.ends, path.x, ahead),
            columns=columns,
            value=jnp.where(at.ends, value, last),
            guess=guess,
            agree=agree,
            going=~agree & ~(at.ends & path.whole),
            finite=piece.finite & jnp.all(jnp.isfinite(d)),
        )

    def attempted(path: _Path) -> _Path:
        # The order is raised until two columns agree. A jump is found to ten digits, for which a method of fixed order
        # would take many pieces.
        columns = jnp.zeros((len(SUBSTEPS), len(x)), dtype)
        yes = jnp.ones((), bool)
        piece = _Piece(path.x, path.x, columns, path.x, path.guess, ~yes, yes, yes)
        piece = _while_going(lambda piece, at: _while_going(lambda p, a: substep(path, p, a), piece, at), piece, _TABLE)
        s = path.s + jnp.where(piece.agree, path.length, 0.0)
        length = jnp.where(piece.agree, jnp.minimum(2 * path.length, 1 - s), path.length / 2)
        return _Path(
            x=jnp.where(piece.agree, piece.value, path.x),
            guess=jax.tree.map(lambda new, old: jnp.where(piece.agree, new, old), piece.guess, path.guess),
            s=s,
            length=jnp.where(path.whole, jnp.asarray(FIRST, dtype), length),
            whole=jnp.zeros((), bool),
            going=s < 1,
            finite=path.finite & piece.finite,
        )

    zero, one, yes = jnp.zeros((), dtype), jnp.ones((), dtype), jnp.ones((), bool)
    begin = _Path(x, guess, zero, one, yes, moves, yes)
    path = _while_going(lambda path, _: attempted(path), begin, jnp.arange(ATTEMPTS))
    return path.x, path.guess, ~path.going & path.finite


_LENGTH = np.array(SUBSTEPS)[_COLUMN]
_TABLE = jax.tree.map(
    lambda column: column.reshape(-1, TOGETHER, *column.shape[1:]),
    _At(_COLUMN, _SUBSTEP, 1.0 / _LENGTH, _WEIGHTS[_COLUMN], _LENGTH - 1 == _SUBSTEP),
)


def _while_going(step: Callable[[Any, Any], Any], carry: Any, each: Any) -> Any:
    """The steps for each entry while the carry is `going`: reverse mode cannot go back over a `while`."""

    def once(carry: Any, at: Any) -> tuple[Any, None]:
        def go(carry: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(carry.going, a, b), step(carry, at), carry)

        return lax.cond(any_member(carry.going), go, lambda carry: carry, carry), None

    return lax.scan(once, carry, each)[0]
