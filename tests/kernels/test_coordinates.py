"""Coordinates of a search: natural values and derivatives on their scale."""

import numpy as np
import pytest

from jaxonomy_dae import ModelError
from jaxonomy_dae.learning.coordinates import Coordinates, Shifts


def test_biases_are_measured_at_the_centre_of_inputs():
    """A bias b = b' − W c: derivatives and changes go through, and points come back."""
    none, flags = np.full(3, np.inf), np.zeros(3, bool)
    c = Coordinates(
        ("w", "v", "b"), ("",) * 3, ("n",) * 3, ~flags, flags, np.array([0.1, 0.2, 1.0]), np.array([3.0, -1.0, 5.0]),
        -none, none, none, np.zeros(3), flags, n_shared=3, n_own=0, experiments=1,
        shifts=Shifts(np.array([2, 2]), np.array([0, 1]), np.array([-300.0, 40.0])),
    )  # fmt: skip
    z = np.array([0.7, -0.4, 0.3])
    np.testing.assert_allclose(c.natural(z), [0.07, -0.08, 0.3 - 21 - 3.2])
    np.testing.assert_allclose(c.scaled(c.natural(z)), z, rtol=1e-12)
    np.testing.assert_allclose(c.natural(c.z_start), c.start, rtol=1e-12)
    steps = np.stack([c.natural(z + e) - c.natural(z) for e in np.eye(3)], axis=1)
    rows = np.random.default_rng(0).standard_normal((4, 3))
    np.testing.assert_allclose(c.moved(z, np.eye(3)), steps, atol=1e-12)
    np.testing.assert_allclose(c.pulled(z, rows), rows @ steps, atol=1e-11)
    np.testing.assert_allclose(c.pulled(z, rows[0]), rows[0] @ steps, atol=1e-11)


def test_an_open_end_can_be_named():
    """Bounds (0, 10) of what is declared above zero: "must lie within [0, inf]; got [0, 10]"."""
    high, flags = np.array([np.inf, np.nextafter(2.0, 0.0)]), np.zeros(2, bool)
    low = np.nextafter([0.0, 1.0], np.inf)
    c = Coordinates(
        ("k", "q"), ("",) * 2, ("k", "q"), flags, ~flags, np.ones(2), np.full(2, 1.5), low, high, np.full(2, np.inf),
        np.zeros(2), flags, n_shared=2, n_own=0, experiments=1,
    )  # fmt: skip
    found = c.bounded({"k": (0, 10), "q": (1.0, 2.0)})
    np.testing.assert_array_equal(found.low, low)
    np.testing.assert_array_equal(found.high, [10.0, high[1]])
    with pytest.raises(ModelError, match="must lie within those declared"):
        c.bounded({"q": (0.999, 2.0)})
