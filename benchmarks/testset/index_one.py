"""Index-1 equations M·dy/dt = F(t, y), M constant, for solvers of JAX, NumPy and CasADi.

A right side is a function `F(t, y, p, m)` of the time, the unknowns `y[0]`, `y[1]`, …, the parameters `p.name` and a
module `m` that has `exp`, `sin`, `cos`, `sqrt` and `pi` (jax.numpy, numpy, casadi or sympy); it returns one entry for
each equation.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import sympy


@dataclass(frozen=True)
class IndexOne:
    """M·dy/dt = F(t, y, p).

    - `mass`: shape `(n,)` for a diagonal, or `(n, n)`.
    - `names`: of the model's variables that the unknowns are, `"-name"` for the negative of one.
    - `linear`: whether the algebraic equations are linear in the algebraic unknowns; the ODE then has closed form.
    """

    right_side: Callable[[Any, Any, Any, Any], Any]
    mass: np.ndarray
    y0: np.ndarray
    parameters: Mapping[str, float]
    names: tuple[str, ...]
    linear: bool = True

    def __post_init__(self):
        assert len(self.names) == len(self.y0) == len(self.mass)

    # --- JAX: what a DAETerm takes -----------------------------------------------------------------------------

    def args(self) -> dict[str, Any]:
        """The parameters as arrays: the `args` of the functions below."""
        return {name: jnp.asarray(value, float) for name, value in self.parameters.items()}

    def F(self, t, y, args):
        """The right side for `DAETerm(F, mass=M)`: shape `(n,)`."""
        out = self.right_side(t, y, SimpleNamespace(**args), jnp)
        return jnp.stack([jnp.asarray(v, y.dtype) for v in out]) if isinstance(out, list | tuple) else out

    def split(self) -> int:
        """How many unknowns are differential, where M = diag(1, …, 1, 0, …, 0)."""
        n = int((self.mass != 0).sum()) if self.mass.ndim == 1 else -1
        if n < 0 or not np.array_equal(self.mass, np.arange(len(self.mass)) < n):
            raise ValueError("M is not diag(1, ..., 1, 0, ..., 0): there is no semi-explicit form")
        return n

    def f(self, t, x, z, args):
        """dx/dt for `DAETerm(f, g)`."""
        return self.F(t, jnp.concatenate([x, z]), args)[: self.split()]

    def g(self, t, x, z, args):
        """The algebraic residual for `DAETerm(f, g)`."""
        return self.F(t, jnp.concatenate([x, z]), args)[self.split() :]

    # --- NumPy and CasADi ---------------------------------------------------------------------------------------

    def numpy(self, t, y):
        """F in NumPy; `y` has shape `(n,)` or, for many points at once, `(n, k)`."""
        out = self.right_side(t, y, SimpleNamespace(**self.parameters), np)
        return np.stack([np.broadcast_to(v, y.shape[1:]) for v in out]) if isinstance(out, list | tuple) else out

    def casadi(self, t, y):
        """F as a CasADi expression of the column `y`."""
        import casadi

        out = self.right_side(t, y, SimpleNamespace(**self.parameters), casadi)
        return casadi.vertcat(*out) if isinstance(out, list | tuple) else out

    def matrix(self) -> np.ndarray:
        return np.diag(self.mass.astype(float)) if self.mass.ndim == 1 else self.mass

    def algebraics(self, t: float, x: np.ndarray) -> np.ndarray:
        """z of 0 = g(t, x, z), where g is linear in z: all columns of ∂g/∂z in one evaluation."""
        if not self.linear:
            raise ValueError("the algebraic equations are not linear in the algebraic unknowns")
        n = self.split()
        k = len(self.y0) - n
        points = np.zeros((n + k, k + 1))
        points[:n] = x[:, None]
        points[n:, 1:] = np.eye(k)
        g = self.numpy(t, points)[n:]
        return np.linalg.solve(g[:, 1:] - g[:, :1], -g[:, 0])

    def ode(self, t: float, x: np.ndarray) -> np.ndarray:
        """dx/dt with the algebraic unknowns eliminated."""
        return self.numpy(t, np.concatenate([x, self.algebraics(t, x)]))[: len(x)]

    def values(self, y: Any) -> dict[str, float]:
        """The values `y` by the model's names."""
        return {n.lstrip("-"): float(-v if n.startswith("-") else v) for n, v in zip(self.names, y, strict=True)}


