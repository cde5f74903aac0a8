"""Models of the other tests in random units: the same verdict, states, start and slopes.

`compiler/test_rescaled.py` compares what needs no program.
"""

import pytest
from other_units import compare_starts, compare_verdicts, outcome
from rescaling import KINDS
from shared_models import WITH_NETWORKS, WITHOUT_NETWORKS

MODELS = WITHOUT_NETWORKS | WITH_NETWORKS


@pytest.mark.parametrize("name, kind", [("learned resistor", "all"), ("network on a row", "units")])
def test_verdicts_and_states_with_networks(name, kind):
    compare_verdicts(*outcome(MODELS[name]), kind, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, kind", [pytest.param("implicit", "all", marks=pytest.mark.slow), ("contradiction", "units")]
)
def test_starts_and_slopes(name, kind):
    compare_starts(compare_verdicts(*outcome(MODELS[name]), kind, 1, shuffled=True))


# A sample, of each kind of model and of units; `make attack` draws random ones.
SAMPLE = ("circuit", "levers, projected", "pendulum", "network", "orifices", "triangle", "prescribed motion", "squares")


@pytest.mark.slow
@pytest.mark.parametrize("name, kind", [(name, KINDS[k % len(KINDS)]) for k, name in enumerate(SAMPLE)])
def test_starts_and_slopes_of_a_sample(name, kind):
    compare_starts(compare_verdicts(*outcome(MODELS[name]), kind, seed=0))
