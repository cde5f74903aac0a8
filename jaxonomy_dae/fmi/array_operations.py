"""Primitives that move, sum and multiply entries of arrays, and that repeat and choose functions, in C."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .c_types import c_type, is_bool, is_float, limits, number
from .elementwise import ELEMENTWISE, Cell
from .straight import Kind, is_uniform
from .writer import Value, Writer

Params = Mapping[str, Any]
Emit = Callable[[Writer, Params, Sequence[Value], Sequence[Value]], None]

ARRAY_OPERATIONS: dict[str, Emit] = {}


def _emits(*names: str) -> Callable[[Emit], Emit]:
    def register(emit: Emit) -> Emit:
        ARRAY_OPERATIONS.update(dict.fromkeys(names, emit))
        return emit

    return register


def flat(indices: Sequence[str], shape: Sequence[int]) -> str:
    """The number of the entry with these indices, row by row."""
    text = "0"
    for i, n in zip(indices, shape, strict=True):
        text = i if text == "0" else (f"{text} * {n}" if i == "0" else f"({text} * {n} + {i})")
    return text


def _cell(primitive: str, given: Sequence[str], dtype: Any) -> str:
    """An expression of two entries of one type."""
    return ELEMENTWISE[primitive](Cell(given, [np.dtype(dtype)] * len(given), np.dtype(dtype), {}))


def copy(body: Writer, target: Value, source: Value) -> None:
    """Assigns a scalar or all entries of an array, if they are not the same one."""
    if target.text == source.text:
        return
    if not target.kind.shape:
        body.line(f"{target.text} = {source.text};")
    elif source.known is not None and is_uniform(source.known):
        with body.loops((target.kind.size,)) as (i,):  # no table of equal numbers
            body.line(f"{target.at(i)} = {number(source.known.ravel()[0], source.kind.dtype)};")
    elif target.kind.size:
        body.line(f"memcpy({target.text}, {source.text}, {target.kind.size} * sizeof *{target.text});")


# --- moving entries ------------------------------------------------------------------------------------------------


@_emits("broadcast_in_dim")
def _broadcast(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, *_), (out,) = given, results
    with body.loops(out.kind.shape) as i:
        at = ["0" if n == 1 else i[d] for d, n in zip(params["broadcast_dimensions"], source.kind.shape, strict=True)]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@_emits("transpose")
def _transpose(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    with body.loops(out.kind.shape) as i:
        at = ["0"] * len(i)
        for place, d in enumerate(params["permutation"]):
            at[d] = i[place]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@_emits("slice")
def _slice(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    strides = params["strides"] or (1,) * len(params["start_indices"])
    with body.loops(out.kind.shape) as i:
        at = [_affine(k, stride, begin) for k, stride, begin in zip(i, strides, params["start_indices"], strict=True)]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


def _affine(i: str, stride: int, begin: int) -> str:
    text = i if stride == 1 else ("0" if i == "0" else f"{i} * {stride}")
    if begin == 0:
        return text
    return str(begin) if text == "0" else f"({text} + {begin})"


@_emits("rev")
def _reverse(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    shape = out.kind.shape
    with body.loops(shape) as i:
        at = [
            f"({n - 1} - {k})" if d in params["dimensions"] else k
            for d, (k, n) in enumerate(zip(i, shape, strict=True))
        ]
        body.line(f"{out.at(flat(i, shape))} = {source.at(flat(at, shape))};")


@_emits("iota")
def _iota(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (out,) = results
    with body.loops(out.kind.shape) as i:
        body.line(f"{out.at(flat(i, out.kind.shape))} = ({c_type(out.kind.dtype)}){i[params['dimension']]};")


@_emits("pad")
def _pad(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, filling), (out,) = given, results
    if out.kind.size:
        with body.block(f"for (int p = 0; p < {out.kind.size}; ++p)"):
            body.line(f"{out.at('p')} = {filling.text};")
    with body.loops(source.kind.shape) as i:
        at, tests = [], []
        for k, (low, _, inside), n in zip(i, params["padding_config"], out.kind.shape, strict=True):
            place = _affine(k, inside + 1, low)
            at.append(place)
            if low < 0 or _ < 0:
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
        base = _affine(i, whole[axis] * inner, begin * inner)
        own = _affine(i, length, 0)
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


@_emits("concatenate")
def _concatenate(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (out,), axis, begin = results, params["dimension"], 0
    for part in given:
        _placed(body, out, part, axis, begin, into=True)
        begin += part.kind.shape[axis]


@_emits("split")
def _split(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), axis, begin = given, params["axis"], 0
    for part in results:
        _placed(body, source, part, axis, begin, into=False)
        begin += part.kind.shape[axis]


@_emits("stack")
def _stack(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (out,) = results
    for k, part in enumerate(given):
        _placed(body, out, part, params["axis"], k, into=True)


@_emits("unstack")
def _unstack(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,) = given
    for k, part in enumerate(results):
        _placed(body, source, part, params["axis"], k, into=False)


def _starts(body: Writer, starts: Sequence[Value], shape: Sequence[int], sizes: Sequence[int]) -> list[str]:
    """Where a slice begins along each axis, moved inside the array."""
    names = []
    for start, n, size in zip(starts, shape, sizes, strict=True):
        name = body.name()
        body.line(f"const int64_t {name} = {_inside(f'(int64_t){start.text}', n - size)};")
        names.append(f"(int){name}")
    return names


def _inside(text: str, last: int) -> str:
    return f"{text} < 0 ? 0 : {text} > {last} ? {last} : {text}"


@_emits("dynamic_slice")
def _dynamic_slice(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, *starts), (out,) = given, results
    begin = _starts(body, starts, source.kind.shape, params["slice_sizes"])
    with body.loops(out.kind.shape) as i:
        at = [f"({b} + {k})" for b, k in zip(begin, i, strict=True)]
        body.line(f"{out.at(flat(i, out.kind.shape))} = {source.at(flat(at, source.kind.shape))};")


@_emits("dynamic_update_slice")
def _dynamic_update_slice(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, update, *starts), (out,) = given, results
    copy(body, out, source)
    begin = _starts(body, starts, source.kind.shape, update.kind.shape)
    with body.loops(update.kind.shape) as i:
        at = [f"({b} + {k})" for b, k in zip(begin, i, strict=True)]
        body.line(f"{out.at(flat(at, out.kind.shape))} = {update.at(flat(i, update.kind.shape))};")


# --- gathers and scatters ------------------------------------------------------------------------------------------


def _index_of(indices: Value, batch: Sequence[str], k: int) -> str:
    """Component k of the index vector at a place among the indices."""
    return f"(int64_t){indices.at(flat([*batch, str(k)], indices.kind.shape))}"


def _are_inside(indices: Value, k: int, last: int) -> bool:
    """True if component k of all index vectors is known to be from 0 to `last`: nothing is tested then."""
    found = indices.known
    return found is not None and bool(np.all((found[..., k] >= 0) & (found[..., k] <= last)))


@_emits("gather")
def _gather(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, indices), (out,) = given, results
    numbers, sizes, shape = params["dimension_numbers"], params["slice_sizes"], source.kind.shape
    drops = _mode(params) in ("fill", "fill_or_drop")
    dropped = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    kept = [d for d in range(len(shape)) if d not in dropped]
    with body.loops(out.kind.shape) as i:
        offset = dict(zip(kept, (i[d] for d in numbers.offset_dims), strict=True))
        batch = [k for d, k in enumerate(i) if d not in numbers.offset_dims]
        begin: dict[int, str] = {}
        tests = []
        for k, d in enumerate(numbers.start_index_map):
            name = body.name()
            text, last = _index_of(indices, batch, k), shape[d] - sizes[d]
            inside = _are_inside(indices, k, last)
            body.line(f"const int64_t {name} = {text if drops or inside else _inside(text, last)};")
            begin[d] = f"(int){name}"
            if not inside:
                tests.append(f"{name} >= 0 && {name} <= {last}")
        for d, b in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            begin[d] = batch[b]
        at = [_place(begin.get(d), offset.get(d)) for d in range(len(shape))]
        value = source.at(flat(at, shape)) if source.kind.size else "0"
        if drops and tests:
            value = f"{' && '.join(tests)} ? {value} : {_filling(params, out.kind)}"
        body.line(f"{out.at(flat(i, out.kind.shape))} = {value};")


def _place(begin: str | None, offset: str | None) -> str:
    """An index inside a window that begins somewhere."""
    if begin is None:
        return offset or "0"
    return begin if offset is None else f"({begin} + {offset})"


def _mode(params: Params) -> str:
    return getattr(params["mode"], "name", str(params["mode"])).lower()


def _filling(params: Params, kind: Kind) -> str:
    if params.get("fill_value") is not None:
        return number(params["fill_value"], kind.dtype)
    if is_float(kind.dtype):
        return number(np.nan, kind.dtype)
    if is_bool(kind.dtype):
        return "1"
    low, high = limits(kind.dtype)
    return low if np.dtype(kind.dtype).kind == "i" else high


def _scatters(primitive: str | None) -> Emit:
    def emit(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
        (source, indices, updates), (out,) = given, results
        numbers, shape = params["dimension_numbers"], source.kind.shape
        clips = _mode(params) == "clip"
        copy(body, out, source)
        dropped = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
        kept = [d for d in range(len(shape)) if d not in dropped]
        window = dict(zip(kept, (updates.kind.shape[d] for d in numbers.update_window_dims), strict=True))
        with body.loops(updates.kind.shape) as i:
            offset = dict(zip(kept, (i[d] for d in numbers.update_window_dims), strict=True))
            batch = [k for d, k in enumerate(i) if d not in numbers.update_window_dims]
            begin: dict[int, str] = {}
            tests = []
            for k, d in enumerate(numbers.scatter_dims_to_operand_dims):
                name = body.name()
                text, last = _index_of(indices, batch, k), shape[d] - window.get(d, 1)
                clipped = clips and not _are_inside(indices, k, last)
                body.line(f"const int64_t {name} = {_inside(text, last) if clipped else text};")
                begin[d] = f"(int){name}"
                if not _are_inside(indices, k, last):
                    tests.append(f"{name} >= 0 && {name} <= {last}")
            for d, b in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
                begin[d] = batch[b]
            at = [_place(begin.get(d), offset.get(d)) for d in range(len(shape))]
            target, update = out.at(flat(at, shape)), updates.at(flat(i, updates.kind.shape))
            new = update if primitive is None else _cell(primitive, [target, update], out.kind.dtype)
            line = f"{target} = {new};"
            body.line(f"if ({' && '.join(tests)}) {line}" if tests and not clips else line)

    return emit


for _name, _primitive in {"scatter": None, "scatter-add": "add", "scatter_add": "add", "scatter-sub": "sub",
                          "scatter_sub": "sub", "scatter-mul": "mul", "scatter_mul": "mul", "scatter-min": "min",
                          "scatter_min": "min", "scatter-max": "max", "scatter_max": "max"}.items():  # fmt: skip
    ARRAY_OPERATIONS[_name] = _scatters(_primitive)


# --- sums and products ---------------------------------------------------------------------------------------------


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
                    body.line(f"{total} = {_cell(primitive, [total, entry], out.kind.dtype)};")
                body.line(f"{out.at(flat(outer, out.kind.shape))} = {total};")

    return emit


for _name, _primitive in {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or",
                          "xor": "xor"}.items():  # fmt: skip
    ARRAY_OPERATIONS[f"reduce_{_name}"] = _reduces(_primitive)


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


ARRAY_OPERATIONS["argmax"], ARRAY_OPERATIONS["argmin"] = _finds(">"), _finds("<")


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
                body.line(f"{total} = {_cell(primitive, [total, source.at(at)], out.kind.dtype)};")
                body.line(f"{out.at(at)} = {total};")

    return emit


for _name, _primitive in {"sum": "add", "prod": "mul", "max": "max", "min": "min"}.items():
    ARRAY_OPERATIONS[f"cum{_name}"] = _accumulates(_primitive)


@_emits("dot_general")
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
                product = _cell("mul", [f"({t}){x}", f"({t}){y}"], out.kind.dtype)
                body.line(f"{total} = {_cell('add', [total, product], out.kind.dtype)};")
        body.line(f"{out.at(flat(i, out.kind.shape))} = {total};")


@_emits("sort")
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


# --- linear algebra ------------------------------------------------------------------------------------------------


def _matrices(value: Value) -> tuple[int, int, int]:
    """(how many matrices, rows, columns)"""
    *batch, n, m = value.kind.shape
    return int(np.prod(batch, dtype=np.int64)), n, m


@_emits("lu")
def _lu(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (factors, pivots, permutation) = given, results
    count, n, m = _matrices(source)
    copy(body, factors, source)
    if not source.kind.size:
        return
    least = min(n, m)
    with body.loops((count,)) as (i,):
        body.line(
            f"jx_lu_{_tag(source)}({factors.text} + {_affine(i, n * m, 0)}, {pivots.text} + {_affine(i, least, 0)}, "
            f"{permutation.text} + {_affine(i, n, 0)}, {n}, {m});"
        )


@_emits("triangular_solve")
def _triangular_solve(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (a, b), (out,) = given, results
    count, n, m = _matrices(out)
    copy(body, out, b)
    if not out.kind.size:
        return
    if params["left_side"]:
        size, other, step, skip = n, m, m, 1
    else:
        size, other, step, skip = m, n, 1, m
    # x·a = b is aᵀ·xᵀ = bᵀ.
    turned = bool(params["transpose_a"]) == bool(params["left_side"])
    lower = bool(params["lower"]) != turned
    with body.loops((count,)) as (i,):
        body.line(
            f"jx_triangular_{_tag(out)}({a.text} + {_affine(i, size * size, 0)}, {out.text} + "
            f"{_affine(i, n * m, 0)}, {size}, {other}, {step}, {skip}, {int(lower)}, {int(turned)}, "
            f"{int(bool(params['unit_diagonal']))});"
        )


@_emits("cholesky")
def _cholesky(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    count, n, _ = _matrices(source)
    copy(body, out, source)
    if out.kind.size:
        with body.loops((count,)) as (i,):
            body.line(f"jx_cholesky_{_tag(out)}({out.text} + {_affine(i, n * n, 0)}, {n});")


@_emits("geqrf")
def _geqrf(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out, taus) = given, results
    count, n, m = _matrices(source)
    copy(body, out, source)
    if out.kind.size:
        with body.loops((count,)) as (i,):
            body.line(
                f"jx_geqrf_{_tag(out)}({out.text} + {_affine(i, n * m, 0)}, {taus.text} + "
                f"{_affine(i, min(n, m), 0)}, {n}, {m});"
            )


@_emits("householder_product")
def _householder_product(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, taus), (out,) = given, results
    count, n, m = _matrices(source)
    if not out.kind.size:
        return
    with body.loops((count,)) as (i,):
        body.line(
            f"jx_householder_{_tag(out)}({source.text} + {_affine(i, n * m, 0)}, {taus.text} + "
            f"{_affine(i, taus.kind.shape[-1], 0)}, {out.text} + {_affine(i, n * m, 0)}, {n}, {m}, "
            f"{taus.kind.shape[-1]});"
        )


@_emits("qr")
def _qr(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    if params["full_matrices"] or params["pivoting"]:
        raise NotImplementedError
    (source,), (q, r) = given, results
    count, n, m = _matrices(source)
    k = min(n, m)
    if not source.kind.size:
        return
    t, tag = c_type(source.kind.dtype), _tag(source)
    factors = body.scratch(Kind((n, m), source.kind.dtype))
    taus = body.scratch(Kind((k,), source.kind.dtype))
    with body.loops((count,)) as (i,):
        row, column = body.name(), body.name()
        body.line(f"memcpy({factors.text}, {source.text} + {_affine(i, n * m, 0)}, {n * m} * sizeof({t}));")
        body.line(f"jx_geqrf_{tag}({factors.text}, {taus.text}, {n}, {m});")
        with body.block(f"for (int {row} = 0; {row} < {k}; ++{row})"):
            with body.block(f"for (int {column} = 0; {column} < {m}; ++{column})"):
                entry = f"{factors.text}[{row} * {m} + {column}]"
                body.line(
                    f"{r.text}[{_affine(i, k * m, 0)} + {row} * {m} + {column}] = {column} < {row} ? 0 : {entry};"
                )
        if m > k:  # the reflections alone
            with body.block(f"for (int {row} = 0; {row} < {n}; ++{row})"):
                with body.block(f"for (int {column} = 0; {column} < {k}; ++{column})"):
                    body.line(f"{factors.text}[{row} * {k} + {column}] = {factors.text}[{row} * {m} + {column}];")
        body.line(
            f"jx_householder_{tag}({factors.text}, {taus.text}, {q.text} + {_affine(i, n * k, 0)}, {n}, {k}, {k});"
        )


def _tag(value: Value) -> str:
    return "f" if value.kind.dtype == np.float32 else "d"


# --- repeating and choosing ----------------------------------------------------------------------------------------


@_emits("while")
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


@_emits("cond")
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


@_emits("scan")
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
