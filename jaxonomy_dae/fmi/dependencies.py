"""Which arguments each result of a program depends on, entry by entry.

A dependence that is reported may be none (loops depend on all that they read); one that is not reported is none.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from .elementwise import ELEMENTWISE
from .straight import CALLS, Atom, Constant, Operation, Straight, function_of, known, straight

# Entries by columns, booleans, sparse: what SciPy's stubs say of indexing it is not what it does.
Rows: TypeAlias = Any
Reads: TypeAlias = Sequence[Rows | None]
Values: TypeAlias = Sequence[np.ndarray | None]
Params: TypeAlias = Mapping[str, Any]

# Operations whose results are entries of what they read, or entries that are the same whatever they read.
MOVES = {
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "slice", "rev", "concatenate", "split",
    "stack", "unstack", "pad", "gather", "scatter",
}  # fmt: skip
REDUCES = {"reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or", "argmax", "argmin"}


def dependencies(program: Any, given: Sequence[Rows | None], n: int) -> list[Rows]:
    """For each result of a program (a `ClosedJaxpr`), a matrix of booleans, shape (entries, n): the columns that each
    entry depends on. `given` has such a matrix for each argument, None for one that depends on nothing."""
    with jax.ensure_compile_time_eval():
        return _closed(program, given, (), n)


def _of_program(inside: Any, given: Sequence[Any], constants: Sequence[Any], n: int) -> list[Rows]:
    program = straight(inside, [None if c is None else known(c).value for c in constants])
    found: dict[int, Rows | None] = dict(zip(program.arguments, given, strict=True))
    values: dict[int, np.ndarray] = {
        a: known(c).value for a, c in zip(program.arguments, constants, strict=False) if c is not None
    }

    def of(atom: Atom) -> Rows | None:
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
            results = _of_program(inner, [*(None for _ in closed), *read], known_values, n)
        elif operation.primitive in _CONTROL:
            results = _CONTROL[operation.primitive](
                operation.params, read, [value(a) for a in operation.given], kinds, n
            )
        else:
            results = _of_operation(program, operation, read, value, n)
        found.update(zip(operation.results, results, strict=True))
    return [_whole(of(a), program.kind(a).size, n) for a in program.results]


def _closed(program: Any, read: Sequence[Rows | None], values: Sequence[np.ndarray | None], n: int) -> list[Rows]:
    """What the results of a closed program depend on, given what is known of the values of its first arguments."""
    given = [*(None for _ in program.consts), *read]
    return _of_program(program.jaxpr, given, [*program.consts, *values], n)


def _together(a: Rows | None, b: Rows | None) -> Rows | None:
    return b if a is None else a if b is None else a + b


def _any_row(found: Rows | None) -> Rows | None:
    """The union of all rows, one row."""
    return None if found is None or not found.shape[0] else sp.csr_array(np.ones((1, found.shape[0]), bool)) @ found


def _everywhere(row: Rows | None, size: int) -> Rows | None:
    return None if row is None else row[np.zeros(size, int)]


def _repeated(
    step: Callable[[list[Rows | None]], list[Rows]], carried: list[Rows | None], controls: Callable[..., Rows | None]
) -> list[Rows | None]:
    """What carried values depend on in the end, with what decides how often the step is taken."""
    count = -1
    while True:
        new, control = step(carried), controls(carried)
        changed = []
        for old, now in zip(carried, new, strict=True):
            moves = old is None or (now != old).nnz > 0
            total = _together(old, now)
            changed.append(_together(total, _everywhere(control, now.shape[0])) if moves or control is None else total)
        carried = changed
        total = sum(0 if c is None else c.nnz for c in carried)
        if total == count:
            return carried
        count = total


def _of_while(params: Params, read: Reads, values: Values, kinds: Sequence[Any], n: int) -> list[Rows | None]:
    a, b = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_step, carried = read[:a], read[a : a + b], list(read[a + b :])
    return _repeated(
        lambda now: _closed(params["body_jaxpr"], [*of_step, *now], values[a : a + b], n),
        carried,
        lambda now: _any_row(_closed(params["cond_jaxpr"], [*of_test, *now], values[:a], n)[0]),
    )


def _of_scan(params: Params, read: Reads, values: Values, kinds: Sequence[Any], n: int) -> list[Rows | None]:
    a, b, length = params["num_consts"], params["num_carry"], params["length"]
    constants, carried = list(read[:a]), list(read[a : a + b])
    sizes = [int(np.prod(v.aval.shape, dtype=int)) for v in params["jaxpr"].jaxpr.invars[a + b :]]
    rows = [None if r is None else _by_rows(length, size) @ r for r, size in zip(read[a + b :], sizes, strict=True)]

    def step(now: list[Rows | None]) -> list[Rows]:
        return _closed(params["jaxpr"], [*constants, *now, *rows], values[:a], n)

    carried = _repeated(lambda now: step(now)[:b], carried, lambda now: None)
    collected = step(carried)[b:]
    return [*carried, *(sp.csr_array(sp.vstack([c] * length)) if length else None for c in collected)]


def _by_rows(length: int, size: int) -> Rows:
    """Adds up what stands at one place of each of so many rows."""
    places = np.tile(np.arange(size), length)
    return sp.csr_array((np.ones(len(places), bool), (places, np.arange(len(places)))), shape=(size, size * length))


def _of_cond(params: Params, read: Reads, values: Values, kinds: Sequence[Any], n: int) -> list[Rows | None]:
    found: list[Rows | None] = [_everywhere(_any_row(read[0]), kind.size) for kind in kinds]
    for branch in params["branches"]:
        found = [_together(a, b) for a, b in zip(found, _closed(branch, read[1:], values[1:], n), strict=True)]
    return found


_CONTROL = {"while": _of_while, "scan": _of_scan, "cond": _of_cond}


def _whole(found: Rows | None, size: int, n: int) -> Rows:
    return sp.csr_array((size, n), dtype=bool) if found is None else found


def _of_operation(
    program: Straight, operation: Operation, read: Sequence[Rows | None],
    value: Callable[[Atom], np.ndarray | None], n: int,
) -> list[Rows]:  # fmt: skip
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
        places = moved(program, operation, value)
        if places is not None:
            every: Rows = sp.vstack(
                [sp.csr_array((1, n), dtype=bool)]
                + [_whole(r, program.kind(a).size, n) for a, r in zip(operation.given, read, strict=True)],
                format="csr",
            )
            return [sp.csr_array(every[np.maximum(ids, 0).ravel()]) for ids in places]
    if name in REDUCES and read[0] is not None:
        shape, axes = program.kind(operation.given[0]).shape, tuple(operation.params["axes"])
        places = np.moveaxis(np.arange(read[0].shape[0]).reshape(shape), axes, range(-len(axes), 0))
        places = places.reshape(kinds[0].size, -1)
        gathers = sp.csr_array(
            (np.ones(places.size, bool), (np.repeat(np.arange(len(places)), places.shape[1]), places.ravel())),
            shape=(len(places), read[0].shape[0]),
        )
        return [gathers @ read[0]]
    row: Rows = sp.csr_array((1, n), dtype=bool)
    for rows in read:
        if rows is not None and rows.shape[0]:
            row = row + sp.csr_array(sp.csr_array(np.ones((1, rows.shape[0]), bool)) @ rows)
    return [sp.csr_array(row[np.zeros(kind.size, int)]) for kind in kinds]


def moved(
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
    # The operation itself is run, on the numbers of entries: so no rule for gathers, pads and slices stands here a
    # second time.
    found = operation.source_primitive.bind(*ids, **params)
    return [np.asarray(m) for m in (found if operation.source_primitive.multiple_results else [found])]
