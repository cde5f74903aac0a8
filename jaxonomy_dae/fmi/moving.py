"""Primitives that move entries of arrays, in C."""

from collections.abc import Sequence

import numpy as np

from .c_types import c_type, number
from .emitters import Emit, Params, affine, copy, emits, flat, inside
from .straight import is_uniform
from .writer import Value, Writer

OPERATIONS: dict[str, Emit] = {}


@emits(OPERATIONS, "broadcast_in_dim")
def _broadcast(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, *_), (out,) = given, results
    with body.loops(out.kind.shape) as i:
        at = ["0" if n == 1 else i[d] for d, n in zip(params["broadcast_dimensions"], source.kind.shape, strict=True)]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@emits(OPERATIONS, "transpose")
def _transpose(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    with body.loops(out.kind.shape) as i:
        at = ["0"] * len(i)
        for place, d in enumerate(params["permutation"]):
            at[d] = i[place]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@emits(OPERATIONS, "slice")
def _slice(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    strides = params["strides"] or (1,) * len(params["start_indices"])
    with body.loops(out.kind.shape) as i:
        at = [affine(k, stride, begin) for k, stride, begin in zip(i, strides, params["start_indices"], strict=True)]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@emits(OPERATIONS, "rev")
def _reverse(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    shape = out.kind.shape
    with body.loops(shape) as i:
        at = [
            f"({n - 1} - {k})" if d in params["dimensions"] else k
            for d, (k, n) in enumerate(zip(i, shape, strict=True))
        ]
        body.line(f"{out.at(flat(i, shape))} = {source.at(flat(at, shape))};")


@emits(OPERATIONS, "iota")
def _iota(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (out,) = results
    with body.loops(out.kind.shape) as i:
        body.line(f"{out.at(flat(i, out.kind.shape))} = ({c_type(out.kind.dtype)}){i[params['dimension']]};")


@emits(OPERATIONS, "pad")
def _pad(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, filling), (out,) = given, results
    if out.kind.size:
        with body.block(f"for (int p = 0; p < {out.kind.size}; ++p)"):
            body.line(f"{out.at('p')} = {filling.text};")
    with body.loops(source.kind.shape) as i:
        at, tests = [], []
        for k, (low, high, between), n in zip(i, params["padding_config"], out.kind.shape, strict=True):
            place = affine(k, between + 1, low)
            at.append(place)
            if low < 0 or high < 0:
                tests.append(f"{place} >= 0 && {place} < {n}")
        line = f"{out.at(flat(at, out.kind.shape))} = {source.at(flat(i, source.kind.shape))};"
        body.line(f"if ({' && '.join(tests)}) {line}" if tests else line)


def _placed(body: Writer, out: Value, part: Value, axis: int, begin: int, into: bool) -> None:
    """Copies a part of an array along an axis, `into` the array or out of it."""
    whole = out.kind.shape
    rows, inner = int(np.prod(whole[:axis])), int(np.prod(whole[axis + 1 :]))
    length = part.kind.size // rows if rows else 0
    if not length:
        return
    with body.loops((rows,)) as (i,):
        base = affine(i, whole[axis] * inner, begin * inner)
        own = affine(i, length, 0)
        if part.known is not None and is_uniform(part.known):
            with body.loops((length,)) as (k,):
                place = base if k == "0" else f"{base} + {k}"
                body.line(f"{out.at(place)} = {number(part.known.ravel()[0], part.kind.dtype)};")
            return
        if length == 1 or not part.kind.shape:
            target, source = (out.at(base), part.at(own)) if into else (part.at(own), out.at(base))
            body.line(f"{target} = {source};")
        else:
            target, source = (out.text + " + " + base, part.text + " + " + own)
            target, source = (target, source) if into else (source, target)
            body.line(f"memcpy({target}, {source}, {length} * sizeof *{out.text});")


@emits(OPERATIONS, "concatenate")
def _concatenate(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (out,), axis, begin = results, params["dimension"], 0
    for part in given:
        _placed(body, out, part, axis, begin, into=True)
        begin += part.kind.shape[axis]


@emits(OPERATIONS, "split")
def _split(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), axis, begin = given, params["axis"], 0
    for part in results:
        _placed(body, source, part, axis, begin, into=False)
        begin += part.kind.shape[axis]


@emits(OPERATIONS, "stack")
def _stack(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (out,) = results
    for k, part in enumerate(given):
        _placed(body, out, part, params["axis"], k, into=True)


@emits(OPERATIONS, "unstack")
def _unstack(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,) = given
    for k, part in enumerate(results):
        _placed(body, source, part, params["axis"], k, into=False)


def _starts(body: Writer, starts: Sequence[Value], shape: Sequence[int], sizes: Sequence[int]) -> list[str]:
    """Where a slice begins along each axis, moved inside the array."""
    names = []
    for start, n, size in zip(starts, shape, sizes, strict=True):
        name = body.name()
        body.line(f"const int64_t {name} = {inside(f'(int64_t){start.text}', n - size)};")
        names.append(f"(int){name}")
    return names


@emits(OPERATIONS, "dynamic_slice")
def _dynamic_slice(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, *starts), (out,) = given, results
    begin = _starts(body, starts, source.kind.shape, params["slice_sizes"])
    with body.loops(out.kind.shape) as i:
        at = [f"({b} + {k})" for b, k in zip(begin, i, strict=True)]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@emits(OPERATIONS, "dynamic_update_slice")
def _dynamic_update_slice(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, update, *starts), (out,) = given, results
    copy(body, out, source)
    begin = _starts(body, starts, source.kind.shape, update.kind.shape)
    with body.loops(update.kind.shape) as i:
        at = [f"({b} + {k})" for b, k in zip(begin, i, strict=True)]
        body.line(f"{out.at(flat(at, out.kind.shape))} = {update.at(flat(i, update.kind.shape))};")
