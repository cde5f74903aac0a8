"""`with_parameters(p)` beside a fresh compilation with p, where coefficients are switches and signs of parameters.

A model is E(p)·y' + A(p)·y = b with entries such as Abs(p), sign(p), Max(p, 0), Heaviside(p − 3/4), p·q or p − q: with
other values the rank of E is another, and so is what the states are. It is compiled with one p, and given others: a
system must find the solution, or refuse, or give not-a-number, whatever it was compiled with. The solution, and how
many states it has, are those of the linear equations at p (`linear_dae.py`).
"""

import dataclasses
import math
import time
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, Component, EqnEnv, der
from jaxonomy_dae.errors import InitializationError, ModelError

from .judge import CHEAP
from .linear_dae import Flow, NoUniqueSolution, flow
from .linear_network import ORDER
from .outcome import Outcome

VARIANTS = 24  # values of the parameters for each structure
VALUES = (0.0, 0.0, 1.0, 1.0, -1.0, 2.0, -0.5, 0.5, 0.25, 3.0)
ENTRIES = (
    lambda p, q: p,
    lambda p, q: sympy.Abs(p),
    lambda p, q: sympy.sign(p),
    lambda p, q: sympy.Max(p, 0),
    lambda p, q: sympy.Min(p, 1),
    lambda p, q: sympy.Piecewise((1, p > sympy.Rational(1, 2)), (0, True)),
    lambda p, q: sympy.Piecewise((p, p < 1), (1, True)),
    lambda p, q: sympy.Heaviside(p - sympy.Rational(3, 4)),
    lambda p, q: p * q,
    lambda p, q: p - q,
    lambda p, q: p**2,
    lambda p, q: 1 + p,
)
WORDS = ("singular", "determine", "depend", "contradict", "vanish", "no consistent", "follow")
ALLOWED = 1e-9  # of the terms of an equation


