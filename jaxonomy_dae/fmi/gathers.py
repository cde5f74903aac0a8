"""Gathers and scatters, in C."""

from collections.abc import Sequence

import numpy as np

from .c_types import is_bool, is_float, limits, number
from .emitters import Emit, Params, cell, copy, emits, flat, inside
from .straight import Kind
from .writer import Value, Writer

OPERATIONS: dict[str, Emit] = {}


def _index_of(indices: Value, batch: Sequence[str], k: int) -> str:
    """Component k of the index vector at a place among the indices."""
    return f"(int64_t){indices.at(flat([*batch, str(k)], indices.kind.shape))}"


def _are_inside(indices: Value, k: int, last: int) -> bool:
    """True if component k of all index vectors is known to be from 0 to `last`: nothing is tested then."""
    found = indices.known
    return found is not None and bool(np.all((found[..., k] >= 0) & (found[..., k] <= last)))


@emits(OPERATIONS, "gather")
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
            known = _are_inside(indices, k, last)
            body.line(f"const int64_t {name} = {text if drops or known else inside(text, last)};")
            begin[d] = f"(int){name}"
            if not known:
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
                body.line(f"const int64_t {name} = {inside(text, last) if clipped else text};")
                begin[d] = f"(int){name}"
                if not _are_inside(indices, k, last):
                    tests.append(f"{name} >= 0 && {name} <= {last}")
            for d, b in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
                begin[d] = batch[b]
            at = [_place(begin.get(d), offset.get(d)) for d in range(len(shape))]
            target, update = out.at(flat(at, shape)), updates.at(flat(i, updates.kind.shape))
            new = update if primitive is None else cell(primitive, [target, update], out.kind.dtype)
            line = f"{target} = {new};"
            body.line(f"if ({' && '.join(tests)}) {line}" if tests and not clips else line)

    return emit


for _name, _primitive in {"scatter": None, "scatter-add": "add", "scatter_add": "add", "scatter-sub": "sub",
                          "scatter_sub": "sub", "scatter-mul": "mul", "scatter_mul": "mul", "scatter-min": "min",
                          "scatter_min": "min", "scatter-max": "max", "scatter_max": "max"}.items():  # fmt: skip
    OPERATIONS[_name] = _scatters(_primitive)
