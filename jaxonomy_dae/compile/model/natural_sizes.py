"""Sizes of quantities and parameters at which all terms of all equations are alike, whatever the units."""

import hashlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from ...solve.linear.graph_elimination import GraphElimination, with_small_indices
from .group import Point, QuantityGroup
from .jacobian import generic
from .tables import ZERO

ROUNDS = 3  # of least squares: entries depend on sizes, and are evaluated anew at those that the last round found
STEP = 1e-3  # of the logarithm of an argument
FARTHEST = 100.0  # decades from one that a size may be looked for
STEEPEST = 8.0  # power that an entry is taken for
# A damping keeps sizes that nothing tells where they are. It must be small: a size at the end of a chain of n links
# hangs on its beginning with a singular value near 2/n. Its square, 1e-12, is what normal equations have beside
# rounding.
DAMPING = 1e-6
STIFFER = 100.0  # times DAMPING, again and again, until no size moves by more than FARTHEST
# The weight of a decade by which a derivative is off its quantity over the model's time scale. What equations tell wins
# over it by its square, and it wins over DAMPING by as much.
SLOW = 1e-3
RELUCTANCE = 0.1  # weight of a decade by which a size has moved, beside one by which a term is off


class _Seen(NamedTuple):
    """log₁₀ of what equations have at a generic point: entries of the Jacobian, constants or terms; the equation of
    each; and their powers in quantities and in parameters, each as (place, argument, power)."""

    logarithm: np.ndarray
    equation: np.ndarray
    by_quantity: tuple[np.ndarray, np.ndarray, np.ndarray]
    by_parameter: tuple[np.ndarray, np.ndarray, np.ndarray]

    n_own: int  # of the powers in quantities: entries have one in the quantity to which they belong

    def is_linear(self, is_known: np.ndarray) -> bool:
        """True if nothing but these powers, and parameters that are known, (parameters,), moves them."""
        return len(self.by_quantity[0]) == self.n_own and bool(is_known[self.by_parameter[1]].all())

    def powers(self, n_quantities: int, n_parameters: int, n_equations: int) -> sp.csr_array:
        """The powers in quantities, parameters and units of equations, a sparse matrix."""
        k = np.arange(len(self.equation))
        first = n_quantities + n_parameters
        rows = np.concatenate([self.by_quantity[0], self.by_parameter[0], k])
        columns = np.concatenate([self.by_quantity[1], n_quantities + self.by_parameter[1], first + self.equation])
        powers = np.concatenate([self.by_quantity[2], self.by_parameter[2], np.ones(len(k))])
        return sp.csr_array((powers, (rows, columns)), shape=(len(k), first + n_equations))


def natural_sizes(
    groups: Sequence[QuantityGroup],
    n_equations: int,
    size: Float[np.ndarray, " n"],
    parameters: Float[np.ndarray, " p"],
    by_terms: bool = False,
    rates: tuple[np.ndarray, np.ndarray] | None = None,
    factors: "Factors | None" = None,
    given: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " p"]]:
    """Sizes s with |∂F_e/∂x_q|·s_q near 1 in units of each equation, in the least-squares sense of logarithms (Curtis &
    Reid 1972, where the entries depend on the sizes as well). What an equation has without quantities, such as the
    pressure of a reservoir, is a term like others where its parameters are known.

    **Arguments:**

    - `size`: of every quantity, with signs, as far as it is known; zero for those whose size is looked for.
    - `parameters`: values that stay; zero for those whose size is looked for, too.
    - `rates`: (quantities, their derivatives by time). What no equation tells is such that these are 1/T of those, with
        one T for the whole model: the speed of a nanometre's oscillation lies between its amplitude and acceleration.
    - `by_terms`: terms count as well as entries, which do not see that one of their terms is lost beside others; and
        sizes move only for what it gains.
    - `factors`: of an earlier search in the same equations, to be used again where they are the same.
    - `given`: as `constants` returns it, if that is known.
    """
    factors = Factors() if factors is None else factors
    n, n_parameters = len(size), len(parameters)
    # Units of equations are unknowns beside sizes: an equation that is multiplied by 1e9 says the same.
    known = np.concatenate([size != 0.0, parameters != 0.0, np.zeros(n_equations, bool)])
    quantity, parameter = (np.where(given == 0.0, 1.0, given) for given in (size, parameters))
    begun = np.log10(np.abs(np.append(quantity, parameter)))
    there, where = constants(groups, parameters) if given is None else given
    beside, time = _Seen(np.log10(there), where, _joined([]), _joined([]), 0), 0.0
    for _ in range(ROUNDS):
        entries = _seen(groups, quantity, parameter, False)
        if not len(entries.logarithm):
            break
        seen = [entries, beside] + ([_seen(groups, quantity, parameter, True)] if by_terms else [])
        matrix: Any = sp.vstack([s.powers(n, n_parameters, n_equations) for s in seen], format="csr")
        # Their columns stay, as zeros, so that the numbering does not depend on what is known.
        matrix.data[known[matrix.indices]] = 0.0
        off = np.concatenate([s.logarithm for s in seen])
        is_last = all(s.is_linear(parameters != 0.0) for s in seen)
        del entries, seen  # of a large model, as large as the factors
        if by_terms:
            moved = np.log10(np.abs(np.append(quantity, parameter))) - begun
            stay = sp.eye_array(len(moved), matrix.shape[1]) * RELUCTANCE
            matrix, off = sp.vstack([matrix, stay], format="csr"), np.append(off, RELUCTANCE * moved)
        if rates is not None:
            slopes, late = _slopes(*rates, matrix.shape[1], known, np.log10(np.abs(quantity)), time)
            matrix = sp.vstack([sp.hstack([matrix, sp.csr_array((len(off), 1))]), slopes], format="csr")
            off = np.append(off, late)
        matrix.eliminate_zeros()
        found = factors.least_squares(matrix, -off)
        time += float(found[-1]) if rates is not None else 0.0
        quantity, parameter = _moved(quantity, found[:n]), _moved(parameter, found[n : n + n_parameters])
        # 0.3 decades are a factor of two, to which typical sizes are rounded. Entries that are products of sizes are
        # met by the first round.
        if is_last or np.abs(found[: n + n_parameters]).max(initial=0.0) < 0.3:
            break
    return quantity, parameter


