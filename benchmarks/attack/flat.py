"""Flat and tangent guards: conditions that meet zero with the slope zero, or turn back just before or behind it.

Guards are those of `events`, in another expression of the same sign: their cubes, multiplied by any number, with a
little of themselves. To these come levels that a state just reaches or just misses. The reference watches the plain
guard.
"""

import dataclasses

import numpy as np
import sympy
from sympy import Abs, Symbol

from .case import Case
from .events import Style, case_of, drawn
from .hybrid import Delicate, HybridSystem, Limits, Reference, Rule

# A level that is reached by 3e-5 is crossed at a rate of some 0.005; 1e-9 of a state shift that instant by 2e-7.
FINE = Limits(crossing=2e-3, near=1e-5, looks=2000)


class Bent(Style):
    """Guards of the same sign that are flat where they are zero, or of any size."""

    def guard(self, guard, rng: np.random.Generator):
        forms = (
            guard**3, guard**5, guard * Abs(guard), (guard / 10) ** 3, guard**3 + sympy.Float(1e-9) * guard,
            guard**3 * (2 + sympy.sin(guard)), sympy.tanh(guard) ** 3, 1e-9 * guard, 1e9 * guard, guard,
        )  # fmt: skip
        return forms[int(rng.integers(len(forms)))]


def _tangent(rng: np.random.Generator, system: HybridSystem, end: float) -> HybridSystem:
    """The system with a level that one of its states just reaches, or just misses, and a count of that."""
    found = Reference(system).run(end)
    begin, sol, *_ = found.segments[int(rng.integers(len(found.segments)))]
    times = np.linspace(begin, min(sol.t_max, end), 4001)[1:-1]
    x = sol(times)
    tops = [
        (k, sign, sign * x[k][j])
        for k in range(len(x))
        for sign in (1.0, -1.0)
        for j in np.flatnonzero((sign * x[k][1:-1] > sign * x[k][:-2]) & (sign * x[k][1:-1] > sign * x[k][2:])) + 1
    ]
    if not tops:
        raise Delicate("no state turns back")
    k, sign, top = tops[int(rng.integers(len(tops)))]
    apart = float(rng.choice([-1.0, 1.0])) * 10 ** float(rng.uniform(-4.5, -2))
    n, symbol = Symbol("touched"), list(system.states)[k]
    rule = Rule(sympy.Float(top + apart) - sign * symbol, {n: n + 1})
    return dataclasses.replace(system, discretes={**system.discretes, n: 0.0}, rules=[*system.rules, rule])


def make(seed: int) -> Case:
    """One to seven states with one to five events; what two methods need not agree about is drawn again."""
    rng = np.random.default_rng([seed, 21])
    while True:
        system, end = drawn(rng)
        if not 1 <= len(system.rules) + len(system.clocks) + len(system.relations) <= 4:
            continue
        try:
            if rng.random() < 0.6:
                system = _tangent(rng, system, end)
            return case_of(rng, system, end, Bent(), FINE)
        except Delicate:
            continue
