"""The same sketch written in another way."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from sympy import Expr, Symbol

from ..case import names as random_names
from .sketch import Declared, Happens, Part, Sketch, T, before, rate


def mapped(sketch: Sketch, change: Callable[[Part], Part], **others: Any) -> Sketch:
    """The sketch with each part changed, and other fields replaced."""
    return dataclasses.replace(sketch, parts=tuple(map(change, sketch.parts)), **others)


def reordered(sketch: Sketch, rng: np.random.Generator) -> Sketch:
    """Everything declared in another order. Events of one instant act in the order of their declaration where they
    write the same variable: those that share a target keep their order."""

    def shuffled(sequence: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(sequence[k] for k in rng.permutation(len(sequence)))

    def change(part: Part) -> Part:
        return dataclasses.replace(
            part,
            declared=shuffled(part.declared),
            equations=shuffled(part.equations),
            events=part.events if _share(part.events) else shuffled(part.events),
        )

    whole = mapped(sketch, change, couplings=shuffled(sketch.couplings))
    return dataclasses.replace(whole, parts=shuffled(whole.parts))


def _share(events: Sequence[Happens]) -> bool:
    """Whether two events write the same variable."""
    written = [target for event in events for kind, target, _ in event.actions if kind != "terminate"]
    return len(written) > len(set(written))


def _substituted(part: Part, symbols: Mapping[Symbol, Any], to: Callable[[str], str] = str) -> Part:
    """The part with other symbols, and names `to(old)`."""

    def other(value: Any) -> Any:
        return value.xreplace(symbols) if isinstance(value, sympy.Basic) else value

    events = tuple(
        dataclasses.replace(
            e,
            condition=other(e.condition),
            actions=tuple((k, t if k == "terminate" else to(t), other(v)) for k, t, v in e.actions),
            period=other(e.period),
            offset=other(e.offset),
        )
        for e in part.events
    )
    declared = tuple(Declared(d.kind, to(d.name), {k: other(v) for k, v in d.args.items()}) for d in part.declared)
    modes = tuple(
        dataclasses.replace(m, args=tuple(map(other, m.args)), options={k: other(v) for k, v in m.options.items()})
        for m in part.modes
    )
    return dataclasses.replace(
        part,
        modes=modes,
        declared=declared,
        equations=tuple(map(other, part.equations)),
        events=events,
        outputs=tuple((to(n), other(v)) for n, v in part.outputs),
    )


def renamed(sketch: Sketch, rng: np.random.Generator) -> tuple[Sketch, dict[str, str]]:
    """The sketch with other names of everything, and the new names by the old ones."""
    old = [d.name for d in sketch.declared()]
    fresh = random_names(rng, len(old) + len(sketch.parts) + 1)
    to = dict(zip(old, fresh, strict=False))
    parts = dict(zip((p.name for p in sketch.parts), fresh[len(old) :], strict=False))
    symbols: dict[Symbol, Any] = {}
    for a, b in to.items():
        x, y = Symbol(a), Symbol(b)
        symbols |= {x: y, rate(x): rate(y), rate(rate(x)): rate(rate(y)), before(x): before(y)}
    whole = mapped(
        sketch,
        lambda part: dataclasses.replace(_substituted(part, symbols, to.__getitem__), name=parts[part.name]),
        couplings=tuple(c.xreplace(symbols) for c in sketch.couplings),
        inputs={to[n]: v for n, v in sketch.inputs.items()},
        sizes={to[n]: v for n, v in sketch.sizes.items()},
        top=fresh[-1],
    )
    return whole, to


@dataclasses.dataclass(frozen=True)
class Units:
    """Old value = factor · new value, by name, and of time; factors of equations are drawn from `rng`."""

    factor: Mapping[str, float]
    time: float = 1.0


def random_units(rng: np.random.Generator, sketch: Sketch, low: float, high: float, time: bool) -> Units:
    """Factors between 10^low and 10^high for variables, inputs, discrete variables and parameters."""
    factor = {d.name: float(10 ** rng.uniform(low, high)) for d in sketch.declared()}
    return Units(factor, float(10 ** rng.uniform(-3, 3)) if time else 1.0)


def in_units(sketch: Sketch, units: Units, rng: np.random.Generator, nominal: bool) -> Sketch:
    """The sketch in other units, every equation multiplied by a number. With `nominal`, every variable says its typical
    size; else, those that did."""
    factor, tau = units.factor, units.time
    symbols: dict[Symbol, Any] = {T: tau * T}
    for d in sketch.declared():
        s, x = factor[d.name], d.symbol
        symbols |= {x: s * x, rate(x): s / tau * rate(x), before(x): s * before(x)}
        symbols[rate(rate(x))] = s / tau**2 * rate(rate(x))

    def declared(d: Declared) -> Declared:
        s = factor[d.name]
        args: dict[str, Any] = {}
        for key, value in d.args.items():
            if key == "bounds":
                args[key] = tuple(v / s for v in value)
            elif key in ("start", "value", "default", "nominal"):
                args[key] = value / s
            else:
                args[key] = value
        if nominal and d.kind == "variable":
            args["nominal"] = sketch.sizes.get(d.name, 1.0) / s
        return dataclasses.replace(d, args=args)

    def equation(e: Expr) -> Expr:
        return float(10 ** rng.uniform(-6, 6)) * e

    def change(part: Part) -> Part:
        new = _substituted(part, symbols)
        events = tuple(
            dataclasses.replace(
                e,
                actions=tuple((k, t, v if k == "terminate" else v / factor[t]) for k, t, v in e.actions),
                period=None if e.period is None else e.period / tau,
                offset=e.offset / tau,
            )
            for e in new.events
        )
        return dataclasses.replace(
            new,
            declared=tuple(map(declared, new.declared)),
            equations=tuple(map(equation, new.equations)),
            events=events,
        )

    inputs = {
        name: (value[0] / tau, value[1] / factor[name], *value[2:])
        if isinstance(value, tuple)
        else value / factor[name]
        for name, value in sketch.inputs.items()
    }
    return mapped(
        sketch,
        change,
        couplings=tuple(equation(c.xreplace(symbols)) for c in sketch.couplings),
        inputs=inputs,
        sizes={n: sketch.sizes.get(n, 1.0) / factor[n] for n in sketch.variables()},
        end=sketch.end / tau,
    )


def asked(sketch: Sketch, rng: np.random.Generator, what: str) -> Sketch:
    """The sketch with something more in it that changes nothing: an output, a derivative, an unused parameter, or an
    unused component."""
    if what == "component":
        k, x = Symbol("extra_k"), Symbol("extra_x")
        extra = Part(
            "extra",
            (
                Declared("parameter", k.name, {"value": 0.7}),
                Declared("variable", x.name, {"start": 0.4, "fixed": True}),
            ),
            (rate(x) + k * x,),
        )
        at = int(rng.integers(len(sketch.parts) + 1))
        return dataclasses.replace(sketch, parts=(*sketch.parts[:at], extra, *sketch.parts[at:]))
    chosen = int(rng.integers(len(sketch.parts)))

    def change(part: Part) -> Part:
        if part is not sketch.parts[chosen]:
            return part
        if what == "parameter":
            return dataclasses.replace(
                part, declared=(Declared("parameter", "extra_p", {"value": 3.5}), *part.declared)
            )
        variables = [d.symbol for d in part.declared if d.kind == "variable"]
        x = variables[int(rng.integers(len(variables)))]
        y = variables[int(rng.integers(len(variables)))]
        value = {"output": x * y + 2 * x, "derivative": rate(x), "linear": x - 2 * y}[what]
        return dataclasses.replace(part, outputs=(*part.outputs, ("extra_y", value)))

    return mapped(sketch, change)


ASKED = ("output", "linear", "derivative", "parameter", "component")


def with_values(sketch: Sketch, values: Mapping[str, float]) -> Sketch:
    """The sketch with other values of parameters that are numbers."""

    def change(part: Part) -> Part:
        return dataclasses.replace(
            part,
            declared=tuple(
                dataclasses.replace(d, args={**d.args, "value": values[d.name]}) if d.name in values else d
                for d in part.declared
            ),
        )

    return mapped(sketch, change)


def numbers(sketch: Sketch) -> dict[str, float]:
    """Parameters that are numbers, by name."""
    return {d.name: d.args["value"] for d in sketch.declared("parameter") if not isinstance(d.args["value"], Expr)}


def varied(sketch: Sketch, rng: np.random.Generator) -> dict[str, float]:
    """Other values of the parameters, some tens of per cent off."""
    return {name: round(value * float(rng.uniform(0.9, 1.1)), 6) for name, value in numbers(sketch).items()}
