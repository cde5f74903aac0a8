"""Sparse direct solves and sparse Jacobians with a static pattern.

Given where the entries of A lie (a `SparsePattern`, known when the model is compiled) and their values (traced),
`solve_sparse` returns x with A·x = b. The factorization is KLU's (Davis & Palamadai Natarajan 2010, ACM TOMS 37:36), a
left-looking LU after a permutation to block triangular form, made for circuits. It is reached through `klujax`, which
is a thin wrapper and runs on every JAX this package supports; `splineax` wraps the same KLU but needs a newer JAX, and
Numba. Where a program runs on an accelerator, the solve is SciPy's SuperLU on the host.

Importing `klujax` turns on 64-bit mode and the CPU for the whole process. It is therefore imported when the first
sparse solve is made, and both settings are put back.

`sparse_jacobian` finds a Jacobian's values from a few directional derivatives: columns that share no row are seeded
together (Curtis, Powell & Reid 1974), a greedy colouring of the pattern's columns.
"""

import functools
import hashlib
import importlib
import importlib.util
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from ...base.errors import MissingPackage, ModelError
from ...host.recalled import REGISTERED

EXTRA = 'pip install "jaxonomy_dae[sparse]"'
DENSE_UPTO = 1000  # unknowns that dense elimination may solve if there is no sparse solver: about 20 ms
COLORING_WORK = 20_000_000  # pairs of entries in one row, above which colours are not sought


