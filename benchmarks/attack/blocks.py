"""Blocks of nonlinear equations in units of 1e-18 to 1e12, read from points that are off.

Σⱼ Aᵢⱼ·f(xⱼ/uⱼ) = valᵢ·c for polynomials, sine and exponential f, with root x = u·root at c = 1 in closed form; every
equation is multiplied by a number of its own. What `observe` reads from any point must satisfy the equations, in
extended precision, or be not-a-number. Compiled with the units, `nominal` declared or not; and with other units, then
given these.
"""

import math
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, Component, EqnEnv, der
from jaxonomy_dae.errors import InitializationError, ModelError
from jaxonomy_dae.write import Eq

from .judge import CHEAP
from .outcome import Outcome

LARGE = np.longdouble
ALLOWED = 1e-11  # of the terms of an equation
VARIANTS = 6  # units for each structure
OFF = (0.0, 1e-9, 0.01, 0.1, 0.5)  # factors of the point are 1 ± so much; and zeros; and 1, whatever the unit
FORMS = (
    (lambda x: x, lambda x: x),
    (lambda x: x**2, lambda x: x**2),
    (sympy.sin, np.sin),
    (lambda x: x**3, lambda x: x**3),
    (sympy.exp, np.exp),
)


class Block(Component):
    """c' = −c, and the block; all numbers are parameters."""

    def __init__(self, ev, name, forms, a, root, units, rows, declared, guess):
        super().__init__(ev, name)
        n = len(root)
        c = self.variable("c", start=1.0, fixed=True)
        x, u = [], []
        for k in range(n):
            u.append(self.parameter(f"u{k}", units[k]))
            given: dict[str, Any] = {"nominal": units[k]} if declared else {}
            x.append(self.variable(f"x{k}", start=u[k] * self.parameter(f"g{k}", guess[k]), **given))
        self.add_equations(Eq(der(c), -c))
        for i in range(n):
            left = sum(self.parameter(f"a{i}_{j}", a[i, j]) * FORMS[forms[i, j]][0](x[j] / u[j]) for j in range(n))
            right = self.parameter(f"val{i}", value(a[i], forms[i], root)) * c
            self.add_equations(Eq(self.parameter(f"row{i}", rows[i]) * (left - right), 0))


def value(a: np.ndarray, forms: np.ndarray, root: np.ndarray) -> float:
    """Of an equation's left side at the root."""
    return float(sum(LARGE(c) * FORMS[f][1](LARGE(r)) for c, f, r in zip(a, forms, root, strict=True)))


def left_over(a: np.ndarray, forms: np.ndarray, values: Sequence[float], y: np.ndarray) -> float:
    """The largest residual at c = 1, in terms of its equation's terms; infinite where it has none."""
    worst = 0.0
    for i in range(len(a)):
        terms = [LARGE(c) * FORMS[f][1](LARGE(v)) for c, f, v in zip(a[i], forms[i], y, strict=True)]
        terms.append(-LARGE(values[i]))
        ratio = float(abs(sum(terms)) / sum(map(abs, terms)))
        worst = max(worst, ratio if math.isfinite(ratio) else math.inf)
    return worst


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """A structure, and one outcome for each of its systems."""
    rng = np.random.default_rng([seed, 16])
    n = int(rng.integers(1, 5))
    forms = rng.integers(0, len(FORMS), (n, n))
    a = rng.normal(size=(n, n)) + 2 * np.eye(n)
    root = rng.uniform(0.5, 1.5, n) * rng.choice([-1.0, 1.0], n)
    values = [value(a[i], forms[i], root) for i in range(n)]
    programs: dict[Any, Any] = {}
    outcomes = []
    base: AcausalSystem | None = None
    for _ in range(VARIANTS):
        alike = rng.random() < 0.5
        units = 10.0 ** (np.full(n, rng.uniform(-18, 12)) if alike else rng.uniform(-18, 12, n))
        rows, guess = 10.0 ** rng.uniform(-15, 15, n), root * rng.uniform(0.8, 1.2, n)
        systems: list[tuple[str, AcausalSystem]] = []
        for declared in (False, True):
            part = Block(EqnEnv(), "c", forms, a, root, units, rows, declared, guess)
            which = f"compiled, nominal {'' if declared else 'not '}declared"
            try:
                systems.append((which, AcausalCompiler(part.ev, AcausalDiagram().add(part))()))
            except ModelError as error:
                outcomes.append(Outcome("untrue", math.inf, f"{which}, units {units.tolist()}: {error}", 0.0))
        base = base or (systems[0][1] if systems else None)
        if base is None:
            continue
        given = {
            f"c.{name}{i}": float(v[i]) for name, v in (("u", units), ("g", guess), ("row", rows)) for i in range(n)
        }
        systems.append(("with_parameters", base.with_parameters(given)))
        for which, system in systems:
            start = time.process_time()
            kind, error, text = _judged(system, units, lambda y: left_over(a, forms, values, y), rng, programs)
            text = f"{which}, units {', '.join(f'{u:.1e}' for u in units)}: {text}"
            outcomes.append(Outcome(kind, error, text, time.process_time() - start))
    return f"{n} unknowns, forms {forms.tolist()}", outcomes


def _judged(system: AcausalSystem, units: np.ndarray, left, rng, programs) -> tuple[str, float, str]:
    """What becomes of the start and of points that are off."""
    names = [f"c.x{k}" for k in range(len(units))]
    try:
        x = system.initialize()
    except InitializationError as error:
        return "untrue", math.inf, f"the root is near the guess: {error}"
    factors = [np.where(rng.random(len(x)) < 0.5, 1 + d, 1 - d) for d in OFF]
    points = [np.asarray(x) * f for f in factors] + [np.zeros(len(x)), np.ones(len(x))]
    for point in points:
        point[: len(system.states)] = np.asarray(x)[: len(system.states)]
    z = jnp.asarray(np.array(points))
    arrays, static = eqx.partition(system, eqx.is_array)
    key = jax.tree.structure(arrays)
    if key not in programs:

        def read(arrays, z):
            return jax.vmap(lambda point: eqx.combine(arrays, static).observe(names, 0.0, point))(z)

        programs[key] = jax.jit(read).lower(arrays, z).compile(compiler_options=CHEAP)
    found = np.asarray(programs[key](arrays, z)) / units
    known = np.isfinite(found).all(axis=1)
    errors = [left(y) if ok else 0.0 for y, ok in zip(found, known, strict=True)]
    worst = int(np.argmax(errors))
    if errors[worst] > ALLOWED:
        where = (*(f"{d:g} off" for d in OFF), "zeros", "ones")[worst]
        return (
            "wrong",
            errors[worst] / ALLOWED,
            f"from {where}: x/u = {found[worst].tolist()}, {errors[worst]:.1e} left",
        )
    if not known[:2].all():
        return "untrue", math.inf, "not-a-number at the root"
    text = f"{int(known.sum())} of {len(known)} points"
    return ("right" if known.all() else "refused"), errors[worst] / ALLOWED, text
