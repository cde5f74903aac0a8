"""Sums, products, extremes and sorting of arrays, in C."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .c_types import c_type, is_bool, is_float, limits, number
from .emitters import Emit, Params, cell, copy, emits, flat
from .writer import Value, Writer

OPERATIONS: dict[str, Emit] = {}


def _unit(primitive: str, dtype: Any) -> str:
    """The value that changes nothing."""
    if primitive in ("add", "or", "xor"):
        return number(0, dtype)
    if primitive == "mul":
        return number(1, dtype)
    if primitive == "and":
        return "1" if is_bool(dtype) else number(-1, dtype)
    least = primitive == "max"
    if is_float(dtype):
        return number(-np.inf if least else np.inf, dtype)
    if is_bool(dtype):
        return "0" if least else "1"
    return limits(dtype)[0 if least else 1]


def _reduces(primitive: str) -> Emit:
    def emit(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
        (source,), (out,) = given, results
        shape, axes = source.kind.shape, set(params["axes"])
        kept = [d for d in range(len(shape)) if d not in axes]
        total = body.name()
        t = c_type(out.kind.dtype)
        with body.loops([shape[d] for d in kept]) as outer:
            with body.block(""):
                body.line(f"{t} {total} = {_unit(primitive, out.kind.dtype)};")
                with body.loops([shape[d] for d in sorted(axes)]) as inner:
                    at = [""] * len(shape)
                    for d, i in [*zip(kept, outer, strict=True), *zip(sorted(axes), inner, strict=True)]:
                        at[d] = i
                    entry = source.at(flat(at, shape))
                    body.line(f"{total} = {cell(primitive, [total, entry], out.kind.dtype)};")
                body.line(f"{out.at(flat(outer, out.kind.shape))} = {total};")

    return emit


for _name, _primitive in {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or",
                          "xor": "xor"}.items():  # fmt: skip
    OPERATIONS[f"reduce_{_name}"] = _reduces(_primitive)


def _finds(operator: str) -> Emit:
    def emit(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
        (source,), (out,) = given, results
        shape, (axis,) = source.kind.shape, params["axes"]
        kept = [d for d in range(len(shape)) if d != axis]
        best, where, new, k = body.name(), body.name(), body.name(), body.name()
        with body.loops([shape[d] for d in kept]) as outer, body.block(""):

            def at(i: str) -> str:
                place = iter(outer)
                return source.at(flat([i if d == axis else next(place) for d in range(len(shape))], shape))

            body.line(f"{c_type(source.kind.dtype)} {best} = {at('0')};")
            body.line(f"int {where} = 0;")
            with body.block(f"for (int {k} = 1; {k} < {shape[axis]}; ++{k})"):
                body.line(f"const {c_type(source.kind.dtype)} {new} = {at(k)};")
                # The first not-a-number wins.
                wins = f"({new} {operator} {best} || {new} != {new}) && {best} == {best}"
                wins = wins if is_float(source.kind.dtype) else f"{new} {operator} {best}"
                body.line(f"if ({wins}) {{ {best} = {new}; {where} = {k}; }}")
            body.line(f"{out.at(flat(outer, out.kind.shape))} = {where};")

    return emit


OPERATIONS["argmax"], OPERATIONS["argmin"] = _finds(">"), _finds("<")


def _accumulates(primitive: str) -> Emit:
    def emit(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
        (source,), (out,) = given, results
        shape, axis = out.kind.shape, params["axis"]
        if not out.kind.size:
            return
        total, k = body.name(), body.name()
        with body.loops([n for d, n in enumerate(shape) if d != axis]) as outer, body.block(""):
            body.line(f"{c_type(out.kind.dtype)} {total} = {_unit(primitive, out.kind.dtype)};")
            with body.block(f"for (int {k} = 0; {k} < {shape[axis]}; ++{k})"):
                place = iter(outer)
                own = f"({shape[axis] - 1} - {k})" if params["reverse"] else k
                at = flat([own if d == axis else next(place) for d in range(len(shape))], shape)
                body.line(f"{total} = {cell(primitive, [total, source.at(at)], out.kind.dtype)};")
                body.line(f"{out.at(at)} = {total};")

    return emit


for _name, _primitive in {"sum": "add", "prod": "mul", "max": "max", "min": "min"}.items():
    OPERATIONS[f"cum{_name}"] = _accumulates(_primitive)


@emits(OPERATIONS, "dot_general")
def _dot_general(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (a, b), (out,) = given, results
    (over_a, over_b), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [d for d in range(len(a.kind.shape)) if d not in (*over_a, *batch_a)]
    free_b = [d for d in range(len(b.kind.shape)) if d not in (*over_b, *batch_b)]
    t, total = c_type(out.kind.dtype), body.name()
    with body.loops(out.kind.shape) as i, body.block(""):
        body.line(f"{t} {total} = {number(0, out.kind.dtype)};")
        with body.loops([a.kind.shape[d] for d in over_a]) as k:
            at_a, at_b = [""] * len(a.kind.shape), [""] * len(b.kind.shape)
            n, m = len(batch_a), len(free_a)
            for at, batch, free, over, own in (
                (at_a, batch_a, free_a, over_a, i[n : n + m]), (at_b, batch_b, free_b, over_b, i[n + m :])
            ):  # fmt: skip
                for d, index in [
                    *zip(batch, i, strict=False),
                    *zip(free, own, strict=True),
                    *zip(over, k, strict=True),
                ]:
                    at[d] = index
            x, y = a.at(flat(at_a, a.kind.shape)), b.at(flat(at_b, b.kind.shape))
            if is_bool(out.kind.dtype):
                body.line(f"{total} = {total} || ({x} && {y});")
            else:
                product = cell("mul", [f"({t}){x}", f"({t}){y}"], out.kind.dtype)
                body.line(f"{total} = {cell('add', [total, product], out.kind.dtype)};")
        body.line(f"{out.at(flat(i, out.kind.shape))} = {total};")


@emits(OPERATIONS, "sort")
def _sort(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    """Insertion, which keeps the order of equal keys; numbers before not-a-number."""
    shape, axis, keys = results[0].kind.shape, params["dimension"], params["num_keys"]
    for source, out in zip(given, results, strict=True):
        copy(body, out, source)
    if not results[0].kind.size:
        return
    held = [body.name() for _ in results]
    j, k = body.name(), body.name()
    with body.loops([n for d, n in enumerate(shape) if d != axis]) as outer:

        def at(out: Value, i: str) -> str:
            place = iter(outer)
            return out.at(flat([i if d == axis else next(place) for d in range(len(shape))], shape))

        with body.block(f"for (int {k} = 1; {k} < {shape[axis]}; ++{k})"):
            for name, out in zip(held, results, strict=True):
                body.line(f"const {c_type(out.kind.dtype)} {name} = {at(out, k)};")
            body.line(f"int {j} = {k} - 1;")
            less = "0"
            for name, out in reversed(list(zip(held[:keys], results[:keys], strict=True))):
                old = at(out, j)
                before, same = f"{name} < {old}", f"{name} == {old}"
                if is_float(out.kind.dtype):
                    before = f"({before} || ({old} != {old} && {name} == {name}))"
                    same = f"({same} || ({old} != {old} && {name} != {name}))"
                less = before if less == "0" else f"({before} || ({same} && {less}))"
            with body.block(f"while ({j} >= 0 && {less})"):
                for out in results:
                    body.line(f"{at(out, f'({j} + 1)')} = {at(out, j)};")
                body.line(f"--{j};")
            for name, out in zip(held, results, strict=True):
                body.line(f"{at(out, f'({j} + 1)')} = {name};")
