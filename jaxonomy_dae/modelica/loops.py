"""A `while` whose condition is not known when a model is read: a function of JAX that repeats what its body says.

The body is carried out once over symbols, which stand for what one round leaves to the next.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import sympy

from ..base.errors import ModelError
from ..base.private_names import private
from ..graph.expressions.from_sympy import read, symbols_of
from ..graph.expressions.kernel import Kernel
from ..write.symbols import VariableSymbol
from .values import Record, Value, as_number, is_condition

MOST = 256  # rounds; iterations of media functions take up to a hundred
JUMPS = ("return", "break")

Path = tuple[str, *tuple[str | int, ...]]


class Carried(NamedTuple):
    """What one round leaves to the next: a number, or a truth, at a place of a local variable.

    - `path`: the variable, then places in arrays and fields of records.
    - `before`: its value before the loop, None if it has none; `symbol`: what stands for it in a round.
    """

    path: Path
    before: Value
    symbol: VariableSymbol
    is_truth: bool

    @property
    def value(self) -> Value:
        """What it is in a round."""
        return sympy.Eq(self.symbol, 1) if self.is_truth else self.symbol


def carried(names: Sequence[str], local: Mapping[str, Value]) -> list[Carried]:
    """The numbers and truths of the local variables `names`."""
    found = [entry for name in names for entry in _entries((name,), local.get(name))]
    return [
        Carried(path, before, VariableSymbol(f":round[{k}]"), is_condition(before))
        for k, (path, before) in enumerate(found)
    ]


def _entries(path: Path, value: Value) -> Iterator[tuple[Path, Value]]:
    if isinstance(value, list | Record):
        for k, v in enumerate(value) if isinstance(value, list) else value.items():
            yield from _entries((*path, k), v)
    else:
        yield path, value


def placed(entries: Sequence[tuple[Path, Value]], local: dict[str, Value]) -> None:
    """Puts values at places of local variables."""
    for (name, *path), value in entries:
        local[name] = _placed(local.get(name), path, value)


def _placed(whole: Value, path: list, value: Value) -> Value:
    if not path:
        return value
    first, *rest = path
    if isinstance(whole, list):
        return [_placed(v, rest, value) if k == first else v for k, v in enumerate(whole)]
    return Record({k: _placed(v, rest, value) if k == first else v for k, v in whole.items()})


def at(local: Mapping[str, Value], path: Path) -> Value:
    """The value at a place."""
    value: Value = local[path[0]]
    for k in path[1:]:
        value = value[k]
    return value


def repeated(condition: Value, state: Sequence[Carried], after: Sequence[Value]) -> tuple[Callable, list[sympy.Symbol]]:
    """Returns (a function of the values of other symbols, then of what is carried, before the loop, that returns what
    is carried after it; these other symbols). It has no value if the loop takes more than `MOST` rounds.

    **Raises:**

    - `ModelError` for what is not a number or a truth.
    """
    for c, value in zip(state, after, strict=True):
        if value is None or isinstance(value, str | list | Record):
            raise ModelError(f"a while loop changes '{c.path[0]}', which is not made of numbers: got {value!r}")
    own = [c.symbol for c in state]
    expressions = [sympy.sympify(as_number(v)) for v in (condition, *after)]
    # Sorted: the order of a set differs from process to process, and that of arguments would, too.
    others = sorted({s for e in expressions for s in symbols_of(e)} - set(own), key=str)
    labels = [str(s) for s in (*others, *own)]
    kernel = Kernel([read(e, str) for e in expressions], labels)
    n = len(others)

    def function(*given: Any) -> Any:
        fixed, start = list(given[:n]), jnp.stack([jnp.asarray(v, jnp.result_type(float)) for v in given[n:]])

        def one(values: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Returns (whether the loop goes on, the values after a round)."""
            goes_on, *new = kernel([*fixed, *values])
            return jnp.asarray(goes_on) > 0.5, jnp.stack([jnp.asarray(v, start.dtype) for v in new])

        # Bounded: reverse mode must go back over the rounds, which it cannot where their number has no limit.
        end = private("while_loop")(
            lambda values: one(values)[0], lambda values: one(values)[1], start, max_steps=MOST, kind="bounded"
        )
        return jnp.where(one(end)[0], jnp.nan, end)

    return function, others