@dataclasses.dataclass(frozen=True)
class Structure:
    """Entries of E and A as expressions in the parameters p0, p1, …; b; and what is given at the start."""

    e: list[dict[int, sympy.Expr]]
    a: list[dict[int, sympy.Expr]]
    b: list[float]
    starts: list[float]
    parameters: tuple[sympy.Symbol, ...]

    def numbers(self, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """E and A at values of the parameters."""
        at = {p: sympy.Rational(values[p.name]) for p in self.parameters}
        out = np.zeros((2, len(self.e), len(self.e)))
        for matrix, table in zip(out, (self.e, self.a), strict=True):
            for i, row in enumerate(table):
                for k, entry in row.items():
                    matrix[i, k] = float(entry.subs(at))
        return out[0], out[1]


class Switched(Component):
    """The equations of a structure."""

    def __init__(self, ev, name, of: Structure, values: dict[str, float]):
        super().__init__(ev, name)
        p = {q: self.parameter(q.name, values[q.name]) for q in of.parameters}
        y = [self.variable(f"y{k}", start=s) for k, s in enumerate(of.starts)]
        for e, a, b in zip(of.e, of.a, of.b, strict=True):
            terms = [c.xreplace(p) * der(y[k]) for k, c in e.items()]
            terms += [c.xreplace(p) * y[k] for k, c in a.items()]
            self.add_equations(sympy.Add(*terms) - b)


def structure(rng: np.random.Generator) -> Structure:
    """Two to four equations, one or two parameters; differences that cancel for some of their values."""
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    p = sympy.symbols(f"p:{m}")

    def entry():
        if rng.random() < 0.5:
            return sympy.Integer(int(rng.choice([-1, 1, 1, 2])))
        form = ENTRIES[int(rng.integers(len(ENTRIES)))]
        first, second = p[int(rng.integers(m))], p[int(rng.integers(m))]
        found = form(first, second)
        return found if found != 0 else first

    e: list[dict[int, sympy.Expr]] = []
    a: list[dict[int, sympy.Expr]] = []
    for i in range(n):
        if rng.random() < 0.25 and i:
            e.append({})
        else:
            others = rng.choice(n, int(rng.integers(0, 2)), replace=False).tolist()
            e.append({int(k): entry() for k in {i, *others}})
        ends = {i, *rng.choice(n, int(rng.integers(0, 3)), replace=False).tolist()}
        a.append({int(k): entry() for k in ends})
    if n > 1 and rng.random() < 0.5:  # a pair whose rates cancel for a value of a switch
        e[1] = {k: -c if rng.random() < 0.5 else -c * entry() for k, c in e[0].items()}
    b = rng.choice([0.0, 0.5, 1.0, -2.0], n).tolist()
    return Structure(e, a, b, rng.choice([0.5, 1.0, -1.5, 2.0], n).tolist(), p)


@dataclasses.dataclass(frozen=True)
class Found:
    """What a system says at the start: y, and y' where that is a state's; or why it refuses."""

    states: tuple[str, ...] = ()
    y: np.ndarray | None = None
    dy: np.ndarray | None = None
    refusal: str = ""


class _Programs:
    """Of one structure: `y` and the states' slopes at the start, compiled once for each plan."""

    def __init__(self, n: int):
        self.n = n
        self.programs: dict[Any, Any] = {}

    def __call__(self, system: AcausalSystem, initial: Mapping[str, float]) -> Found:
        states = tuple(system.states)
        try:
            x = system.initialize(initial={n: jnp.asarray(v) for n, v in initial.items()})
        except InitializationError as error:
            return Found(states, refusal=f"{type(error).__name__}: {error}")
        arrays, static = eqx.partition(system, eqx.is_array)
        key = jax.tree.structure(arrays)
        if key not in self.programs:
            names = [f"c.y{k}" for k in range(self.n)]

            def both(arrays, x):
                whole = eqx.combine(arrays, static)
                return whole.observe(names, 0.0, x), whole.vector_field(0.0, x)

            self.programs[key] = jax.jit(both).lower(arrays, x).compile(compiler_options=CHEAP)
        y, rates = self.programs[key](arrays, x)
        dy = np.full(self.n, np.nan)
        for name, rate in zip(states, np.asarray(rates).tolist(), strict=False):
            sign, bare = (-1.0, name[1:]) if name.startswith("-") else (1.0, name)
            dy[int(bare.removeprefix("c.y"))] = sign * rate
        return Found(states, np.asarray(y), dy)


def _fault(found: Found, at: Flow | None) -> str:
    """What is wrong with numbers, beside the solution: nothing, if it is refused or not-a-number."""
    if found.y is None or found.dy is None or not np.isfinite(found.y).all():
        return ""
    rates = {int(name.lstrip("-").removeprefix("c.y")) for name in found.states}
    if not all(np.isfinite(found.dy[k]) for k in rates):
        return ""
    if at is None:
        return f"y = {found.y.tolist()}, where there is no unique solution"
    if len(found.states) != len(at.free):
        return f"{len(found.states)} states instead of {len(at.free)}"
    free = found.y[at.free]
    true, slopes = at.y0 + at.P @ free, at.d0 + at.Q @ free
    size = 1.0 + np.max(np.abs(at.P) @ np.abs(free) + np.abs(at.y0))
    quick = 1.0 + np.max(np.abs(at.Q) @ np.abs(free) + np.abs(at.d0))
    if not np.max(np.abs(found.y - true)) <= ALLOWED * size:
        return f"y = {found.y.tolist()}, true {true.astype(float).tolist()}"
    off = [k for k in rates if at.dy_known[k] and not abs(found.dy[k] - slopes[k]) <= ALLOWED * quick]
    return f"der(y{off[0]}) = {found.dy[off[0]]}, true {float(slopes[off[0]])}" if off else ""


def _said(found: Found) -> str:
    if found.refusal:
        return "refused"
    assert found.y is not None and found.dy is not None
    rates = [int(name.lstrip("-").removeprefix("c.y")) for name in found.states]
    return "numbers" if np.isfinite([*found.y, *found.dy[rates]]).all() else "nan"


def compared(fresh: Found, kept: Found, same_plan: bool, at: Flow | None) -> tuple[str, str]:
    """The kind of the outcome, and why: of the system that is compiled with p, and of the one that is given p."""
    for which, found in (("compiled with them", fresh), ("with_parameters", kept)):
        fault = _fault(found, at)
        if fault:
            return "wrong", f"{which}: {fault}"
    said = _said(fresh), _said(kept)
    text = f"compiled with them: {said[0]}, with_parameters: {said[1]}. {fresh.refusal or kept.refusal}"
    refusals = [f.refusal for f in (fresh, kept) if f.refusal]
    if any(not any(word in refusal for word in WORDS) for refusal in refusals):
        return "untrue", text
    if same_plan and said[0] != said[1]:
        return "wrong", text
    if said == ("numbers", "numbers"):
        return "right", text
    if said[0] == "nan" and said[1] != "refused" and at is not None:
        return "untrue", text
    return "refused", text


def _shown(table: list[dict[int, sympy.Expr]]) -> str:
    return "; ".join(", ".join(f"{k}: {c}" for k, c in row.items()) for row in table)


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """A structure, and one outcome for each draw of its parameters."""
    rng = np.random.default_rng([seed, 15])
    of = structure(rng)
    names = [p.name for p in of.parameters]
    drawn = [{n: float(rng.choice(VALUES)) for n in names} for _ in range(VARIANTS)]
    programs = _Programs(len(of.e))
    base: AcausalSystem | None = None
    systems: list[AcausalSystem | str] = []
    for values in drawn:
        ev = EqnEnv()
        try:
            systems.append(AcausalCompiler(ev, AcausalDiagram().add(Switched(ev, "c", of, values)))())
        except ModelError as error:
            systems.append(f"{type(error).__name__}: {error}")
    base = next((s for s in systems if isinstance(s, AcausalSystem)), None)
    note = f"E = {_shown(of.e)}, A = {_shown(of.a)}"
    outcomes = []
    for values, system in zip(drawn, systems, strict=True):
        start = time.process_time()
        e, a = of.numbers(values)
        forcing = np.zeros((ORDER + 1, len(e)))
        forcing[0] = of.b
        try:
            at = flow(e, a, forcing, list(range(len(e))), ORDER)
        except NoUniqueSolution:
            at = None
        initial = {f"c.y{k}": of.starts[k] for k in (at.free if at is not None else ())}
        if isinstance(system, str):
            fresh = Found(refusal=system)
        else:
            fresh = programs(system, initial)
        kept = programs(base.with_parameters({f"c.{n}": v for n, v in values.items()}), initial) if base else fresh
        same = base is not None and not isinstance(system, str) and system.plan == base.plan
        kind, text = compared(fresh, kept, same, at)
        text = f"{values}: {text}"
        outcomes.append(Outcome(kind, 0.0 if kind == "right" else math.inf, text, time.process_time() - start))
    return note, outcomes
