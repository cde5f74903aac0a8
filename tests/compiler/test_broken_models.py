"""Random diagrams, most of them broken: compiling either works or says, in names of the model, what is wrong.

A recipe is plain data drawn from a `random.Random`, so that another process can draw the same again.
"""

import random

import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from sympy import Eq

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    InitializationError,
    ModelError,
    NeuralDAEBlock,
    der,
)
from jaxonomy_dae.compiler.flatten import flatten
from jaxonomy_dae.library.electrical import Capacitor, CurrentSource, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.library.thermal import FixedTemperature, HeatCapacitor, ThermalConductor
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Rod, Spring
from jaxonomy_dae.modeling import Electrical

# Classes of each domain with their parameter and the arguments that fix a start.
DOMAINS = {
    "electrical": [
        (Resistor, "R", ()),
        (Capacitor, "C", ("initial_voltage",)),
        (Inductor, "L", ("initial_current",)),
        (VoltageSource, "v", ()),
        (CurrentSource, "i", ()),
        (Ground, None, ()),
    ],
    "translational": [
        (Mass, "M", ("initial_position", "initial_velocity")),
        (Spring, "K", ()),
        (Damper, "D", ()),
        (Rod, "length", ()),
        (FixedPosition, "position", ()),
    ],
    "thermal": [
        (HeatCapacitor, "C", ("initial_temperature",)),
        (ThermalConductor, "G", ()),
        (FixedTemperature, "T", ()),
    ],
}


class Law(Component):
    """Variables x0, x1, … and equations from a menu, as many of each as the recipe says."""

    def __init__(self, ev, name, starts, equations):
        super().__init__(ev, name)
        x = [
            self.variable(f"x{k}", start=start, fixed=fixed and start is not None)
            for k, (start, fixed) in enumerate(starts)
        ]
        p = self.parameter("p", 1.5)
        u = self.input("u", default=0.5)
        for kind, i, j, k in equations:
            a, b, c = (x[n % len(x)] for n in (i, j, k))
            if kind == "learned":
                (learned,) = self.learned(f"law{len(self.learned_terms)}", jnp.tanh, inputs=[a])
                self.add_equations(Eq(learned, b))
                continue
            self.add_equations(*[e for e in [MENU[kind](a, b, c, p, u, ev.t)] if e not in (True, sympy.true)])


MENU = {
    "decay": lambda a, b, c, p, u, t: Eq(der(a), -p * b),
    "second": lambda a, b, c, p, u, t: Eq(der(der(a)), b - c),
    "equal": lambda a, b, c, p, u, t: Eq(a, b),
    "opposite": lambda a, b, c, p, u, t: Eq(a, -b),
    "sum": lambda a, b, c, p, u, t: Eq(a + b + c, 0),
    "offset": lambda a, b, c, p, u, t: Eq(a + b, p),
    "product": lambda a, b, c, p, u, t: Eq(a * b, c + 1),
    "circle": lambda a, b, c, p, u, t: Eq(a**2 + b**2, p**2),
    "zero": lambda a, b, c, p, u, t: Eq(a, 0),
    "one": lambda a, b, c, p, u, t: Eq(a, 1),
    "given": lambda a, b, c, p, u, t: Eq(a, sympy.sin(t)),
    "input": lambda a, b, c, p, u, t: Eq(a, u),
    "of inputs": lambda a, b, c, p, u, t: Eq(u, p),
    "cancel": lambda a, b, c, p, u, t: Eq(p * (der(a) - der(b)), c),
    "exponential": lambda a, b, c, p, u, t: Eq(sympy.exp(a) - b, der(c)),
}


class Pair(Component):
    """Two resistors in series behind two ports, of which some may have been forgotten inside."""

    def __init__(self, ev, name, wires):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        a, b = self.add(Resistor(ev, "a")), self.add(Resistor(ev, "b"))
        for ends, wired in zip([(p, a.p), (a.n, b.p), (b.n, n)], wires, strict=True):
            if wired:
                self.connect(*ends)


def draw_recipe(rng: random.Random) -> dict:
    """A model as plain data: parts, connections, and slips."""
    parts, nodes = [], []

    def maybe(share):
        return rng.random() < share

    careful = maybe(0.6)  # every node has a part that determines it; what is added may still be wrong

    for domain in rng.sample(sorted(DOMAINS), rng.choice([1, 1, 1, 2])):
        first, n_nodes = len(nodes), rng.randint(1, 5)
        nodes.extend([] for _ in range(n_nodes))
        if careful:
            for node in range(n_nodes):
                grounded = domain == "electrical" and node == 0
                starts = [None] * len(DOMAINS[domain][0][2])
                parts.append(("library", domain, 5 if grounded else 0, 1.0, [] if grounded else starts))
                nodes[first + node].append((len(parts) - 1, 0))
                if domain == "electrical" and node:
                    nodes[first].append((len(parts) - 1, 1))
        for _ in range(rng.randint(1, 4 if careful else 7)):
            place = rng.randrange(len(DOMAINS[domain]))
            value = rng.choice([0.5, 1.0, 2.0])
            if maybe(0.02):
                value = rng.choice([0.0, -1.0, float("nan"), float("inf"), 1e300])
            starts = [rng.choice([0.0, 1.0, 2.0]) if maybe(0.4) else None for _ in DOMAINS[domain][place][2]]
            parts.append(("library", domain, place, value, starts))
            for port in range(2):
                if not maybe(0.06):
                    nodes[first + rng.randrange(n_nodes)].append((len(parts) - 1, port))
        if domain == "electrical" and maybe(0.2):
            parts.append(("pair", [not maybe(0.2) for _ in range(3)]))
            for port in range(2):
                nodes[first + rng.randrange(n_nodes)].append((len(parts) - 1, port))
    if maybe(0.35):
        n = rng.randint(1, 5)
        starts = [(rng.choice([None, 0, 1, 2]), maybe(0.5)) for _ in range(n)]
        kinds = [*MENU, "learned"] if maybe(0.2) else list(MENU)
        equations = [
            (rng.choice(kinds), rng.randrange(9), rng.randrange(9), rng.randrange(9))
            for _ in range(max(0, n + rng.choice([-1, 0, 0, 0, 0, 1])))
        ]
        parts.append(("law", starts, equations))
    if maybe(0.05):
        parts.append(("pendulum",))
    slips = [
        (slip, rng.randrange(99), rng.randrange(99))
        for slip in ("port name", "domains", "itself", "no component", "prefer", "block", "same name", "added twice")
        if maybe(0.02)
    ]
    mode = rng.choice(["auto", "auto", "auto", "dummy_derivatives", "projection"])
    order = list(range(len(parts)))
    rng.shuffle(order)
    return dict(parts=parts, nodes=nodes, slips=slips, mode=mode, order=order)