def lambdified(expressions: list[sympy.Expr], t: sympy.Symbol, y: list[sympy.Symbol], p: SimpleNamespace) -> Callable:
    """A right side from SymPy expressions in the time, the unknowns and the parameters' symbols."""
    symbols = list(vars(p).values())
    cached: dict[str, Callable] = {}

    def right_side(time, values, parameters, m):
        if m.__name__ not in cached:
            target = {"numpy": "numpy", "jax.numpy": "jax"}.get(m.__name__, m)
            cached[m.__name__] = sympy.lambdify([t, *y, *symbols], expressions, modules=target, cse=True)
        given = [getattr(parameters, name) for name in vars(p)]
        return cached[m.__name__](time, *[values[k] for k in range(len(y))], *given)

    return right_side


def symbols_of(parameters: Mapping[str, float]) -> SimpleNamespace:
    """One SymPy symbol for each parameter."""
    return SimpleNamespace(**{name: sympy.Symbol(name, real=True) for name in parameters})


Kinetics = Callable[[Any, list, list, Any], tuple[sympy.Matrix, sympy.Matrix, sympy.Matrix]]


def mechanical(
    kinetics: Kinetics,
    parameters: Mapping[str, float],
    q0: list[float],
    v0: list[float],
    names: tuple[str, ...],
    *,
    accelerations: bool,
) -> IndexOne:
    """The index-1 form of M(q)·q'' = f − Gᵀλ, 0 = c(t, q), G = ∂c/∂q, by two differentiations of c.

    **Arguments:**

    - `kinetics`: `(t, q, v, p)` to the SymPy matrix M and the columns f, c.
    - `q0`, `v0`: positions and velocities at t = 0; the other unknowns follow.
    - `accelerations`: whether they are unknowns, (q, v, w, λ); otherwise M is diagonal and divided out, (q, v, λ).
    """
    n = len(q0)
    t, p = sympy.Symbol("t", real=True), symbols_of(parameters)
    q, v, w = ([sympy.Symbol(f"{kind}{k}", real=True) for k in range(n)] for kind in "qvw")
    mass, force, constraint = kinetics(t, q, v, p)
    lam = [sympy.Symbol(f"lam{k}", real=True) for k in range(len(constraint))]
    jacobian = constraint.jacobian(q)
    rest = force - jacobian.T * sympy.Matrix(lam)
    velocity = jacobian * sympy.Matrix(v) + constraint.diff(t)
    drift = velocity.jacobian(q) * sympy.Matrix(v) + velocity.diff(t)
    if accelerations:
        balance = mass * sympy.Matrix(w) - rest
        equations = [*v, *w, *balance, *(jacobian * sympy.Matrix(w) + drift)]
        unknowns = [*q, *v, *w, *lam]
    else:
        w_of = [rest[k] / mass[k, k] for k in range(n)]
        equations = [*v, *w_of, *(jacobian * sympy.Matrix(w_of) + drift)]
        unknowns = [*q, *v, *lam]
    diagonal = (np.arange(len(unknowns)) < 2 * n).astype(float)
    x0 = np.array([*q0, *v0], float)
    right_side = lambdified(equations, t, unknowns, p)
    unsolved = IndexOne(right_side, diagonal, np.zeros(len(unknowns)), parameters, names)
    return replace(unsolved, y0=np.concatenate([x0, unsolved.algebraics(0.0, x0)]))
