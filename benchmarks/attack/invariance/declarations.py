"""Pairs of models that differ in one argument of one declaration: one pair, at least, for each argument of each.

`tests/kernels/test_identity.py` fails for an argument without a pair. Given is whether the argument is structure, a
value, or nothing that remains of it; letter a runs both models of each pair in processes of their own, and in one.
"""

import types
from collections.abc import Callable
from typing import Any

import equinox as eqx
import lineax as lx
import numpy as np
from sympy import Eq, Piecewise

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    AcausalSystem,
    Component,
    Electrical,
    EqnEnv,
    NeuralDAEBlock,
    Thermal,
    assign,
    der,
    reinit,
    terminate,
)


class Law(eqx.Module):
    weight: Any
    power: int = eqx.field(static=True, default=1)

    def __call__(self, u):
        return (self.weight * u[0] ** self.power)[None]


def first(t, u, theta):
    return theta[:1] * u[:1]


def second(t, u, theta):
    return theta[:1] + u[:1]


def rising(x):
    return x * x


def falling(x):
    return -x


def redefined(exponent: float) -> type:
    """Classes of one name, which a notebook's cell defines again."""

    class Again(eqx.Module):
        weight: Any

        def __call__(self, u):
            return (self.weight * abs(u[0]) ** exponent)[None]

    return Again


def again(factor: float) -> Callable:
    """Functions of one name."""

    def law(x):
        return factor * x

    return law


LAW, OTHER = Law(np.array(0.5)), Law(np.array(0.7))
HALF, TWICE = redefined(0.5)(np.array(0.5)), redefined(2.0)(np.array(0.5))


def model(write: Callable, block: Callable | None = None, diagram_name: str | None = None, **compiler: Any):
    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            write(self)

    ev, diagram = EqnEnv(), AcausalDiagram(diagram_name)
    part = Written(ev, "c")
    diagram.add(part)
    if block is not None:
        diagram.add_neural_correction_block(block(part))
    return AcausalCompiler(ev, diagram, **compiler)()


def calls(name: str, *given: Any, **named: Any) -> Callable:
    """A decaying x, and what one declaration says beside it."""

    def write(self):
        x = self.variable("x", start=1.0, fixed=True)
        y = self.variable("y", start=1.0)
        d = self.discrete("d", 0.0)
        k = self.parameter("k", 1.0)
        self.add_equations(Eq(der(x), -k * x), Eq(der(y), -y))
        symbols = {"x": x, "y": y, "d": d, "k": k, "slope": der(y), "t": self.ev.t}

        def read(value):
            is_lambda = getattr(value, "__name__", "") == "<lambda>"
            return value(types.SimpleNamespace(**symbols), self) if is_lambda else value

        found = getattr(self, name)(*map(read, given), **{n: read(v) for n, v in named.items()})
        if name in ("parameter", "variable", "input", "learned", "function"):
            term = found[0] if isinstance(found, tuple) else found
            if name == "variable":
                self.add_equations(Eq(der(term), -term))
            else:
                z = self.variable("z", start=0.0, fixed=True)
                self.add_equations(Eq(der(z), term - z))
        elif name == "vector":
            self.add_equations(*(Eq(der(v), -v) for v in found))
        elif name == "relation":
            w = self.variable("w")
            self.add_equations(Eq(w, self["x"] * 1))

    return write


def event(**changed: Any) -> Callable:
    """x falls; at a level, something happens."""

    def write(self):
        x = self.variable("x", start=1.0, fixed=True)
        d, e = self.discrete("d", 0.0), self.discrete("e", 1.0)
        self.add_equations(Eq(der(x), -x + 0 * d + 0 * e))
        actions = {"reinit": reinit(x, 1.0), "assign": assign(d, 1.0), "other": assign(d, 2.0), "where": assign(e, 1.0),
                   "up": reinit(x, 2.0), "stop": terminate("a"), "end": terminate("b")}  # fmt: skip
        on = changed.get("on")
        self.when(
            changed.get("condition", lambda x: x <= 0.5)(x), actions[changed.get("actions", "assign")],
            on=None if on is None else on(d), at_start=changed.get("at_start", False),
        )  # fmt: skip

    return write


def clock(period: Any = 0.5, offset: Any = 0.0) -> Callable:
    def write(self):
        x, d = self.variable("x", start=1.0, fixed=True), self.discrete("d", 0.0)
        self.add_equations(Eq(der(x), d - x))
        self.when(self.sampled(period, offset), assign(d, x))

    return write


