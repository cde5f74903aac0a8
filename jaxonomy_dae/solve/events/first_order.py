"""Constants of first derivatives that would not be constants of second ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from ...base.aliases import PyTree
from ...base.errors import ModelError


def constant_once(tree: PyTree) -> PyTree:
    """The tree with its inexact arrays constant under a first derivative. A second derivative raises an error.

    The map of an event takes slopes as constants. Its first derivative is exact, its second one is not.
    """
    return jax.tree.map(lambda leaf: _constant(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


@jax.custom_jvp
def _constant(value):
    return value


@_constant.defjvp
def _(primals, tangents):
    (value,) = primals
    return _not_again(value), jnp.zeros_like(value)


@jax.custom_jvp
def differentiable_once(value):
    """Returns the array. Its first derivative is taken as usual; a second derivative raises an error."""
    return value


@differentiable_once.defjvp
def _(primals, tangents):
    (value,), (tangent,) = primals, tangents
    # A tangent does not depend on the value, so that a second derivative would be zero without a word. The factor,
    # which is one, refuses it.
    return differentiable_once(value), tangent * _one(value)


@jax.custom_jvp
def _not_again(value):
    return value


@jax.custom_jvp
def _one(value):
    return jnp.ones_like(value)


def _refused(primals, tangents):
    (value,), (tangent,) = primals, tangents
    if not isinstance(tangent, SymbolicZero):
        raise ModelError(
            "second derivatives through events are not computed: the map of an event is exact to first order. Take "
            "differences of gradients; or, if the events are relations in equations, leave these alone with smooth(...)"
        )
    return value, jnp.zeros_like(value)


def _refused_one(primals, tangents):
    return _refused((jnp.ones_like(primals[0]),), tangents)


# With zeros as arrays, as JAX hands them over by default, forward mode over reverse mode would be refused even where
# nothing of the event moves.
_not_again.defjvp(_refused, symbolic_zeros=True)
_one.defjvp(_refused_one, symbolic_zeros=True)
