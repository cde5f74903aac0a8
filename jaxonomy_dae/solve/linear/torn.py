"""Linear blocks that are torn: elimination in a fixed order, made stable by correction and checked by its residual.

Given a block A·x = b in the order

    [ L  F ] [ u ]   [ c ]      L triangular: equations that give the unknowns u one after another
    [ G  H ] [ z ] = [ d ]      z the tearing variables

the unknowns u are eliminated in their order, and what is left, S = H − G L⁻¹ F, is solved with pivoting. The order was
fixed when the model was compiled, with the numbers it had then, so that pivots may be small at other parameter values.
Three things keep the result right (Skeel 1980, Math. Comp. 35:817; Higham 2002, chapter 12):

1. u is computed from z by the equations themselves, never by superposition. The equations of L then hold to rounding,
   and errors show in the last m equations only.
2. One or more steps of iterative refinement with the residuals of those: what an unstable elimination loses, a factor
   γ of 1/eps, the first step brings back to γ² eps.
3. The residual of every equation that rounding can have spoilt is checked: |A x − b| ≤ c eps (|A| |x| + |b|), or, where
   the unknowns are of very different sizes, the same in the norm of the matrix with rows and columns equilibrated.
   Where neither holds, x is not-a-number: a loud failure, not a wrong number.

Where there is one tearing variable and errors cannot grow over several links, corrections converge if S is more than
what rounding left of its terms, and this is checked in place of the residuals.

Entries are scalars or arrays of one shape (a batch of blocks); which are zero is known when the program is traced.
Derivatives are those of x = A⁻¹ b, from solves by the same elimination.
"""

import functools
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...base.tolerances import TOLERATED, TOLERATED_NORM
from ...graph.structure.tearing import Tearing
from ...host.platform import platform
from . import dense
from .arrays import Scalar
from .inverse import FORMULA, inverse
from .once import once
from .written_out import UNROLLED

APART = 8  # equations of a block from which on what its phases hand on is computed once, and not where it is read
FORMS = 1024  # functions of forms of blocks that are kept: more than any model of the tests has, each of some kB
CORRECTIONS = 2  # where an unknown of the sequence depends on another; else one is enough

Entries = Mapping[tuple[int, int], Scalar]


def solve_torn(tearing: Tearing, matrix: Entries, right: Sequence[jax.Array]) -> list[jax.Array]:
    """x with A·x = b.

    **Arguments:**

    - `tearing`: the order of elimination.
    - `matrix`: the entries that are not identically zero, by (equation, unknown): numbers, or arrays of the shape of
        the right-hand side.
    - `right`: an array for each equation.

    **Returns:** the unknowns, in order; not-a-number where the residual is not small, or where nothing but rounding is
    left of the pivot of the tearing variable.
    """
    arrays = {at: a for at, a in matrix.items() if isinstance(a, jax.Array)}
    numbers = {at: a for at, a in matrix.items() if at not in arrays}
    # An entry of NumPy that differs by instance cannot be part of a key.
    if not all(isinstance(a, int | float) for a in numbers.values()):
        return _solver(tearing, numbers)(arrays, list(right))
    return _traced_once(tearing, tuple(sorted(numbers.items())), platform())(arrays, list(right))


Solver = Callable[[Entries, Sequence[jax.Array]], list[jax.Array]]


@functools.lru_cache(maxsize=FORMS)
def _traced_once(tearing: Tearing, numbers: tuple[tuple[tuple[int, int], float], ...], platform: str) -> Solver:
    """A block is solved in dozens of places of a program: all call one function. XLA takes its calls apart again, but
    what JAX traces, differentiates and lowers is one."""
    return jax.jit(_solver(tearing, dict(numbers)))


