"""Closed laws: linear combinations of terms, in the place of a network."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import sympy
from jaxtyping import Array, Bool, Float

from ..model.opaque import AbstractReplacement
from .term import AbstractTerm


class ClosedForm(AbstractReplacement):
    """f(u) = Σ c·φ(u) over terms φ, of shape `(outputs,)`.

    - `coefficients`: c, trained.
    - `present`: which terms count. It is an array, and so an argument of compiled programs: with another choice,
        nothing is compiled. What is absent is not evaluated at u, where it may be infinite, but at 1.
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
        """A copy without the terms that are absent."""
        kept = np.flatnonzero(np.asarray(self.present))
        return ClosedForm(self.coefficients[kept], self.present[kept], tuple(self.terms[k] for k in kept))

    def expressions(self, *symbols: sympy.Symbol) -> tuple[sympy.Expr, ...]:
        """The law of each output in symbols of the inputs: to be written into a component's equations, or read."""
        parts = [
            [sympy.Float(float(c)) * e for e in term.expressions(symbols)]
            for c, term, is_in in zip(self.coefficients, self.terms, np.asarray(self.present), strict=True)
            if is_in
        ]
        return tuple(sympy.Add(*column) for column in zip(*parts, strict=True))
