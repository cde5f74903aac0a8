"""Random diagrams, most of them broken.

A recipe is plain data drawn from a `random.Random`, so that another process can draw the same again.
"""

import random

import jax.numpy as jnp
import sympy
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, ModelError, NeuralDAEBlock, der
from jaxonomy_dae.library.electrical import Capacitor, CurrentSource, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.library.thermal import FixedTemperature, HeatCapacitor, ThermalConductor
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Rod, Spring
from jaxonomy_dae.write import Electrical

# Classes of each domain with their parameter and the arguments that fix a start.
DOMAINS = {
    "electrical": [
        (Resistor, "R", ()),
        (Capacitor, "C", ("initial_voltage",)),
        (Inductor, "L", ("initial_current",)),
        (VoltageSource, "V", ()),
        (CurrentSource, "I", ()),
        (Ground, None, ()),
    ],
    "translational": [
        (Mass, "m", ("initial_position", "initial_velocity")),
        (Spring, "c", ()),
        (Damper, "d", ()),
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