def names_of(recipe, prefix="part") -> list[str]:
    return [f"{prefix}{k}" for k in range(len(recipe["parts"]))]


def build(recipe, names):
    """The compiled system of a recipe."""
    return compiler_of(recipe, names)()


def compiler_of(recipe, names) -> AcausalCompiler:
    """The compiler of a recipe's diagram."""
    ev = EqnEnv()
    made = []
    for name, (kind, *rest) in zip(names, recipe["parts"], strict=True):
        if kind == "library":
            domain, place, value, starts = rest
            cls, parameter, fixable = DOMAINS[domain][place]
            options = {} if parameter is None else {parameter: value}
            made.append(cls(ev, name, **options, **dict(zip(fixable, starts, strict=True))))
        elif kind == "pair":
            made.append(Pair(ev, name, rest[0]))
        elif kind == "law":
            made.append(Law(ev, name, *rest))
        else:
            made.append(PlanarPendulum(ev, name, initial_theta=-1.0))
    diagram = AcausalDiagram()
    diagram.add(*(made[k] for k in recipe["order"]))
    for ends in recipe["nodes"]:
        ports = []
        for k, port in ends:
            listed = list(made[k].ports.values())
            if port < len(listed):
                ports.append(listed[port])
        if len(ports) > 1:
            diagram.connect(*ports)
    options = {"state_selection": recipe["mode"]}
    for slip, i, j in recipe["slips"]:
        a, b = made[i % len(made)], made[j % len(made)]
        if slip == "port name":
            diagram.connect(a, "flansch", b, "p")
        elif slip == "domains":
            diagram.connect(*(p for c in (a, b) for p in list(c.ports.values())[:1]))
        elif slip == "itself":
            diagram.connect(*(p for c in (a, a) for p in list(c.ports.values())[:1]))
        elif slip == "no component":
            diagram.connect(a, 0)
        elif slip == "prefer":
            options["prefer_states"] = [f"{a.name}.w"]
        elif slip == "block":
            target = list(a.variables)[j % len(a.variables)] if a.variables else "v"
            diagram.add_neural_correction_block(NeuralDAEBlock(jnp.tanh, targets=[(a, target)], name="net"))
        elif slip == "same name":
            diagram.add(Ground(ev, a.name))
        else:
            diagram.add(a)
    return AcausalCompiler(ev, diagram, **options)


def outcome(recipe, names):
    """(system or None, the error's text): whatever else is raised is a failure."""
    try:
        return build(recipe, names), ""
    except ModelError as error:
        return None, f"{type(error).__name__}: {error}"


def check(recipe):
    names = names_of(recipe)
    system, text = outcome(recipe, names)
    if system is None:
        assert any(name in text for name in names) or "got none" in text, text
        assert len(text) < 3000
        assert "Traceback" not in text and "v0_" not in text  # no internal symbols
    else:
        assert "structural index" in str(system.report)
    return system


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
    parameters = np.clip(flat.parameters.values, -10.0, 10.0)  # 1e300 is regular, though not in float64
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


def check_verdict(recipe):
    """A model is refused for its structure exactly if its equations are singular."""
    names = names_of(recipe)
    try:
        flat = flatten(compiler_of(recipe, names).diagram)
    except ModelError:
        return "malformed"
    if flat.networks:
        return "learned"
    system, text = outcome(recipe, names)
    if "start" in text or text.startswith("ModelError"):
        return "starts"
    if " for part" in text or "parameter values" in text:
        return "values"  # with a mass or capacity of zero the index is another
    assert (system is not None) == is_regular(flat), text
    return "regular" if system else "singular"


# Hypothesis' own `randoms` prefer small numbers, and nearly every model would be malformed.
generators = st.integers(0, 2**32 - 1).map(random.Random)


@hypothesis.settings(max_examples=40)
@hypothesis.given(generators)
def test_broken_models_say_what_is_wrong(rng):
    check(draw_recipe(rng))


@hypothesis.settings(max_examples=40)
@hypothesis.given(generators)
def test_models_are_refused_exactly_if_they_are_singular(rng):
    check_verdict(draw_recipe(rng))


@pytest.mark.slow
@hypothesis.settings(max_examples=1000, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(generators)
def test_many_broken_models(rng):
    recipe = draw_recipe(rng)
    check(recipe)
    check_verdict(recipe)


def test_the_recipes_reach_what_they_are_for():
    """Both sound and singular models occur among the first recipes, so that the tests above test something."""
    seen = {check_verdict(draw_recipe(random.Random(seed))) for seed in range(15)}
    assert {"regular", "singular"} <= seen


@hypothesis.settings(max_examples=25)
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


@pytest.mark.slow
@hypothesis.settings(max_examples=12, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(generators)
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
