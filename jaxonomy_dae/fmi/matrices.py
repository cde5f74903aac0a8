"""Factors and solutions of linear systems, in C: calls of the routines in `linear_algebra`."""

from collections.abc import Sequence

import numpy as np

from ..base.errors import ModelError
from .c_types import c_type
from .emitters import Emit, Params, affine, copy, emits
from .straight import Kind
from .writer import Value, Writer

OPERATIONS: dict[str, Emit] = {}
# Unknowns of a sparse system that C code solves for. It eliminates in a full matrix, of 2 MB for so many, and passes by
# the zeros below the diagonal.
FULL_UPTO = 500


def _matrices(value: Value) -> tuple[int, int, int]:
    """(how many matrices, rows, columns)"""
    *batch, n, m = value.kind.shape
    return int(np.prod(batch, dtype=np.int64)), n, m


@emits(OPERATIONS, "lu")
def _lu(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (factors, pivots, permutation) = given, results
    count, n, m = _matrices(source)
    copy(body, factors, source)
    if not source.kind.size:
        return
    least = min(n, m)
    with body.loops((count,)) as (i,):
        body.line(
            f"jx_lu_{_tag(source)}({factors.text} + {affine(i, n * m, 0)}, {pivots.text} + {affine(i, least, 0)}, "
            f"{permutation.text} + {affine(i, n, 0)}, {n}, {m});"
        )


@emits(OPERATIONS, "triangular_solve")
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
            f"jx_triangular_{_tag(out)}({a.text} + {affine(i, size * size, 0)}, {out.text} + "
            f"{affine(i, n * m, 0)}, {size}, {other}, {step}, {skip}, {int(lower)}, {int(turned)}, "
            f"{int(bool(params['unit_diagonal']))});"
        )


@emits(OPERATIONS, "solve_f64")
def _sparse_solve(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    """A·x = b of klujax, for which KLU is not at hand: x and b have the shape (systems, unknowns, right-hand sides)."""
    (rows, columns, values, b), (out,) = given, results
    count, n, m = _matrices(out)
    entries = rows.kind.size
    if n > FULL_UPTO:
        raise ModelError(
            f"the model has {n} simultaneous equations, and C code solves up to {FULL_UPTO} at once: a variable that "
            "changes with time between them, as a small capacity, takes them apart"
        )
    with body.lent(Kind((n, n), out.kind.dtype)) as matrix, body.lent(Kind((2 * n,), np.dtype(np.int32))) as order:
        with body.loops((count,)) as (i,):
            body.line(f"memset({matrix.text}, 0, {n * n} * sizeof *{matrix.text});")
            with body.loops((entries,)) as (k,):
                place = f"{rows.at(k)} * {n} + {columns.at(k)}"
                body.line(f"{matrix.at(place)} += {values.at(affine(i, entries, 0) + f' + {k}')};")
            body.line(f"jx_lu_d({matrix.text}, {order.text}, {order.text} + {n}, {n}, {n});")
            begin = affine(i, n * m, 0)
            with body.loops((n, m)) as (j, c):
                source = f"{begin} + {order.at(f'{n} + {j}')} * {m} + {c}"
                body.line(f"{out.at(f'{begin} + {j} * {m} + {c}')} = {b.at(source)};")
            body.line(f"jx_triangular_d({matrix.text}, {out.text} + {begin}, {n}, {m}, {m}, 1, 1, 0, 1);")
            body.line(f"jx_triangular_d({matrix.text}, {out.text} + {begin}, {n}, {m}, {m}, 1, 0, 0, 0);")


@emits(OPERATIONS, "cholesky")
def _cholesky(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out,) = given, results
    count, n, _ = _matrices(source)
    copy(body, out, source)
    if out.kind.size:
        with body.loops((count,)) as (i,):
            body.line(f"jx_cholesky_{_tag(out)}({out.text} + {affine(i, n * n, 0)}, {n});")


@emits(OPERATIONS, "geqrf")
def _geqrf(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source,), (out, taus) = given, results
    count, n, m = _matrices(source)
    copy(body, out, source)
    if out.kind.size:
        with body.loops((count,)) as (i,):
            body.line(
                f"jx_geqrf_{_tag(out)}({out.text} + {affine(i, n * m, 0)}, {taus.text} + "
                f"{affine(i, min(n, m), 0)}, {n}, {m});"
            )


@emits(OPERATIONS, "householder_product")
def _householder_product(body: Writer, params: Params, given: Sequence[Value], results: Sequence[Value]) -> None:
    (source, taus), (out,) = given, results
    count, n, m = _matrices(source)
    if not out.kind.size:
        return
    with body.loops((count,)) as (i,):
        body.line(
            f"jx_householder_{_tag(out)}({source.text} + {affine(i, n * m, 0)}, {taus.text} + "
            f"{affine(i, taus.kind.shape[-1], 0)}, {out.text} + {affine(i, n * m, 0)}, {n}, {m}, "
            f"{taus.kind.shape[-1]});"
        )


@emits(OPERATIONS, "qr")
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
        body.line(f"memcpy({factors.text}, {source.text} + {affine(i, n * m, 0)}, {n * m} * sizeof({t}));")
        body.line(f"jx_geqrf_{tag}({factors.text}, {taus.text}, {n}, {m});")
        with body.block(f"for (int {row} = 0; {row} < {k}; ++{row})"):
            with body.block(f"for (int {column} = 0; {column} < {m}; ++{column})"):
                entry = f"{factors.text}[{row} * {m} + {column}]"
                body.line(f"{r.text}[{affine(i, k * m, 0)} + {row} * {m} + {column}] = {column} < {row} ? 0 : {entry};")
        if m > k:  # the reflections alone
            with body.block(f"for (int {row} = 0; {row} < {n}; ++{row})"):
                with body.block(f"for (int {column} = 0; {column} < {k}; ++{column})"):
                    body.line(f"{factors.text}[{row} * {k} + {column}] = {factors.text}[{row} * {m} + {column}];")
        body.line(
            f"jx_householder_{tag}({factors.text}, {taus.text}, {q.text} + {affine(i, n * k, 0)}, {n}, {k}, {k});"
        )


def _tag(value: Value) -> str:
    return "f" if value.kind.dtype == np.float32 else "d"
