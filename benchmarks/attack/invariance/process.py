"""Letter a: in a process of its own, or after twins that differ in one argument of one declaration.

Programs are cached by what they are made from; what is forgotten there serves the wrong model. Everything that is said
of a model must be what a fresh process says, to the last bit.
"""

import contextlib
import dataclasses
import functools
import multiprocessing
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import sympy
from sympy import Expr, Float

from .drawing import draw
from .rewrite import mapped, numbers
from .sketch import Declared, Happens, Part, Sketch

TWINS = 4  # of each model


def _other(d: Declared, rng: np.random.Generator) -> tuple[str, Mapping[str, Any]] | None:
    """One argument of a declaration, and what it becomes."""
    args = dict(d.args)
    choices: list[tuple[str, dict[str, Any]]] = [("unit", {"unit": str(rng.choice(["m", "kg", "mm"]))})]
    if d.kind == "parameter":
        value = args["value"]
        choices += [("bounds", {"bounds": (-50.0, 50.0 + 100 * float(rng.random()))})]
        if not isinstance(value, Expr):
            choices += [("bounds", {"bounds": (value - 1.0, value + 1.5)})]
            choices += [("value", {"value": value * float(rng.choice([1.25, 1e3]))})] * ("bounds" not in args)
    if d.kind == "variable":
        choices += [("nominal", {"nominal": float(10 ** rng.uniform(-4, 4))}), ("bounds", {"bounds": (-1e3, 1e3)})]
        if "start" in args:
            choices += [("start", {"start": args["start"] * 1.25}), ("fixed", {"fixed": not args.get("fixed", False)})]
    if d.kind == "input":
        choices += [("default", {"default": args["default"] + 1.0})] * 3
    if d.kind == "discrete":
        choices += [("start", {"start": args["start"] + 0.5})]
    what, change = choices[int(rng.integers(len(choices)))]
    return f"{what} of {d.kind} {d.name}", args | change


def _with_other_number(e: Any, rng: np.random.Generator) -> Any:
    """The expression with one of its literal numbers changed; None if it has none."""
    literals = sorted(sympy.sympify(e).atoms(Float), key=float)
    if not literals:
        return None
    chosen = literals[int(rng.integers(len(literals)))]
    return e.xreplace({chosen: Float(1.125 * float(chosen))})


def twin(sketch: Sketch, rng: np.random.Generator) -> tuple[Sketch, str]:
    """The sketch with something declared otherwise, and what."""
    while True:
        at = int(rng.integers(len(sketch.parts)))
        part = sketch.parts[at]
        kind = rng.random()
        if kind < 0.7:
            k = int(rng.integers(len(part.declared)))
            what, args = _other(part.declared[k], rng)  # pyright: ignore[reportGeneralTypeIssues]
            declared = (*part.declared[:k], dataclasses.replace(part.declared[k], args=args), *part.declared[k + 1 :])
            other = dataclasses.replace(part, declared=declared)
        elif kind < 0.85 or not part.events:
            k = int(rng.integers(len(part.equations)))
            changed = _with_other_number(part.equations[k], rng)
            if changed is None:
                continue
            what = f"a number in equation {k}"
            other = dataclasses.replace(part, equations=(*part.equations[:k], changed, *part.equations[k + 1 :]))
        else:
            k = int(rng.integers(len(part.events)))
            found = _other_event(part.events[k], rng)
            if found is None:
                continue
            what = f"event {k}"
            other = dataclasses.replace(part, events=(*part.events[:k], found, *part.events[k + 1 :]))

        def change(p: Part, part: Part = part, other: Part = other) -> Part:
            return other if p is part else p

        return mapped(sketch, change), what


def _other_event(event: Happens, rng: np.random.Generator) -> Happens | None:
    if event.period is None:
        changed = _with_other_number(event.condition, rng)
        return None if changed is None else dataclasses.replace(event, condition=changed)
    return dataclasses.replace(event, period=event.period * Float(1.125))


def models(number: int) -> tuple[list[Sketch], list[str]]:
    """A model and its twins, and what is different in each."""
    rng = np.random.default_rng([number, 23])
    sketch = draw(rng, most=2)
    found, what = [sketch], ["the model"]
    for _ in range(TWINS):
        other, difference = twin(sketch, rng)
        found.append(other)
        what.append(difference)
    return found, what


@functools.cache
def _programs():
    """Jitted functions of a system, one of each in a process: JAX tells twins apart by what they are made of."""
    import equinox as eqx

    from jaxonomy_dae import simulate

    @eqx.filter_jit
    def point(system, x, names):
        return system.observe(list(names), 0.0, x), system.vector_field(0.0, x)

    @eqx.filter_jit
    def run(system, ts, names, kinds, inputs):
        inputs = {n: (*v, *dict(kinds)[n]) if isinstance(v, tuple) else v for n, v in inputs.items()}
        solution = simulate(system, ts[-1], ts=ts, inputs=inputs)
        return [solution[n] for n in names], solution.result

    @eqx.filter_jit
    def bounded(system, names):
        free = system.unconstrain(*names)
        return [free[n] for n in names], system.constrain(free).parameters.values

    return point, run, bounded


