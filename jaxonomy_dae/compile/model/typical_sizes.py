"""Sizes of quantities of which nothing is declared, by what their equations say."""

import weakref
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ...base.tolerances import KNOWN
from ...graph.structure.integers import distinct
from .declared import declared_scale
from .extended import Extended
from .jacobian import generic
from .natural_sizes import Factors, constants, natural_sizes
from .quantities import ReducedModel

MOVED = 1e-6  # of parameters: a difference from which a slope is told to six digits
# Typical sizes lie within so many decades of one: single precision has 38.
DECADES = 30
ROOM = 4  # answers kept for one model: at the values it was compiled with, at those it is run with, and two between


def typical_sizes(
    model: ReducedModel, parameters: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, " quantities"]:
    """The typical sizes of all quantities, at these values of the parameters; powers of two, by which numbers are
    multiplied without rounding.

    What they follow from is rounded to powers of two as well: so values of parameters near each other, as those of a
    fit or of a slider, have the same sizes, which are looked up then (0.1 ms in place of 3 for a pendulum).
    """
    started = _powers_of_two(_declared_or_started(model, parameters))
    return _powers_of_two(_balanced(model.extended, _between(model, parameters), started, _powers_of_two))


def unrounded_sizes(
    model: ReducedModel, parameters: Float[np.ndarray, " parameters"]
) -> Float[np.ndarray, " quantities"]:
    """As `typical_sizes` before rounding to powers of two. State selection compares sizes, and rounding could turn a
    small difference into a factor of two."""
    started = _declared_or_started(model, parameters)
    return _balanced(model.extended, _between(model, parameters), started, np.asarray)


def _between(model: ReducedModel, parameters: np.ndarray) -> np.ndarray:
    """The parameters, with those that events assign moved a little. They start at one of their values, at which a
    branch of an equation may be zero that has a size at all others: while friction is off, its equation says nothing of
    the force. Beside that value, the other branches count."""
    assigned = model.flat.parameters.changed_by_events
    return np.where(assigned[: len(parameters)], parameters * (1 + MOVED), parameters)


def _powers_of_two(values: np.ndarray) -> np.ndarray:
    """The nearest powers of two, with the signs of the values; zero stays zero."""
    with np.errstate(divide="ignore"):
        exponents = np.round(np.log2(np.abs(values)))
    return np.sign(values) * np.exp2(exponents)


class _Declared:
    """What a model declares of sizes, whatever the values of its parameters."""

    def __init__(self, model: ReducedModel):
        self.flat, variables = model.flat, model.variables
        flat = self.flat
        self.scale = declared_scale(model)  # of quantities
        self.started = np.flatnonzero(flat.variables.start.is_given & (variables.quantity >= 0))
        self.quantity, self.factor = variables.quantity[self.started], variables.factor[self.started]
        self.open = self.scale[self.quantity] == 0.0
        self.unit = [flat.variables.unit[k] for k in self.started.tolist()]
        # Numbers that nothing computes are not told from rounding, so their slopes need not be known.
        self.are_numbers = bool(flat.variables.start.is_number[self.started].all())


_DECLARED: weakref.WeakKeyDictionary[Extended, _Declared] = weakref.WeakKeyDictionary()


def _declared_or_started(model: ReducedModel, parameters: np.ndarray) -> np.ndarray:
    """Nominal values, and else the largest starts; zero where there is none."""
    declared = _DECLARED.get(model.extended)
    if declared is None or declared.flat is not model.flat:
        declared = _DECLARED[model.extended] = _Declared(model)
    size, starts, started = declared.scale.copy(), model.flat.variables.start, declared.started
    values = starts.values(parameters)[started]
    if not declared.are_numbers:
        # A start that is computed may be rounding alone, as L·sin(π) is; a number that is given is what it is.
        # How a start answers to small changes of its parameters shows how large its terms are.
        moved = starts.values(parameters * (1 + MOVED * generic(np.random.default_rng(1), parameters.shape)))[started]
        values = np.where(np.abs(values) <= KNOWN * np.abs(moved - values) / MOVED, 0.0, values)
    value = values / declared.factor
    tells = declared.open & np.isfinite(value) & (value != 0.0) & ~_lost_beside_others(values, declared.unit)
    np.maximum.at(size, declared.quantity[tells], np.abs(value[tells]))
    return size


def _lost_beside_others(values: np.ndarray, units: list[str]) -> np.ndarray:
    """True for starts that rounding would lose beside the largest one of the same unit: an angle of 1e-16 among angles
    of 1, computed outside of the model, is zero."""
    sizes = np.where(np.isfinite(values), np.abs(values), 0.0)
    small = (sizes > 0) & (sizes <= KNOWN * sizes.max(initial=0.0))
    lost = np.zeros(len(values), bool)
    # Only within one unit: a charge of 1e-18 C beside a resistance of 1e6 Ω is not a rounding error. Without units
    # nothing can be compared.
    for unit in {units[k] for k in np.flatnonzero(small).tolist()} - {""}:
        same = np.array([other == unit for other in units])
        lost |= same & (sizes <= KNOWN * sizes[same].max())
    return lost


class _Balance:
    """Sizes that were found for a model. They depend on the parameters that its equations read, and on no others."""

    def __init__(self, extended: Extended):
        self.factors = Factors()
        read = [group.parameter.ravel() for group in extended.groups]
        self.read = distinct(np.concatenate([np.zeros(0, np.int64), *read]))
        q = extended.quantities
        lower = np.flatnonzero((q.owner[:-1] == q.owner[1:]) & (q.order[1:] == q.order[:-1] + 1))
        self.rates = (lower, lower + 1) if len(lower) else None
        # Groups in which something stands beside the quantities, at some values of the parameters.
        anywhere = generic(np.random.default_rng(1), (int(self.read.max(initial=-1)) + 1,))
        self.with_constants = [g for g in extended.groups if len(constants([g], anywhere)[0])]
        self.found: dict[tuple[bytes, ...], np.ndarray] = {}


_BALANCES: weakref.WeakKeyDictionary[Extended, _Balance] = weakref.WeakKeyDictionary()


def _balanced(
    extended: Extended, parameters: np.ndarray, size: np.ndarray, rounded: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Sizes that make terms alike, where `size` is zero; of numbers that are `rounded` first."""
    balance = _BALANCES.get(extended)
    if balance is None:
        balance = _BALANCES[extended] = _Balance(extended)
    # What stands beside quantities may be a difference of parameters: it is rounded, not they.
    there, where = constants(balance.with_constants, parameters)
    there, parameters = rounded(there), rounded(parameters[balance.read])
    key = size.tobytes(), parameters.tobytes(), there.tobytes(), where.tobytes()
    found = balance.found.get(key)
    if found is None:
        every = np.zeros(int(balance.read.max(initial=-1)) + 1)
        every[balance.read] = parameters
        sizes, _ = natural_sizes(
            extended.groups, extended.n_equations, size, every,
            rates=balance.rates, factors=balance.factors, given=(there, where),
        )  # fmt: skip
        while len(balance.found) >= ROOM:
            balance.found.pop(next(iter(balance.found)), None)
        found = 10.0 ** np.clip(np.log10(np.abs(sizes)), -DECADES, DECADES)
        # The array is handed to all who ask; one that changed it would change the sizes of all others.
        found.flags.writeable = False
        balance.found[key] = found  # another thread may drop it at once
    return found
