"""Random models that compile: they start, or say why not."""

import random

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from recipes import draw_recipe, names_of, outcome

from jaxonomy_dae import InitializationError, ModelError


@pytest.mark.slow
@hypothesis.settings(max_examples=12, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(st.integers(0, 2**32 - 1).map(random.Random))
def test_accepted_models_start_or_say_why_not(rng):
    recipe = draw_recipe(rng)
    system, _ = outcome(recipe, names_of(recipe))
    hypothesis.assume(system is not None)
    assert system is not None
    try:
        x = system.initialize()
    except (InitializationError, ModelError) as error:
        assert str(error)
    else:
        assert np.isfinite(np.asarray(x)).all()
