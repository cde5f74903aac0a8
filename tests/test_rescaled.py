"""Models of the other tests in random units: same verdict, states, start and slopes.

Each variable, parameter and equation is multiplied by its own factor between 1e-12 and 1e9; `benchmarks/attack` does
the same with its random models and with published problems, and `pytest --units SEED` with every model of every test.
"""

import contextlib
import itertools
import random

import pytest
import sympy
import test_determinism
import test_index_reduction
import test_jacobian
import test_linear_daes
import test_modeling
import test_scaling
import test_stable_blocks
from attack import circuits, mechanisms
from attack.rescaled import rescaled as in_other_units
from other_units import compare_starts, compare_verdicts, watched
from problems import FreeMass, compiled, drag_on, mlp, oscillator, pendulum
from rescaling import KINDS
from test_learned import discharge

from jaxonomy_dae import AcausalCompiler, Component, EqnEnv, ModelError, der
from jaxonomy_dae.initialization.rows import initial_rows

MODELS = test_jacobian.MODELS | {
    # Its numbers are in every equation: in other units no two nodes are alike, and a program of forty kinds of nodes
    # takes XLA minutes and gigabytes.
    "nonlinear grid": lambda: test_jacobian.Grid(4, cubic=0.5).system(),
    "free mass": lambda: oscillator(kind=FreeMass),
    "learned drag": lambda: pendulum(drag_on("vx", "vy", network=mlp(2, 2))),
    "contradiction": lambda: test_scaling.triangle(1.0, False, y=3.0),
    "triangle": lambda: test_scaling.triangle(1.0, True),
    "cubic": lambda: test_scaling.scaled_cubic(1.0, True),
    "charge": lambda: test_scaling.charge(1.0),
    "orifices": lambda: test_scaling.orifices(1.0, 1.0),
    "attenuator": lambda: test_stable_blocks.attenuator(12, 100.0, 1.0),
    "levers": lambda: test_stable_blocks.levers("dummy_derivatives"),
    "levers, projected": lambda: test_stable_blocks.levers("projection"),
    "ladder": lambda: test_determinism.ladder(stages=4),
    "learned resistor": lambda: discharge(mlp(1, 1), "i"),
    "squares": lambda: test_modeling.single(test_modeling.Squares(EqnEnv(), "c")),
    "prescribed motion": lambda: test_modeling.single(test_modeling.Moved(EqnEnv(), "c")),
    "dependent equations": lambda: compiled(Twice(EqnEnv())),
    "contradicting constraints": lambda: compiled(Twice(EqnEnv(), constraint=1.0)),
}


class Twice(Component):
    """x' + y' = 1 twice; or x + y = 1 and x + y = 2 beside their motion."""

    def __init__(self, ev, constraint=None):
        super().__init__(ev, "c")
        x, y = self.variable("x"), self.variable("y")
        if constraint is None:
            self.add_equations(der(x) + der(y) - 1, 2 * der(x) + 2 * der(y) - 2)
        else:
            self.add_equations(x + y - constraint, 0.1 * x + 0.1 * y - 0.2 * constraint)


def built(name):
    with watched() as seen:
        with contextlib.suppress(ModelError):
            MODELS[name]()
    return seen[-1]


LARGE = ("grid", "nonlinear grid", "attenuator", "ladder", "cascade")
KINDS_OF_SMALL = [(n, KINDS[k % len(KINDS)]) for k, n in enumerate(n for n in MODELS if n not in LARGE)]


@pytest.mark.parametrize("name, kind", KINDS_OF_SMALL)
def test_verdicts_and_states(name, kind):
    compare_verdicts(*built(name), kind, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("name, kind", list(itertools.product(MODELS, KINDS)))
def test_verdicts_and_states_of_all(name, kind):
    compiler, old = built(name)
    for seed in range(1, 4):
        compare_verdicts(compiler, old, kind, seed)


@pytest.mark.parametrize("kind, seed", [("parameters", 6), ("all", 4), ("all", 24), ("all", 42)])
def test_states_of_combined_equations(kind, seed):
    """Equations whose highest derivatives cancel are combined twice. Their weights are no simple fractions here; taken
    for such, and with the digits that poor scaling leaves, they left terms of 1e-9 that chose other states."""
    with watched() as seen:
        test_linear_daes.compiled(test_linear_daes.written(test_linear_daes.MIXED))
    compare_verdicts(*seen[-1], kind, seed)


def test_exponentials_that_overflow():
    """Where a variable near one is many volts, the amplifier's transistors have no values; it was refused."""
    with watched() as seen:
        test_index_reduction.test_transistor_amplifier_has_five_degrees_of_freedom()
    compare_verdicts(*seen[-1], "all", 3)


@pytest.mark.parametrize("name, kind", [("implicit", "all"), ("contradiction", "units")])
def test_starts_and_slopes(name, kind):
    compiler, old = built(name)
    compare_starts(compare_verdicts(compiler, old, kind, 1, shuffled=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", MODELS)
def test_starts_and_slopes_of_all(name, kind):
    compiler, old = built(name)
    for seed in range(2):
        pair = compare_verdicts(compiler, old, kind, seed)
        if pair is not None:
            compare_starts(pair)


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
        ("mechanisms", 5),
        *(pytest.param(f, k, marks=pytest.mark.slow) for f in ("circuits", "mechanisms") for k in (0, 1, 2, 4, 6)),
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


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, 30))])
def test_reactions_beside_diffusion(seed):
    """Sizes at which questions of rank are asked made reactions vanish: the cells then determined u, and its start was
    taken for a contradiction."""
    with watched() as seen:
        compiled(Cells(EqnEnv(), seed))
    compiler, system = seen[-1]
    pairs = [compare_verdicts(compiler, system, kind, seed) for kind in KINDS]
    for each in (system, *(pair.new for pair in pairs if pair is not None)):
        rows = initial_rows(each.plan, ())
        assert all(rows.independent) and not rows.n_soft, [row.name for row in rows.kept]