def _solver(tearing: Tearing, numbers: Mapping[tuple[int, int], Any]) -> Solver:
    """The function (entries that are arrays, right-hand sides) → unknowns."""

    @jax.custom_jvp
    def solved(arrays, right):
        return _Elimination(tearing, {**numbers, **arrays}, right[0]).solve(right)

    @solved.defjvp
    def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[list[Any], list[Any]]:
        arrays, right = primals
        arrays_dot, right_dot = tangents
        # The derivative solves with the same elimination; the tangents of its entries are in `moved`.
        still = {**numbers, **jax.lax.stop_gradient(arrays)}
        elimination = _Elimination(tearing, still, right[0])
        x = solved(arrays, right)
        n = len(right)
        moved = [[right_dot[e]] for e in range(n)]
        for (e, u), a_dot in arrays_dot.items():
            moved[e].append(-(a_dot * x[u]))
        rows = _rows({**numbers, **arrays}, n)

        def times(v: jax.Array) -> jax.Array:
            parts = _parts(v)
            return jnp.stack([_total([_product(a, parts[u]) for u, a in row], parts[0]) for row in rows])

        # One array, not a list: `custom_linear_solve` cannot be transposed where some right-hand sides are constants.
        x_dot = jax.lax.custom_linear_solve(
            times,
            jnp.stack([_total(m, None) for m in moved]),
            lambda _, b: jnp.stack(elimination.solve(_parts(b))),
            lambda _, b: jnp.stack(elimination.transpose_solve(_parts(b))),
        )
        return x, _parts(x_dot)

    return solved


def _parts(rows: jax.Array) -> list[jax.Array]:
    return [rows[k] for k in range(rows.shape[0])]


