"""Models of the other tests in random units: same verdict and states, and the same starts that count.

Each variable, parameter and equation is multiplied by its own factor between 1e-12 and 1e9; `make attack` does the same
with random models and with published problems, and `pytest --units SEED` with every model of every test.
`plants/test_rescaled_starts.py` compares starts and slopes as well, and models with networks.
"""

import random

import pytest
import sympy
from attack import circuits, mechanisms
from attack.rescaled import rescaled as in_other_units
from other_units import compare_verdicts, outcome
from problems import compiled
from rescaling import KINDS
from shared_models import MIXED, WITHOUT_NETWORKS, written
from testset import PROBLEMS

from jaxonomy_dae import AcausalCompiler, Component, EqnEnv, der
from jaxonomy_dae.run.start.rows import initial_rows

LARGE = ("grid", "nonlinear grid", "attenuator", "ladder", "cascade")
SMALL = [name for name in WITHOUT_NETWORKS if name not in LARGE]


@pytest.mark.parametrize("name, kind", [(name, KINDS[k % len(KINDS)]) for k, name in enumerate(SMALL)])
def test_verdicts_and_states(name, kind):
    compare_verdicts(*outcome(WITHOUT_NETWORKS[name]), kind, seed=0)


# Two kinds of units for each model; `make attack` draws all of them with random models.
@pytest.mark.slow
@pytest.mark.parametrize("name", WITHOUT_NETWORKS)
def test_verdicts_and_states_in_other_kinds_of_units(name):
    compiler, old = outcome(WITHOUT_NETWORKS[name])
    k = list(WITHOUT_NETWORKS).index(name)
    for kind in (KINDS[(k + 1) % len(KINDS)], KINDS[(k + 2) % len(KINDS)]):
        compare_verdicts(compiler, old, kind, 1)


@pytest.mark.parametrize("kind, seed", [("parameters", 6), ("all", 4), ("all", 24), ("all", 42)])
def test_states_of_combined_equations(kind, seed):
    """Equations whose highest derivatives cancel are combined twice. Their weights are no simple fractions here; taken
    for such, and with the digits that poor scaling leaves, they left terms of 1e-9 that chose other states."""
    compare_verdicts(*outcome(lambda: compiled(written(MIXED))), kind, seed)


@pytest.mark.slow
def test_exponentials_that_overflow():
    """Where a variable near one is many volts, the amplifier's transistors have no values; it was refused."""
    compare_verdicts(*outcome(PROBLEMS["transamp"].compile), "all", 3)


# --- which starts determine the initial point ------------------------------------------------------------------------


def starts_that_count(case):
    """How many starts are independent, how many follow from others, how many guesses are needed."""
    plan = AcausalCompiler(case.ev, case.diagram)().plan
    rows = initial_rows(plan, tuple(case.initial))
    return sum(rows.independent), len(rows.redundant), rows.n_soft


@pytest.mark.parametrize(
    "family, seed",
    [
        ("circuits", 3),
        pytest.param("mechanisms", 5, marks=pytest.mark.slow),
        *(pytest.param(f, k, marks=pytest.mark.slow) for f in ("circuits", "mechanisms") for k in (0, 4)),
    ],
)
def test_starts_that_count(family, seed):
    """Factors of 1e-12 to 1e9 in equations hid open directions: a start was taken for redundant, and values of 1e300
    that fulfil everything else were found."""
    make = {"circuits": circuits.make, "mechanisms": mechanisms.make}[family]
    assert starts_that_count(in_other_units(make(seed), seed, "all")) == starts_that_count(make(seed))


LAWS = (
    lambda z, k: k * z**3,
    lambda z, k: k * sympy.exp(z),
    lambda z, k: k * sympy.sin(z),
    lambda z, k: k * z * sympy.Abs(z),
    lambda z, k: k * sympy.sqrt(1 + z**2),
    lambda z, k: k * z**5 - z,
)


class Cells(Component):
    """A random network of cells, 0 = Σ D (z_j − z_i) − law(z_i) + (1 + i/10) u, while u' = −u for each u: whatever
    these are, they determine the cells."""

    def __init__(self, ev, seed):
        super().__init__(ev, "c")
        rng = random.Random(seed)
        n = rng.randint(2, 9)
        conductance, factor = self.parameter("D", 2.0), self.parameter("k", 3.0)
        if seed % 3 == 0:
            conductance, factor = 2.0, 3.0
        us = [self.variable(f"u{j}", start=1.0, fixed=True) for j in range(rng.randint(1, 3))]
        z = [self.variable(f"z{i}", start=rng.choice([None, 0.9, 1.0, 2.5])) for i in range(n)]
        flow = [-rng.choice(LAWS)(z[0], factor), *(0 for _ in z[1:])]
        for i in range(1, n):
            other = rng.randrange(i)
            flow[i] += conductance * (z[other] - z[i])
            flow[other] += conductance * (z[i] - z[other])
            if rng.random() < 0.6:
                flow[i] -= rng.choice(LAWS)(z[i], factor)
        self.add_equations(*(der(u) + u for u in us))
        self.add_equations(*(f + (1 + 0.1 * i) * rng.choice(us) for i, f in enumerate(flow)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 5))])
def test_reactions_beside_diffusion(seed):
    """Sizes at which questions of rank are asked made reactions vanish: the cells then determined u, and its start was
    taken for a contradiction."""
    compiler, system = outcome(lambda: compiled(Cells(EqnEnv(), seed)))
    pairs = [compare_verdicts(compiler, system, kind, seed) for kind in KINDS]
    for each in (system, *(pair.new for pair in pairs if pair is not None)):
        rows = initial_rows(each.plan, ())
        assert all(rows.independent) and not rows.n_soft, [row.name for row in rows.kept]
