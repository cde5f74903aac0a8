"""Random diagrams, most of them broken: compiling either works or says, in names of the model, what is wrong."""

import random

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from recipes import compiler_of, draw_recipe, names_of, outcome

from jaxonomy_dae import ModelError
from jaxonomy_dae.compile.passes.flatten import flatten


def check_text(names, system, text):
    if system is None:
        assert any(name in text for name in names) or "got none" in text, text
        assert len(text) < 3000
        assert "Traceback" not in text and "v0_" not in text  # no internal symbols
    else:
        assert "structural index" in str(system.report)


# --- verdicts ----------------------------------------------------------------------------------------------------


def pencil(flat, seed=0) -> np.ndarray:
    """Σ ∂F/∂v^(k)·s^k of the flattened model at a random point and a random s, columns without inputs.

    A model is regular, generically, if this matrix is: for linear equations with constant coefficients that is the
    definition, for others it holds along solutions near almost every point.
    """
    rng = np.random.default_rng(seed)
    n = len(flat.variables)
    s = rng.uniform(0.7, 1.3)
    values = rng.uniform(0.5, 1.5, (n, 3))
    matrix, row = np.zeros((flat.n_equations, n)), 0
    parameters = np.clip(flat.declares.values, -10.0, 10.0)  # 1e300 is regular, though not in float64
    for group in flat.groups:
        slots = list(values[group.variable, group.order].T)
        partials = group.template.partial_values(
            slots, list(parameters[group.parameter].T), list(group.coefficient.T), 0.3, None, backend="numpy"
        )
        for k, partial in enumerate(partials):
            np.add.at(matrix, (row + np.arange(len(group)), group.variable[:, k]), partial * s ** group.order[:, k])
        row += len(group)
    return matrix[:, ~flat.variables.is_input]


def is_regular(flat) -> bool:
    matrix = pencil(flat)
    if matrix.shape[0] != matrix.shape[1]:
        return False
    # Entries are of size one to ten, up to a hundred rows.
    singular = np.linalg.svd(matrix, compute_uv=False)
    return bool(len(singular) == 0 or singular[-1] > 1e-9 * singular[0])


def check(recipe):
    """An error says what is wrong; a model is refused for its structure exactly if its equations are singular."""
    names = names_of(recipe)
    system, text = outcome(recipe, names)
    check_text(names, system, text)
    try:
        flat = flatten(compiler_of(recipe, names).diagram)
    except ModelError:
        return "malformed"
    if flat.network_names:
        return "learned"
    if "start" in text or text.startswith("ModelError"):
        return "starts"
    if " for part" in text or "parameter values" in text:
        return "values"  # with a mass or capacity of zero the index is another
    assert (system is not None) == is_regular(flat), text
    return "regular" if system else "singular"


# Hypothesis' own `randoms` prefer small numbers, and nearly every model would be malformed.
generators = st.integers(0, 2**32 - 1).map(random.Random)


@pytest.mark.long("sixteen models")
def test_models_are_refused_exactly_if_they_are_singular_and_say_what_is_wrong():
    """Both sound and singular models occur among these recipes, so that this tests something."""
    seen = {check(draw_recipe(random.Random(seed))) for seed in range(16)}
    assert {"regular", "singular"} <= seen


@pytest.mark.slow
@hypothesis.settings(max_examples=150, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(generators)
def test_many_broken_models(rng):
    check(draw_recipe(rng))


@hypothesis.settings(max_examples=8)
@hypothesis.given(generators)
def test_names_change_nothing(rng):
    """The same model under other names: the same text under those names, or the same report."""
    recipe = draw_recipe(rng)
    n = len(recipe["parts"])
    first, second = [f"u{k}u" for k in range(n)], [f"{'zyx'[k % 3]}{k}u" for k in range(n)]

    def told(names):
        system, text = outcome(recipe, names)
        text = str(system.report) if system else text
        for k, name in enumerate(names):
            text = text.replace(name, f"<{k}>")
        return text

    one, two = told(first), told(second)
    if "did you mean" in one:  # which names are near depends on them
        one, two = one.split("did you mean")[0], two.split("did you mean")[0]
    assert one == two
