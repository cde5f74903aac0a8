"""Local parabolas through samples, against polynomials that they reproduce and NumPy's fit of the same samples."""

import numpy as np
import pytest

from jaxonomy_dae.learning.node_guesses import local_parabolas, sizes


@pytest.mark.parametrize("scale, shift", [(1.0, 0.0), (1e-6, 3.0), (1e5, -2e5)])
def test_parabolas_are_reproduced(scale, shift):
    """In any unit of time, at the ends too, with values and slopes."""
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0, 10, 80))
    at = np.linspace(times[0], times[-1], 7)

    def value(t):
        return 3.0 - 0.4 * t + 0.7 * t**2

    stretched = dict(times=shift + scale * times, values=value(times), at=shift + scale * at, width=1.5 * scale)
    np.testing.assert_allclose(local_parabolas(**stretched, order=0), value(at), rtol=1e-8)
    np.testing.assert_allclose(local_parabolas(**stretched, order=1), (-0.4 + 1.4 * at) / scale, rtol=1e-6)


def test_noise_is_smoothed_over_half_a_width_on_both_sides():
    rng = np.random.default_rng(1)
    times, values = np.linspace(0, 1, 101), rng.standard_normal(101)
    near = np.abs(times - 0.5) <= 0.1 + 1e-12
    expected = np.polyfit(times[near] - 0.5, values[near], 2)
    found = [local_parabolas(times, values, np.array([0.5]), 0.2 + 1e-11, order)[0] for order in (0, 1)]
    np.testing.assert_allclose(found, expected[[2, 1]], rtol=1e-8)


def test_where_no_samples_are_near_nothing_is_known():
    times = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 5.0])
    found = local_parabolas(times, times, np.array([0.2, 2.5]), 1.0, 0)
    np.testing.assert_allclose(found[0], 0.2, rtol=1e-12)
    assert np.isnan(found[1])
    assert np.isnan(local_parabolas(times[:0], times[:0], np.array([0.2]), 1.0, 0)).all()
    one = (
        local_parabolas(times[:1], times[:1] + 4, np.array([0.2]), 1.0, 0),
        local_parabolas(times[:1], times[:1], np.array([0.2]), 1.0, 1),
    )
    assert one[0][0] == 4.0 and np.isnan(one[1][0])


def test_sizes():
    states = np.zeros((1, 3, 3))
    states[0, :, 0], states[0, :, 1] = [1.0, 2.0, 4.0], 5.0
    np.testing.assert_allclose(sizes(states), [3.0, 5e-3, 1.0])
