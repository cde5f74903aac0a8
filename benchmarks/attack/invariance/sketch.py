"""Models as data: declarations, equations and events in plain SymPy symbols, to be written in many ways.

A symbol `x` stands for a variable, parameter, input or discrete variable of this name, which is unique in the model;
`x'` for its derivative, `x''` for the second one, `pre(x)` for a discrete variable before an event, and `t` for time.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import sympy
from sympy import Expr, Symbol

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, assign, der, pre, reinit, terminate

T = Symbol("t")


def rate(x: Symbol) -> Symbol:
    """The symbol of the derivative of `x`."""
    return Symbol(f"{x.name}'")


def before(x: Symbol) -> Symbol:
    """The symbol of a discrete variable before an event."""
    return Symbol(f"pre({x.name})")


@dataclasses.dataclass(frozen=True)
class Declared:
    """`kind`: parameter, variable, discrete or input. `args`: keyword arguments of the method of that name; `start` and
    `value` may be expressions in parameters."""

    kind: str
    name: str
    args: Mapping[str, Any]

    @property
    def symbol(self) -> Symbol:
        return Symbol(self.name)


@dataclasses.dataclass(frozen=True)
class Happens:
    """An event: a condition, or a clock's `period` and `offset`; `actions`: (kind, target, value), of kind assign,
    reinit or terminate, whose target is then a text."""

    condition: Any
    actions: tuple[tuple[str, str, Expr], ...]
    period: Expr | None = None
    offset: Expr = sympy.S.Zero
    at_start: bool = False


@dataclasses.dataclass(frozen=True)
class Mode:
    """Branches of an equation, by `kind`, either or complementary: the arguments of the method of that name."""

    kind: str
    args: tuple[Any, ...]
    options: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Part:
    """One component."""

    name: str
    declared: tuple[Declared, ...]
    equations: tuple[Expr, ...]
    events: tuple[Happens, ...] = ()
    outputs: tuple[tuple[str, Expr], ...] = ()
    modes: tuple[Mode, ...] = ()


@dataclasses.dataclass(frozen=True)
class Sketch:
    """A model and how it is run.

    - `parts`, and `couplings`: equations of the component around them.
    - `inputs`: by name, what `simulate` is given. `end`: of a run.
    - `sizes`: by name, a variable's typical size where that is not 1.
    - `note`: what is in it. `strange`: whether something in it is unusual.
    """

    parts: tuple[Part, ...]
    couplings: tuple[Expr, ...]
    inputs: Mapping[str, Any]
    end: float
    sizes: Mapping[str, float]
    note: str
    strange: bool = False
    top: str = "top"

    def declared(self, *kinds: str) -> list[Declared]:
        """The declarations of these kinds, or all."""
        return [d for part in self.parts for d in part.declared if not kinds or d.kind in kinds]

    def names(self) -> dict[str, str]:
        """Full names in the system, by symbols' names."""
        return {d.name: f"{self.top}.{part.name}.{d.name}" for part in self.parts for d in part.declared}

    def variables(self) -> list[str]:
        """The unknowns."""
        return [d.name for d in self.declared("variable")]


def _conditions(expression: Any, symbols: Mapping[Symbol, Any]) -> Any:
    """The expression in other symbols; relations stay as they are written."""
    return sympy.sympify(expression).xreplace(symbols)


class _Whole(Component):
    def __init__(self, ev: EqnEnv, sketch: Sketch):
        super().__init__(ev, sketch.top)
        seen: dict[Symbol, Any] = {T: ev.t}
        for part in sketch.parts:
            child = _Written(ev, part)
            self.add(child)
            for d in part.declared:
                seen |= _symbols(child[d.name], d)
        self.add_equations(*(_conditions(e, seen) for e in sketch.couplings))


def _symbols(symbol: Any, d: Declared) -> dict[Symbol, Any]:
    if d.kind == "variable":
        first = der(symbol)
        return {d.symbol: symbol, rate(d.symbol): first, rate(rate(d.symbol)): der(first)}
    if d.kind == "discrete":
        return {d.symbol: symbol, before(d.symbol): pre(symbol)}
    return {d.symbol: symbol}


class _Written(Component):
    def __init__(self, ev: EqnEnv, part: Part):
        super().__init__(ev, part.name)
        seen: dict[Symbol, Any] = {T: ev.t}
        # What others' starts and values are made of comes first.
        order = {"parameter": 0, "discrete": 1, "input": 2, "variable": 3}
        waiting = sorted(part.declared, key=lambda d: order[d.kind])
        while waiting:
            d = next(d for d in waiting if not _needs(d) - set(seen))
            waiting.remove(d)
            args = {k: _conditions(v, seen) if isinstance(v, Expr) else v for k, v in d.args.items()}
            seen |= _symbols(getattr(self, d.kind)(d.name, **args), d)
        for name, value in part.outputs:
            self.output(name, _conditions(value, seen))
        self.add_equations(*(_conditions(e, seen) for e in part.equations))
        for mode in part.modes:
            getattr(self, mode.kind)(*(_conditions(a, seen) for a in mode.args), **mode.options)
        for event in part.events:
            if event.period is not None:
                condition = self.sampled(_conditions(event.period, seen), _conditions(event.offset, seen))
                self.when(condition, *self._actions(event, seen))
            else:
                self.when(_conditions(event.condition, seen), *self._actions(event, seen), at_start=event.at_start)

    def _actions(self, event: Happens, seen: Mapping[Symbol, Any]) -> Iterable[Any]:
        acts = {"assign": assign, "reinit": reinit}
        for kind, target, value in event.actions:
            yield (
                terminate(target) if kind == "terminate" else acts[kind](seen[Symbol(target)], _conditions(value, seen))
            )


def _needs(d: Declared) -> set[Symbol]:
    """Parameters that a declaration uses."""
    return {s for v in d.args.values() if isinstance(v, Expr) for s in v.free_symbols if isinstance(s, Symbol)}


def diagram_of(sketch: Sketch) -> tuple[EqnEnv, AcausalDiagram]:
    """The model as the package reads it."""
    ev = EqnEnv()
    return ev, AcausalDiagram().add(_Whole(ev, sketch))
