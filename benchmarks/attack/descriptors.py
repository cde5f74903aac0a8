"""Linear descriptor systems E·y' = A·y + f(t) whose float coefficients are rank deficient, in Weierstrass form, mixed.

A regular pencil is equivalent to x' = J·x and N·z' = z + g(t) with N nilpotent (Weierstrass 1868; Kunkel & Mehrmann
2006, Theorem 2.7), so that z = −Σ Nⁱ·g⁽ⁱ⁾. Dense random factors left and right make E singular in its numbers only.
"""

import numpy as np
import sympy

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, der

from .case import TOLERANCE, Case, Expected, log_uniform, names

LARGE = np.longdouble


class Descriptor(Component):
    """Σ e·der(y) = Σ a·y + f for each row; numbers stand in the equations, or are parameters."""

    def __init__(self, ev, name, variables, order, e, a, f, as_parameters):
        super().__init__(ev, name)
        for k in order:
            self.variable(variables[k])
        y = [self[v] for v in variables]

        def number(label, value):
            return self.parameter(label, value) if as_parameters and value else value

        for r in range(len(f)):
            left = [number(f"e{r}_{k}", float(e[r, k])) * der(y[k]) for k in range(len(y))]
            right = [number(f"a{r}_{k}", float(a[r, k])) * y[k] for k in range(len(y))]
            self.add_equations(sympy.Add(*left) - sympy.Add(*right) - f[r])


def _mixer(rng, n, sparse):
    """A well-conditioned factor: orthogonal, or a product of a few elementary ones."""
    if not sparse:
        return np.linalg.qr(rng.normal(size=(n, n)))[0]
    out = np.eye(n)[rng.permutation(n)]
    for _ in range(n):
        i, j = rng.choice(n, 2, replace=False) if n > 1 else (0, 0)
        if i != j:
            out[i] += round(float(rng.uniform(-2, 2)), 1) * out[j]
    return out


def make(seed: int) -> Case:
    """2 to 7 unknowns of index 0 to 3."""
    rng = np.random.default_rng([seed, 8])
    d = int(rng.integers(0, 4))
    blocks = [int(rng.integers(1, 4)) for _ in range(int(rng.integers(0 if d > 1 else 1, 3)))]
    n = d + sum(blocks)
    if n < 2:
        return make(seed + 100_000)
    nilpotent = np.zeros((n - d, n - d))
    at = 0
    for k in blocks:
        nilpotent[at : at + k, at : at + k] = np.eye(k, k=1)
        at += k
    j = rng.uniform(-1, 1, (d, d))
    sparse = rng.random() < 0.5
    left, right = (_mixer(rng, n, sparse) for _ in range(2))
    if max(np.linalg.cond(left), np.linalg.cond(right)) > 1e3:
        return make(seed + 100_000)
    middle_e, middle_a = np.zeros((n, n)), np.zeros((n, n))
    middle_e[:d, :d], middle_e[d:, d:] = np.eye(d), nilpotent
    middle_a[:d, :d], middle_a[d:, d:] = j, np.eye(n - d)
    back = np.linalg.inv(right)
    e, a = left @ middle_e @ back, left @ middle_a @ back
    # Zeros are written as zeros: beside other units, a coefficient of 1e-17 would mean something.
    e, a = (np.where(np.abs(m) <= 1e-14 * np.max(np.abs(m), initial=0), 0.0, m) for m in (e, a))
    forced = rng.random() < 0.7
    amplitude = rng.uniform(-1, 1, n - d) if forced else np.zeros(n - d)
    slope = rng.uniform(-1, 1, n - d) if forced else np.zeros(n - d)
    w = log_uniform(rng, -0.5, 0.5)
    ev = EqnEnv()
    push = left[:, d:]  # f = left·(0, g), g = amplitude·cos(w·t) + slope·t
    if not sparse:  # rows and columns of other sizes
        rows, columns = (10.0 ** rng.integers(-3, 4, n) for _ in range(2))
        e, a, push = rows[:, None] * e * columns, rows[:, None] * a * columns, rows[:, None] * push
        right = right / columns[:, None]
    f = [
        sum(
            float(push[r, k]) * (float(amplitude[k]) * sympy.cos(w * ev.t) + float(slope[k]) * ev.t)
            for k in range(n - d)
        )
        for r in range(n)
    ]
    derivatives = [amplitude, slope, -amplitude * w**2, 0 * slope, amplitude * w**4]
    z, dz, power = np.zeros(n - d), np.zeros(n - d), np.eye(n - d)
    for i in range(3):
        z -= power @ derivatives[i]
        dz -= power @ derivatives[i + 1]
        power = power @ nilpotent
    x = rng.uniform(-1, 1, d)
    y, dy = right @ np.concatenate([x, z]), right @ np.concatenate([j @ x, dz])
    variables = names(rng, n)
    as_parameters = rng.random() < 0.3
    part = Descriptor(ev, "sys", variables, rng.permutation(n), e, a, f, as_parameters)
    # A rank that depends on parameters' values is named, not resolved: with other values the index is another.
    may_refuse = ["singular for .*, though not in general"] if as_parameters and blocks else []
    size = np.abs(right) @ np.abs(np.concatenate([x, z])) + 1e-3 * np.abs(right).sum(1)
    quick = np.abs(right) @ np.abs(np.concatenate([j @ x, dz])) + 1e-3 * np.abs(right).sum(1)
    expected = {f"sys.{v}": Expected(float(y[k]), TOLERANCE * size[k]) for k, v in enumerate(variables)}
    rates = {f"sys.{v}": Expected(float(dy[k]), TOLERANCE * quick[k]) for k, v in enumerate(variables)}
    initial = {f"sys.{v}": float(y[k]) for k, v in enumerate(variables)}
    note = f"{d} modes, blocks {blocks}, {'sparse' if sparse else 'dense'} factors"
    return Case(ev, AcausalDiagram().add(part), initial, expected, rates, freedom=d, note=note, may_refuse=may_refuse)
