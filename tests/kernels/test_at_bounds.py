"""Whether data push an estimate against its bound: y = a x + b t with a ≥ 0, against least squares."""

import numpy as np

from jaxonomy_dae.learning.at_bounds import PUSHED, at_bounds
from jaxonomy_dae.learning.evaluation import Rows

T = np.linspace(0, 1, 30)
COLUMNS = np.stack([np.sin(5 * T), T], axis=1)


def at_zero(y):
    """The report where a is held at zero and b is fitted, noise of one."""
    b = (T @ y) / (T @ T)
    return at_bounds(Rows(b * T - y, COLUMNS), np.array([False, True]), 1e-12)[0]


def test_the_least_beyond_a_bound_is_that_of_both_numbers():
    covariance = np.linalg.inv(COLUMNS.T @ COLUMNS)
    for y in np.random.default_rng(0).standard_normal((5, len(T))):
        both = covariance @ COLUMNS.T @ y
        found = at_zero(y)
        np.testing.assert_allclose([found.beyond, found.spread], [both[0], np.sqrt(covariance[0, 0])], rtol=1e-9)


def test_a_truth_on_its_bound_is_rarely_doubted_and_one_beyond_often():
    noise = np.random.default_rng(1).standard_normal((1500, len(T)))
    ends = [at for at in map(at_zero, noise) if at.beyond < 0]  # the others move away from the bound
    share = sum(at.is_pushed for at in ends) / 1500
    assert abs(share - 0.02) < 4 * np.sqrt(0.02 / 1500)
    far = at_zero(noise[0] - 3 * PUSHED * np.sqrt(np.linalg.inv(COLUMNS.T @ COLUMNS)[0, 0]) * COLUMNS[:, 0])
    assert far.is_pushed


def test_what_the_data_do_not_tell_pushes_nowhere():
    twice = np.stack([T, T], axis=1)
    found = at_bounds(Rows(T**2, twice), np.array([False, True]), 1e-8)[0]
    assert not found.is_pushed and found.spread == np.inf