class _Elimination:
    """The factors of a torn matrix."""

    def __init__(self, tearing: Tearing, matrix: dict[tuple[int, int], Scalar], like: jax.Array):
        self.tearing = tearing
        self.like = like
        n, m = len(tearing.sequence) + len(tearing.tearing), len(tearing.tearing)
        self.rows = _rows(matrix, n)
        self.columns = _rows({(u, e): a for (e, u), a in matrix.items()}, n)
        self.over_pivot = {u: 1 / matrix[e, u] for e, u in tearing.sequence}
        self.place = {u: j for j, u in enumerate(tearing.tearing)}
        self.written_out = m <= UNROLLED
        self.in_batches_only = m <= FORMULA and n <= APART and not like.shape
        self.giving = {e for e, _ in tearing.sequence}
        self.can_grow = self._links() > 1
        self.chained = any(_others(self.rows[e], u, self.over_pivot) for e, u in tearing.sequence)
        self.exact = m == 1 and not self.can_grow
        # W = −L⁻¹ F, by unknowns.
        self.w: dict[int, Any] = {}
        for e, u in tearing.sequence:
            row = self._row_of_schur(e, skip=u)
            scale = -self.over_pivot[u]
            self.w[u] = {j: _product(scale, a) for j, a in row.items()} if self.written_out else _product(scale, row)
        schur = [self._row_of_schur(e) for e in tearing.residuals]
        if self.written_out:
            entries = [[self._filled(row.get(j, 0.0)) for j in range(m)] for row in schur]
            if self.exact:
                entries[0][0] = self._more_than_rounding(entries[0][0])
            self.inverse = inverse(entries)
        else:
            self.factors = dense.factor(jnp.stack([jnp.moveaxis(row, 0, -1) for row in schur], axis=-2))

    def _filled(self, value: Scalar) -> Scalar:
        return jnp.broadcast_to(jnp.asarray(value, self.like.dtype), self.like.shape)

    def _links(self) -> int:
        """The largest number of links from a tearing variable to an unknown of the sequence.

        An equation with plain numbers only, which do not enlarge what is known, is not a link.
        """
        links: dict[int, int] = {}
        for e, u in self.tearing.sequence:
            known = [(v, a) for v, a in self.rows[e] if v in links]
            link = 1
            if all(isinstance(a, int | float) for _, a in self.rows[e]):
                pivot = next(abs(a) for v, a in self.rows[e] if v == u)
                link = int(sum(abs(a) for _, a in known) > pivot)
            links[u] = link + max((links[v] for v, _ in known), default=0)
        return max(links.values(), default=0)

    def _more_than_rounding(self, schur: Scalar) -> Scalar:
        """The only entry of S, or not-a-number where it is what rounding left of its terms."""
        sizes: dict[int, Scalar] = {self.tearing.tearing[0]: 1.0}  # |L⁻¹| |F|
        for e, u in self.tearing.sequence:
            terms = [_product(abs(a), sizes[v]) for v, a in self.rows[e] if v in sizes]
            sizes[u] = _product(abs(self.over_pivot[u]), _total(terms, None)) if terms else 0.0
        (e,) = self.tearing.residuals
        size = _total([_product(abs(a), sizes[v]) for v, a in self.rows[e]], None)
        return jnp.where(abs(schur) > TOLERATED_NORM * float(jnp.finfo(self.like.dtype).eps) * size, schur, jnp.nan)

    # Rows over the tearing variables: {place: entry} where few, an array of shape (m, *batch) where many.

    def _row_of_schur(self, e: int, skip: int | None = None) -> Any:
        """(F + L̂ W) or (H + G W) of equation e."""
        direct = {self.place[u]: a for u, a in self.rows[e] if u in self.place}
        through = [(a, self.w[u]) for u, a in self.rows[e] if u not in self.place and u != skip]
        if self.written_out:
            terms: dict[int, list[Scalar]] = {j: [a] for j, a in direct.items()}
            for a, w in through:
                for j, v in w.items():
                    terms.setdefault(j, []).append(_product(a, v))
            return {j: _total(t, None) for j, t in sorted(terms.items())}
        # Beyond what is written out, rows are arrays: a program of scalars would grow with the square of the tearing
        # variables.
        row = jnp.zeros((len(self.place), *self.like.shape), self.like.dtype)
        if direct:
            values = jnp.stack([self._filled(a) for a in direct.values()])
            row = row.at[np.array(list(direct))].set(values)
        return _total([row, *(_product(a, w) for a, w in through)], row)

    def _along(self, u: int, z: list[Scalar]) -> Scalar:
        """W z of one unknown."""
        if self.written_out:
            return _total([_product(a, z[j]) for j, a in self.w[u].items()], self.like)
        return jnp.sum(self.w[u] * jnp.stack(z), axis=0)

    def _schur_solve(self, s: list[Scalar], transposed: bool) -> list[Scalar]:
        """S⁻¹ s or S⁻ᵀ s."""
        if self.written_out:
            m = len(s)
            s = self._once(s)
            entry = (lambda r, c: self.inverse[c][r]) if transposed else (lambda r, c: self.inverse[r][c])
            return self._once([_total([entry(r, c) * s[c] for c in range(m)], None) for r in range(m)])
        solve = dense.transpose_solve if transposed else dense.solve
        return list(jnp.moveaxis(solve(self.factors, jnp.moveaxis(jnp.stack(s), 0, -1)[..., None])[..., 0], -1, 0))

    def solve(self, b: Sequence[Scalar]) -> list[Any]:
        """A⁻¹ b."""
        tearing = self.tearing
        b = self._right(b)
        x: list[Any] = [None] * len(b)

        def given(e: int, u: int) -> Scalar:
            known = [_product(a, x[v]) for v, a in self.rows[e] if v != u and x[v] is not None]
            return _product(self.over_pivot[u], _less(b[e], known))

        def follow(z: list[Scalar] | None):
            for u, value in zip(tearing.tearing, z or [None] * len(tearing.tearing), strict=True):
                x[u] = value
            for e, u in tearing.sequence:
                x[u] = given(e, u)

        follow(None)
        rest = [
            _less(b[e], [_product(a, x[v]) for v, a in self.rows[e] if x[v] is not None]) for e in tearing.residuals
        ]
        follow(self._schur_solve(rest, transposed=False))
        for k in range(self.corrections):
            missing = [_less(b[e], [_product(a, x[v]) for v, a in self.rows[e]]) for e in tearing.residuals]
            change = self._schur_solve(missing, transposed=False)
            corrected = [x[u] + dz for u, dz in zip(tearing.tearing, change, strict=True)]
            if k < self.corrections - 1:
                follow(corrected)
                continue
            # The last one by superposition: it is small, and u from z alone would bring back the noise of the march.
            for u, z in zip(tearing.tearing, corrected, strict=True):
                x[u] = z
            for _, u in tearing.sequence:
                x[u] = x[u] + self._along(u, change)
        if self.exact:
            return x
        # What depends on tearing variables alone is as good as they are.
        checked = [*tearing.residuals, *(e for e, u in tearing.sequence if _others(self.rows[e], u, self.over_pivot))]
        return self._verified(x, b, self.rows, checked)

    def transpose_solve(self, g: Sequence[Scalar]) -> list[Scalar]:
        """A⁻ᵀ g: one entry for each equation."""
        tearing = self.tearing
        g = self._right(g)
        y: list[Any] = [None] * len(g)

        def follow(s: Sequence[Scalar] | None, g: Sequence[Scalar] | None):
            for e, value in zip(tearing.residuals, s or [None] * len(tearing.residuals), strict=True):
                y[e] = value
            for e, u in reversed(tearing.sequence):
                known = [_product(a, y[r]) for r, a in self.columns[u] if r != e and y[r] is not None]
                start = self._filled(0.0) if g is None else g[u]
                y[e] = _product(self.over_pivot[u], _less(start, known))

        s = [g[u] for u in tearing.tearing]
        if self.written_out:
            for _, u in tearing.sequence:
                for j, a in self.w[u].items():
                    s[j] = s[j] + _product(a, g[u])
        else:
            total = jnp.stack(s)
            for _, u in tearing.sequence:
                total = total + self.w[u] * g[u]
            s = list(total)
        follow(self._schur_solve(s, transposed=True), g)
        for _ in range(self.corrections):
            missing = [_less(g[u], [_product(a, y[r]) for r, a in self.columns[u]]) for u in tearing.tearing]
            kept = list(y)
            follow(self._schur_solve(missing, transposed=True), None)
            y = [a + b for a, b in zip(kept, y, strict=True)]
        if self.exact:
            return y
        checked = [*tearing.tearing, *(u for e, u in tearing.sequence if _others(self.columns[u], e, self.giving))]
        return self._verified(y, g, self.columns, checked)

    @property
    def corrections(self) -> int:
        """The number of corrections of a solution."""
        return CORRECTIONS if self.chained else 1

    def _verified(
        self, x: list[jax.Array], b: Sequence[Scalar], rows: list[list[tuple[int, Scalar]]], places
    ) -> list[Scalar]:
        """x, or not-a-number if one of the equations at `places` does not hold to rounding."""
        holds = self._hold(x, b, rows, places)
        (holds,) = self._once([holds])
        return [jnp.where(holds, v, jnp.nan) for v in x]

    def _right(self, b: Sequence[Scalar]) -> list[Scalar]:
        """Right-hand sides, computed once. If XLA recomputed them for the check, one that is zero up to rounding could
        fail its own check."""
        return list(b) if self.exact else once(b)

    def _once(self, values: list[Any]) -> list[Any]:
        """The values, computed once if many expressions read them."""
        return values if self.exact else once(values, self.in_batches_only)

    def _hold(self, x: list[jax.Array], b: Sequence[Scalar], rows: list[list[tuple[int, Scalar]]], places) -> Scalar:
        """True if the equations at `places` hold to rounding."""
        dtype = x[0].dtype
        eps, tiny = float(jnp.finfo(dtype).eps), float(jnp.finfo(dtype).tiny)
        norm = None
        if self.can_grow or len(self.tearing.tearing) > 1:
            entries = [[(v, _magnitude(a)) for v, a in row] for row in rows]
            largest = [_largest([a for _, a in row]) for row in entries]
            units: list[list[Scalar]] = [[] for _ in x]  # 1 / the unit of each unknown
            for row, size in zip(entries, largest, strict=True):
                for v, a in row:
                    units[v].append(_quotient(a, size))
            norm = _largest([_product(_largest(unit), _magnitude(v)) for unit, v in zip(units, x, strict=True)])
        holds: Scalar = True
        for place in places:
            products = [_product(a, x[v]) for v, a in rows[place]]
            residual = _magnitude(_less(b[place], products))
            size = _total([_magnitude(b[place]), *(_magnitude(p) for p in products)], None)
            allowed = _product(TOLERATED * eps, size)
            if norm is not None:
                allowed = _largest([allowed, _product(_product(TOLERATED_NORM * eps, largest[place]), norm)])
            # Below the second term, products have lost digits to underflow.
            fine = residual <= allowed + TOLERATED / eps * tiny
            holds = fine if holds is True else holds & fine
        return holds


