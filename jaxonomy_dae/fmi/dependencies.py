"""Which arguments each result of a program depends on, entry by entry.

A dependence that is reported may be none (loops depend on all that they read); one that is not reported is none.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from .elementwise import ELEMENTWISE
from .straight import CALLS, Atom, Constant, Operation, Straight, function_of, known, straight

# Operations whose results are entries of what they read, or entries that are the same whatever they read.
MOVES = {
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "slice", "rev", "concatenate", "split",
    "stack", "unstack", "pad", "gather", "scatter",
}  # fmt: skip
REDUCES = {"reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or", "argmax", "argmin"}


def dependencies(program: Any, given: Sequence[sp.csr_array | None], n: int) -> list[sp.csr_array]:
    """For each result of a program (a `ClosedJaxpr`), a matrix of booleans, shape (entries, n): the columns that each
    entry depends on. `given` has such a matrix for each argument, None for one that depends on nothing."""
    with jax.ensure_compile_time_eval():
        return _of_program(straight(program.jaxpr), [*(None for _ in program.consts), *given], list(program.consts), n)


def _of_program(program: Straight, given: Sequence[Any], constants: Sequence[Any], n: int) -> list[sp.csr_array]:
    found: dict[int, sp.csr_array | None] = dict(zip(program.arguments, given, strict=True))
    values: dict[int, np.ndarray] = {
        a: known(c).value for a, c in zip(program.arguments, constants, strict=False) if c is not None
    }

    def of(atom: Atom) -> sp.csr_array | None:
        return None if isinstance(atom, Constant) else found[atom]

    def value(atom: Atom) -> np.ndarray | None:
        return atom.value if isinstance(atom, Constant) else values.get(atom)

    for operation in program.operations:
        read = [of(a) for a in operation.given]
        kinds = [program.kinds[r] for r in operation.results]
        if all(r is None for r in read):
            results: list[Any] = [None] * len(kinds)
        elif operation.primitive in CALLS:
            inner, closed = function_of(operation)
            known_values = [*closed, *(value(a) for a in operation.given)]
            results = _of_program(straight(inner), [*(None for _ in closed), *read], known_values, n)
        else:
            results = _of_operation(program, operation, read, value, n)
        found.update(zip(operation.results, results, strict=True))
    return [_whole(of(a), program.kind(a).size, n) for a in program.results]


def _whole(found: sp.csr_array | None, size: int, n: int) -> sp.csr_array:
    return sp.csr_array((size, n), dtype=bool) if found is None else found


def _of_operation(
    program: Straight, operation: Operation, read: Sequence[sp.csr_array | None],
    value: Callable[[Atom], np.ndarray | None], n: int,
) -> list[sp.csr_array]:  # fmt: skip
    kinds = [program.kinds[r] for r in operation.results]
    name = operation.primitive
    if name in ELEMENTWISE:
        total = sp.csr_array((kinds[0].size, n), dtype=bool)
        for atom, rows in zip(operation.given, read, strict=True):
            if rows is not None:
                own = np.arange(rows.shape[0]).reshape(program.kind(atom).shape)
                total = total + rows[np.broadcast_to(own, kinds[0].shape).ravel()]
        return [total]
    if name in MOVES:
        moved = _moved(program, operation, value)
        if moved is not None:
            every = sp.vstack(
                [sp.csr_array((1, n), dtype=bool)]
                + [_whole(r, program.kind(a).size, n) for a, r in zip(operation.given, read, strict=True)],
                format="csr",
            )
            return [sp.csr_array(every[np.maximum(ids, 0).ravel()]) for ids in moved]
    if name in REDUCES and read[0] is not None:
        shape, axes = program.kind(operation.given[0]).shape, tuple(operation.params["axes"])
        places = np.moveaxis(np.arange(read[0].shape[0]).reshape(shape), axes, range(-len(axes), 0))
        places = places.reshape(kinds[0].size, -1)
        gathers = sp.csr_array(
            (np.ones(places.size, bool), (np.repeat(np.arange(len(places)), places.shape[1]), places.ravel())),
            shape=(len(places), read[0].shape[0]),
        )
        return [gathers @ read[0]]
    row = sp.csr_array((1, n), dtype=bool)
    for rows in read:
        if rows is not None and rows.shape[0]:
            row = row + sp.csr_array(sp.csr_array(np.ones((1, rows.shape[0]), bool)) @ rows)
    return [sp.csr_array(row[np.zeros(kind.size, int)]) for kind in kinds]


def _moved(
    program: Straight, operation: Operation, value: Callable[[Atom], np.ndarray | None]
) -> list[np.ndarray] | None:
    """For each result, the entries that it is made of: places among all entries that are read, from 1, 0 for none.
    None where the places depend on values."""
    ids: list[Any] = []
    begin = 1
    indices = {"gather": [1], "scatter": [1]}.get(operation.primitive, [])
    for k, atom in enumerate(operation.given):
        kind = program.kind(atom)
        own = np.arange(begin, begin + kind.size, dtype=np.int32).reshape(kind.shape)
        begin += kind.size
        if k in indices:
            places = value(atom)
            if places is None:
                return None
            ids.append(jnp.asarray(places))
        else:
            ids.append(jnp.asarray(own))
    params: Mapping[str, Any] = operation.params
    if operation.primitive == "gather":
        params = {**params, "fill_value": 0}
    moved = operation.source_primitive.bind(*ids, **params)
    return [np.asarray(m) for m in (moved if operation.source_primitive.multiple_results else [moved])]