def branches(order: int = 0, mode: int = 1, swapped: bool = False) -> Callable:
    def write(self):
        x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        f, d = self.variable("f"), self.discrete("d", 0.0)
        self.add_equations(Eq(der(x), v), Eq(der(v), f - x))
        then, otherwise = (v if order else f - 1), f
        self.either(Eq(d, mode), *((otherwise, then) if swapped else (then, otherwise)), order=order)

    return write


def gap(**changed: Any) -> Callable:
    def write(self):
        x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        f = self.variable("f")
        self.add_equations(Eq(der(x), v), Eq(der(v), f - 1))
        given = {"gap": lambda x, f: x, "force": lambda x, f: f, "order": 2} | changed
        self.complementary(given.pop("gap")(x, f), given.pop("force")(x, f), **given)

    return write


def account(name: str, factor: float) -> Callable:
    def write(self):
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x))
        getattr(self, name)(factor * x**2)

    return write


def relation(level: float) -> Callable:
    def write(self):
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x + Piecewise((1, self.relation(x > level)), (0, True))))

    return write


def ports(domain: Any, name: str = "p", **given: Any) -> Callable:
    def write(self):
        self.port(name, domain, **given)
        x = self.variable("x", start=1.0, fixed=True)
        across = self["p.v" if domain is Electrical else "p.T"] if name == "p" else self["q.v"]
        self.add_equations(Eq(der(x), -x), Eq(across, x))

    return write


def tree(root: int = 0, a: int = 0, b: int = 2) -> Callable:
    def write(self):
        joined = [self.port(name, Electrical) for name in "pqr"]
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x), *(Eq(self[f"{name}.v"], x) for name in "pqr"))
        self.declare_root(joined[root])
        self.declare_branch(joined[a], joined[b])

    return write


def slides(surface: float = 1.0, above: float = 1.0, below: float = 1.0, **given: Any) -> Callable:
    def write(self):
        x, u = self.variable("x", start=1.0, fixed=True), self.variable("u")
        self.add_equations(Eq(der(x), -u))
        self.sliding(surface * x, u - above, u + below, **given)

    return write


def switch(value: Callable = lambda x: x < 0.5, place: int = 0) -> Callable:
    """A discrete variable that an equation determines, beside another one that nothing changes."""

    def write(self):
        x, both = self.variable("x", start=1.0, fixed=True), [self.discrete("on"), self.discrete("other")]
        self.add_equations(Eq(der(x), -x * (1 + sum(both))))
        self.discrete_equation(both[place], value(x))

    return write


def array(shape: Any = 2, **changed: Any) -> Callable:
    class Cell(Component):
        def __init__(self, ev, name, k=1.0, start=1.0):
            super().__init__(ev, name)
            k, x = self.parameter("k", k), self.variable("x", start=start, fixed=True)
            self.add_equations(Eq(der(x), -k * x))

    more = {key: value for key, value in changed.items() if key != "name"}
    return lambda self: self.add_array(changed.get("name", "cell"), Cell, shape, **more)


def outputs(name: str = "o", factor: float = 2.0, unit: str = "") -> Callable:
    def write(self):
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x))
        self.output(name, factor * x, unit=unit)

    return write


def plain(self):
    calls("parameter", "p", 1.0)(self)


def corrected(**changed: Any) -> dict[str, Any]:
    given = {"network": first, "theta": np.array([0.5]), "targets": "x", "inputs": ["x"], "name": "net"} | changed

    def block(part):
        targets = [(part, given["targets"])]
        inputs = None if given["inputs"] is None else [(part, n) for n in given["inputs"]]
        kept = {k: v for k, v in given.items() if k not in ("targets", "inputs", "network")}
        return NeuralDAEBlock(given["network"], **kept, targets=targets, inputs=inputs)

    return {"write": plain, "block": block, "state_selection": "dummy_derivatives"}


def pair(call: Callable, *given: Any, **named: Any):
    """Two models of one call, of which the argument that is a `Two` has two values."""

    def made(which: int):
        def chosen(v):
            return v[which] if isinstance(v, Two) else v

        return call(*map(chosen, given), **{n: chosen(v) for n, v in named.items()})

    return made(0), made(1)


class Two(tuple):
    """Two values of an argument."""

    def __new__(cls, first: Any, second: Any):
        return super().__new__(cls, (first, second))


