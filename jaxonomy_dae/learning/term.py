"""Closed laws, linear combinations of terms in the place of a network: terms are functions of a block's inputs.

Terms are records that compare by what they say, so that two libraries that say the same share one compiled program.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import sympy
from jaxtyping import Array, Bool, Float

from ..expressions.from_sympy import read
from ..expressions.kernel import Kernel
from ..model.opaque import AbstractReplacement


class AbstractTerm(abc.ABC):
    """φ(u), of shape `(outputs,)`, for inputs u of shape `(inputs,)`."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The name of the term in reports."""

    @abc.abstractmethod
    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        """The values."""

    @abc.abstractmethod
    def expressions(self, symbols: tuple[sympy.Symbol, ...]) -> tuple[sympy.Expr, ...]:
        """The term of each output, in symbols of the inputs."""


@dataclasses.dataclass(frozen=True)
class Power(AbstractTerm):
    """|u|^(k−1) u: of one input its k-th power with its sign, of several a vector along them of length |u|^k."""

    exponent: int
    inputs: tuple[str, ...]

    @property
    def name(self) -> str:
        """Such as `v`, `v*|v|`, `v*|v|^2`; of several inputs in brackets, as a vector."""
        u = local_name(self.inputs[0]) if len(self.inputs) == 1 else f"[{', '.join(map(local_name, self.inputs))}]"
        tail = {1: "", 2: f"*|{u}|"}.get(self.exponent, f"*|{u}|^{self.exponent - 1}")
        return u + tail

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " inputs"]:
        if self.exponent == 1:
            return u
        # Even powers of the length are polynomials; of odd ones, the root's derivative at rest is left out, as it is
        # multiplied by zero.
        square = jnp.sum(u**2)
        half, odd = divmod(self.exponent - 1, 2)
        away = square > 0
        length = jnp.where(away, jnp.sqrt(jnp.where(away, square, 1.0)), 0.0)
        return square**half * (length if odd else 1.0) * u

    def expressions(self, symbols: tuple[sympy.Symbol, ...]) -> tuple[sympy.Expr, ...]:
        """In symbols of real numbers."""
        length = sympy.Abs(symbols[0]) if len(symbols) == 1 else sympy.sqrt(sympy.Add(*(s**2 for s in symbols)))
        return tuple(s * length ** (self.exponent - 1) for s in symbols)


@dataclasses.dataclass(frozen=True)
class Written(AbstractTerm):
    """Expressions for each output, in symbols for the inputs."""

    label: str
    symbols: tuple[sympy.Symbol, ...]
    written: tuple[sympy.Expr, ...]

    @property
    def name(self) -> str:
        """The text as the user wrote it."""
        return self.label

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        values = _kernel(self.symbols, self.written)(list(u))
        return jnp.stack([jnp.asarray(v, u.dtype) for v in values])

    def expressions(self, symbols: tuple[sympy.Symbol, ...]) -> tuple[sympy.Expr, ...]:
        """The expressions with other symbols in place of the term's own."""
        other = dict(zip(self.symbols, symbols, strict=True))
        written: tuple[Any, ...] = self.written  # SymPy says of nothing what it becomes
        return tuple(e.xreplace(other) for e in written)


@dataclasses.dataclass(frozen=True)
class OfFunction(AbstractTerm):
    """A function of scalars, `function(x, y, …)`, for one of several outputs or for all."""

    label: str
    function: Callable[..., Any]
    outputs: int
    output: int | None  # None: for all

    @property
    def name(self) -> str:
        """Its own, with the output that it is for where there are several."""
        return self.label if self.output is None else f"{self.label}[{self.output}]"

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        value = jnp.atleast_1d(jnp.asarray(self.function(*u), u.dtype))
        return value if self.output is None else jnp.zeros(self.outputs, u.dtype).at[self.output].set(value[0])

    def expressions(self, symbols: tuple[sympy.Symbol, ...]) -> tuple[sympy.Expr, ...]:
        """The term as an undefined function of SymPy."""
        if self.output is not None:
            whole = sympy.Function(self.label)(*symbols)
            return tuple(whole if k == self.output else sympy.Integer(0) for k in range(self.outputs))
        names = [self.label] if self.outputs == 1 else [f"{self.label}{k}" for k in range(self.outputs)]
        return tuple(sympy.Function(name)(*symbols) for name in names)


@functools.lru_cache(maxsize=256)
def _kernel(symbols: tuple[sympy.Symbol, ...], written: tuple[sympy.Expr, ...]) -> Kernel:
    return Kernel([read(e, lambda s: s) for e in written], symbols)


def local_name(name: str) -> str:
    """A variable's name in its component."""
    return name.rpartition(".")[2]


class ClosedForm(AbstractReplacement):
    """f(u) = Σ c·φ(u) over terms φ, of shape `(outputs,)`.

    - `coefficients`: c, trained.
    - `present`: the terms that count. It is an array and therefore an argument of compiled programs: another choice
        compiles nothing. Absent terms are evaluated at 1 rather than at u, where they may be infinite.
    """

    coefficients: Float[Array, " terms"]
    present: Bool[Array, " terms"]
    terms: tuple[AbstractTerm, ...] = eqx.field(static=True)

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        total = 0.0
        for k, term in enumerate(self.terms):
            value = term(jnp.where(self.present[k], u, jnp.ones_like(u)))
            total = total + self.coefficients[k] * jnp.where(self.present[k], value, jnp.zeros_like(value))
        return jnp.asarray(total)

    def chosen(self) -> "ClosedForm":
        """A copy without absent terms."""
        kept = np.flatnonzero(np.asarray(self.present))
        return ClosedForm(self.coefficients[kept], self.present[kept], tuple(self.terms[k] for k in kept))

    def expressions(self, *symbols: sympy.Symbol) -> tuple[sympy.Expr, ...]:
        """The law of each output in symbols of the inputs, for reading or for the equations of a component."""
        parts = [
            [sympy.Float(float(c)) * e for e in term.expressions(symbols)]
            for c, term, is_in in zip(self.coefficients, self.terms, np.asarray(self.present), strict=True)
            if is_in
        ]
        return tuple(sympy.Add(*column) for column in zip(*parts, strict=True))
