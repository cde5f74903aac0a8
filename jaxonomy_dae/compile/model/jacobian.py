"""Numbers at compile time: residuals and Jacobians of the extended system in NumPy.

Only the choice of states needs numbers before the model runs. They are computed in float64 whatever the precision the
model will run in, from the same templates the lowered system uses.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from ...base.tolerances import KNOWN
from .extended import Extended, ExtendedGroup
from .group import Point
from .tables import ZERO


def residual_and_jacobian(extended: Extended, at: Point) -> tuple[Float[np.ndarray, " equations"], sp.csr_array]:
    """All residuals, and the sparse Jacobian with respect to all quantities."""
    residual = np.empty(extended.n_equations)
    for group in extended.groups:
        residual[group.equation] = group.residual(at)
    return residual, _jacobian(extended, [(g, g.partials(at)) for g in extended.groups if g.quantity.shape[1]])


def _jacobian(extended: Extended, partials: Sequence[tuple[ExtendedGroup, np.ndarray]]) -> sp.csr_array:
    """The sparse Jacobian of all equations, from the partial derivatives (n, slots) of groups that have slots."""
    shape = (extended.n_equations, extended.quantities.n)
    if not partials:
        return sp.csr_array(shape)
    used = [group.quantity != ZERO for group, _ in partials]
    rows = [np.broadcast_to(g.equation[:, None], u.shape)[u] for (g, _), u in zip(partials, used, strict=True)]
    columns = [g.quantity[u] for (g, _), u in zip(partials, used, strict=True)]
    entries = [partial[u] for (_, partial), u in zip(partials, used, strict=True)]
    data = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
    return sp.coo_array(data, shape=shape).tocsr()


def generic_jacobian(
    extended: Extended, size: np.ndarray, parameter_size: np.ndarray
) -> tuple[sp.csr_array, sp.csr_array, np.ndarray, np.ndarray]:
    """A sparse Jacobian with respect to all quantities at a generic point, for questions of rank: what depends there
    depends everywhere, or nearly so. Also bounds of the errors of its entries, the point and the parameters.

    It reads nothing but the structure: not the values of parameters, nor the weights of networks. Partial derivatives
    that are not real at the point, and those of networks, are generic numbers.

    **Arguments:**

    - `size`: of every quantity; the factor counts. `parameter_size`: of every parameter.
    """
    rng = np.random.default_rng(0)
    # The seed is fixed, so that a verdict on a model is the same in each process.
    values = [(size * generic(rng, size.shape), parameter_size * generic(rng, parameter_size.shape)) for _ in range(2)]
    samples = [Point.of(*numbers, 0.5) for numbers in values]
    partials, errors = [], []
    for group in extended.groups:
        n, k = group.quantity.shape
        if k == 0:
            continue
        if group.template.opaque is not None:
            partial = generic(rng, (n, k))
            error = KNOWN * partial
        else:
            (first, of_first), (second, of_second) = (
                group.partials_with_errors(at, KNOWN * np.abs(at.values)) for at in samples
            )
            # Zero on one branch is not zero on all; and what is not real at one point may be so at the other.
            other = (np.abs(first) <= of_first) | ~np.isfinite(first)
            partial, error = np.where(other, second, first), np.where(other, of_second, of_first)
            partial = np.where(np.isfinite(partial), partial, generic(rng, (n, k)))
            error = np.where(np.isfinite(error), error, KNOWN * np.abs(partial))
        partials.append((group, partial))
        errors.append((group, error))
    return _jacobian(extended, partials), _jacobian(extended, errors), *values[0]


def generic(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers near 1 without pattern."""
    return rng.uniform(0.5, 1.5, shape)