def _slopes(
    lower: np.ndarray, higher: np.ndarray, width: int, known: np.ndarray, size: np.ndarray, time: float
) -> tuple[sp.csr_array, np.ndarray]:
    """Rows log s(q') − log s(q) + log T = 0 with a column for log T behind the others, and how far off each is."""
    k = np.arange(len(lower))
    rows, columns = np.concatenate([k, k, k]), np.concatenate([higher, lower, np.full(len(k), width)])
    values = SLOW * np.repeat([1.0, -1.0, 1.0], len(k))
    values[np.append(known, False)[columns]] = 0.0
    return sp.csr_array((values, (rows, columns)), shape=(len(k), width + 1)), SLOW * (
        size[higher] - size[lower] + time
    )


class Factors:
    """Least squares by the factors of the last matrix, as long as it is the same: where entries are products of
    parameters, other values of these change the right-hand side alone."""

    def __init__(self):
        self._last: tuple[bytes, GraphElimination] | None = None  # a digest of the matrix, and its factors

    def least_squares(self, matrix: Any, right: np.ndarray) -> np.ndarray:
        """The x of least norm with A·x near b, by normal equations: logarithms need a few digits, of which an iterative
        method takes as many steps as a chain has links."""
        matrix = with_small_indices(matrix)
        digest, damping = hashlib.sha256(repr(matrix.shape).encode()), DAMPING
        for part in (matrix.indptr, matrix.indices, matrix.data):
            digest.update(part.data)
        # The matrix itself would take as much memory as its factors. Another thread may put others in their place.
        last = self._last
        if last is None or last[0] != digest.digest():
            last = self._last = digest.digest(), _normal(matrix, damping)
        found = last[1].solve(matrix.T @ right)
        # Powers are differences, known to a few digits. What they hardly tell, as the time of a mechanism that nothing
        # drives, is told by their errors, and would move without bound.
        while np.abs(found).max(initial=0.0) > FARTHEST and damping < 1.0:
            damping *= STIFFER
            found = _normal(matrix, damping).solve(matrix.T @ right)
        return found


def _normal(matrix: Any, damping: float) -> GraphElimination:
    """The factors of damped normal equations."""
    return GraphElimination(matrix.T @ matrix + damping**2 * sp.eye_array(matrix.shape[1], format="csr"))


def _moved(size: np.ndarray, decades: np.ndarray) -> np.ndarray:
    """Sizes times powers of ten, up to a limit; those that do not move stay whatever they are."""
    there = np.log10(np.abs(size))
    limited = np.clip(there + np.clip(decades, -60, 60), np.minimum(there, -FARTHEST), np.maximum(there, FARTHEST))
    return np.where(decades == 0.0, size, np.sign(size) * 10.0**limited)


