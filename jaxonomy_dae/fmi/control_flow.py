"""Primitives that repeat and choose functions, in C."""

from collections.abc import Sequence

import numpy as np

from .c_types import is_bool
from .emitters import Emit, Params, copy, emits
from .straight import Kind
from .writer import Value, Writer

OPERATIONS: dict[str, Emit] = {}


@emits(OPERATIONS, "while")
def _while(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    n, m = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_step, carried = given[:n], given[n : n + m], given[n + m :]
    for out, value in zip(results, carried, strict=True):
        copy(body, out, value)
    goes_on = body.scratch(Kind((), np.dtype(bool)))
    new = [body.scratch(out.kind) for out in results]
    with body.block("for (;;)"):
        body.apply_closed(params["cond_jaxpr"], [*of_test, *results], [goes_on])
        body.line(f"if (!{goes_on.text}) break;")
        body.apply_closed(params["body_jaxpr"], [*of_step, *results], new)
        for out, value in zip(results, new, strict=True):
            copy(body, out, value)


@emits(OPERATIONS, "cond")
def _cond(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    index, *operands = given
    branches = params["branches"]
    if is_bool(index.kind.dtype):
        raise NotImplementedError
    for k, branch in enumerate(branches):
        test = f"{index.text} <= {k}" if k == 0 else f"{index.text} == {k}"
        head = f"if ({test})" if k == 0 else ("else" if k == len(branches) - 1 else f"else if ({test})")
        with body.block(head if len(branches) > 1 else ""):
            body.apply_closed(branch, operands, results)


@emits(OPERATIONS, "scan")
def _scan(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    n, m, length = params["num_consts"], params["num_carry"], params["length"]
    constants, begin, rows = given[:n], given[n : n + m], given[n + m :]
    carried, collected = results[:m], results[m:]
    for out, value in zip(carried, begin, strict=True):
        copy(body, out, value)
    new = [body.scratch(out.kind) for out in carried]
    k, i = body.name(), body.name()
    with body.block(f"for (int {k} = 0; {k} < {length}; ++{k})"):
        body.line(f"const int {i} = {f'{length - 1} - {k}' if params['reverse'] else k};")
        row_in = [_row(value, i) for value in rows]
        row_out = [_row(value, i) for value in collected]
        given_now, results_now = [*constants, *carried, *row_in], [*new, *row_out]
        body.apply_closed(params["jaxpr"], given_now, results_now)
        for out, value in zip(carried, new, strict=True):
            copy(body, out, value)
        if not rows and not collected:
            body.line(f"(void){i};")


def _row(value: Value, i: str) -> Value:
    """Row i of an array."""
    kind = Kind(value.kind.shape[1:], value.kind.dtype)
    return Value(f"({value.text} + {i} * {kind.size})" if kind.shape else f"{value.text}[{i}]", kind)