@dataclasses.dataclass(frozen=True)
class Asked:
    """A model that a process makes, and what it is asked: values of `names` (all, if None), bounds of the parameters
    `free`, and runs with these inputs to `end`."""

    make: Callable[[], Any]
    end: float
    names: tuple[str, ...] | None = None
    free: tuple[str, ...] | None = None
    inputs: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def asked_of(sketch: Sketch) -> Asked:
    """What is asked of a sketch."""
    from .said import compiled, inputs_of, variables_of

    free = tuple(sketch.names()[n] for n in numbers(sketch))
    names = tuple(variables_of(sketch).values())
    return Asked(lambda: compiled(sketch), sketch.end, names, free, inputs_of(sketch))


def everything(asked: Asked, running: bool) -> dict[str, Any]:
    """What is said of a model: texts, and numbers in hexadecimal; a refusal is a text."""
    from jaxonomy_dae import simulate

    from .said import REFUSALS

    out: dict[str, Any] = {}

    def tell(what: str, values: Any) -> None:
        try:
            found = values()
            out[what] = found if isinstance(found, str) else [float(v).hex() for v in np.ravel(np.asarray(found))]
        except REFUSALS as error:
            out[what] = f"{type(error).__name__}: {error}"

    try:
        system = asked.make()
    except REFUSALS as error:
        return {"compiled": f"{type(error).__name__}: {error}"}
    point, run, bounded = _programs()
    names = (*system.variables, *system.discretes) if asked.names is None else asked.names
    variables = tuple(n for n in names if n in system.variables)
    tell("report", lambda: str(system.report))
    tell("parameters", lambda: system.parameters.values)
    tell("typical sizes", lambda: system.typical_sizes)
    tell("start", system.initialize)
    tell("report of the start", lambda: str(system.initialization_report()))
    x = None
    if not isinstance(out["start"], str):
        x = system.initialize()
        tell("variables and slopes", lambda: np.concatenate(point(system, x, variables)))
    free = tuple(system.parameters.names) if asked.free is None else asked.free
    if free:
        tell("free numbers", lambda: np.concatenate([np.ravel(a) for a in bounded(system, free)]))
    if running and x is not None:
        ts = np.linspace(0.2, 1.0, 5) * asked.end
        kinds = tuple((n, v[2:]) for n, v in asked.inputs.items() if isinstance(v, tuple))
        arrays = {n: v[:2] if isinstance(v, tuple) else v for n, v in asked.inputs.items()}

        def eager():
            solution = simulate(system, asked.end, ts=ts, inputs=asked.inputs)
            tell("what a run says", lambda: repr(solution))
            for account in (solution.energy, solution.dissipation, solution.supply):
                tell(account.__name__, account)
            return np.stack([np.asarray(solution[n]) for n in names])

        def inside():
            values, result = run(system, ts, names, kinds, arrays)
            return np.append(np.stack(values), float(np.asarray(result._value)))

        tell("run", eager)
        tell("run inside jit", inside)
    return out


def asked_for(number: int) -> tuple[str, list[Asked], list[str]]:
    """What model it is, what processes are asked of it and its twins, and what is different in each; of every third
    number, of a pair that differs in one argument of one declaration."""
    if number % 3:
        found, what = models(number)
        return found[0].note, [asked_of(sketch) for sketch in found], what
    from .declarations import PAIRS, built

    name = list(PAIRS)[number // 3 % len(PAIRS)]
    sides, _ = PAIRS[name]
    return name, [Asked(functools.partial(built, side), 1.0) for side in sides], ["one side", "the other side"]


def in_order(number: int, order: tuple[int, ...], running: bool, fault: int | None) -> list[dict[str, Any]]:
    """What is said of a model and its twins, one after the other; with a deliberate fault, if one is given."""
    _, found, _ = asked_for(number)
    with contextlib.ExitStack() as stack:
        if fault is not None:
            from .planted import FAULTS, planted

            stack.enter_context(planted(FAULTS[fault]))
        return [everything(found[k], running) for k in order]


def _fresh_processes():
    """A pool whose processes have imported everything, and run one task each."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.attack.invariance.process", "jaxonomy_dae.learning"])
    return context.Pool(1, maxtasksperchild=1)


def process(number: int, planted: int | None = None):
    """Letter a; with the deliberate fault number `planted`."""
    from .said import Pairs

    note, found, what = asked_for(number)
    running = number % 3 == 0 or number % 2 == 0
    pairs = Pairs("a", note)
    count = len(found)

    orders = (tuple(range(count)), tuple(reversed(range(count))))
    with _fresh_processes() as pool:

        def ask(order: tuple[int, ...]) -> list[dict[str, Any]]:
            return pool.apply(in_order, (number, order, running, planted))

        alone = [ask((k,))[0] for k in range(count)]
        together = [ask(order) for order in orders]
    for order, told_of in zip(orders, together, strict=True):
        for k, told in zip(order, told_of, strict=True):
            faults = [
                f"{key}: {told.get(key)!r:.200}, alone {alone[k][key]!r:.200}"
                for key in alone[k]
                if told.get(key) != alone[k][key]
            ]
            refused = any(isinstance(alone[k].get(key), str) for key in ("compiled", "start", "run"))
            text = "; ".join(faults) or str(alone[k].get("start"))[:100]
            pairs.add(f"{what[k]}, in order {order}", np.inf if faults else 0.0, text, refused)
    return pairs
