"""Closed laws, linear combinations of terms in the place of a network: terms are functions of a block's inputs, and
some of numbers inside them, such as v_s in exp(−(v/v_s)²).

Terms are records that compare by what they say, so that two libraries that say the same share one compiled program.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import sympy
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..base.aliases import Expression, Numeric
from ..compile.model.opaque import AbstractReplacement
from ..graph.expressions.from_sympy import read
from ..graph.expressions.kernel import Kernel


@dataclasses.dataclass(frozen=True)
class Inner:
    """A number inside terms, to be found with the coefficients: its name, and the range in which it is looked for; None
    if it is positive, with a range that follows from what the experiments explored."""

    name: str
    range: tuple[float, float] | None = None

    @property
    def is_log(self) -> bool:
        """True if it is positive, and searched by its logarithm."""
        return self.range is None or self.range[0] > 0

    def scaled(self, values: tuple[float, float]) -> np.ndarray:
        """Values on the scale of the search."""
        return np.log(values) if self.is_log else np.asarray(values)

    def natural(self, x: Numeric) -> Numeric:
        """The values that numbers on this scale stand for."""
        return jnp.exp(x) if self.is_log else x


class AbstractTerm(abc.ABC):
    """φ(u), of shape `(outputs,)`, for inputs u of shape `(inputs,)`."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The name of the term in reports."""

    @property
    def inner(self) -> tuple[Inner, ...]:
        """The numbers inside the term."""
        return ()

    @abc.abstractmethod
    def __call__(self, u: Float[Array, " inputs"], *inner: Float[Array, ""]) -> Float[Array, " outputs"]:
        """The values, for these numbers inside."""

    @abc.abstractmethod
    def expressions(self, symbols: tuple[sympy.Symbol, ...], *inner: sympy.Expr) -> tuple[sympy.Expr, ...]:
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

    def __call__(self, u: Float[Array, " inputs"], *inner: Float[Array, ""]) -> Float[Array, " inputs"]:
        if self.exponent == 1:
            return u
        # Even powers of the length are polynomials; of odd ones, the root's derivative at rest is left out, as it is
        # multiplied by zero.
        square = jnp.sum(u**2)
        half, odd = divmod(self.exponent - 1, 2)
        away = square > 0
        length = jnp.where(away, jnp.sqrt(jnp.where(away, square, 1.0)), 0.0)
        return square**half * (length if odd else 1.0) * u

    def expressions(self, symbols: tuple[sympy.Symbol, ...], *inner: sympy.Expr) -> tuple[sympy.Expr, ...]:
        """In symbols of real numbers."""
        length = sympy.Abs(symbols[0]) if len(symbols) == 1 else sympy.sqrt(sympy.Add(*(s**2 for s in symbols)))
        return tuple(s * length ** (self.exponent - 1) for s in symbols)


@dataclasses.dataclass(frozen=True)
class Written(AbstractTerm):
    """Expressions for each output, in symbols for the inputs, and after them for the numbers inside."""

    label: str
    symbols: tuple[sympy.Symbol, ...]
    written: tuple[sympy.Expr, ...]
    numbers: tuple[Inner, ...] = ()

    @property
    def name(self) -> str:
        """The text as the user wrote it."""
        return self.label

    @property
    def inner(self) -> tuple[Inner, ...]:
        """The free symbols of the expressions."""
        return self.numbers

    def __call__(self, u: Float[Array, " inputs"], *inner: Float[Array, ""]) -> Float[Array, " outputs"]:
        values = _kernel(self.symbols, self.written)([*u, *inner])
        return jnp.stack([jnp.asarray(v, u.dtype) for v in values])

    def expressions(self, symbols: tuple[sympy.Symbol, ...], *inner: sympy.Expr) -> tuple[sympy.Expr, ...]:
        """The expressions with other symbols in place of the term's own."""
        other = dict(zip(self.symbols, (*symbols, *inner), strict=True))
        written: tuple[Expression, ...] = self.written  # SymPy says of nothing what it becomes
        return tuple(e.xreplace(other) for e in written)


