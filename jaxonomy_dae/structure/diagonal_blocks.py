"""The diagonal blocks of the Jacobian by highest derivatives, after index reduction."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from .incidence import Incidence
from .pantelides import Offsets


def diagonal_blocks(signature: Incidence, offsets: Offsets) -> tuple[np.ndarray, np.ndarray]:
    """The diagonal block of every equation in the system Jacobian, and how many equations that block has."""
    rows, n = signature.rows, signature.n_equations
    active = signature.order + offsets.equation[rows] == offsets.variable[signature.variable]
    owner = np.empty(signature.n_variables, np.int64)
    owner[offsets.matched_variable] = np.arange(n)
    follow = (rows[active], owner[signature.variable[active]])
    _, label = connected_components(
        sp.coo_array((np.ones(len(follow[0])), follow), shape=(n, n)), directed=True, connection="strong"
    )
    return label, np.bincount(label)[label]
