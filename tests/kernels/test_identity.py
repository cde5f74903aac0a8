"""Which models share compiled programs: those of one structure, and no others.

Kind of defect: identity was a list kept by hand of what counts, which forgot the bounds of parameters, so that a model
ran the program of another; and a choice made from values was kept under what knows no values.
"""

import dataclasses
import inspect
import pickle
import types
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from sympy import Eq, Piecewise

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    Electrical,
    EqnEnv,
    NeuralDAEBlock,
    Thermal,
    assign,
    der,
    reinit,
    simulate,
    terminate,
)
from jaxonomy_dae.model.identity import Identity
from jaxonomy_dae.model.tables import Declared


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


LAW, OTHER = Law(np.array(0.5)), Law(np.array(0.7))


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


def ports(domain: Any, name: str = "p") -> Callable:
    def write(self):
        self.port(name, domain)
        x = self.variable("x", start=1.0, fixed=True)
        across = self["p.v" if domain is Electrical else "p.T"] if name == "p" else self["q.v"]
        self.add_equations(Eq(der(x), -x), Eq(across, x))

    return write


def array(shape: Any = 2, **changed: Any) -> Callable:
    class Cell(Component):
        def __init__(self, ev, name, k=1.0, start=1.0):
            super().__init__(ev, name)
            k, x = self.parameter("k", k), self.variable("x", start=start, fixed=True)
            self.add_equations(Eq(der(x), -k * x))

    return lambda self: self.add_array(changed.pop("name", "cell"), Cell, shape, **changed)


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
    "port.name": (pair(ports, Electrical, Two("p", "q")), STRUCTURE),
    "port.domain": (pair(ports, Two(Electrical, Thermal)), STRUCTURE),
    "learned.name": (pair(calls, "learned", Two("n", "m"), LAW, inputs=lambda s, self: [s.x]), STRUCTURE),
    "learned.network": (pair(calls, "learned", "n", Two(LAW, OTHER), inputs=lambda s, self: [s.x]), VALUE),
    "learned.inputs": (
        pair(calls, "learned", "n", LAW, inputs=Two(lambda s, self: [s.x], lambda s, self: [s.y])),
        STRUCTURE,
    ),
    "learned.outputs": (pair(calls, "learned", "n", LAW, outputs=Two(1, None), inputs=lambda s, self: [s.x]), NOTHING),
    "learned.kind": (pair(calls, "learned", "n", LAW, kind=Two(Law, None), inputs=lambda s, self: [s.x]), NOTHING),
    "function.name": (pair(calls, "function", Two("f", "g"), rising, inputs=lambda s, self: [s.x]), STRUCTURE),
    # A function without arrays is a leaf of the system without numbers: programs tell it apart.
    "function.function": (pair(calls, "function", "f", Two(rising, falling), inputs=lambda s, self: [s.x]), VALUE),
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
}
# What says nothing of one declaration: how parts are put together, and what reads names.
ELSEWHERE = {"add", "connect", "symbol", "outside_path", "add_equations"}


def arguments() -> Iterator[str]:
    """All arguments of all public declarations."""
    named = [(n, getattr(Component, n)) for n in dir(Component) if not n.startswith("_") and n not in ELSEWHERE]
    named += [(f.__name__, f) for f in (NeuralDAEBlock, AcausalCompiler, AcausalDiagram, reinit, assign, terminate)]
    for name, function in named:
        if callable(function):
            yield from (f"{name}.{p}" for p in inspect.signature(function).parameters)


def test_every_argument_of_every_declaration_is_tried():
    left_out = {"ev", "diagram", "self", "kind", "args"}
    wanted = {n for n in arguments() if n.partition(".")[2] not in left_out or n in ("learned.kind", "when.actions")}
    assert wanted <= set(PAIRS), sorted(wanted - set(PAIRS))


def built(given: Any):
    return model(given) if callable(given) else model(**({"write": plain} | given))


@pytest.mark.parametrize("name", PAIRS)
def test_models_share_programs_if_they_differ_in_values_alone(name):
    """Of two models that differ in one argument: plans are equal if it is a value, and differ if it is structure; an
    equal plan says the same of all that is static."""
    (one, other), kind = PAIRS[name]
    a, b, again = built(one), built(other), built(one)
    assert a.plan == again.plan and hash(a.plan) == hash(again.plan) and a.plan.digest == again.plan.digest
    assert jax.tree.structure(a) == jax.tree.structure(again)
    assert (a.plan == b.plan) == (kind != STRUCTURE)
    if kind == STRUCTURE:
        return
    numbers = [jax.tree.leaves((s.parameters, s.neural)) for s in (a, b)]
    same = all(p is q or np.array_equal(p, q) for p, q in zip(*numbers, strict=True))
    assert same == (kind == NOTHING)
    assert a.variables == b.variables and a.parameters.names == b.parameters.names