def constants(
    groups: Sequence[QuantityGroup], parameters: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """|F_e| where all quantities are zero, where it is not zero, and the equations e; none that reads a parameter
    without a value."""
    values, equations = [np.zeros(0)], [np.zeros(0, np.int64)]
    quantities = 1 + max((int(g.quantity.max(initial=-1)) for g in groups), default=0)
    nothing = Point.of(np.zeros(quantities), parameters, 0.5)
    for group in groups:
        if group.template.opaque is not None:
            continue
        there = np.abs(group.residual(nothing))
        used = (there > 0) & np.isfinite(there) & (parameters[group.parameter] != 0.0).all(axis=1)
        values.append(there[used])
        equations.append(group.equation[used])
    return np.concatenate(values), np.concatenate(equations)


def _seen(groups: Sequence[QuantityGroup], quantity: np.ndarray, parameter: np.ndarray, of_terms: bool) -> _Seen:
    """Evaluates |∂F_e/∂x_q| of each slot, or |term| of each term of F_e, at a generic point. The former are multiplied
    by the sizes of the quantities to which they belong."""

    def sizes(own: QuantityGroup, quantities: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        at = Point.of(quantities.ravel(), parameters.ravel(), 0.5)
        return np.abs(own.terms(at) if of_terms else own.partials(at))

    # A generic point, the same in each process: at the sizes themselves, terms may cancel, as in p₁ − p₂ where both
    # have one size.
    rng = np.random.default_rng(1)
    point, parameters = quantity * generic(rng, quantity.shape), parameter * generic(rng, parameter.shape)
    logarithms: list[np.ndarray] = [np.zeros(0)]
    equations: list[np.ndarray] = [np.zeros(0, np.int64)]
    powers: tuple[list, list] = [], []
    first = 0
    for group in groups:
        if group.quantity.shape[1] == 0 or group.template.opaque is not None:
            continue
        # A quantity that stands in several slots of an equation has a power for each: moved together, they would hide
        # each other.
        own = group.apart()
        arguments = np.append(point, 0.0)[group.quantity], parameters[group.parameter]
        size = sizes(own, *arguments)
        used = (size > 0) & np.isfinite(size)
        if not of_terms:
            used &= group.quantity != ZERO
        if not used.any():
            continue
        place = np.full(size.shape, -1)
        place[used] = first + np.arange(used.sum())
        first += int(used.sum())
        logarithm = np.log10(size[used])
        if not of_terms:
            column = group.quantity[used]
            logarithm = logarithm + np.log10(np.abs(point[column]))
            powers[0].append((place[used], column, np.ones(len(column))))
        logarithms.append(logarithm)
        equations.append(np.broadcast_to(group.equation[:, None], used.shape)[used])
        read = group.template.readers_of_terms() if of_terms else group.template.readers_of_partials()
        for side, (ids, readers) in enumerate(zip((group.quantity, group.parameter), read, strict=True)):
            for owner in _apart(readers, size.shape[1]):
                moved = list(arguments)
                moved[side] = arguments[side].copy()
                moved[side][:, np.unique(owner[owner >= 0])] *= 1 + STEP
                with np.errstate(all="ignore"):
                    # The powers are differences of logarithms rather than derivatives: second derivatives of all
                    # templates would have to be made for some digits.
                    power = np.log(sizes(own, *moved) / size) / np.log1p(STEP)
                moving = ids[:, owner]
                hit = used & np.isfinite(power) & (np.abs(power) > 1e-6) & (owner >= 0) & (moving != ZERO)
                powers[side].append((place[hit], moving[hit], np.clip(power[hit], -STEEPEST, STEEPEST)))
    n_own = 0 if of_terms else first
    return _Seen(np.concatenate(logarithms), np.concatenate(equations), _joined(powers[0]), _joined(powers[1]), n_own)


def _apart(readers: Sequence[frozenset[int]], n: int) -> Iterator[np.ndarray]:
    """Arguments that can be moved at once, as no two of them are read by the same of n values (Curtis, Powell & Reid
    1974): for each set of them, the argument that each value reads, (n,), or −1. `readers` are those of each
    argument."""
    sets: list[np.ndarray] = []
    for k, values in enumerate(readers):
        if not values:
            continue
        reading = np.fromiter(values, np.int64)
        owner = next((owner for owner in sets if (owner[reading] < 0).all()), None)
        if owner is None:
            sets.append(owner := np.full(n, -1))
        owner[reading] = k
    yield from sets


def _joined(powers: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    places, arguments, values = zip(*powers, strict=True) if powers else ([], [], [])
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *places]), np.concatenate([none, *arguments]), np.concatenate([np.zeros(0), *values])
