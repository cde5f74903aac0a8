"""Sizes of quantities and parameters at which all terms of all equations are alike, whatever the units."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Float

from .evaluate_numpy import Networks, generic, group_values
from .extended import ExtendedGroup
from .tables import ZERO

ROUNDS = 3
STEP = 1e-3  # of the logarithm of an argument
FARTHEST = 100.0  # decades from one that a size may be looked for
STEEPEST = 8.0  # power that an entry is taken for
DAMPING = 1e-3  # keeps sizes that nothing tells where they are


def natural_sizes(
    groups: Sequence[ExtendedGroup],
    n_equations: int,
    size: Float[np.ndarray, " n"],
    parameters: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " p"]]:
    """Sizes s with |∂F_e/∂x_q|·s_q near 1 in units of each equation, in the least-squares sense of logarithms (Curtis &
    Reid 1972, where the entries depend on the sizes as well). What an equation has without quantities, such as the
    pressure of a reservoir, is a term like others where its parameters are known.

    **Arguments:**

    - `size`: of every quantity, with signs, from which the search begins: those other than ±1 are declared and stay.
    - `parameters`: values that stay; zero for those whose size is looked for, too.
    """
    n_parameters = len(parameters)
    known = np.append(np.abs(size) != 1.0, parameters != 0.0)
    quantity, parameter = size.copy(), np.where(parameters == 0.0, 1.0, parameters)
    constant = _constants(groups, parameters)
    for _ in range(ROUNDS):
        table = _logarithms(groups, quantity, parameter)
        if table is None:
            break
        logarithm, row, column, by_quantity, by_parameter = table
        k, n = np.arange(len(row)), len(quantity)
        alone = len(k) + np.arange(len(constant[0]))
        shape = (len(k) + len(alone), n + n_parameters + n_equations)
        places = np.concatenate([alone, k, k, by_quantity[0], by_parameter[0]])
        rows = n + n_parameters + np.concatenate([constant[1], row])
        unknowns = np.concatenate([rows, column, by_quantity[1], n + by_parameter[1]])
        powers = np.concatenate([np.ones(len(alone) + 2 * len(k)), by_quantity[2], by_parameter[2]])
        powers[(unknowns < len(known)) & known[np.minimum(unknowns, len(known) - 1)]] = 0.0
        matrix = sp.csr_array((powers, (places, unknowns)), shape=shape)
        linalg: Any = scipy.sparse.linalg
        sizes = np.append(logarithm, constant[0])
        found = linalg.lsmr(matrix, -sizes, damp=DAMPING, atol=1e-4, btol=1e-4, maxiter=20 * n)[0]
        quantity, parameter = _moved(quantity, found[:n]), _moved(parameter, found[n : n + n_parameters])
        if np.abs(found[: n + n_parameters]).max(initial=0.0) < 0.3:
            break
    return quantity, parameter


def _moved(size: np.ndarray, decades: np.ndarray) -> np.ndarray:
    """Sizes times powers of ten, up to a limit; those that do not move stay whatever they are."""
    there = np.log10(np.abs(size))
    limited = np.clip(there + np.clip(decades, -60, 60), np.minimum(there, -FARTHEST), np.maximum(there, FARTHEST))
    return np.where(decades == 0.0, size, np.sign(size) * 10.0**limited)


def _constants(groups: Sequence[ExtendedGroup], parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log₁₀ |F_e| where all quantities are zero, and the equations e; none that reads a parameter without a value."""
    values, equations = [np.zeros(0)], [np.zeros(0, np.int64)]
    nothing = np.zeros(1 + max((int(g.quantity.max(initial=-1)) for g in groups), default=0))
    for group in groups:
        if group.template.opaque is not None:
            continue
        with np.errstate(all="ignore"):
            there = np.abs(group_values(group, nothing, parameters, 0.5, Networks(()), partials=False))
        used = (there > 0) & np.isfinite(there) & (parameters[group.parameter] != 0.0).all(axis=1)
        values.append(np.log10(there[used]))
        equations.append(group.equation[used])
    return np.concatenate(values), np.concatenate(equations)


def _logarithms(groups: Sequence[ExtendedGroup], quantity: np.ndarray, parameter: np.ndarray):
    """log₁₀ |∂F_e/∂x_q|·|x_q| of all entries at a generic point of these sizes, their equations and quantities, and
    their powers in quantities and parameters as (entry, argument, power)."""
    rng = np.random.default_rng(1)
    point, parameters = quantity * generic(rng, quantity.shape), parameter * generic(rng, parameter.shape)
    out: list[list[np.ndarray]] = [[] for _ in range(9)]
    first = 0
    for group in groups:
        if group.quantity.shape[1] == 0 or group.template.opaque is not None:
            continue
        entry = _sizes(group, point, parameters)
        used = (entry > 0) & np.isfinite(entry) & (group.quantity != ZERO)
        if not used.any():
            continue
        place = np.full(entry.shape, -1)
        place[used] = first + np.arange(used.sum())
        first += int(used.sum())
        column = np.where(used, group.quantity, 0)
        values = np.log10(entry[used]) + np.log10(np.abs(point[column[used]]))
        rows = np.broadcast_to(group.equation[:, None], used.shape)[used]
        for collected, value in zip(out[:3], (values, rows, column[used]), strict=True):
            collected.append(value)
        if all(group.template.coefficient_is_number(j) for j in range(entry.shape[1])):
            continue
        arguments = [(3, point, group.quantity), (6, parameters, group.parameter)]
        for base, vector, ids in arguments:
            for j in range(ids.shape[1]):
                moved = vector.copy()
                moved[ids[:, j]] *= 1 + STEP
                after = _sizes(group, *((moved, parameters) if base == 3 else (point, moved)))
                with np.errstate(all="ignore"):
                    power = np.log(after / entry) / np.log1p(STEP)
                hit = used & np.isfinite(power) & (np.abs(power) > 1e-6) & (ids[:, j] != ZERO)[:, None]
                owner = np.broadcast_to(ids[:, j][:, None], used.shape)
                for offset, value in enumerate((place[hit], owner[hit], np.clip(power[hit], -STEEPEST, STEEPEST))):
                    out[base + offset].append(value)
    if not first:
        return None
    logarithm, row, column, *powers = (np.concatenate(v) if v else np.zeros(0) for v in out)
    return logarithm, row, column, _integers(powers[:3]), _integers(powers[3:])


def _integers(powers: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return powers[0].astype(np.int64), powers[1].astype(np.int64), powers[2]


def _sizes(group: ExtendedGroup, point: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        return np.abs(group_values(group, point, parameters, 0.5, Networks(()), partials=True))