@dataclasses.dataclass(frozen=True)
class OfFunction(AbstractTerm):
    """A function of scalars, `function(x, y, …)`, for one of several outputs or for all."""

    label: str
    function: Callable[..., ArrayLike]
    outputs: int
    output: int | None  # None: for all

    @property
    def name(self) -> str:
        """Its own, with the output that it is for where there are several."""
        return self.label if self.output is None else f"{self.label}[{self.output}]"

    def __call__(self, u: Float[Array, " inputs"], *inner: Float[Array, ""]) -> Float[Array, " outputs"]:
        value = jnp.atleast_1d(jnp.asarray(self.function(*u), u.dtype))
        return value if self.output is None else jnp.zeros(self.outputs, u.dtype).at[self.output].set(value[0])

    def expressions(self, symbols: tuple[sympy.Symbol, ...], *inner: sympy.Expr) -> tuple[sympy.Expr, ...]:
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


def inner_of(terms: Sequence[AbstractTerm]) -> tuple[Inner, ...]:
    """The numbers inside terms, each once: what has one name in several is one number."""
    return tuple(dict.fromkeys(one for term in terms for one in term.inner))


class ClosedForm(AbstractReplacement):
    """f(u) = Σ c·φ(u) over terms φ, of shape `(outputs,)`.

    - `coefficients`: c, trained.
    - `present`: the terms that count. It is an array and therefore an argument of compiled programs: another choice
        compiles nothing. Absent terms are evaluated at 1 rather than at u, where they may be infinite.
    - `inner`: the numbers inside the terms, trained; positive ones as logarithms. `numbers` has their values.
    """

    coefficients: Float[Array, " terms"]
    present: Bool[Array, " terms"]
    terms: tuple[AbstractTerm, ...] = eqx.field(static=True)
    inner: Float[Array, " inner"] = eqx.field(default_factory=lambda: jnp.zeros(0))

    @property
    def numbers(self) -> dict[str, Numeric]:
        """The numbers inside the terms, by name."""
        return {one.name: one.natural(x) for one, x in zip(inner_of(self.terms), self.inner, strict=True)}

    def features(self, u: Float[Array, " inputs"]) -> Float[Array, "outputs terms"]:
        """The terms that count; the others are zero."""
        numbers, columns = self.numbers, []
        for k, term in enumerate(self.terms):
            inner = [jnp.asarray(numbers[one.name], u.dtype) for one in term.inner]
            value = term(jnp.where(self.present[k], u, jnp.ones_like(u)), *inner)
            columns.append(jnp.where(self.present[k], value, jnp.zeros_like(value)))
        return jnp.stack(columns, axis=-1)

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        return self.features(u) @ self.coefficients.astype(u.dtype)

    def chosen(self) -> "ClosedForm":
        """A copy without absent terms."""
        kept = np.flatnonzero(np.asarray(self.present))
        terms = tuple(self.terms[k] for k in kept)
        places = [inner_of(self.terms).index(one) for one in inner_of(terms)]
        return ClosedForm(self.coefficients[kept], self.present[kept], terms, self.inner[np.array(places, int)])

    def expressions(self, *symbols: sympy.Symbol) -> tuple[sympy.Expr, ...]:
        """The law of each output in symbols of the inputs, for reading or for the equations of a component."""
        numbers = {name: sympy.Float(float(value)) for name, value in self.numbers.items()}
        parts = [
            [sympy.Float(float(c)) * e for e in term.expressions(symbols, *(numbers[one.name] for one in term.inner))]
            for c, term, is_in in zip(self.coefficients, self.terms, np.asarray(self.present), strict=True)
            if is_in
        ]
        return tuple(sympy.Add(*column) for column in zip(*parts, strict=True))
