"""Functions of time as inputs: two of one form share a program, whatever rules for derivatives they have.

Kind of defect: JAX makes the rules of a function such as `jax.nn.relu` anew whenever it is traced, and they were
compared as objects, so that every call of `simulate` compiled a program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from problems import slow

from jaxonomy_dae.run.system.closed_function import closed_function


def with_jvp(slope):
    @jax.custom_jvp
    def f(x):
        return jnp.sin(x)

    @f.defjvp
    def _(primals, tangents):
        return f(primals[0]), slope(primals[0]) * tangents[0]

    return f


def with_vjp(slope):
    @jax.custom_vjp
    def f(x):
        return jnp.sin(x)

    f.defvjp(lambda x: (f(x), x), lambda x, c: (slope(x) * c,))
    return f


ALIKE = {
    "relu": lambda: lambda t: jax.nn.relu(t - 1),
    "relu of relu": lambda: lambda t: jax.nn.relu(2 - jax.nn.relu(t - 1)),
    "softplus": lambda: lambda t: jax.nn.softplus(t) * jax.nn.gelu(t),
    "own forward rule": lambda: with_jvp(lambda x: jnp.cos(x)),
    "own backward rule": lambda: with_vjp(lambda x: jnp.cos(x)),
    "a check": lambda: lambda t: eqx.error_if(t * t, t > 10, "too late"),
    "checks within checks": lambda: lambda t: eqx.error_if(jax.nn.relu(eqx.error_if(t, t > 3, "a")), t > 4, "b"),
    "branches": lambda: lambda t: jax.lax.cond(t > 1, jax.nn.relu, jnp.sin, t),
}


@pytest.mark.parametrize("name", slow(ALIKE, "a check", "checks within checks"))
def test_functions_that_are_written_anew_are_one_program(name):
    one, other = (closed_function(ALIKE[name](), jnp.result_type(float)) for _ in range(2))
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert hash(jax.tree.structure(one)) == hash(jax.tree.structure(other))


@pytest.mark.parametrize("check", [lambda t: t > 3, lambda t: t < 3])
def test_functions_whose_checks_differ_are_two(check):
    """Kind: keys that nest too deep to be compared. Functions with a check were never equal, and each call compiled."""
    one = closed_function(lambda t: eqx.error_if(t, t > 3, "a"), jnp.result_type(float))
    other = closed_function(lambda t: eqx.error_if(t, check(t), "b" if check(4.0) else "a"), jnp.result_type(float))
    assert jax.tree.structure(one) != jax.tree.structure(other)


@pytest.mark.parametrize("kind", [with_jvp, with_vjp])
def test_functions_that_differ_in_their_derivatives_alone_are_two(kind):
    one, other = (closed_function(kind(s), jnp.result_type(float)) for s in (jnp.cos, lambda x: 3.0 * jnp.cos(x)))
    assert jax.tree.structure(one) != jax.tree.structure(other)
    assert jax.grad(one)(0.0) == 1.0 and jax.grad(other)(0.0) == 3.0
