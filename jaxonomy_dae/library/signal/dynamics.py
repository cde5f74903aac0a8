"""Linear blocks with memory: input `u`, output `y`."""

from collections.abc import Sequence

import numpy as np
import sympy
from numpy.typing import ArrayLike

from ...base.errors import ModelError
from ...write import POSITIVE, Component, Eq, EqnEnv, Value, der
from ..arguments import coefficients, count, finite, row, start_of


class Integrator(Component):
    """dy/dt = k·u, from `initial_y` at the start."""

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0, initial_y: Value = 0.0):
        super().__init__(ev, name)
        gain, y0 = self.parameter("k", k), self.parameter("initial_y", initial_y)
        u, y = self.input("u"), self.variable("y", start=y0, fixed=True)
        self.add_equations(Eq(der(y), gain * u))


class FirstOrder(Component):
    """T·dy/dt = k·u − y, `T` > 0 in second, from `initial_y` at the start."""

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0, T: Value = 1.0, initial_y: Value = 0.0):
        super().__init__(ev, name)
        gain, y0 = self.parameter("k", k), self.parameter("initial_y", initial_y)
        lag = self.parameter("T", T, unit="s", bounds=POSITIVE)
        u, y = self.input("u"), self.variable("y", start=y0, fixed=True)
        self.add_equations(Eq(lag * der(y), gain * u - y))


class SecondOrder(Component):
    """y''/w² + 2·zeta·y'/w + y = k·u, `w` > 0 in rad/s, with the damping ratio `zeta`, from rest at `initial_y`."""

    def __init__(
        self, ev: EqnEnv, name: str, k: Value = 1.0, w: Value = 1.0, zeta: Value = 1.0, initial_y: Value = 0.0
    ):
        super().__init__(ev, name)
        gain, y0 = self.parameter("k", k), self.parameter("initial_y", initial_y)
        frequency = self.parameter("w", w, unit="rad/s", bounds=POSITIVE)
        damping = self.parameter("zeta", zeta, unit="1")
        u, y = self.input("u"), self.variable("y", start=y0, fixed=True)
        v = self.variable("v", start=0.0, fixed=True)
        self.add_equations(Eq(der(y), v), Eq(der(v), frequency * (frequency * (gain * u - y) - 2 * damping * v)))


class DerivativeFilter(Component):
    """y = k·(u − x)/T with T·dx/dt = u − x: the derivative of `u`, filtered by a lag `T` > 0 (second).

    It starts at y = 0 unless `initial_x` is given.
    """

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0, T: Value = 0.01, initial_x: Value | None = None):
        super().__init__(ev, name)
        gain, lag = self.parameter("k", k), self.parameter("T", T, unit="s", bounds=POSITIVE)
        u = self.input("u")
        x = self.variable("x", **start_of(self, "initial_x", initial_x))
        y = self.variable("y", start=None if initial_x is not None else 0.0, fixed=initial_x is None)
        self.add_equations(Eq(y, gain * (u - x) / lag), Eq(lag * der(x), u - x))