def parts(tree: Any, seen: dict[int, Any] | None = None) -> Iterator[Any]:
    """All objects that can be reached by attributes, items and closures."""
    seen = {} if seen is None else seen
    if id(tree) in seen or isinstance(tree, str | bytes | int | float | type(None) | type | types.ModuleType):
        return
    seen[id(tree)] = tree
    yield tree
    inside: list[Any] = []
    if isinstance(tree, dict):
        inside += [*tree, *tree.values()]
    elif isinstance(tree, list | tuple | set | frozenset):
        inside += tree
    elif isinstance(tree, types.FunctionType):
        inside += [c.cell_contents for c in tree.__closure__ or ()]
    elif isinstance(tree, types.MethodType | types.BuiltinMethodType):
        inside.append(tree.__self__)
    else:
        inside += vars(tree).values() if hasattr(tree, "__dict__") else ()
        inside += [getattr(tree, s, None) for k in type(tree).__mro__ for s in getattr(k, "__slots__", ())]
    for one in inside:
        yield from parts(one, seen)


@pytest.mark.parametrize("name", ["learned.network", "NeuralDAEBlock.theta", "when.actions", "add_array.kwargs"])
def test_no_attribute_of_a_plan_leads_to_a_value(name):
    """Plans held the values of parameters and the networks that a model was declared with, and caches held plans."""
    system = built(PAIRS[name][0][0])
    reached = list(parts(system.plan))
    assert len(reached) > 100
    assert not [p for p in reached if isinstance(p, Declared | Component | EqnEnv | jax.Array | Law)]


def test_a_type_that_nobody_thought_of_is_refused():
    """What is not known to the walk cannot be forgotten by it."""
    with pytest.raises(TypeError, match="it is not known what makes two objects of type"):
        Identity.of((1, iter([2])))

    @dataclasses.dataclass
    class Record:
        table: dict[str, Any]

    one, other = (Record({"a": [np.arange(3), v]}) for v in (1, 1.0))
    assert Identity.of(one) != Identity.of(other)
    assert Identity.of(one) == Identity.of(Record({"a": [np.arange(3), 1]}))
    assert Identity.of(["ab", "c"]) != Identity.of(["a", "bc"]) != Identity.of(("a", "bc"))
    assert Identity.of([rising]) != Identity.of([falling]) and Identity.of([rising, 1]) == Identity.of([rising, 1])


def test_identity_survives_a_file():
    for name in ("when.actions", "NeuralDAEBlock.network"):
        system = built(PAIRS[name][0][0])
        assert pickle.loads(pickle.dumps(system)).plan == system.plan


# --- by runs ---------------------------------------------------------------------------------------------------------


def decay(rate: float) -> Callable:
    def write(self):
        k, x = self.parameter("k", rate), self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * (x - 1)))

    return write


def told(system, z):
    """What one program says of a model and a number."""
    x = system.initialize()
    changed = system.constrain({"c.p": z}) if "c.p" in system.parameters else system
    return x, system.vector_field(0.0, x), system.typical_sizes, changed.parameters.array


@pytest.mark.parametrize(
    "name", ["parameter.bounds", "variable.start", "variable.nominal", "input.default", "discrete.start"]
)
def test_what_ran_before_changes_nothing(name):
    """A after B, and B after A, in one function compiled by `jax.jit`, say what each says alone."""
    models = [built(one) for one in PAIRS[name][0]]
    alone = [jax.jit(lambda s, z: told(s, z))(one, 1.5) for one in models]
    for order in ((0, 1), (1, 0)):
        shared = jax.jit(lambda s, z: told(s, z))
        for k in order:
            for got, wanted in zip(shared(models[k], 1.5), alone[k], strict=True):
                np.testing.assert_array_equal(got, wanted)


@pytest.mark.long("runs two programs of an explicit and an implicit solver")
def test_the_choice_of_a_solver_is_no_other_models():
    """The explicit solver that a slow model chose inside `jax.jit` was taken for a stiff one of equal structure, which
    failed after 16,384 steps."""
    slow, stiff = model(decay(1.0)), model(decay(1e6))
    assert slow.plan == stiff.plan
    run = jax.jit(lambda s: simulate(s, 1.0, ts=jnp.array([1.0]), initial={"c.x": 3.0})["c.x"][0])
    assert float(run(slow)) == pytest.approx(1 + 2 * np.exp(-1.0), rel=1e-4)
    assert float(run(stiff)) == pytest.approx(1.0, abs=1e-4)
    assert float(run(slow)) == pytest.approx(1 + 2 * np.exp(-1.0), rel=1e-4)
    other = model(decay(1.5))  # of the same decade
    assert jax.tree.structure(other) == jax.tree.structure(slow) != jax.tree.structure(stiff)