def _others(row: list[tuple[int, Scalar]], own: int, places: Container[int]) -> bool:
    """True if a row has entries at some of the places, other than its own."""
    return any(v in places and v != own for v, _ in row)


def _rows(matrix: Entries, n: int) -> list[list[tuple[int, Scalar]]]:
    """The entries of each row, in order."""
    rows: list[list[tuple[int, Scalar]]] = [[] for _ in range(n)]
    for (e, u), a in sorted(matrix.items(), key=lambda item: item[0]):
        rows[e].append((u, a))
    return rows


# Arithmetic on numbers and arrays. It is most of what is traced: numbers are folded, and operands of one shape go to
# `lax`, which traces several times faster than `jnp`.


def _magnitude(a: Scalar) -> Scalar:
    return abs(a) if isinstance(a, int | float) else jax.lax.abs(a)


def _largest(values: Sequence[Scalar]) -> Scalar:
    """The largest of some magnitudes."""
    numbers = [v for v in values if isinstance(v, int | float)]
    arrays = [v for v in values if not isinstance(v, int | float)]
    if not arrays:
        return max(numbers)
    total = functools.reduce(lambda a, b: _binary(jax.lax.max, jnp.maximum, a, b), arrays)
    return jnp.maximum(total, max(numbers)) if numbers and max(numbers) > 0 else total