class StateSpace(Component):
    """dx/dt = A·x + B·u, y = C·x + D·u, with numbers in the matrices.

    **Arguments:**

    - `A`, `B`, `C`, `D`: shapes (n, n), (n, m), (p, n), (p, m); `D` is zero if left out. With m = 1 the input is `u`,
        with p = 1 the output is `y`; else they are `u1`, `u2`, … and `y1`, `y2`, …
    - `initial_x`: shape (n,), zero if left out.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike | None = None,
        initial_x: Sequence[Value] | None = None,
    ):
        super().__init__(ev, name)
        a, b, c = (np.atleast_2d(finite(m, name, what)) for what, m in (("A", A), ("B", B), ("C", C)))
        n, m, p = a.shape[0], b.shape[1], c.shape[0]
        d = np.zeros((p, m)) if D is None else np.atleast_2d(finite(D, name, "D"))
        for what, matrix, shape in (
            ("A", a, (n, n)),
            ("B", b, (n, 1 if np.ndim(B) == 1 and n > 1 else m)),
            ("C", c, (p, n)),
            ("D", d, (p, m)),
        ):
            if matrix.shape != shape:
                column = ": one input's column is [[b1], [b2], …]" if what == "B" and np.ndim(B) == 1 else ""
                raise ModelError(f"'{name}': {what} has shape {matrix.shape}, expected {shape}{column}")
        starts = [0.0] * n if initial_x is None else row(initial_x, name, "initial_x")
        if len(starts) != n:
            raise ModelError(f"'{name}': initial_x has {len(starts)} entries, expected {n}")
        u = [self.input("u" if m == 1 else f"u{j}") for j in range(1, m + 1)]
        x0 = [self.parameter(f"initial_x{k}", start) for k, start in enumerate(starts, 1)]
        x = [self.variable(f"x{k}", start=start, fixed=True) for k, start in enumerate(x0, 1)]
        self.add_equations(*(Eq(der(x[k]), _row(a[k], x) + _row(b[k], u)) for k in range(n)))
        for k in range(p):
            self.output("y" if p == 1 else f"y{k + 1}", _row(c[k], x) + _row(d[k], u))


class TransferFunction(Component):
    """y = N(s)/D(s)·u, from rest, in controllable canonical form (Kailath 1980, section 2.1).

    `numerator` and `denominator` are coefficients of falling powers of s; the numerator's degree is at most the
    denominator's.
    """

    def __init__(self, ev: EqnEnv, name: str, numerator: ArrayLike, denominator: ArrayLike):
        super().__init__(ev, name)
        top = coefficients(numerator, name, "numerator")
        bottom = coefficients(denominator, name, "denominator")
        if not len(top):
            raise ModelError(f"'{name}': the numerator needs at least one coefficient; got none")
        if not len(bottom) or bottom[0] == 0.0:
            raise ModelError(f"'{name}': the first coefficient of the denominator must not be zero")
        if len(top) > len(bottom):
            raise ModelError(
                f"'{name}': the numerator's degree, {len(top) - 1}, is above the denominator's, {len(bottom) - 1}"
            )
        n = len(bottom) - 1
        a = bottom / bottom[0]
        b = np.concatenate([np.zeros(n + 1 - len(top)), top]) / bottom[0]
        u = self.input("u")
        x = [self.variable(f"x{k}", start=0.0, fixed=True) for k in range(1, n + 1)]
        for k in range(n - 1):
            self.add_equations(Eq(der(x[k]), x[k + 1]))
        if n:
            self.add_equations(Eq(der(x[-1]), u - _row(a[:0:-1], x)))
        self.output("y", b[0] * u + _row((b[1:] - b[0] * a[1:])[::-1], x))


class PadeDelay(Component):
    """u delayed by `T` > 0 seconds, as Padé's approximation of e^(−T·s) of order (n, n), from rest.

    At w·T = n the phase is off by 7 % for n = 1, 1.7 % for n = 2 and 0.2 % for n = 4, below that by less (coefficients:
    Golub & Van Loan 2013, section 9.3.1).
    """

    def __init__(self, ev: EqnEnv, name: str, T: Value = 1.0, n: int = 4):
        super().__init__(ev, name)
        n = count(n, name, "n")
        lag = self.parameter("T", T, unit="s", bounds=POSITIVE)
        # e^(−s) ≈ Σ cₖ·(−s)ᵏ / Σ cₖ·sᵏ; states in units of T: x[k] = Tᵏ·dᵏx/dtᵏ.
        c = [1.0]
        for k in range(1, n + 1):
            c.append(c[-1] * (n - k + 1) / (k * (2 * n - k + 1)))
        u = self.input("u")
        x = [self.variable(f"x{k}", start=0.0, fixed=True) for k in range(1, n + 1)]
        for k in range(n - 1):
            self.add_equations(Eq(lag * der(x[k]), x[k + 1]))
        top = (u - _row(np.array(c[:n]), x)) / c[n]  # the highest derivative
        self.add_equations(Eq(lag * der(x[-1]), top))
        signed = [ck * (-1) ** k for k, ck in enumerate(c)]
        self.output("y", _row(np.array(signed[:n]), x) + signed[n] * top)


def _row(numbers: np.ndarray, symbols: Sequence[sympy.Expr]) -> Value:
    return sum((float(k) * s for k, s in zip(numbers, symbols, strict=True) if k), 0)