class SparsePattern:
    """The places of a matrix's entries: static, compared and hashed by a digest.

    **Arguments:**

    - `rows`, `cols`: the places of the entries, integers of shape (nnz,). A place may occur more than once: values at
        the same place add up.
    - `n`: the number of columns, and of rows unless `n_rows` is given.

    **Raises:** `ValueError` for places outside the matrix.
    """

    def __init__(self, rows: np.ndarray, cols: np.ndarray, n: int, n_rows: int | None = None):
        for name, places in (("rows", rows), ("cols", cols)):
            # Numbers with fractions would be cut off to whole ones without a word.
            if np.size(places) and np.asarray(places).dtype.kind not in "iu":
                raise ModelError(f"{name} must be integers; got {np.asarray(places).dtype}")
        self.rows = np.array(rows, np.int32)
        self.cols = np.array(cols, np.int32)
        self.n = int(n)
        self.n_rows = self.n if n_rows is None else int(n_rows)
        if self.rows.shape != self.cols.shape or self.rows.ndim != 1:
            raise ModelError(f"rows {self.rows.shape} and cols {self.cols.shape} must be vectors of one length")
        for name, places, size in (("rows", self.rows, self.n_rows), ("cols", self.cols, self.n)):
            if len(places) and not (0 <= places.min() and places.max() < size):
                raise ModelError(f"{name} must lie in 0 … {size - 1}; got {places.min()} … {places.max()}")
        self.rows.flags.writeable = self.cols.flags.writeable = False
        hasher = hashlib.sha256(repr((self.n_rows, self.n)).encode())
        hasher.update(self.rows.tobytes() + self.cols.tobytes())
        self.digest = hasher.hexdigest()

    def __eq__(self, other):
        return isinstance(other, SparsePattern) and self.digest == other.digest

    def __hash__(self):
        return hash(self.digest)

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        return self.digest, ()

    def __repr__(self):
        return f"SparsePattern({self.n_rows} × {self.n}, {len(self)} entries)"

    def __len__(self):
        return len(self.rows)

    @property
    def shape(self) -> tuple[int, int]:
        return self.n_rows, self.n

    @functools.cached_property
    def coalesced(self) -> tuple["SparsePattern", np.ndarray] | None:
        """The pattern with every place once, sorted by row, and each entry's number in it; None if it is so already."""
        key = self.rows.astype(np.int64) * self.n + self.cols
        places, inverse = np.unique(key, return_inverse=True)
        if np.array_equal(places, key):
            return None
        return SparsePattern(places // max(self.n, 1), places % max(self.n, 1), self.n, self.n_rows), inverse

    def merged(self, values: Float[Array, " nnz"]) -> tuple["SparsePattern", Float[Array, " places"]]:
        """The pattern with every place once, and the values there; values at the same place add up."""
        # Mostly every place occurs once, in order, and the values go to KLU as they are.
        if self.coalesced is None:
            return self, values
        pattern, inverse = self.coalesced
        return pattern, jnp.zeros(len(pattern), values.dtype).at[inverse].add(values)

    @functools.cached_property
    def colors(self) -> np.ndarray:
        """A colour for every column, such that columns of one colour share no row.

        Greedy, in the order of the columns. Where that would take long because rows are long (the pattern is nearly
        dense), every column has its own.
        """
        lengths = np.bincount(self.rows, minlength=self.n_rows).astype(np.int64)
        # A row with half of the columns needs as many colours, so that little is left to gain.
        if int((lengths**2).sum()) > COLORING_WORK or lengths.max(initial=0) * 2 > self.n:
            return np.arange(self.n)
        by_column: Any = sp.coo_array((np.ones(len(self), np.int8), (self.rows, self.cols)), shape=self.shape).tocsc()
        pointer, entries = by_column.indptr.tolist(), by_column.indices.tolist()
        taken: list[set[int]] = [set() for _ in range(self.n_rows)]  # colours of the columns seen in each row
        colors = np.zeros(self.n, np.int64)
        for column in range(self.n):
            here = entries[pointer[column] : pointer[column + 1]]
            used = set().union(*(taken[r] for r in here)) if here else set()
            color = 0
            while color in used:
                color += 1
            colors[column] = color
            for r in here:
                taken[r].add(color)
        return colors

    @property
    def n_colors(self) -> int:
        """The number of directional derivatives that a Jacobian of this pattern takes."""
        return int(self.colors.max(initial=-1)) + 1

    @property
    def density(self) -> float:
        """The share of places that are entries."""
        return len(self) / max(1, self.n_rows * self.n)

    def dense(self, values: Float[Array, " nnz"]) -> Float[Array, "n_rows n"]:
        """The matrix as an array."""
        return jnp.zeros(self.shape, values.dtype).at[self.rows, self.cols].add(values)

    def multiply(self, values: Float[Array, " nnz"], x: Float[Array, " n"], transpose: bool = False) -> Any:
        """A·x, or Aᵀ·x."""
        rows, cols, size = (self.cols, self.rows, self.n) if transpose else (self.rows, self.cols, self.n_rows)
        return jnp.zeros(size, x.dtype).at[rows].add(values * x[cols])


class SparseMatrix(eqx.Module):
    """A matrix by its pattern and the values of its entries."""

    values: Float[Array, " nnz"]
    pattern: SparsePattern = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        return self.pattern.shape

    def dense(self) -> Float[Array, "n_rows n"]:
        """The matrix as an array."""
        return self.pattern.dense(self.values)

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n_rows"]:
        return self.pattern.multiply(self.values, x)

    def solve(self, b: Float[Array, " n"], transpose: bool = False) -> Float[Array, " n"]:
        """x with A·x = b, or Aᵀ·x = b: see `solve_sparse`."""
        return solve_sparse(self.pattern, self.values, b, transpose)


class MissingSparseSolver(MissingPackage):
    """The package for sparse solves is not installed."""


def is_double() -> bool:
    """True if JAX is in 64-bit mode."""
    return jnp.result_type(float) == jnp.float64


@functools.cache
def klu() -> Any:
    """The module `klujax`, imported without its effects on JAX's settings.

    **Raises:** `MissingSparseSolver`, which names the extra to install.
    """
    # A new thread has no settings but those of the process: `with jax.enable_x64(True)` around the first sparse solve
    # is not to become one of these.
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(_imported).result()


REGISTERED["klu"] = klu


def _imported() -> Any:
    settings = {name: jax.config.values[name] for name in ("jax_enable_x64", "jax_platform_name")}
    try:
        return importlib.import_module("klujax")
    except ImportError as error:
        raise MissingSparseSolver(f"sparse solves need the package klujax: {EXTRA}") from error
    finally:
        for name, value in settings.items():
            jax.config.update(name, value)


def available() -> bool:
    """True if the package for sparse solves is installed; it is not imported."""
    return importlib.util.find_spec("klujax") is not None


def solve_sparse(
    pattern: SparsePattern,
    values: Float[Array, " nnz"],
    b: Float[Array, " n"],
    transpose: bool = False,
    *,
    nudged: bool = False,
) -> Float[Array, " n"]:
    """x with A·x = b (or Aᵀ·x = b), A square and regular, its entries `values` at the places of `pattern`.

    It is differentiable any number of times with respect to `values` and `b` by the implicit function theorem, in
    forward and reverse mode, and works in `jit`, loops and `vmap`. Not-a-number in the input gives not-a-number in the
    output.

    **Raises:**

    - `MissingSparseSolver` if `klujax` is not installed.
    - `ValueError` without 64-bit mode: KLU computes in float64.
    - When run: JAX's run-time error "singular matrix" if entries cancel to a pivot of exactly zero; `nudged` avoids it
        by changing every entry by a few units in its last place. Zero entries give results that are not finite.
    """
    if pattern.n_rows != pattern.n:
        raise ModelError(f"a matrix to be solved with must be square; this one is {pattern.n_rows} × {pattern.n}")
    _check_double()
    klu()
    if not pattern.n:
        return b
    pattern, values = pattern.merged(values)

    def matvec(x):
        return pattern.multiply(values, x, transpose)

    def solve(_, right):
        return _factorized(pattern, values, right, transpose, nudged)

    def transpose_solve(_, right):
        return _factorized(pattern, values, right, not transpose, nudged)

    return jax.lax.custom_linear_solve(matvec, b, solve, transpose_solve)


def factorised_solve(
    pattern: SparsePattern, values: Float[Array, " nnz"], b: Float[Array, " n"], transpose: bool = False
) -> Float[Array, " n"]:
    """As `solve_sparse`, without derivatives."""
    klu()
    _check_double()
    return _factorized(*pattern.merged(values), b, transpose, False)


def _check_double():
    if not is_double():
        raise ModelError(
            "sparse solves compute in float64: call jax.config.update('jax_enable_x64', True) at the start"
        )


ULPS = 16  # changes of entries, in units of their rounding
ZERO = 1e-200  # takes the place of a zero


def _regularised(pattern: SparsePattern, values: Float[Array, " nnz"], nudged: bool) -> Float[Array, " nnz"]:
    """The values with zeros replaced by what is tiny and, if `nudged`, changed by some units in their last place.

    KLU gives up at a pivot that is exactly zero, and klujax then aborts the whole program, all members of a batch
    included. After this such a pivot is tiny, and the solution overflows or is huge, as any caller can see. Zeros
    replaced are enough where entries vanish; against those that cancel to zero the nudge helps, at a backward error of
    `ULPS` roundings, which a Newton iteration does not feel.
    """
    shift = np.random.default_rng(0).uniform(-1, 1, len(pattern))
    if nudged:
        # One factor for all entries would leave a singular matrix singular, so each entry has its own. They are the
        # same in every solve, so that a call has one result.
        values = values * (1 + jnp.asarray(ULPS * np.finfo(np.float64).eps * shift))
    # Each zero gets a number of its own, because equal ones in two rows of zeros would cancel to a pivot of exactly
    # zero.
    return jnp.where(values == 0, jnp.asarray(ZERO * (2 + shift)), values)


def _factorized(pattern: SparsePattern, values: Any, b: Any, transpose: bool, nudged: bool) -> Any:
    rows, cols = (pattern.cols, pattern.rows) if transpose else (pattern.rows, pattern.cols)
    double = values.astype(jnp.float64), b.astype(jnp.float64)
    # The platform is that of the program, which may not be the default one: a function can be compiled for a CPU on a
    # machine with a GPU.
    x = jax.lax.platform_dependent(
        *double,
        cpu=lambda values, b: klu().solve(
            jnp.asarray(rows), jnp.asarray(cols), _regularised(pattern, values, nudged), b
        ),
        default=lambda values, b: _on_host(rows, cols, values, b),
    )
    return x.astype(b.dtype)


def _on_host(rows: np.ndarray, cols: np.ndarray, values: Any, b: Any) -> Any:
    """The solution by SciPy's SuperLU, from a callback."""

    def solved(values, b):
        values, b = np.asarray(values), np.asarray(b)
        n = b.shape[-1]
        batch = np.broadcast_shapes(values.shape[:-1], b.shape[:-1])
        values = np.broadcast_to(values, (*batch, values.shape[-1])).reshape(-1, values.shape[-1])
        right = np.broadcast_to(b, (*batch, n)).reshape(-1, n)
        out = np.full(right.shape, np.nan)
        for k in range(len(right)):
            try:
                matrix = sp.csc_array((values[k], (rows, cols)), shape=(n, n))
                out[k] = sp.linalg.splu(matrix).solve(right[k])
            except RuntimeError:  # singular
                continue
        return out.reshape(*batch, n)

    # A batch is one callback, and not one for each member.
    return jax.pure_callback(solved, jax.ShapeDtypeStruct(b.shape, b.dtype), values, b, vmap_method="expand_dims")


def check_solvable(n: int):
    """**Raises:** `ModelError` if n simultaneous equations need a package that is not installed."""
    if n > DENSE_UPTO and not available():
        raise ModelError(f"the model has {n} simultaneous equations, which need a sparse solver: {EXTRA}")


def sparse_jacobian(fun: Callable[[Any], Any], pattern: SparsePattern) -> Callable[[Any], Float[Array, " nnz"]]:
    """A function of y that returns the values of ∂fun/∂y at the places of `pattern`.

    Exact where `pattern` has every place that is not identically zero, differentiable, and as cheap as `n_colors`
    directional derivatives. `fun` maps shape (n,) to (n_rows,).
    """

    def values(y: Float[Array, " n"]) -> Float[Array, " nnz"]:
        _, push = jax.linearize(fun, y)
        return compressed(push, pattern, y.dtype)

    return values


def compressed(push: Callable[[Any], Any], pattern: SparsePattern, dtype: Any) -> Float[Array, " nnz"]:
    """The values at the places of `pattern` of the linear map `push`, from one product for each colour."""
    if not len(pattern):
        return jnp.zeros(0, dtype)
    colors = pattern.colors
    seeds = jnp.zeros((pattern.n_colors, pattern.n), dtype).at[colors, np.arange(pattern.n)].set(1.0)
    products = jax.vmap(push)(seeds)
    # No other column of the colour has an entry in this row, so the product there is the entry itself.
    found = products[colors[pattern.cols], pattern.rows]
    if pattern.coalesced is None:
        return found
    # Values at one place add up, so that the first of them is the entry, and the others are zero.
    _, place = pattern.coalesced
    is_first = np.zeros(len(pattern), bool)
    is_first[np.unique(place, return_index=True)[1]] = True
    return jnp.where(is_first, found, 0)
