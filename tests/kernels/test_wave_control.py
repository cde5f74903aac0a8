"""Where long steps end that waves drive, around a controller that always wishes the same length."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.run.simulation.wave_control import AtWaves
from jaxonomy_dae.solve.adjoint.ends import ending


class Wishing(diffrax.AbstractAdaptiveStepSizeController):
    """Keeps every step; the next one shall be so long."""

    length: float
    rtol: float = 1e-6
    atol: float = 1e-6
    norm: object = None

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return t0 + self.length, None

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, state):
        return True, t1, t1 + self.length, False, None, diffrax.RESULTS.successful


def ends(length, frequency, phase, n, t0=0.0):
    """The ends of n steps."""
    control = ending(Wishing(length), AtWaves(jnp.array(frequency), jnp.array(phase)))
    first, state = control.init(None, jnp.array(t0), 1e9, None, None, None, None, 5)

    def step(end, _):
        _, _, following, *_ = control.adapt_step_size(t0, end, None, None, None, None, 5, state)
        return following, end

    return np.asarray(jax.lax.scan(step, first, length=n)[1])


def test_long_steps_end_at_zeros_and_extremes():
    """sin(3·t + 0.3): zero, one or minus one at (k·π/2 − 0.3)/3."""
    expected = (np.arange(1, 21) * np.pi / 2 - 0.3) / 3
    np.testing.assert_allclose(ends(100.0, [3.0], [0.3], 20), expected, rtol=1e-12)
    np.testing.assert_allclose(ends(100.0, [-3.0], [-0.3], 20), expected, rtol=1e-12)


def test_all_phases_of_one_frequency():
    phases = np.array([0.0, 2 * np.pi / 3, 4 * np.pi / 3])
    np.testing.assert_allclose(ends(9.0, [2.0] * 3, phases, 24), np.arange(1, 25) * np.pi / 12, rtol=1e-12)


def test_no_remainders():
    """A length between half of the way and all of it becomes two even steps."""
    quarter = np.pi / 2
    np.testing.assert_allclose(ends(0.7 * quarter, [1.0], [0.0], 8), np.arange(1, 9) * quarter / 2, rtol=1e-12)


def test_short_steps_are_left_alone():
    np.testing.assert_array_equal(ends(0.25, [1.0], [0.0], 9), np.cumsum(np.full(9, 0.25)))


def test_slow_waves_beside_a_fast_one_are_left_alone():
    """A quarter of the fast period, 1/50 of the slow one, sees the slow one."""
    np.testing.assert_allclose(ends(9.0, [100.0, 2.0], [0.0, 0.1], 30), np.arange(1, 31) * np.pi / 200, rtol=1e-12)


@pytest.mark.parametrize("t0", [0.0, 1e6])
def test_a_phase_that_moves_bounds_steps(t0):
    found = ends(9.0, [4.0], [np.nan], 5, t0)
    np.testing.assert_allclose(np.diff(found), np.pi / 8, rtol=1e-9)


@pytest.mark.parametrize("t0", [0.0, 1e6, 1e9])
def test_after_many_periods_every_step_goes_on(t0):
    """250 Hz, also at a time that is known to 1e-4 of a quarter only."""
    steps = np.diff(ends(9.0, [500 * np.pi], [0.3], 50, t0))
    np.testing.assert_allclose(steps, 1e-3, rtol=0, atol=1e-8 + 8 * np.spacing(t0))


def test_what_does_not_turn_bounds_nothing():
    np.testing.assert_array_equal(ends(9.0, [0.0, 0.0], [0.0, np.nan], 3), [9.0, 18.0, 27.0])


def test_times_are_constants_of_differentiation():
    def last(frequency):
        control = ending(Wishing(100.0), AtWaves(frequency[None], jnp.array([0.3])))
        return control.init(None, jnp.array(0.0), 1e9, None, None, None, None, 5)[0]

    value, slope = jax.value_and_grad(last)(jnp.array(3.0))
    assert value == pytest.approx((np.pi / 2 - 0.3) / 3, rel=1e-12) and slope == 0
