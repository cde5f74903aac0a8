"""Runs whose times numbers hardly tell apart."""

import jax
import pytest
from problems import compiled, component

from jaxonomy_dae import Eq, ModelError, der, simulate


def _decay(c, ev):
    x = c.variable("x", start=1.0, fixed=True)
    c.add_equations(Eq(der(x), -x))


@pytest.mark.parametrize("t0", [1e17, -1e16])
def test_an_interval_of_a_few_spacings_of_its_times(t0):
    """Seconds of a distant epoch: such a run had no length, and returned its start."""
    with pytest.raises(ModelError, match=r"too short for float64, in which times near 1e\+1\d are \d+ s apart: count"):
        simulate(compiled(component(_decay)), t0 + 64.0, t0=t0)


def test_such_an_interval_in_single_precision():
    """The times are double precision's, the model's numbers are not."""
    with jax.enable_x64(False):
        single = compiled(component(_decay))
        for t0 in (1e7, 1.7e9):
            with pytest.raises(ModelError, match=r"too short for float32.*jax_enable_x64.*t0=0\.0"):
                simulate(single, t0 + 5.3, t0=t0)