def _quotient(a: Scalar, b: Scalar) -> Scalar:
    if isinstance(a, int | float) and isinstance(b, int | float) and b:
        return a / b
    return _binary(jax.lax.div, jnp.true_divide, a, b)


def _product(a: Scalar, x: Scalar) -> Scalar:
    if isinstance(a, int | float):
        if abs(a) != 1:
            return a * x
        return x if a == 1 else -x if isinstance(x, int | float) else jax.lax.neg(x)
    return x * a if isinstance(x, int | float) else _binary(jax.lax.mul, jnp.multiply, a, x)


def _less(value: Scalar, terms: list[Scalar]) -> Scalar:
    for term in terms:
        value = _binary(jax.lax.sub, jnp.subtract, value, term)
    return value


def _total(terms: list[Scalar], like: jax.Array | None) -> Scalar:
    if not terms:
        assert like is not None
        return jnp.zeros_like(like)
    return functools.reduce(lambda total, term: _binary(jax.lax.add, jnp.add, total, term), terms)


def _binary(
    on_arrays: Callable[[Scalar, Scalar], Scalar], on_all: Callable[[Scalar, Scalar], Scalar], a: Scalar, b: Scalar
) -> Scalar:
    """An operation, in `lax` where both operands are arrays of one shape."""
    alike = isinstance(a, jax.Array) and isinstance(b, jax.Array) and a.shape == b.shape and a.dtype == b.dtype
    return on_arrays(a, b) if alike else on_all(a, b)