X = lambda s, self: s.x  # noqa: E731
Y = lambda s, self: s.y  # noqa: E731
SLOPE = lambda s, self: s.slope  # noqa: E731
STATE = lambda s, self: s.x  # noqa: E731

# For each argument of each public declaration, two models that differ in it alone, and whether that is structure, a
# value (then one program serves both), or nothing that remains (a check).
STRUCTURE, VALUE, NOTHING = "structure", "value", "nothing"
PAIRS: dict[str, tuple[tuple[Any, Any], str]] = {
    "parameter.name": (pair(calls, "parameter", Two("p", "q"), 1.0), STRUCTURE),
    "parameter.value": (pair(calls, "parameter", "p", Two(1.0, 2.0)), VALUE),
    "parameter.unit": (pair(calls, "parameter", "p", 1.0, unit=Two("m", "km")), STRUCTURE),
    "parameter.bounds": (pair(calls, "parameter", "p", 1.0, bounds=Two((0.0, 2.0), (0.0, 20.0))), STRUCTURE),
    "variable.name": (pair(calls, "variable", Two("u", "w"), 1.0), STRUCTURE),
    "variable.start": (pair(calls, "variable", "u", Two(1.0, 2.0)), STRUCTURE),
    "variable.fixed": (pair(calls, "variable", "u", 1.0, fixed=Two(False, True)), STRUCTURE),
    "variable.nominal": (pair(calls, "variable", "u", 1.0, nominal=Two(1.0, None)), STRUCTURE),
    "variable.unit": (pair(calls, "variable", "u", 1.0, unit=Two("m", "km")), STRUCTURE),
    "variable.bounds": (pair(calls, "variable", "u", 1.0, bounds=Two((0.0, 2.0), (0.0, 9.0))), STRUCTURE),
    "vector.name": (pair(calls, "vector", Two("u", "w"), 2, 1.0), STRUCTURE),
    "vector.count": (pair(calls, "vector", "u", Two(2, 3), 1.0), STRUCTURE),
    "vector.start": (pair(calls, "vector", "u", 2, Two(1.0, 2.0)), STRUCTURE),
    "vector.fixed": (pair(calls, "vector", "u", 2, 1.0, fixed=Two(False, True)), STRUCTURE),
    "vector.nominal": (pair(calls, "vector", "u", 2, 1.0, nominal=Two(1.0, 2.0)), STRUCTURE),
    "vector.unit": (pair(calls, "vector", "u", 2, 1.0, unit=Two("m", "km")), STRUCTURE),
    "vector.bounds": (pair(calls, "vector", "u", 2, 1.0, bounds=Two((0.0, 2.0), (0.0, 9.0))), STRUCTURE),
    "start.derivative": (pair(calls, "start", Two(SLOPE, lambda s, self: der(s.x)), 1.0), STRUCTURE),
    "start.value": (pair(calls, "start", SLOPE, Two(1.0, 2.0)), STRUCTURE),
    "initially.equations": (
        pair(calls, "initially", Two(lambda s, self: Eq(s.y, 1), lambda s, self: Eq(s.y, s.x))),
        STRUCTURE,
    ),
    "start.fixed": (pair(calls, "start", SLOPE, 1.0, fixed=Two(False, True)), STRUCTURE),
    "input.name": (pair(calls, "input", Two("u", "w"), 1.0), STRUCTURE),
    "input.default": (pair(calls, "input", "u", Two(1.0, 2.0)), STRUCTURE),
    "input.unit": (pair(calls, "input", "u", 1.0, unit=Two("m", "km")), STRUCTURE),
    "output.name": (pair(outputs, Two("o", "w")), STRUCTURE),
    "output.expr": (pair(outputs, "o", Two(2.0, 3.0)), STRUCTURE),
    "output.unit": (pair(outputs, "o", 2.0, unit=Two("m", "km")), STRUCTURE),
    "delayed.name": (pair(calls, "delayed", Two("u", "w"), STATE, 0.5), STRUCTURE),
    "delayed.expression": (pair(calls, "delayed", "u", Two(STATE, lambda s, self: s.y), 0.5), STRUCTURE),
    "delayed.time": (pair(calls, "delayed", "u", STATE, Two(0.5, 0.25)), STRUCTURE),
    "delayed.longest": (pair(calls, "delayed", "u", STATE, 0.5, longest=Two(1.0, 2.0)), STRUCTURE),
    "delayed.unit": (pair(calls, "delayed", "u", STATE, 0.5, unit=Two("m", "km")), STRUCTURE),
    "port.name": (pair(ports, Electrical, Two("p", "q")), STRUCTURE),
    "port.domain": (pair(ports, Two(Electrical, Thermal)), STRUCTURE),
    "port.nominal": (pair(ports, Electrical, nominal=Two({"i": 1.0}, {"i": 1e-3})), STRUCTURE),
    "declare_root.port": (pair(tree, root=Two(0, 1)), NOTHING),  # nothing is connected here
    "declare_branch.a": (pair(tree, a=Two(0, 1)), NOTHING),
    "declare_branch.b": (pair(tree, b=Two(2, 1)), NOTHING),
    "discrete_equation.variable": (pair(switch, place=Two(0, 1)), STRUCTURE),
    "discrete_equation.value": (pair(switch, Two(lambda x: x < 0.5, lambda x: x > 0.5)), STRUCTURE),
    "sliding.surface": (pair(slides, surface=Two(1.0, 2.0)), STRUCTURE),
    "sliding.above": (pair(slides, above=Two(1.0, 2.0)), STRUCTURE),
    "sliding.below": (pair(slides, below=Two(1.0, 2.0)), STRUCTURE),
    "sliding.name": (pair(slides, name=Two("side", "mode")), STRUCTURE),
    "learned.name": (pair(calls, "learned", Two("n", "m"), LAW, inputs=lambda s, self: [s.x]), STRUCTURE),
    "learned.network": (pair(calls, "learned", "n", Two(LAW, OTHER), inputs=lambda s, self: [s.x]), VALUE),
    # Networks' classes are told apart as nodes of JAX's trees, whatever they are called.
    "learned.network's class": (pair(calls, "learned", "n", Two(HALF, TWICE), inputs=lambda s, self: [s.x]), VALUE),
    "learned.inputs": (
        pair(calls, "learned", "n", LAW, inputs=Two(lambda s, self: [s.x], lambda s, self: [s.y])),
        STRUCTURE,
    ),
    "learned.outputs": (pair(calls, "learned", "n", LAW, outputs=Two(1, None), inputs=lambda s, self: [s.x]), NOTHING),
    "learned.kind": (pair(calls, "learned", "n", LAW, kind=Two(Law, None), inputs=lambda s, self: [s.x]), NOTHING),
    "function.name": (pair(calls, "function", Two("f", "g"), rising, inputs=lambda s, self: [s.x]), STRUCTURE),
    # A function without arrays is a leaf of the system without numbers: programs tell it apart.
    "function.function": (pair(calls, "function", "f", Two(rising, falling), inputs=lambda s, self: [s.x]), VALUE),
    "function.function's body": (
        pair(calls, "function", "f", Two(again(0.5), again(2.0)), inputs=lambda s, self: [s.x]),
        VALUE,
    ),
    "function.inputs": (
        pair(calls, "function", "f", rising, inputs=Two(lambda s, self: [s.x], lambda s, self: [s.y])),
        STRUCTURE,
    ),
    "function.outputs": (
        pair(calls, "function", "f", rising, outputs=Two(1, None), inputs=lambda s, self: [s.x]),
        NOTHING,
    ),
    "discrete.name": (pair(calls, "discrete", Two("q", "r"), 1.0), STRUCTURE),
    "discrete.start": (pair(calls, "discrete", "q", Two(1.0, 2.0)), VALUE),
    "discrete.unit": (pair(calls, "discrete", "q", 1.0, unit=Two("m", "km")), STRUCTURE),
    "sampled.period": (pair(clock, Two(0.5, 0.25)), STRUCTURE),
    "sampled.offset": (pair(clock, 0.5, Two(0.0, 0.1)), STRUCTURE),
    "when.condition": (pair(event, condition=Two(lambda x: x <= 0.5, lambda x: x < 0.5)), STRUCTURE),
    "when.condition's level": (pair(event, condition=Two(lambda x: x <= 0.5, lambda x: x <= 0.4)), STRUCTURE),
    "when.actions": (pair(event, actions=Two("assign", "reinit")), STRUCTURE),
    "when.on": (pair(event, on=Two(lambda d: Eq(d, 0), lambda d: Eq(d, 1))), STRUCTURE),
    "when.at_start": (pair(event, at_start=Two(False, True)), STRUCTURE),
    "reinit.value": (pair(event, actions=Two("reinit", "up")), STRUCTURE),
    "reinit.variable": (pair(event, actions=Two("reinit", "assign")), STRUCTURE),
    "assign.value": (pair(event, actions=Two("assign", "other")), STRUCTURE),
    "assign.variable": (pair(event, actions=Two("assign", "where")), STRUCTURE),
    "terminate.message": (pair(event, actions=Two("stop", "end")), STRUCTURE),
    "relation.condition": (pair(relation, Two(0.5, 0.6)), STRUCTURE),
    "either.mode": (pair(branches, 0, Two(1, 0)), STRUCTURE),
    "either.then": (pair(branches, 0, swapped=Two(False, True)), STRUCTURE),
    "either.otherwise": (pair(branches, 0, swapped=Two(True, False)), STRUCTURE),
    "either.order": (pair(branches, Two(0, 1)), STRUCTURE),
    "complementary.gap": (pair(gap, gap=Two(lambda x, f: x, lambda x, f: 2 * x)), STRUCTURE),
    "complementary.force": (pair(gap, force=Two(lambda x, f: f, lambda x, f: 2 * f)), STRUCTURE),
    "complementary.name": (pair(gap, name=Two("active", "closed")), STRUCTURE),
    "complementary.order": (
        (gap(order=0, gap=lambda x, f: x + f), gap(order=2)),
        STRUCTURE,
    ),
    "complementary.restitution": (pair(gap, restitution=Two(0.5, 0.6)), STRUCTURE),
    "complementary.rest_speed": (pair(gap, restitution=0.5, rest_speed=Two(0.0, 0.1)), STRUCTURE),
    "complementary.clearance": (pair(gap, clearance=Two(1e-9, 1e-6)), STRUCTURE),
    "complementary.start": (pair(gap, start=Two(0, 1)), VALUE),
    "declare_energy.expressions": (pair(account, "declare_energy", Two(1.0, 2.0)), STRUCTURE),
    "declare_dissipation.expressions": (pair(account, "declare_dissipation", Two(1.0, 2.0)), STRUCTURE),
    "declare_supply.expressions": (pair(account, "declare_supply", Two(1.0, 2.0)), STRUCTURE),
    "add_array.name": (pair(array, name=Two("cell", "part")), STRUCTURE),
    "add_array.shape": (pair(array, Two(2, 3)), STRUCTURE),
    "add_array.kwargs": (pair(array, 2, k=Two(1.0, np.array([1.0, 2.0]))), VALUE),
    "NeuralDAEBlock.network": (pair(corrected, network=Two(first, second)), STRUCTURE),
    "NeuralDAEBlock.theta": (pair(corrected, theta=Two(np.array([0.5]), np.array([0.7]))), VALUE),
    "NeuralDAEBlock.targets": (pair(corrected, targets=Two("x", "y")), STRUCTURE),
    "NeuralDAEBlock.inputs": (pair(corrected, inputs=Two(["x"], ["y"])), STRUCTURE),
    "NeuralDAEBlock.name": (pair(corrected, name=Two("net", "drag")), STRUCTURE),
    "NeuralDAEBlock.inject": (pair(corrected, inject=Two("equation", "row")), STRUCTURE),
    "NeuralDAEBlock.kind": (
        pair(corrected, network=LAW, theta=None, kind=Two(None, Law)),
        NOTHING,
    ),
    "AcausalDiagram.name": (({"diagram_name": "a"}, {"diagram_name": "b"}), STRUCTURE),
    "AcausalCompiler.state_selection": (({}, {"state_selection": "projection"}), STRUCTURE),
    "AcausalCompiler.prefer_states": (({}, {"prefer_states": ("c.z",)}), NOTHING),
    "AcausalCompiler.linear_solver": (
        ({"linear_solver": lx.GMRES(1e-8, 1e-8)}, {"linear_solver": lx.GMRES(1e-6, 1e-8)}),
        STRUCTURE,
    ),
    "AcausalCompiler.check_units": (({}, {"check_units": False}), NOTHING),
    "AcausalCompiler.passes": (({}, {"passes": (lambda flat: flat,)}), NOTHING),
}


def built(given: Any) -> AcausalSystem:
    """The compiled model of one side of a pair."""
    return model(given) if callable(given) else model(**({"write": plain} | given))
